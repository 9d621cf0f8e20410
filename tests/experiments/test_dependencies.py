"""What a job depends on: all that it reads, and nothing else."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
from hiersched.runs.bound import compute_bound
from hiersched.runs.evaluate import evaluate
from hiersched.runs.gain_points import GAIN_SWEEPS
from hiersched.runs.gain_study import gain_study, gain_sweep
from hiersched.runs.generalise import generalise
from hiersched.runs.learned import learned_policies
from hiersched.runs.policies import untrained_policies
from hiersched.runs.sweep import sweep
from hiersched.runs.variants import replaced

from hiersched.models.model import SECTIONS
from hiersched.runs import dependencies, paths, stability
from hiersched.runs import gains as gains_stage
from hiersched.scenario import Scenario
from hiersched.scenario.schema import model_at
from hiersched.study.metrics import measured_row

# What these read is in the log as a copy of the scenario, or decides on file names alone.
NOT_A_USE = {
    "scenario_to_yaml",
    "scenario_to_dict",
    "scenario_sha256",
    "swept_scenario",
    "cell_scenario",
    "group_policies",
    "plugin_hashes",
    "learner_scenario",
    "study_scenario",
    "gain_designs",
    "gain_points",
    "robots_alone",
    "design_of",
}


@pytest.fixture
def reads(tiny: Scenario, monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Keys of the scenario that are read while a test runs."""
    seen: set[str] = set()

    def record(section: str) -> Callable[[Any, str], Any]:
        def read(self: Any, name: str) -> Any:
            is_key = name in {field.name for field in fields(type(self))}
            if is_key and f"{section}.{name}" not in SECTIONS:
                frame = sys._getframe(1)
                callers = set()
                while frame is not None:
                    callers.add(frame.f_code.co_name)
                    frame = frame.f_back
                if not callers & NOT_A_USE:
                    seen.add(f"{section}.{name}")
            return object.__getattribute__(self, name)

        return read

    for field in fields(tiny):
        kind = type(getattr(tiny, field.name))
        if kind not in (str, dict, tuple) and field.name not in SECTIONS:
            monkeypatch.setattr(kind, "__getattribute__", record(field.name), raising=False)
    for section in SECTIONS:
        kind = type(model_at(tiny, section))
        monkeypatch.setattr(kind, "__getattribute__", record(section), raising=False)
    return seen


def undeclared(reads: set[str], values: dict[str, Any]) -> set[str]:
    return reads - set(values)


def test_evaluation_reads_what_it_declares(tiny: Scenario, results: Path, reads: set[str]) -> None:
    evaluate(tiny, results, "classical", untrained_policies)
    values = dependencies.evaluate_values(tiny, "classical")
    assert undeclared(set(reads), values) == {"evaluate.policies"}  # "policies": those of the group


def test_a_learners_evaluation_reads_what_it_declares(
    tiny: Scenario, results: Path, reads: set[str]
) -> None:
    """Measures of runs that are not logged are taken in the same job."""
    from hiersched.runs.train import train_and_log

    train_and_log(tiny, "ddpg", results, "code", show=False)
    source = learned_policies([results / name for name in paths.policy_files(tiny, "ddpg")])
    reads.clear()
    evaluate(tiny, results, "ddpg", source, measured_row)
    assert (results / paths.evaluation_crossed("ddpg")).is_file()
    values = dependencies.evaluate_values(tiny, "ddpg")
    assert undeclared(set(reads), values) == {"evaluate.policies"}


def test_measures_depend_on_the_training_seeds_of_their_own_learner(tiny: Scenario) -> None:
    more = replace(tiny, learning=replace(tiny.learning, seeds=(1, 2, 3)))
    for group, same in (("ddpg", False), ("classical", True)):
        values = [dependencies.measure_values(s, group) for s in (tiny, more)]
        assert (values[0] == values[1]) == same


@pytest.mark.parametrize("axis", list(dependencies.SWEPT_KEYS))
def test_a_sweep_reads_what_it_declares(
    tiny: Scenario, results: Path, reads: set[str], axis: str
) -> None:
    sweep(tiny, results, axis, "classical", untrained_policies)
    values = dependencies.sweep_values(tiny, axis, "classical")
    # The swept key is read from the variant: its values are those of the axis.
    swept = {
        "sampling_s": set(),
        "load_ratio": set(),
        "service_coefficient_mbps": {"traffic.service_coefficient_mbps"},
    }.get(axis, {dependencies.SWEPT_KEYS[axis]})
    # "policies" are those of the group; along the load, all evaluated ones.
    listed = {"sweeps.policies"} | ({"evaluate.policies"} if axis == "load" else set())
    # Along these axes the study's own learner is named by its algorithm.
    if axis in ("load_ratio", "service_coefficient_mbps"):
        listed |= {"learning.algorithm"}
    assert undeclared(set(reads), values) == {*listed, *swept}


def test_cells_of_other_sizes_read_what_they_declare(
    tiny: Scenario, results: Path, reads: set[str]
) -> None:
    study = replace(tiny.generalise, cells=((1, 2, 4),), duration_s=0.05, seeds=(1,))
    generalise(replace(tiny, generalise=study), results, "classical", untrained_policies)
    values = dependencies.cell_values(tiny, "classical")
    assert undeclared(set(reads), values) == {"generalise.policies"}


def test_the_bound_reads_what_it_declares(tiny: Scenario, results: Path, reads: set[str]) -> None:
    few = replace(tiny, evaluate=replace(tiny.evaluate, policies=("pf",), duration_s=0.05))
    evaluate(few, results, "classical", untrained_policies)
    reads.clear()
    compute_bound(few, results, results / paths.BOUND)
    assert undeclared(set(reads), dependencies.bound_values(tiny)) == set()


def test_the_gain_study_reads_what_it_declares(
    tiny: Scenario, results: Path, reads: set[str]
) -> None:
    gain_study(tiny, results)
    undeclared_reads = undeclared(set(reads), dependencies.gain_study_values(tiny))
    # The slot loop's constants are built, but the robots run alone.
    unused = ("users.", "traffic.", "radio.", "objective.", "schedulers.", "learning.reward_scale")
    assert {key for key in undeclared_reads if not key.startswith(unused)} == set()


@pytest.mark.parametrize("axis", list(GAIN_SWEEPS))
def test_a_gain_sweep_reads_what_it_declares(
    tiny: Scenario, results: Path, reads: set[str], axis: str
) -> None:
    gain_sweep(tiny, results, axis)
    undeclared_reads = undeclared(set(reads), dependencies.gain_sweep_values(tiny, axis))
    unused = ("users.", "traffic.", "radio.", "objective.", "schedulers.", "learning.reward_scale")
    assert {key for key in undeclared_reads if not key.startswith(unused)} == set()


def test_stability_reads_what_it_declares(
    tiny: Scenario, results: Path, reads: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stability, "certified_delays", lambda *_: {})
    stability.write_stability(tiny, results)
    assert undeclared(set(reads), dependencies.stability_values(tiny)) == {
        *("control.gain", "control.hold_samples")  # of the loop, which does not run
    }


def test_gain_design_reads_what_it_declares(
    tiny: Scenario, results: Path, reads: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gains_stage, "load_or_build", lambda *_, **__: None)
    gains_stage.design_gains(tiny, "schedule", results / "x.json")
    assert undeclared(set(reads), dependencies.gains_values(tiny, "schedule")) == set()


def test_training_reads_what_it_declares(tiny: Scenario, results: Path, reads: set[str]) -> None:
    from hiersched.runs.train import train_and_log

    train_and_log(tiny, "ddpg", results, "code", show=False)
    assert undeclared(set(reads), dependencies.train_values(tiny, "ddpg")) == set()


def changed(scenario: Scenario, key: str, value: Any) -> Scenario:
    return replaced(scenario, key, value)


JOBS: dict[str, Callable[[Scenario], Any]] = {
    "gains": lambda s: dependencies.gains_values(s, "schedule"),
    "gains_0.04": lambda s: dependencies.gains_values(s, "schedule_0.04"),
    "train": lambda s: dependencies.train_values(s, "ddpg"),
    "evaluate": lambda s: dependencies.evaluate_values(s, "classical"),
    "evaluate_ddpg": lambda s: dependencies.evaluate_values(s, "ddpg"),
    "gain_study": dependencies.gain_study_values,
    "gain_sweep_grid": lambda s: dependencies.gain_sweep_values(s, "grid"),
    "gain_sweep_noise": lambda s: dependencies.gain_sweep_values(s, "noise"),
    "stability": dependencies.stability_values,
    **{
        f"sweep_{axis}": (lambda s, axis=axis: dependencies.sweep_values(s, axis, "classical"))
        for axis in dependencies.SWEPT_KEYS
    },
}
SWEEPS = {f"sweep_{axis}" for axis in dependencies.SWEPT_KEYS}
GAIN_RUNS = {"gain_study", "gain_sweep_grid", "gain_sweep_noise"}
SLOT_LOOP = {"train", "evaluate", "evaluate_ddpg", *SWEEPS}


@pytest.mark.parametrize(
    ("key", "value", "jobs"),
    [
        ("evaluate.duration_s", 0.3, {"evaluate", "evaluate_ddpg"}),
        ("evaluate.policies", ("ddpg", "pf", "max_rate"), {"evaluate", "sweep_load"}),
        ("evaluate.policies", ("pf", "ddpg", "edf"), set()),
        ("learning.episodes", 8, {"train"}),
        ("learning.reward_scale", 10.0, SLOT_LOOP),
        ("objective.multiplier_step", 1.0, {"train"}),
        ("objective.penalty_weight", 1.0, SLOT_LOOP),
        ("sweeps.load", (0.9, 1.0), {"sweep_load"}),
        ("sweeps.duration_s", 0.2, SWEEPS),
        ("traffic.load", 0.8, SLOT_LOOP - {"sweep_load"}),
        ("radio.fading.scale", 2.0, (SLOT_LOOP - {"sweep_rayleigh_scale"})),
        ("radio.slot_s", 0.005, SLOT_LOOP | GAIN_RUNS),
        ("gain_study.num_robots", 5, {"gain_study"}),
        ("gain_study.sweep_robots", 5, GAIN_RUNS - {"gain_study"}),
        ("gain_study.noise_position_m", (0.1,), {"gain_sweep_noise"}),
        ("gain_study.weight", (700.0,), {"gain_sweep_grid", "stability"}),
        ("gain_study.methods", ("krasovskii",), {"gain_study"}),
        ("log.train_profile", "full", {"train"}),
        ("robot.speed_mps", 0.5, SLOT_LOOP | GAIN_RUNS | {"stability", "gains", "gains_0.04"}),
        ("control.gain", "nominal", SLOT_LOOP | GAIN_RUNS),
        ("traffic.reliability_levels", (0.9,), SLOT_LOOP),
    ],
)
def test_a_value_changes_the_jobs_that_read_it(
    tiny: Scenario, key: str, value: Any, jobs: set[str]
) -> None:
    other = changed(tiny, key, value)
    assert {name for name, values in JOBS.items() if values(tiny) != values(other)} == jobs


def test_the_parameter_is_canonical(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text("x = 1\n", encoding="utf-8")
    one = dependencies.stage_spec("train", {"a": 1, "b": 2}, script)
    assert one == dependencies.stage_spec("train", {"b": 2, "a": 1}, script)
    assert one != dependencies.stage_spec("train", {"a": 2, "b": 1}, script)
    assert json.loads(one)["values"] == {"a": 1, "b": 2}
    assert paths.SCENARIO == "scenario.yaml"
