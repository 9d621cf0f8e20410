"""Knobs of the study of the task: chosen where the answer is known, in worlds of their own."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from hiersched.core.randomness import world_key
from hiersched.experiments import files
from hiersched.experiments.feasible import load_study
from hiersched.experiments.gains import design_gains, designs
from hiersched.experiments.logged import STAGES, load_run
from hiersched.experiments.points import FLOOR, TUNED, cell_of, experiments
from hiersched.experiments.run import run_experiment
from hiersched.experiments.tune import (
    DESIGN,
    GRID_RATIO,
    PRECISION,
    WIDENINGS,
    Tried,
    TuningError,
    choose_knob,
    read_tuning,
    tune_cell,
    tuned_scenario,
)
from hiersched.experiments.worlds import untrained_policies
from hiersched.replay.verify import verify
from hiersched.scenario import Scenario
from hiersched.scenario.consistency import inconsistencies
from hiersched.study.built_in import shown
from hiersched.study.growth import write_growth
from hiersched.study.measure import measure
from hiersched.study.metrics import measured_row
from hiersched.study.registry import CLAIMS, FIGURES, TABLES
from hiersched.study.study import Study
from hiersched.study.task_metrics import TASK_MEASURES, task_row

TASK_CELL = """
name: tiny_task
users: {num_urllc: 2, num_embb: 2}
radio: {bandwidth_hz: 2.0e+6, num_prb: 5}
traffic: {urllc_offered_mbps: [20.0, 30.0]}
robot: {reference: reach, set_point: hold}
control: {loop: local, sampling_s: 0.0025}
evaluate: {seeds: [11], warmup_s: 0.0, duration_s: 0.2, policies: [pf], full_logs: 0}
sweeps: {axes: {rayleigh_scale: null, sampling_s: null, reference: null, load: null,
                load_ratio: null, service_coefficient_mbps: null}}
bound: {slots_per_log: 0}
generalise: {cells: []}
gain_study: {methods: []}
task_study:
  design_seeds: [51, 52]
  seeds: [61, 62, 63]
  warmup_s: 0.1
  duration_s: 0.4
  pareto_knobs: 2
  families:
    drift_k: {policy: {model: drift_plus_penalty}, range: [0.25, 4.0]}
    urgency: {policy: {model: urgency}, range: [0.25, 4.0]}
    discard: {policy: {model: try_once_discard}}
  cells:
    hold: {values: {traffic.load: 1.0}, pareto: true}
    batch: {values: {robot.superseding: batch}, families: [drift_k, urgency], bound_late: true}
"""


# The search.


def tried(knob: float, error: float, *, share: float = 1.0, keeps: bool = True) -> Tried:
    excess = 0.0 if keeps else max(0.995 - share, 1e-3)
    return Tried(
        knob=knob, embb_share=share, embb_late_share=0.0, tracking_rms_cm=error, excess=excess
    )


def test_the_last_knob_before_the_limit_where_the_error_falls_up_to_it() -> None:
    limit = 10.0
    asked: list[float] = []

    def evaluate(knob: float) -> Tried:
        asked.append(knob)
        return tried(knob, knob**-0.1, share=limit / knob, keeps=knob <= limit)

    choice = choose_knob(evaluate, 0.25, 64.0)
    assert limit / PRECISION <= choice.best.knob <= limit
    assert (choice.best.keeps_limit, choice.edge) == (True, "")
    assert [one.knob for one in choice.tried] == sorted(asked)
    assert len(asked) == len(set(asked)) < 12
    # Gaps on the far side of the limit hold nothing better.
    assert not [knob for knob in asked if 1.0 < knob < 4.0]


def test_a_limit_below_which_knobs_break_it() -> None:
    """Of a deadline less is more favour."""
    choice = choose_knob(lambda knob: tried(knob, knob**0.1, keeps=knob >= 3.0), 0.25, 64.0)
    assert 3.0 <= choice.best.knob <= 3.0 * PRECISION


@pytest.mark.parametrize("best", [3.0, 0.06, 700.0])
def test_the_least_error_where_the_limit_binds_nothing(best: float) -> None:
    """Also beyond the range, which is widened."""
    choice = choose_knob(lambda knob: tried(knob, 1.0 + math.log(knob / best) ** 2), 0.25, 64.0)
    assert max(choice.best.knob / best, best / choice.best.knob) <= PRECISION
    assert choice.edge == ""


def test_a_knob_at_the_edge_says_so() -> None:
    widest = GRID_RATIO**WIDENINGS
    more = choose_knob(lambda knob: tried(knob, 1.0 / knob), 0.25, 64.0)
    less = choose_knob(lambda knob: tried(knob, knob), 0.25, 64.0)
    assert (more.edge, more.best.knob) == ("greatest", pytest.approx(64.0 * widest))
    assert (less.edge, less.best.knob) == ("least", pytest.approx(0.25 / widest))


def test_the_nearest_to_the_limit_where_no_knob_keeps_it() -> None:
    """Not the one with the least error."""
    choice = choose_knob(
        lambda knob: tried(knob, 1.0 / knob, share=0.9 - 0.001 * knob, keeps=False), 0.25, 64.0
    )
    assert choice.best.keeps_limit is False
    assert choice.best.embb_share == max(one.embb_share for one in choice.tried)


def test_the_limit_is_sought_where_lateness_alone_breaks_it() -> None:
    """Throughput, which is the same within noise, does not lead away from it."""

    def evaluate(knob: float) -> Tried:
        one = tried(knob, 1.0 / knob, share=1.0 + 1e-5 * math.log(knob))
        return replace(one, excess=max(0.0, 0.04 * knob - 0.01))

    choice = choose_knob(evaluate, 0.5, 2048.0)
    assert 0.25 / PRECISION <= choice.best.knob <= 0.25
    assert choice.best.keeps_limit


# A cell.


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Scenario:
    path = tmp_path_factory.mktemp("scenario") / "tiny_task.yaml"
    path.write_text(TASK_CELL, encoding="utf-8")
    return load_study(path)


@pytest.fixture(scope="module")
def tuned(scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results with gains and the knobs of both cells."""
    results = tmp_path_factory.mktemp("tuned")
    for design in designs(scenario):
        design_gains(scenario, design, results / files.gain_file(design))
    for cell in scenario.task_study.cells:
        tune_cell(scenario, results, cell, task_row)
    return results


def test_tune_writes_every_knob_and_nothing_of_its_runs(scenario: Scenario, tuned: Path) -> None:
    left = {path.relative_to(tuned).as_posix() for path in tuned.rglob("*") if path.is_file()}
    knobs = {files.tuning_file(cell) for cell in ("hold", "batch")}
    assert left == knobs | {files.gain_file(design) for design in designs(scenario)}
    document = read_tuning(tuned / files.tuning_file("hold"))
    assert document["worlds"] == {"purpose": DESIGN, "seeds": [51, 52], "slots": 50}
    assert document["limits"] == {"embb_share": 0.995, "embb_late_share": None}
    assert list(document["families"]) == ["drift_k", "urgency", "discard"]
    drift, discard = (document["families"][name] for name in ("drift_k", "discard"))
    (at_one,) = (one for one in drift["tried"] if one["knob"] == 1.0)
    assert at_one["embb_share"] == 1.0  # the reference itself
    assert at_one["tracking_rms_cm"] == document["reference"]["tracking_rms_cm"]
    keeping = [one for one in drift["tried"] if one["keeps_limit"]]
    best = min(keeping, key=lambda one: one["tracking_rms_cm"])
    assert drift["tracking_rms_cm"] == best["tracking_rms_cm"]
    assert {key: drift[key] for key in best} in keeping
    assert all((one["embb_share"] >= 0.995) == one["keeps_limit"] for one in drift["tried"])
    assert (discard["knob"], len(discard["tried"])) == (None, 1)


def test_lateness_is_bounded_where_a_cell_says_so(tuned: Path) -> None:
    document = read_tuning(tuned / files.tuning_file("batch"))
    most = document["reference"]["embb_late_share"] + 0.01
    assert document["limits"]["embb_late_share"] == pytest.approx(most)
    for family in document["families"].values():
        for one in family["tried"]:
            keeps = one["embb_share"] >= 0.995 and one["embb_late_share"] <= most
            assert keeps == one["keeps_limit"]


def test_design_worlds_are_those_of_no_stage() -> None:
    """Whatever the seeds: no knob has seen the worlds that report."""
    assert DESIGN not in STAGES
    assert len({world_key(purpose, 51) for purpose in (*STAGES, DESIGN)}) == len(STAGES) + 1


@pytest.fixture(scope="module")
def ran(scenario: Scenario, tuned: Path) -> Path:
    for cell in ("hold", "batch"):
        run_experiment(
            *(scenario, tuned, f"task_{cell}", "classical"),
            *(untrained_policies, task_row, tuned_scenario),
        )
    return tuned


def test_held_out_runs_are_measured_and_the_first_is_logged(scenario: Scenario, ran: Path) -> None:
    for experiment in experiments(scenario).values():
        if experiment.stage != "task":
            continue
        for point, policy in experiment.runs(experiment.policies):
            rows = pd.read_parquet(ran / files.crossed_file(experiment, point, policy))
            assert rows["seed"].tolist() == [61, 62, 63]
            assert set(TASK_MEASURES) <= set(rows)
            logs = sorted((ran / files.runs_folder(experiment, point, policy)).glob("*.mcap"))
            assert [path.name for path in logs] == ["seed61.mcap"]
    assert [p.value for p in experiments(scenario)["task_hold"].points] == [
        *(TUNED, FLOOR, "knob0", "knob1")
    ]


def test_everything_is_shown_of_what_was_measured(scenario: Scenario, ran: Path) -> None:
    run_experiment(scenario, ran, "evaluate", "classical", untrained_policies, measured_row)
    measure(scenario, ran, "classical")
    write_growth(scenario, ran)
    study = Study(scenario, ran)
    assert set(study.task["point"]) == {TUNED, FLOOR, "knob0", "knob1"}
    knobs = study.task.groupby("point")["knob"].unique()
    assert (knobs["knob0"].tolist(), knobs["knob1"].tolist()) == ([0.25], [4.0])
    traces = study.measures("traces")
    assert set(traces["policy"]) == {"drift_plus_penalty", "drift_k", "urgency", "discard"}
    assert len(traces) == 4 * 2 * 40  # policies, robots, slots behind the warm-up
    for registry in (TABLES, FIGURES, CLAIMS):
        for name, thing in shown(registry, scenario).items():
            if "tunings" in thing.reads:
                assert thing.build(study) is not None, name


def test_a_log_has_its_knob_and_can_be_run_again(scenario: Scenario, ran: Path) -> None:
    experiment = experiments(scenario)["task_hold"]
    point, cell = experiment.points[0], cell_of(experiment)
    knobs = read_tuning(ran / files.tuning_file(cell))["families"]
    path = ran / files.run_log(experiment, point, "urgency", 61)
    run = load_run(path)
    assert run.scenario.policies["urgency"].urllc_factor == knobs["urgency"]["knob"]
    assert list(run.scenario.policies) == ["urgency"]
    assert not run.scenario.task_study.cells
    assert (run.metadata["stage"], run.metadata["axis"], run.metadata["value"]) == (
        *("task", "task_hold", TUNED),
    )
    assert verify(run) is None


def test_a_run_at_a_knob_of_the_curve_that_is_tuned_is_the_same(
    scenario: Scenario, ran: Path
) -> None:
    """The knob of a point of the curve is the grid's; a run at that knob again gives its errors."""
    experiment = experiments(scenario)["task_hold"]
    low = experiment.points[2]
    assert low.scenario.policies["urgency"].urllc_factor == 0.25
    document = read_tuning(ran / files.tuning_file("hold"))
    document["families"]["urgency"]["knob"] = 0.25
    other = ran.parent / "other"
    (other / "tune").mkdir(parents=True, exist_ok=True)
    (other / files.tuning_file("hold")).write_text(json.dumps(document))
    variant = tuned_scenario(other, experiment, experiment.points[0], "urgency")
    assert variant.policies["urgency"] == low.scenario.policies["urgency"]


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"families": {"urgency": {"knob": -1.0}}}', '{"families": {"a": 1}}']
)
def test_a_file_that_is_no_tuning_is_one_fault(tmp_path: Path, text: str) -> None:
    path = tmp_path / "hold.json"
    path.write_text(text)
    with pytest.raises(TuningError, match=r"hold\.json"):
        read_tuning(path)


def test_a_policy_of_the_scenario_runs_in_the_cells_as_it_is(tmp_path: Path) -> None:
    """With its own knob, and in the scenarios of the families; the reference runs once."""
    text = TASK_CELL.replace("policies: [pf]", "policies: [pf, mine, by_age]")
    text = text.replace("pareto_knobs", "policies: [mine, drift_plus_penalty]\n  pareto_knobs")
    own = "policies: {mine: {model: urgency, urllc_factor: 3.0}, by_age: {model: age}}\n"
    (tmp_path / "own.yaml").write_text(text + own, encoding="utf-8")
    scenario = load_study(tmp_path / "own.yaml")
    experiment = experiments(scenario)["task_hold"]
    assert experiment.policies == ("drift_plus_penalty", "drift_k", "urgency", "discard", "mine")
    mine = tuned_scenario(tmp_path, experiment, experiment.points[0], "mine")
    assert mine.policies["mine"].urllc_factor == 3.0
    assert list(mine.policies) == ["mine", "by_age"]
    path = tmp_path / files.tuning_file("hold")
    path.parent.mkdir()
    path.write_text('{"families": {"urgency": {"knob": 2.0}}}')
    family = tuned_scenario(tmp_path, experiment, experiment.points[0], "urgency")
    assert family.policies["urgency"].urllc_factor == 2.0
    assert not inconsistencies(family)


def test_a_family_without_a_knob_in_the_file_is_a_fault(scenario: Scenario, tmp_path: Path) -> None:
    experiment = experiments(scenario)["task_hold"]
    path = tmp_path / files.tuning_file("hold")
    path.parent.mkdir()
    path.write_text('{"families": {}}')
    with pytest.raises(TuningError, match="no knob of urgency"):
        tuned_scenario(tmp_path, experiment, experiment.points[0], "urgency")
    reference = tuned_scenario(tmp_path, experiment, experiment.points[0], "drift_plus_penalty")
    assert reference == replace(experiment.points[0].scenario, policies={})
