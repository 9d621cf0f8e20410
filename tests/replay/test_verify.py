"""A log is what the simulator computes, to the last bit, or `verify` says where it is not."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from hiersched.experiments import files, logged
from hiersched.experiments.gains import design_gains, designs
from hiersched.experiments.logged import load_run
from hiersched.experiments.points import experiments, logged_delays
from hiersched.experiments.run import run_experiment
from hiersched.experiments.worlds import untrained_policies
from hiersched.log import TOPICS, LogError, LogReader, LogWriter
from hiersched.replay.verify import expand, verify
from hiersched.scenario import Scenario
from hiersched.study.metrics import measured_row

FULL = "runs/evaluate/edf/seed12.mcap"
EVALUATED = ("ddpg", "flat", "aware", "pf", "edf", "drift_plus_penalty")
SWEEP = "runs/reference/arc/ddpg/seed21.mcap"
TOPIC_OF = {field.name: name for name, topic in TOPICS.items() for field in topic.fields}


def test_every_log_of_a_study_is_what_the_simulator_computes(study: Path) -> None:
    logs = sorted(study.rglob("*.mcap"))
    stages = {}
    for path in logs:
        run = load_run(path)
        stages.setdefault((run.stage, run.policy), 0)
        stages[run.stage, run.policy] += 1
        assert verify(run) is None, path
    assert stages == {
        ("train", "ddpg"): 1,
        ("train", "flat"): 1,
        ("train", "aware"): 1,
        ("checkpoint", "ddpg"): 1,
        ("checkpoint", "flat"): 1,
        ("checkpoint", "aware"): 1,
        **{("evaluate", policy): 2 for policy in EVALUATED},
        **{("sweep", policy): 2 for policy in ("ddpg", "pf")},
        **{("generalise", policy): 1 for policy in ("ddpg", "pf")},
        ("gain_study", "none"): 2 + 5,  # nominal on both plants, five methods
    }


def test_a_log_says_what_its_weights_are_factors_of(
    study: Path, tmp_path: Path, rewrite: Any
) -> None:
    path = study / "runs/evaluate/aware/seed11.mcap"
    assert load_run(path).metadata["weighs"] == "drift"

    def change(fields: dict[str, Any], events: list, metadata: dict) -> None:
        metadata["weighs"] = "speed"

    with pytest.raises(ValueError, match="weighs = 'speed' with the allocation 'lagrangian'"):
        verify(load_run(rewrite(path, tmp_path / "log.mcap", change)))


def test_batches_are_the_same_run(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """However a long log is cut."""
    monkeypatch.setattr(logged, "BATCH_SLOTS", 7)
    seen: list[int] = []
    training = "train/ddpg/seed1.mcap", "train/ddpg/checkpoints_seed1.mcap"
    for name in (FULL, *training, "runs/gain_study/krasovskii/adjusted/seed31.mcap"):
        run = load_run(study / name)
        assert sum(batch.num_envs * batch.num_slots for batch in run.batches()) == run.num_slots
        assert len(list(run.batches())) >= 4
        assert verify(run, lambda batch, record: seen.append(batch.stop_slot)) is None
        assert seen[-1] == run.num_slots


def flip(field: str, slot: int, bit: int) -> Callable[[dict, list, dict], None]:
    def change(fields: dict[str, Any], events: list, metadata: dict) -> None:
        values = fields[field] = fields[field].copy()
        rows = values.reshape(len(values), -1)
        index = rows.shape[1] // 2
        view = rows[slot, index : index + 1].view(np.uint8)
        view[bit // 8] ^= 1 << bit % 8

    return change


@pytest.mark.parametrize("name", [FULL, "train/ddpg/seed1.mcap", SWEEP])
def test_one_changed_bit_is_caught_with_slot_and_field(
    name: str, study: Path, tmp_path: Path, rewrite: Any
) -> None:
    with LogReader(study / name) as log:
        fields = [field for topic in log.topics for field in log.read(topic, None, 0, 0)]
    # Decisions of learned policies are what the log alone knows: owners or weights.
    taken = {"slot"} if name == FULL else {"slot", "prb_owner" if "train" in name else "weight"}
    for number, field in enumerate(field for field in fields if field not in taken):
        slot = (14 if "reference" not in name else 1) + number % 9
        path = rewrite(study / name, tmp_path / "a.mcap", flip(field, slot, number % 32))
        found = verify(load_run(path))
        assert found is not None, field
        assert (found.slot, found.topic, found.field.split("[")[0]) == (
            slot, TOPIC_OF[field], field,
        )  # fmt: skip
        assert found.logged != found.computed or np.isnan(found.logged)
        assert f"slot {slot}, topic {TOPIC_OF[field]}, field {field}" in str(found)


def test_the_first_of_two_changes_is_named(study: Path, tmp_path: Path, rewrite: Any) -> None:
    def change(*arguments: Any) -> None:
        flip("drift_embb", 22, 3)(*arguments)
        flip("state", 9, 0)(*arguments)
        flip("reward_embb", 9, 0)(*arguments)

    found = verify(load_run(rewrite(study / FULL, tmp_path / "a.mcap", change)))
    assert found is not None
    assert (found.slot, found.topic, found.field) == (9, "/delay", "reward_embb")


def test_forced_delays_come_from_the_seed_too(study: Path, tmp_path: Path, rewrite: Any) -> None:
    name = "runs/gain_study/krasovskii/adjusted/seed31.mcap"
    assert expand(load_run(study / name), tmp_path / "full.mcap") is None
    for log, field in (
        (study / name, "delay_steps"),
        (tmp_path / "full.mcap", "network_delay_s"),
        (tmp_path / "full.mcap", "state"),
    ):
        path = rewrite(log, tmp_path / "a.mcap", flip(field, 17, 2))
        found = verify(load_run(path))
        assert found is not None
        assert (found.slot, found.field.split("[")[0]) == (17, field)


def test_delays_of_a_gain_sweep_are_drawn_again(
    small: Scenario, study: Path, tmp_path: Path
) -> None:
    """Each point has delays of its own."""
    study_of = replace(
        small.gain_study, weight=(700.0,), fixed_delay_s=(0.02, 0.04), sweep_robots=2,
        noise_position_m=(0.0, 0.01), noise_heading_rad=(0.0, 0.02),
    )  # fmt: skip
    fast = replace(small, gain_study=study_of)
    for design in designs(fast):
        design_gains(fast, design, tmp_path / files.gain_file(design))
    names = ("gain_grid", "gain_noise")
    for name in names:
        run_experiment(fast, tmp_path, name, "gains", untrained_policies, measured_row)
    logs = [path for name in names for path in sorted((tmp_path / "runs" / name).rglob("*.mcap"))]
    assert len(logs) == 4 + 4
    for path in logs:
        assert verify(load_run(path)) is None, path
        run = load_run(path)
        without = {key: value for key, value in run.metadata.items() if key != "delays"}
        # Logs of release 0.1 carry no delays: they follow from the point.
        assert logged_delays(run.scenario, without) == logged_delays(run.scenario, run.metadata)
    (low, high) = (p.delays for p in experiments(fast)["gain_grid"].points)
    assert low is not None
    assert high is not None
    assert (low.violation_s, high.violation_s) == ((0.02, 0.02), (0.04, 0.04))


def test_owners_that_nobody_can_decide_are_refused(
    study: Path, tmp_path: Path, rewrite: Any
) -> None:
    def change(fields: dict[str, Any], events: list, metadata: dict) -> None:
        fields["prb_owner"][13] = 2

    path = rewrite(study / "train/ddpg/seed1.mcap", tmp_path / "a.mcap", change)
    with pytest.raises(ValueError, match="every user 0 to 3 must own a PRB"):
        verify(load_run(path))


def test_owners_decide_what_follows(study: Path, tmp_path: Path, rewrite: Any) -> None:
    """Of a log of decisions, another owner shows in the reward of the slot."""

    def change(fields: dict[str, Any], events: list, metadata: dict) -> None:
        owner = fields["prb_owner"][13]
        first = int(np.flatnonzero(np.bincount(owner, minlength=4) > 1)[0])
        owner[np.flatnonzero(owner == first)[0]] = (first + 1) % 4

    path = rewrite(study / "train/ddpg/seed1.mcap", tmp_path / "a.mcap", change)
    found = verify(load_run(path))
    assert found is not None
    assert (found.slot, found.topic) == (13, "/delay")


def test_events_are_computed_too(study: Path, tmp_path: Path, rewrite: Any) -> None:
    with LogReader(study / FULL) as log:
        count = len(log.events())
    assert count > 1

    def another_text(fields: dict, events: list, metadata: dict) -> None:
        events[1] = events[1]._replace(message="all is well")

    def one_less(fields: dict, events: list, metadata: dict) -> None:
        del events[-1]

    found = verify(load_run(rewrite(study / FULL, tmp_path / "a.mcap", another_text)))
    assert found is not None
    assert (found.topic, found.field, found.logged) == ("/events", "message", "all is well")
    found = verify(load_run(rewrite(study / FULL, tmp_path / "b.mcap", one_less)))
    assert found is not None
    assert (found.field, found.logged, found.computed) == ("number", count - 1, count)


def test_another_seed_is_another_world(study: Path, tmp_path: Path, rewrite: Any) -> None:
    path = rewrite(study / FULL, tmp_path / "a.mcap", lambda f, e, m: m.update(seed="13"))
    found = verify(load_run(path))
    assert found is not None
    assert (found.slot, found.topic, found.field) == (0, "/channel", "fading_power[0,0]")


def test_logs_that_cannot_be_run_again_say_why(study: Path, tmp_path: Path, rewrite: Any) -> None:
    cases = [
        (
            lambda f, e, m: m.update(stage="demo"),
            "its stage is 'demo'; allowed: train, checkpoint, evaluate",
        ),
        (lambda f, e, m: m.pop("policy"), "it has no policy"),
        (lambda f, e, m: m.update(scenario_sha256="0"), "the attached scenario is not the one"),
        (lambda f, e, m: m.update(seed="one"), "invalid literal"),
    ]
    for change, message in cases:
        path = rewrite(study / FULL, tmp_path / "a.mcap", change)
        with pytest.raises(LogError, match=f"cannot be run again: {message}"):
            load_run(path)
    with LogReader(study / FULL) as log:
        part = {k: v for t in log.topics for k, v in log.read(t, None, 3, 9).items() if k != "slot"}
        with LogWriter(tmp_path / "b.mcap", log.dims, slot_ns=log.slot_ns) as writer:
            writer.write_block(3, part)
    with pytest.raises(LogError, match="does not have all slots from 0 on"):
        load_run(tmp_path / "b.mcap")


def test_a_log_of_an_older_version_is_computed_with_todays_defaults(
    study: Path, tmp_path: Path, project_root: Path, rewrite: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Keys that came later are named; whether their defaults are right, the bits say."""
    monkeypatch.chdir(project_root)
    old = yaml.safe_load(load_run(study / FULL).attachments["scenario.yaml"])
    del old["log"]["chunk_bytes"], old["bound"]
    text = json.dumps(old, sort_keys=True, separators=(",", ":"))

    def change(fields: dict[str, Any], events: list, metadata: dict) -> None:
        metadata["scenario_sha256"] = hashlib.sha256(text.encode()).hexdigest()

    attached = {"scenario.yaml": yaml.safe_dump(old).encode()}
    path = rewrite(study / FULL, tmp_path / "old.mcap", change, attached)
    run = load_run(path)
    assert set(run.added_keys) == {"log.chunk_bytes", "bound.slots_per_log"}
    assert verify(run) is None
