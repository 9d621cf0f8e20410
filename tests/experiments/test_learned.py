"""Training and the learned policy: every slot is logged, and an interruption changes no bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hiersched.core.randomness import world_keys
from hiersched.experiments import files
from hiersched.experiments import train as stage
from hiersched.experiments.gains import load_gains
from hiersched.experiments.learned import learned_policies
from hiersched.experiments.logging import RunLabel
from hiersched.experiments.points import experiments
from hiersched.experiments.run import run_experiment, slots_of
from hiersched.experiments.train import train_and_log
from hiersched.experiments.worlds import run_worlds, seed_worlds
from hiersched.log import LogReader
from hiersched.policies.trained import TrainedPolicy
from hiersched.scenario import Scenario
from hiersched.scenario.schema import checkpoint_rounds
from hiersched.simulator import Simulator
from hiersched.simulator.loop_gains import Gains
from hiersched.study import measure
from hiersched.study.metrics import measured_row, metrics_row, run_metrics

Run = Callable[..., None]
EPISODES, SLOTS = 6, 10


def fields_of(path: Path) -> dict[str, np.ndarray]:
    """All fields of a log."""
    with LogReader(path) as log:
        return {k: v for topic in log.topics for k, v in log.read(topic).items() if k != "slot"}


@pytest.fixture(scope="module")
def trained(tiny: Scenario, designed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    results = tmp_path_factory.mktemp("trained")
    (results / "gains").symlink_to(designed / "gains")
    train_and_log(tiny, "ddpg", results, "code", show=False)
    return results


def test_every_slot_of_training_is_logged(tiny: Scenario, trained: Path) -> None:
    for seed in tiny.learning.seeds:
        with LogReader(trained / files.training_log("ddpg", seed)) as log:
            assert log.num_slots == EPISODES * SLOTS
            queue = log.read("/queue")
            assert log.metadata["seed"] == str(seed)
            assert log.metadata["slots_per_episode"] == str(SLOTS)
            weights = log.attachments[f"policy_seed{seed}.json"]
        assert (queue["slot"] == np.arange(EPISODES * SLOTS)).all()
        backlog = queue["backlog_packets"].reshape(EPISODES, SLOTS, -1)
        assert (backlog[:, 0] == 0).all()  # every episode starts with empty queues
        after = np.maximum(
            0.0, queue["backlog_packets"] + queue["arrivals_packets"] - queue["service_packets"]
        ).reshape(backlog.shape)
        assert np.array_equal(after[:, :-1], backlog[:, 1:])
        assert weights == (trained / f"train/ddpg/policy_seed{seed}.json").read_bytes()
    assert (trained / files.progress_file("ddpg")).stat().st_size > 0
    assert not (trained / files.CHECKPOINTS / "ddpg").exists()


def test_checkpoints_run_in_the_same_worlds_without_noise(tiny: Scenario, trained: Path) -> None:
    """The start is PF for every seed; training moves on from it, in the very same worlds."""
    logs = [fields_of(trained / files.checkpoint_log("ddpg", seed)) for seed in (1, 2)]
    worlds = tiny.learning.checkpoint_worlds
    shape = (len(checkpoint_rounds(tiny.learning)), worlds, SLOTS, -1)
    assert shape[0] == 4  # the start and three rounds
    for name in ("mean_fading_power", "weight", "backlog_packets"):
        first, second = (fields[name].reshape(shape) for fields in logs)
        np.testing.assert_array_equal(first[0], second[0])
    for fields in logs:
        assert (fields["weight"].reshape(shape)[0] == 1.0).all()
        fading = fields["mean_fading_power"].reshape(shape)
        np.testing.assert_array_equal(fading, np.broadcast_to(fading[:1], fading.shape))
        assert len(np.unique(fading[0, :, 0, 0])) == worlds


def test_a_frozen_learner_stays_as_it_starts(tiny: Scenario, results: Path) -> None:
    """Its policy is the scheduler it starts from; in training it has the noise, which falls."""
    for algorithm, start in (("ddpg", "pf"), ("a2c", "drift_plus_penalty")):
        frozen = replace(tiny.learning, frozen=True, algorithm=algorithm, start=start)
        scenario = replace(tiny, learners={"frozen": frozen})
        train_and_log(scenario, "frozen", results, "code", show=False)
        fixed, noisy = (
            fields_of(results / f"train/frozen/{name}seed1.mcap") for name in ("checkpoints_", "")
        )
        assert (fixed["weight"] == 1.0).all()
        spread = np.log(noisy["weight"]).reshape(3, -1).std(axis=1)
        assert (np.diff(spread) < 0.0).all()
        loop = Simulator(
            scenario,
            load_gains(results / "gains/schedule.json", scenario)[1],
            world_keys("checkpoint", 0, 1),
            SLOTS,
        )
        record = loop.run(start)
        np.testing.assert_array_equal(fixed["rate_mbps"][:SLOTS], record.rate_mbps[0])
        policy = TrainedPolicy.load(results / "train/frozen/policy_seed1.json")
        loop.reset(world_keys("checkpoint", 0, 1))
        np.testing.assert_array_equal(loop.run(policy).weight, 1.0)


def test_a_training_without_logs_learns_the_same_and_shows_its_rounds(
    tiny: Scenario, trained: Path, results: Path
) -> None:
    """Means of rounds from the progress file against those of the logged episodes."""
    bare = replace(tiny, log=replace(tiny.log, train_profile="none"))
    train_and_log(bare, "ddpg", results, "code", show=False)
    found = sorted(path.name for path in (results / "train/ddpg").glob("*.mcap"))
    assert found == ["checkpoints_seed1.mcap", "checkpoints_seed2.mcap"]
    for name in files.policy_files(tiny, "ddpg"):
        a, b = TrainedPolicy.load(results / name), TrainedPolicy.load(trained / name)
        assert np.array_equal(a.parameters, b.parameters)
    with LogReader(results / files.checkpoint_log("ddpg", 1)) as log:
        assert log.profile == "decisions"
    rounds = measure._training_episodes(results, bare, "ddpg")
    logged = measure._training_episodes(trained, tiny, "ddpg")
    assert list(rounds) == list(logged)
    number = (logged["episode"] + 1) // tiny.learning.num_envs
    means = logged.groupby(["seed", number]).mean(numeric_only=True)
    for column in ("urllc_reward", "embb_reward", "urllc_backlog_packets", "embb_backlog_packets"):
        np.testing.assert_allclose(rounds[column], means[column], rtol=1e-6)
    assert rounds["seed"].tolist() == [1, 1, 1, 2, 2, 2]
    assert rounds["episode"].tolist() == [2, 4, 6] * 2


class InterruptedRunError(Exception):
    pass


def test_an_interrupted_training_ends_in_the_same_bits(
    tiny: Scenario, trained: Path, results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add = stage.RoundLogs.add
    calls = []

    def add_then_stop(self: stage.RoundLogs, seed_index: int, fields: dict) -> None:
        add(self, seed_index, fields)
        calls.append(seed_index)
        # 2 seeds of 8 worlds at the start, 2 of 2 episodes, 2 of 8 worlds, then in the second round
        if len(calls) == 16 + 4 + 16 + 2:
            raise InterruptedRunError

    monkeypatch.setattr(stage.RoundLogs, "add", add_then_stop)
    with pytest.raises(InterruptedRunError):
        train_and_log(tiny, "ddpg", results, "code", show=False)
    assert not list((results / "train/ddpg").glob("*.mcap"))  # nothing looks complete
    monkeypatch.setattr(stage.RoundLogs, "add", add)
    train_and_log(tiny, "ddpg", results, "code", show=False)
    for name in files.learner_logs(tiny, "ddpg"):
        assert (results / name).read_bytes() == (trained / name).read_bytes()
    for name in files.policy_files(tiny, "ddpg"):
        a, b = TrainedPolicy.load(results / name), TrainedPolicy.load(trained / name)
        assert np.array_equal(a.parameters, b.parameters)


def test_a_checkpoint_of_other_code_is_not_used(
    tiny: Scenario, results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = results / files.CHECKPOINTS / "ddpg/0_other"
    folder.mkdir(parents=True)
    (folder / "training.pt").write_bytes(b"no checkpoint")
    seen = []
    monkeypatch.setattr(stage, "train", lambda *_, **given: seen.append(given["checkpoint"]) or ())
    train_and_log(tiny, "ddpg", results, "code", show=False)
    assert not folder.exists()
    assert seen[0].name == "training.pt"
    assert seen[0].parent != folder


@pytest.fixture
def policies(tiny: Scenario, trained: Path, tmp_path: Path) -> list[Path]:
    """Policies that differ: so short a training leaves the actors where they began."""
    written = []
    for place, name in enumerate(files.policy_files(tiny, "ddpg")):
        policy = TrainedPolicy.load(trained / name)
        rng = np.random.default_rng(place)
        parameters = rng.normal(0.0, 0.5, policy.parameters.shape).astype(np.float32)
        written.append(tmp_path / Path(name).name)
        replace(policy, parameters=parameters).save(written[-1])
    return written


def test_world_i_runs_the_policy_of_training_seed_i(
    tiny: Scenario, policies: list[Path], results: Path, run: Run
) -> None:
    run(tiny, "evaluate", "ddpg", learned_policies(policies))
    _, gains = load_gains(results / "gains/schedule.json", tiny)
    for index, seed in enumerate(tiny.evaluate.seeds):
        file = policies[index % 2]
        simulator = Simulator(tiny, gains, seed_worlds("evaluate", [seed]), 20)
        expected = simulator.run(TrainedPolicy.load(file)).environment(0)
        with LogReader(results / f"runs/evaluate/ddpg/seed{seed}.mcap") as log:
            assert log.metadata["policy_seed"] == str(tiny.learning.seeds[index % 2])
            assert log.attachments[file.name] == file.read_bytes()
            logged = log.read("/allocation")
        for name in ("prb_owner", "weight"):
            assert np.array_equal(logged[name], expected[name])
        assert len(np.unique(logged["weight"])) > 2


def test_every_policy_runs_in_every_world_and_one_a_world_is_logged(
    tiny: Scenario, policies: list[Path], results: Path, run: Run, tmp_path: Path
) -> None:
    """The others are measured as their logs would be."""
    run(tiny, "evaluate", "ddpg", learned_policies(policies))
    rows = pd.read_parquet(results / "runs/evaluate/ddpg/crossed.parquet")
    rows = rows.set_index(["policy_seed", "seed"])
    assert sorted(rows.index) == [(1, 12), (2, 11), (2, 13)]
    (tmp_path / "alone/gains").parent.mkdir()
    (tmp_path / "alone/gains").symlink_to(results / "gains")
    for index, file in enumerate(policies):
        for place, seed in enumerate(tiny.evaluate.seeds):
            one = replace(
                tiny,
                evaluate=replace(tiny.evaluate, seeds=(seed,)),
                learning=replace(tiny.learning, seeds=(index + 1,)),
            )
            source = learned_policies([file])
            run_experiment(one, tmp_path / "alone", "evaluate", "ddpg", source, measured_row)
            log = tmp_path / f"alone/runs/evaluate/ddpg/seed{seed}.mcap"
            if place % 2 == index:
                own = fields_of(results / f"runs/evaluate/ddpg/seed{seed}.mcap")
                for name, values in fields_of(log).items():
                    np.testing.assert_array_equal(own[name], values, err_msg=name)
                continue
            expected = metrics_row(run_metrics(log, tiny), tiny)
            got = rows.loc[(index + 1, seed)]
            assert len(expected.keys() & set(got.index)) > 20
            for name, value in expected.items():
                if isinstance(value, float) and name in got:
                    assert got[name] == value or (np.isnan(got[name]) and np.isnan(value)), name
    assert rows["urllc_rate_mbps"].nunique() == 3


@pytest.mark.parametrize("profile", ["full", "compact", "decisions"])
def test_measures_in_memory_are_those_of_the_log(
    tiny: Scenario, policies: list[Path], results: Path, run: Run, profile: str
) -> None:
    logging = replace(tiny.log, evaluate_profile=profile)
    scenario = replace(tiny, log=logging, evaluate=replace(tiny.evaluate, warmup_s=0.05))
    run(scenario, "evaluate", "ddpg", learned_policies(policies))
    _, gains = load_gains(results / "gains/schedule.json", scenario)
    runnables = learned_policies(policies)(scenario, "ddpg")
    worlds = list(run_worlds(scenario, gains, runnables, "evaluate", (11, 12, 13), 25))
    assert [(world.seed, world.logged) for world in worlds] == [
        *((11, True), (12, False), (13, True)),
        *((11, False), (12, True), (13, False)),
    ]
    label = RunLabel(stage="evaluate", policy="ddpg", seed=11)
    first = replace(worlds[0], metadata={**worlds[0].metadata, "warmup_slots": "5"})
    in_memory = measured_row(slots_of(scenario, label, first), scenario)
    path = results / "runs/evaluate/ddpg/seed11.mcap"
    logged = metrics_row(run_metrics(path, scenario), scenario)
    assert str(in_memory) == str(logged)  # NaN is NaN


def test_sweeps_and_cells_are_crossed_too(
    tiny: Scenario, policies: list[Path], results: Path, run: Run
) -> None:
    source = learned_policies(policies)
    run(tiny, "rayleigh_scale", "ddpg", source)
    run(tiny, "generalise", "ddpg", source)
    names = {
        name
        for experiment in ("rayleigh_scale", "generalise")
        for name in files.group_files(tiny, experiments(tiny)[experiment], "ddpg")
    }
    assert names == {
        str(path.relative_to(results)) for path in (results / "runs").rglob("*.*t")
    } | {str(path.relative_to(results)) for path in (results / "runs").rglob("*.mcap")}
    for value in ("0.5", "1"):
        table = pd.read_parquet(results / f"runs/rayleigh_scale/{value}/ddpg/crossed.parquet")
        places = table[["policy_seed", "seed", "stage", "axis", "value"]].to_numpy().tolist()
        assert places == [[2, 21, "sweep", "rayleigh_scale", value]]
    table = pd.read_parquet(results / "runs/generalise/u1_e3_k6/ddpg/crossed.parquet")
    assert table[["policy_seed", "seed"]].to_numpy().tolist() == [[1, 42], [2, 41]]


def test_what_is_no_longer_asked_for_disappears(
    tiny: Scenario, policies: list[Path], results: Path, run: Run
) -> None:
    """Of this group: logs and measures of other values; other policies' stay."""
    run(tiny, "rayleigh_scale", "ddpg", learned_policies(policies))
    run(tiny, "rayleigh_scale")
    axes = dict(tiny.sweeps.axes)
    axes["rayleigh_scale"] = replace(axes["rayleigh_scale"], vary={"radio.fading.scale": (1.0,)})
    fewer = replace(tiny, sweeps=replace(tiny.sweeps, axes=axes))
    kept = {"1/ddpg/seed21.mcap", "1/ddpg/crossed.parquet", "1/pf/seed21.mcap"}

    def left() -> set[str]:
        folder = results / "runs/rayleigh_scale"
        return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}

    run(fewer, "rayleigh_scale", "ddpg", learned_policies(policies))
    assert left() == kept | {"0.5/pf/seed21.mcap"}
    run(fewer, "rayleigh_scale")
    assert left() == kept


def test_fewer_worlds_than_policies(tiny: Scenario, trained: Path) -> None:
    source = learned_policies([trained / name for name in files.policy_files(tiny, "ddpg")])
    gains = Gains.memoryless(np.zeros((tiny.max_delay_steps + 1, 2, 5)))
    runs = run_worlds(tiny, gains, source(tiny, "ddpg"), "evaluate", (5,), 2)
    assert [(run.seed, run.logged) for run in runs] == [(5, True), (5, False)]
