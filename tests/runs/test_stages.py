"""Every stage: the logs hold what the simulator computes, and say what they are."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hiersched.runs.evaluate import evaluate
from hiersched.runs.gain_study import forced_delays, gain_study, gain_sweep
from hiersched.runs.gains import design_gains, load_gains
from hiersched.runs.policies import seed_worlds, untrained_policies
from hiersched.runs.sweep import sweep

from hiersched.core.randomness import world_key
from hiersched.log import LogReader
from hiersched.runs import paths
from hiersched.scenario import Scenario, load_scenario, scenario_sha256
from hiersched.simulator import Simulator


def fields_of(path: Path) -> dict[str, np.ndarray]:
    with LogReader(path) as log:
        return {name: value for topic in log.topics for name, value in log.read(topic).items()}


def test_evaluation_logs_hold_what_one_world_computes(tiny: Scenario, results: Path) -> None:
    """The batch of worlds, cut apart and logged, is each world on its own."""
    evaluate(tiny, results, "classical", untrained_policies)
    _, gains = load_gains(results / "gains/schedule.json", tiny)
    for policy in ("pf", "edf"):
        for seed in tiny.evaluate.seeds:
            key = np.array([world_key("evaluate", seed)], np.uint64)
            record = Simulator(tiny, gains, key, 20).run(policy).environment(0)
            logged = fields_of(results / "eval" / policy / f"seed{seed}.mcap")
            assert record.pop("model_values").shape == (20, 0)  # its models add nothing
            for name, value in record.items():
                assert np.array_equal(logged[name], value), name
    a, b = (fields_of(results / "eval" / policy / "seed11.mcap") for policy in ("pf", "edf"))
    assert np.array_equal(a["fading_power"], b["fading_power"])
    assert not np.array_equal(a["prb_owner"], b["prb_owner"])


def test_a_log_says_what_it_is(
    tiny: Scenario, results: Path, project_root: Path, tmp_path: Path
) -> None:
    evaluate(tiny, results, "classical", untrained_policies)
    with LogReader(results / "eval/edf/seed12.mcap") as log:
        metadata, attachments, profile = log.metadata, log.attachments, log.profile
    assert profile == "full"
    wanted = {
        "scenario": "tiny",
        "scenario_sha256": scenario_sha256(tiny),
        "seed": "12",
        "policy": "edf",
        "stage": "evaluate",
        "axis": "",
        "value": "",
    }
    assert wanted.items() <= metadata.items()
    (tmp_path / "tiny.yaml").write_bytes(attachments["scenario.yaml"])
    attached = load_scenario(
        tmp_path / "tiny.yaml", defaults=project_root / "src/hiersched/config" / "defaults.yaml"
    )
    assert attached == tiny
    schedule = json.loads((results / "gains/schedule.json").read_text(encoding="utf-8"))
    assert json.loads(attachments["schedule.json"]) == schedule


def test_logs_of_seeds_no_longer_asked_for_disappear(tiny: Scenario, results: Path) -> None:
    old = results / "eval/pf/seed99.mcap"
    old.parent.mkdir(parents=True)
    old.write_bytes(b"old")
    evaluate(tiny, results, "classical", untrained_policies)
    assert sorted(path.name for path in old.parent.iterdir()) == [
        "seed11.mcap",
        "seed12.mcap",
        "seed13.mcap",
    ]


@pytest.mark.parametrize("axis", ["rayleigh_scale", "sampling_s", "reference", "load"])
def test_a_sweep_writes_every_point(tiny: Scenario, results: Path, axis: str) -> None:
    sweep(tiny, results, axis, "classical", untrained_policies)
    for name in paths.sweep_logs(tiny, axis, "classical"):
        with LogReader(results / name) as log:
            assert log.num_slots == 10
            assert log.metadata["axis"] == axis
            assert f"{log.metadata['value']}_seed21.mcap" == Path(name).name
            assert log.profile == "compact"


def test_the_fading_scale_of_a_sweep_scales_the_fading(tiny: Scenario, results: Path) -> None:
    sweep(tiny, results, "rayleigh_scale", "classical", untrained_policies)
    half, one = (
        fields_of(results / f"sweep/rayleigh_scale/pf/{value}_seed21.mcap")["mean_fading_power"]
        for value in ("0.5", "1")
    )
    assert np.allclose(4.0 * half, one, rtol=1e-6)


def test_gains_of_another_design_are_refused(tiny: Scenario, results: Path) -> None:
    other = replace(tiny, control=replace(tiny.control, weight=100.0))
    with pytest.raises(ValueError, match="gains of another design"):
        load_gains(results / "gains/schedule.json", other)
    with pytest.raises(ValueError, match="design = 'schedule_1': must be one of schedule, "):
        design_gains(tiny, "schedule_1", results / "x.json")


def test_forced_delays_are_long_in_the_violation_windows(tiny: Scenario) -> None:
    keys = seed_worlds("gain_study", (31, 32))
    delays = forced_delays(tiny, keys, 300, 3)
    violation, calm = delays[:, 100:200], np.delete(delays, np.s_[100:200], axis=1)
    assert 0.08 <= violation.min() < 0.081 < 0.119 < violation.max() <= 0.12
    assert 0.005 <= calm.min() < 0.0052 < 0.0198 < calm.max() <= 0.02
    assert violation.mean() == pytest.approx(0.1, abs=2e-3)  # four standard errors
    assert np.array_equal(delays[1:], forced_delays(tiny, keys[1:], 300, 3))
    assert len(np.unique(delays)) == delays.size


def in_full(scenario: Scenario) -> Scenario:
    """The same with full logs, which have the robots' delays and controls."""
    return replace(scenario, log=replace(scenario.log, gain_study_profile="full"))


def test_gain_study_meets_the_same_delays_with_both_gains(tiny: Scenario, results: Path) -> None:
    gain_study(in_full(tiny), results)
    logs = {
        name.removeprefix("gain_study/"): fields_of(results / name)
        for name in paths.gain_study_logs(tiny)
    }
    first = logs["krasovskii_nominal_seed31.mcap"]["network_delay_s"]
    assert first.shape == (300, 3)
    for name, fields in logs.items():
        assert np.array_equal(fields["network_delay_s"], first) == name.endswith("seed31.mcap")
    with LogReader(results / "gain_study/razumikhin_adjusted_seed32.mcap") as log:
        assert log.metadata["gain"] == "adjusted"
        assert log.metadata["method"] == "razumikhin"
        assert b'"razumikhin"' in log.attachments["schedule.json"]


def test_a_gain_sweep_meets_the_delays_of_each_point(tiny: Scenario, results: Path) -> None:
    gain_sweep(in_full(tiny), results, "grid")
    logs = {
        Path(name).name: fields_of(results / name) for name in paths.gain_sweep_logs(tiny, "grid")
    }
    for name, fields in logs.items():
        weight, delay_s, *_ = name.removesuffix(".mcap").split("_")
        violated = fields["network_delay_s"][100:]
        assert np.array_equal(violated, np.full((100, 2), float(delay_s)))
        assert fields["network_delay_s"][:100].max() <= 0.02
        # Another weight is another loop in the same world and under the same calm delays.
        other = logs[name.replace(weight, "q900" if weight == "q700" else "q700")]
        assert np.array_equal(other["network_delay_s"], fields["network_delay_s"])
        assert not np.array_equal(other["state"], fields["state"])
    with LogReader(results / "gain_study/grid/q900_0.04_adjusted_seed31.mcap") as log:
        wanted = {"axis": "grid", "value": "q900_0.04", "stage": "gain_study", "gain": "adjusted"}
        assert wanted.items() <= log.metadata.items()


def test_the_noise_of_a_gain_sweep_is_in_force(tiny: Scenario, results: Path) -> None:
    gain_sweep(in_full(tiny), results, "noise")
    gain_sweep(in_full(tiny), results, "sampling_s")
    noisy, usual = (
        fields_of(results / paths.gain_sweep_log(axis, value, "nominal", 31))
        for axis, value in (("noise", "0_0.01"), ("sampling_s", "0.02"))
    )
    assert np.array_equal(noisy["network_delay_s"], usual["network_delay_s"])
    assert not np.array_equal(noisy["control"], usual["control"])
