"""Every experiment: the logs hold what the simulator computes, and say what they are."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hiersched.core.randomness import world_key
from hiersched.experiments import files
from hiersched.experiments.gains import design_gains, load_gains
from hiersched.experiments.points import experiments
from hiersched.log import LogReader
from hiersched.scenario import Scenario, load_scenario, scenario_sha256
from hiersched.simulator import Simulator

Run = Callable[..., None]


def fields_of(path: Path) -> dict[str, np.ndarray]:
    with LogReader(path) as log:
        return {name: value for topic in log.topics for name, value in log.read(topic).items()}


def test_evaluation_logs_hold_what_one_world_computes(
    tiny: Scenario, results: Path, run: Run
) -> None:
    """The batch of worlds, cut apart and logged, is each world on its own."""
    run(tiny, "evaluate")
    _, gains = load_gains(results / "gains/schedule.json", tiny)
    for policy in ("pf", "edf"):
        for seed in tiny.evaluate.seeds:
            key = np.array([world_key("evaluate", seed)], np.uint64)
            record = Simulator(tiny, gains, key, 20).run(policy).environment(0)
            logged = fields_of(results / f"runs/evaluate/{policy}/seed{seed}.mcap")
            assert record.pop("model_values").shape == (20, 0)  # its models add nothing
            for name, value in record.items():
                assert np.array_equal(logged[name], value), name
    a, b = (fields_of(results / f"runs/evaluate/{policy}/seed11.mcap") for policy in ("pf", "edf"))
    assert np.array_equal(a["fading_power"], b["fading_power"])
    assert not np.array_equal(a["prb_owner"], b["prb_owner"])


def test_a_log_says_what_it_is(tiny: Scenario, results: Path, run: Run, tmp_path: Path) -> None:
    run(tiny, "evaluate")
    with LogReader(results / "runs/evaluate/edf/seed12.mcap") as log:
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
    assert load_scenario(tmp_path / "tiny.yaml") == tiny
    schedule = json.loads((results / "gains/schedule.json").read_text(encoding="utf-8"))
    assert json.loads(attachments["schedule.json"]) == schedule


def test_logs_of_seeds_no_longer_asked_for_disappear(
    tiny: Scenario, results: Path, run: Run
) -> None:
    old = results / "runs/evaluate/pf/seed99.mcap"
    old.parent.mkdir(parents=True)
    old.write_bytes(b"old")
    run(tiny, "evaluate")
    assert sorted(path.name for path in old.parent.iterdir()) == [
        "seed11.mcap",
        "seed12.mcap",
        "seed13.mcap",
    ]


@pytest.mark.parametrize("axis", ["sampling_s", "load", "service_coefficient_mbps"])
def test_a_sweep_writes_every_point(tiny: Scenario, results: Path, run: Run, axis: str) -> None:
    run(tiny, axis)
    swept = experiments(tiny)[axis]
    names = files.group_logs(swept, ("pf",) if axis != "load" else ("pf", "edf"))
    written = {str(path.relative_to(results)) for path in (results / "runs").rglob("*.mcap")}
    assert written == set(names)
    assert len(names) == {"sampling_s": 2, "load": 2, "service_coefficient_mbps": 2}[axis]
    for name in names:
        with LogReader(results / name) as log:
            assert log.num_slots == 10
            assert log.profile == "compact"
            assert (log.metadata["axis"], log.metadata["stage"]) == (axis, "sweep")
            value, policy = log.metadata["value"], log.metadata["policy"]
            assert name == f"runs/{axis}/{value}/{policy}/seed21.mcap"
            (own,) = (p.scenario for p in swept.points if p.value == value)
            assert log.metadata["scenario_sha256"] == scenario_sha256(own)


def test_the_fading_scale_of_a_sweep_scales_the_fading(
    tiny: Scenario, results: Path, run: Run
) -> None:
    run(tiny, "rayleigh_scale")
    half, one = (
        fields_of(results / f"runs/rayleigh_scale/{value}/pf/seed21.mcap")["mean_fading_power"]
        for value in ("0.5", "1")
    )
    assert np.allclose(4.0 * half, one, rtol=1e-6)


def test_logs_of_other_cells(tiny: Scenario, results: Path, run: Run) -> None:
    run(tiny, "generalise")
    names = files.group_logs(experiments(tiny)["generalise"], ("pf", "edf"))
    assert len(names) == 2 * 2 * 2
    for name in names:
        with LogReader(results / name) as log:
            assert log.metadata["axis"] == "cell"
            assert f"/{log.metadata['value']}/{log.metadata['policy']}/" in name
            sizes = (log.dims.num_urllc, log.dims.num_embb, log.dims.num_prb)
            assert "u{}_e{}_k{}".format(*sizes) == log.metadata["value"]
            assert log.num_slots == 5


def test_gains_of_another_design_are_refused(tiny: Scenario, results: Path) -> None:
    other = replace(tiny, control=replace(tiny.control, weight=100.0))
    with pytest.raises(ValueError, match="its key is that of another design"):
        load_gains(results / "gains/schedule.json", other)
    with pytest.raises(ValueError, match="design = 'schedule_1': must be one of schedule, "):
        design_gains(tiny, "schedule_1", results / "x.json")


def in_full(scenario: Scenario) -> Scenario:
    """The same with full logs, which have the robots' delays and controls."""
    return replace(scenario, log=replace(scenario.log, gain_study_profile="full"))


def gain_logs(scenario: Scenario, results: Path, experiment: str) -> dict[str, dict]:
    """Fields of all logs of an experiment of the gain study, by ``value/gain/seedN``."""
    names = files.group_logs(experiments(scenario)[experiment], ("nominal", "adjusted"))
    cut = f"runs/{experiment}/"
    return {n.removeprefix(cut).removesuffix(".mcap"): fields_of(results / n) for n in names}


def test_gain_study_meets_the_same_delays_with_both_gains(
    tiny: Scenario, results: Path, run: Run
) -> None:
    run(in_full(tiny), "gain_study", "gains")
    logs = gain_logs(tiny, results, "gain_study")
    first = logs["krasovskii/nominal/seed31"]["network_delay_s"]
    assert first.shape == (300, 3)
    for name, fields in logs.items():
        assert np.array_equal(fields["network_delay_s"], first) == name.endswith("seed31")
    with LogReader(results / "runs/gain_study/razumikhin/adjusted/seed32.mcap") as log:
        assert log.metadata["gain"] == "adjusted"
        assert log.metadata["method"] == "razumikhin"
        assert log.metadata["policy"] == "none"
        assert b'"razumikhin"' in log.attachments["schedule.json"]


def test_a_gain_sweep_meets_the_delays_of_each_point(
    tiny: Scenario, results: Path, run: Run
) -> None:
    run(in_full(tiny), "gain_grid", "gains")
    logs = gain_logs(tiny, results, "gain_grid")
    assert len(logs) == 2 * 2 * 2 * 2
    for name, fields in logs.items():
        weight, delay_s = name.partition("/")[0].split("_")
        violated = fields["network_delay_s"][100:]
        assert np.array_equal(violated, np.full((100, 2), float(delay_s)))
        assert fields["network_delay_s"][:100].max() <= 0.02
        # Another weight is another loop in the same world and under the same calm delays.
        other = logs[name.replace(weight, "q900" if weight == "q700" else "q700")]
        assert np.array_equal(other["network_delay_s"], fields["network_delay_s"])
        assert not np.array_equal(other["state"], fields["state"])
    with LogReader(results / "runs/gain_grid/q900_0.04/adjusted/seed31.mcap") as log:
        wanted = {"axis": "grid", "value": "q900_0.04", "stage": "gain_study", "gain": "adjusted"}
        assert wanted.items() <= log.metadata.items()


def test_the_noise_of_a_gain_sweep_is_in_force(tiny: Scenario, results: Path, run: Run) -> None:
    run(in_full(tiny), "gain_noise", "gains")
    run(in_full(tiny), "gain_sampling_s", "gains")
    noisy, usual = (
        fields_of(results / f"runs/{point}/nominal/seed31.mcap")
        for point in ("gain_noise/0_0.01", "gain_sampling_s/0.02")
    )
    assert np.array_equal(noisy["network_delay_s"], usual["network_delay_s"])
    assert not np.array_equal(noisy["control"], usual["control"])
