"""What a job depends on: all that it reads, and nothing else."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

from hiersched.experiments import dependencies, files, fingerprint, stability
from hiersched.experiments import gains as gains_stage
from hiersched.experiments.bound import compute_bound
from hiersched.experiments.fingerprint import code_fingerprint
from hiersched.experiments.learned import learned_policies
from hiersched.experiments.points import experiments, groups
from hiersched.models.model import SECTIONS
from hiersched.scenario import Scenario, with_values
from hiersched.scenario.schema import model_at
from hiersched.study.growth import write_growth
from hiersched.study.measure import measure
from hiersched.study.registry import FIGURES

Run = Callable[..., None]
Load = Callable[[str], Scenario]

# What these read is in the log as a copy of the scenario, or decides on file names alone.
NOT_A_USE = {
    "__eq__",
    "__hash__",
    "scenario_to_yaml",
    "scenario_to_dict",
    "scenario_sha256",
    "experiments",
    "groups",
    "is_crossed",
    "plugin_hashes",
    "learner_scenario",
    "designs",
    "design_of",
    "baseline_method",
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
    """Keys that were read, and stand neither with the job nor with its points."""
    points = values.get("points", {}).values()
    return reads - set(values) - {key for point in points for key in point}


def run_values(scenario: Scenario, name: str, group: str = "classical") -> dict[str, Any]:
    return dependencies.run_values(scenario, experiments(scenario)[name], group)


@pytest.mark.parametrize(
    "name",
    [
        *("evaluate", "generalise", "rayleigh_scale", "sampling_s", "reference", "load"),
        *("load_ratio", "service_coefficient_mbps"),
    ],
)
def test_an_experiment_reads_what_it_declares(
    tiny: Scenario, run: Run, reads: set[str], name: str
) -> None:
    run(tiny, name)
    assert {"radio.bandwidth_hz", "radio.fading.scale", "robot.window_s"} <= reads
    assert undeclared(set(reads), run_values(tiny, name)) == set()


def test_an_axis_of_any_key_reads_what_it_declares(
    tiny_with: Load, run: Run, reads: set[str]
) -> None:
    scenario = tiny_with(
        "sweeps: {axes: {mine: {vary: {traffic.packet_bits: [1.0e+4, 2.0e+4],"
        " radio.path_loss: [{model: none}, {model: macro, shadowing_db: 0.0}]}}}}"
    )
    reads.clear()
    run(scenario, "mine")
    values = run_values(scenario, "mine")
    assert undeclared(set(reads), values) == set()
    assert {"traffic.packet_bits", "radio.path_loss.model"}.isdisjoint(values)
    assert set(values["points"]) == {
        *("10000_none", "10000_macro-shadowing_db-0"),
        *("20000_none", "20000_macro-shadowing_db-0"),
    }


def test_a_learners_evaluation_reads_what_it_declares(
    tiny: Scenario, results: Path, run: Run, reads: set[str]
) -> None:
    """Measures of runs that are not logged are taken in the same job."""
    from hiersched.experiments.train import train_and_log

    train_and_log(tiny, "ddpg", results, "code", show=False)
    source = learned_policies([results / name for name in files.policy_files(tiny, "ddpg")])
    reads.clear()
    run(tiny, "evaluate", "ddpg", source)
    assert (results / "runs/evaluate/ddpg/crossed.parquet").is_file()
    assert "traffic.deadline_s" in reads
    assert undeclared(set(reads), run_values(tiny, "evaluate", "ddpg")) == set()


def test_measures_depend_on_the_training_seeds_of_their_own_learner(tiny: Scenario) -> None:
    more = replace(tiny, learning=replace(tiny.learning, seeds=(1, 2, 3)))
    for group, same in (("ddpg", False), ("classical", True), ("gains", True)):
        values = [dependencies.measure_values(s, group) for s in (tiny, more)]
        assert (values[0] == values[1]) == same


def test_measures_depend_on_the_runs_of_their_own_group(tiny: Scenario) -> None:
    """What the logs are is in them; which there are, and the values that measures take, are not."""
    for key, value, groups_changed in (
        ("evaluate.duration_s", 0.3, {"classical", "ddpg"}),
        ("gain_study.sweep_windows", 3, {"gains"}),
        ("evaluate.policies", ["ddpg", "pf", "max_rate"], {"classical"}),
        ("learning.episodes", 8, set()),
    ):
        other = with_values(tiny, {key: value}, "")
        changed = {
            group
            for group in ("classical", "ddpg", "gains")
            if dependencies.measure_values(tiny, group) != dependencies.measure_values(other, group)
        }
        assert changed == groups_changed, key


def test_the_bound_reads_what_it_declares(
    tiny: Scenario, results: Path, run: Run, reads: set[str]
) -> None:
    few = replace(tiny, evaluate=replace(tiny.evaluate, policies=("pf",), duration_s=0.05))
    run(few, "evaluate")
    reads.clear()
    compute_bound(few, results, results / files.BOUND)
    assert "objective.penalty_weight" in reads
    assert undeclared(set(reads), dependencies.bound_values(tiny)) == set()


@pytest.mark.parametrize("name", ["gain_study", "gain_grid", "gain_sampling_s", "gain_noise"])
def test_the_gain_study_reads_what_it_declares(
    tiny: Scenario, run: Run, reads: set[str], name: str
) -> None:
    run(tiny, name, "gains")
    assert {"robot.speed_mps", "control.hold_samples"} <= reads
    assert undeclared(set(reads), run_values(tiny, name, "gains")) == set()


BELIEFS = {
    f"control.believed_{name}"
    for name in ("lag_s", "slip_speed_mps", "slip_turn_rate_radps", "slip_time_s")
}
"""What a design reads in place of the robot's own keys, under whose names it is declared."""


def test_growth_reads_what_it_declares(
    tiny: Scenario, results: Path, run: Run, reads: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    few = replace(
        tiny,
        evaluate=replace(tiny.evaluate, policies=("pf",), duration_s=0.05),
        sweeps=replace(tiny.sweeps, axes={}),
        generalise=replace(tiny.generalise, cells=()),
        gain_study=replace(tiny.gain_study, methods=()),
    )
    run(few, "evaluate")
    measure(few, results, "classical")
    reads.clear()
    write_growth(few, results)
    values = dependencies.growth_values(few)["evaluate classical"]
    assert {"control.gain", "control.hold_samples", "robot.speed_mps"} <= reads
    # Which learners are trained decides on the files of chains, which are its inputs.
    left = {"learning.algorithm", "learning.frozen"}
    assert undeclared(set(reads), values) == left


def test_stability_reads_what_it_declares(
    tiny: Scenario, results: Path, reads: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stability, "certified_delays", lambda *_: {})
    stability.write_stability(tiny, results)
    assert undeclared(set(reads), dependencies.stability_values(tiny)) == {
        # Of the loop, which does not run.
        *("control.gain", "control.hold_samples", "control.delay", "control.sample_phases"),
        *("control.link", "control.playout_s", "control.packet_samples", "control.command_hold_s"),
        *("control.known_motion", "control.stamp_error_samples"),
        *BELIEFS,
    }


def test_gain_design_reads_what_it_declares(
    tiny: Scenario, results: Path, reads: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gains_stage, "load_or_build", lambda *_, **__: None)
    gains_stage.design_gains(tiny, "schedule", results / "x.json")
    assert "control.weight" in reads
    left = undeclared(set(reads), dependencies.gains_values(tiny, "schedule"))
    assert left == {"control.believed_lag_s"}
    believed = replace(tiny, control=replace(tiny.control, believed_lag_s=0.2))
    assert dependencies.gains_values(believed, "schedule")["robot.actuator_lag_s"] == 0.2


def test_training_reads_what_it_declares(tiny: Scenario, results: Path, reads: set[str]) -> None:
    from hiersched.experiments.train import train_and_log

    train_and_log(tiny, "ddpg", results, "code", show=False)
    assert "learning.discount" in reads
    assert undeclared(set(reads), dependencies.train_values(tiny, "ddpg")) == set()


def all_jobs(scenario: Scenario) -> dict[str, Any]:
    """What each job of a study depends on; of experiments by name, of learners' with ``_ddpg``."""
    found = {
        "gains": dependencies.gains_values(scenario, "schedule"),
        "train": dependencies.train_values(scenario, "ddpg"),
        "stability": dependencies.stability_values(scenario),
        "bound": dependencies.bound_values(scenario),
    }
    for name, experiment in experiments(scenario).items():
        for group in groups(scenario, experiment):
            job = name if group in ("classical", "gains") else f"{name}_{group}"
            found[job] = dependencies.run_values(scenario, experiment, group)
    return found


AXES = (
    *("rayleigh_scale", "sampling_s", "reference"),
    *("load", "load_ratio", "service_coefficient_mbps"),
)


def of_policies(*names: str) -> set[str]:
    """Jobs of both groups of policies."""
    return {f"{name}{group}" for name in names for group in ("", "_ddpg")}


EVALUATE, CELLS = of_policies("evaluate"), of_policies("generalise")
SWEEPS = of_policies(*AXES)
GAIN_RUNS = {"gain_study", "gain_grid", "gain_sampling_s", "gain_noise"}
SLOT_LOOP = {"train", "bound", *EVALUATE, *CELLS, *SWEEPS}


@pytest.mark.parametrize(
    ("key", "value", "jobs"),
    [
        ("evaluate.duration_s", 0.3, EVALUATE | {"bound"}),
        ("evaluate.policies", ["ddpg", "pf", "max_rate"], {"evaluate", "load", "bound"}),
        ("evaluate.policies", ["pf", "ddpg", "edf"], {"bound"}),
        ("generalise.duration_s", 0.1, CELLS),
        ("generalise.cells", [[1, 3, 6]], CELLS),
        ("learning.episodes", 8, {"train"}),
        ("learning.reward_scale", 10.0, SLOT_LOOP | GAIN_RUNS),
        ("objective.multiplier_step", 1.0, {"train"}),
        ("objective.penalty_weight", 1.0, SLOT_LOOP | GAIN_RUNS),
        ("bound.slots_per_log", 9, {"bound"}),
        ("sweeps.duration_s", 0.2, SWEEPS),
        ("traffic.reliability_levels", [0.9], SLOT_LOOP | GAIN_RUNS),
        ("radio.slot_s", 0.005, SLOT_LOOP | GAIN_RUNS),
        # A swept key's own value is nothing to its sweep.
        ("traffic.load", 0.8, (SLOT_LOOP | GAIN_RUNS) - of_policies("load")),
        ("radio.fading.scale", 2.0, (SLOT_LOOP | GAIN_RUNS) - of_policies("rayleigh_scale")),
        ("robot.reference", "zigzag", (SLOT_LOOP | GAIN_RUNS) - of_policies("reference")),
        ("traffic.load_ratio", 1.1, (SLOT_LOOP | GAIN_RUNS) - of_policies("load_ratio")),
        (
            "traffic.service_coefficient_mbps",
            5.0,
            (SLOT_LOOP | GAIN_RUNS) - of_policies("service_coefficient_mbps"),
        ),
        (
            "control.sampling_s",
            0.01,
            (SLOT_LOOP | GAIN_RUNS | {"stability", "gains"})
            - of_policies("sampling_s", "service_coefficient_mbps")
            - {"gain_sampling_s"},
        ),
        ("robot.speed_mps", 0.5, SLOT_LOOP | GAIN_RUNS | {"stability", "gains"}),
        ("control.gain", "nominal", SLOT_LOOP | GAIN_RUNS),
        ("gain_study.num_robots", 5, {"gain_study", "stability"}),
        ("gain_study.sweep_robots", 5, GAIN_RUNS - {"gain_study"} | {"stability"}),
        ("gain_study.methods", ["krasovskii"], {"gain_study", "stability"}),
        ("log.train_profile", "full", {"train"}),
        ("log.sweep_profile", "full", SWEEPS | CELLS),
        ("log.evaluate_profile", "decisions", EVALUATE),
    ],
)
def test_a_value_changes_the_jobs_that_read_it(
    tiny: Scenario, key: str, value: Any, jobs: set[str]
) -> None:
    before, after = all_jobs(tiny), all_jobs(with_values(tiny, {key: value}, ""))
    assert before.keys() == after.keys()
    assert {name for name in before if before[name] != after[name]} == jobs


@pytest.mark.parametrize("axis", AXES)
def test_other_values_of_an_axis_change_that_axis_alone(tiny_with: Load, axis: str) -> None:
    text = {
        "rayleigh_scale": "radio.fading.scale: [0.5, 3.0]",
        "sampling_s": "control.sampling_s: [0.02]",
        "reference": "robot.reference: [straight]",
        "load": "traffic.load: [1.1]",
        "load_ratio": "traffic.load_ratio: [0.7]",
        "service_coefficient_mbps": "traffic.service_coefficient_mbps: [3.0]",
    }[axis]
    before = all_jobs(tiny_with(""))
    after = all_jobs(tiny_with(f"sweeps: {{axes: {{{axis}: {{vary: {{{text}}}}}}}}}"))
    assert {name for name in before if before[name] != after[name]} == of_policies(axis)


WHOLE = """
sweeps: {axes: {mine: {vary: {radio.path_loss: [
  {model: macro, cell_radius_m: 300.0}, {model: macro, cell_radius_m: 600.0}]}}}}
"""


def test_a_model_swept_as_a_whole_hides_the_scenarios_own(tiny_with: Load) -> None:
    """Whichever it is, and whatever its keys are."""
    own = ("{model: none}", "{model: macro, cell_radius_m: 300.0}", "{model: macro}")
    found = [run_values(tiny_with(f"{WHOLE}radio: {{path_loss: {text}}}"), "mine") for text in own]
    assert found[0] == found[1] == found[2]
    values = {value: point["radio.path_loss.cell_radius_m"] for value, point in points(found[0])}
    assert values == {"macro-cell_radius_m-300": 300.0, "macro-cell_radius_m-600": 600.0}
    other = tiny_with(WHOLE.replace("cell_radius_m: 600.0", "shadowing_db: 6.0"))
    assert run_values(other, "mine") != found[0]


def points(values: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    return list(values["points"].items())


def test_keys_of_policies_count_for_the_jobs_of_these_policies(
    tiny_with: Load, tmp_path: Path, write_plugin: Callable[[Path, str], Path]
) -> None:
    text = "def risk(view, level):\n    return view.backlog_packets * level\n"
    write_plugin(tmp_path / "risk_rules.py", text)

    def study(own: float, swept: str) -> dict[str, Any]:
        scenario = tiny_with(
            "plugins: [risk_rules.py]\nevaluate: {policies: [mine, pf]}\n"
            f'policies: {{mine: {{import: "risk_rules:risk", parameters: {{level: {own}}}}}}}\n'
            "sweeps: {policies: [pf], axes: {level: {policies: [mine], vary: "
            f"{{policies.mine.parameters.level: [{swept}]}}}}}}}}"
        )
        return all_jobs(scenario)

    first = study(0.9, "0.5, 0.99")
    for own, swept, changed in (
        (0.9, "0.5, 0.99", set()),
        (0.8, "0.5, 0.99", {"evaluate", "load"}),
        (0.5, "0.5, 0.99", {"evaluate", "load"}),
        (0.9, "0.5", {"level"}),
        (0.9, "0.5, 0.9900000000001", {"level"}),  # called the same
    ):
        other = study(own, swept)
        runs = {n for n in first if first[n] != other[n] and n not in ("bound", "train")}
        assert runs == changed, (own, swept)
    assert study(0.5, "0.5")["level"] == study(0.8, "0.5")["level"]


FIGURE = """
from hiersched.study.registry import figure

@figure("mine", title="Mine.", reads=("runs",))
def mine(study):
    return {}
"""
RULE = """
def flat(view):
    return view.backlog_packets * 0.0 + 1.0
"""


@pytest.mark.nightly
def test_a_plugin_that_only_adds_figures_is_nothing_to_the_runs(
    tiny_with: Load, tmp_path: Path, write_plugin: Callable[[Path, str], Path]
) -> None:
    """One that adds a rule is, whatever else it adds; of a figure its own source counts."""
    plain = all_jobs(tiny_with(""))
    file = write_plugin(tmp_path / "only_figures.py", FIGURE.format(1))
    shown = tiny_with("plugins: [only_figures.py]")
    assert all_jobs(shown) == plain
    sources = code_fingerprint(FIGURES["mine"].file, only="mine")
    file.write_text(FIGURE.format(2), encoding="utf-8")
    edited = tiny_with("plugins: [only_figures.py]")
    assert all_jobs(edited) == plain
    for cached in vars(fingerprint).values():
        getattr(cached, "cache_clear", int)()  # every job of the workflow is a process of its own
    assert code_fingerprint(FIGURES["mine"].file, only="mine") != sources

    both = tmp_path / "figures_and_rules.py"
    write_plugin(both, FIGURE.format(1).replace("mine", "other") + RULE)
    given = (
        "plugins: [figures_and_rules.py]\n"
        'policies: {flat: {import: "figures_and_rules:flat"}}\nevaluate: {policies: [flat, pf]}'
    )
    before = all_jobs(tiny_with(given))
    both.write_text(both.read_text() + "\n\nNEW = 1\n", encoding="utf-8")
    after = all_jobs(tiny_with(given))
    assert {name for name in before if before[name] != after[name]} >= {"evaluate", "load"}


def test_the_parameter_is_canonical(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text("x = 1\n", encoding="utf-8")
    one = dependencies.stage_spec("train", {"a": 1, "b": 2}, script)
    assert one == dependencies.stage_spec("train", {"b": 2, "a": 1}, script)
    assert one != dependencies.stage_spec("train", {"a": 2, "b": 1}, script)
    assert json.loads(one)["values"] == {"a": 1, "b": 2}
