"""The study of the task by hand: measures of a run, who is compared, corrected p-values."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from hiersched.core.files import write_parquet
from hiersched.experiments.feasible import load_study
from hiersched.experiments.logged import RunSlots
from hiersched.experiments.points import REFERENCE
from hiersched.scenario import Scenario
from hiersched.study.claims.task import task_improves
from hiersched.study.figures.task import (
    draw_gain,
    draw_learners,
    draw_pareto,
    draw_traces,
    family_look,
)
from hiersched.study.growth import write_growth
from hiersched.study.measure import chain_files
from hiersched.study.statistics import Interval, holm, mean_interval, p_value
from hiersched.study.study import Study
from hiersched.study.tables.task import (
    in_range,
    task_gains,
    task_knobs,
    task_learners,
    task_pareto,
    task_superseding,
)
from hiersched.study.task import best_blind, best_family, first_aware, kind_of, lines, twin_of
from hiersched.study.task_metrics import TASK_MEASURES, served_packets, task_row

CELLS = """
name: planted
users: {num_urllc: 2, num_embb: 1}
radio: {bandwidth_hz: 1.6e+6, num_prb: 4}
traffic: {urllc_offered_mbps: 10.0, load: 1.0}
robot: {reference: reach, set_point: hold}
control: {loop: local, sampling_s: 0.0025}
learning: {seeds: [1, 2]}
evaluate: {policies: [pf], full_logs: 0}
task_study:
  seeds: [61, 62, 63]
  pareto_knobs: 2
  policies: [ddpg]
  families:
    drift_k: {policy: {model: drift_plus_penalty}, range: [0.25, 4.0]}
    edf_k: {policy: {model: edf}, range: [0.25, 4.0]}
    lag: {policy: {model: lag}, range: [0.25, 4.0]}
    urgency: {policy: {model: urgency}, range: [0.25, 4.0]}
    calm: {policy: {model: urgency, floor: 1.0}, range: [0.25, 4.0]}
  cells:
    load_100: {values: {traffic.load: 1.0}, pareto: true, expected_rms: [0.4, 0.6]}
    load_110: {values: {traffic.load: 1.1}}
    timely_100: {values: {traffic.load: 1.0}, bound_late: true}
    batch_100: {values: {traffic.load: 1.0, robot.superseding: batch}, bound_late: true}
"""
WORLDS = (61, 62, 63)
FAMILIES = ("drift_k", "edf_k", "lag", "urgency", "calm")
ERROR_CM = {
    **{REFERENCE: 4.0, "drift_k": 2.0, "edf_k": 3.0, "lag": 1.8, "urgency": 1.0, "calm": 1.5},
    "ddpg": 1.2,
}
"""Of the tuned policies in the first world; others have multiples of it."""
DESIGN_CM = {"drift_k": 2.0, "edf_k": 1.0, "lag": 2.5, "urgency": 1.1, "calm": 1.4}
"""edf has the least error and breaks the limit; lag would be the best in the held-out worlds."""


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Scenario:
    path = tmp_path_factory.mktemp("scenario") / "planted.yaml"
    path.write_text(CELLS, encoding="utf-8")
    return load_study(path)


def planted_runs(policy: str, cell: str, point: str, error_cm: float) -> list[dict[str, object]]:
    factor = {"load_100": 1.0, "load_110": 3.0, "timely_100": 1.0, "batch_100": 0.5}[cell]
    rows = []
    for policy_seed in (1, 2) if policy == "ddpg" else (None,):
        for place, seed in enumerate(WORLDS):
            wobble = 1.0 + (0.1 * place if policy in ("urgency", "floor") else 0.0)
            rows.append(
                dict.fromkeys(TASK_MEASURES, 0.5)
                | {"policy": policy, "policy_seed": policy_seed, "seed": seed, "cell": cell}
                | {"point": point, "tracking_rms_cm": factor * error_cm * wobble, "knob": math.nan}
                | {"tracking_p99_cm": 3.0 * factor * error_cm, "embb_mbps": 10.0 - 0.5 * place}
            )
    return rows


@pytest.fixture
def study(scenario: Scenario, tmp_path: Path) -> Study:
    rows = []
    for cell in scenario.task_study.cells:
        for policy, error in ERROR_CM.items():
            rows += planted_runs(policy, cell, "tuned", error)
        rows += planted_runs(REFERENCE, cell, "floor", 0.8)
    for number, knob in enumerate((0.25, 4.0)):
        for policy in FAMILIES:
            own = planted_runs(policy, "load_100", f"knob{number}", ERROR_CM[policy] + 1 - number)
            rows += [{**row, "knob": knob} for row in own]
    task = pd.DataFrame(rows)
    task["policy_seed"] = task["policy_seed"].astype("Int64")
    families = {
        name: {
            **{"key": "urllc_factor", "knob": 2.0, "embb_share": 0.996, "embb_late_share": 0.0},
            **{"tracking_rms_cm": error, "keeps_limit": name != "edf_k", "edge": "", "tried": []},
        }
        for name, error in DESIGN_CM.items()
    }
    limits = {"embb_share": 0.995, "embb_late_share": None}
    study = Study(scenario, tmp_path)
    local = replace(scenario, gain_study=replace(scenario.gain_study, methods=()))
    for name in chain_files(local):
        write_parquet(tmp_path / name, pd.DataFrame())
    write_growth(local, tmp_path)
    study.__dict__["task"] = task
    study.__dict__["tunings"] = {
        cell: {"families": families, "limits": limits} for cell in scenario.task_study.cells
    }
    return study


# Measures of a run.


def test_measures_of_four_slots_by_hand(scenario: Scenario) -> None:
    """One slot of warm-up, then three; two robots and a camera."""
    error_m = np.array([[9.0, 9.0], [0.03, 0.04], [0.2, 0.0], [0.0, 0.0]])
    run = RunSlots(
        source="by hand",
        metadata={"policy": "urgency", "seed": "61"},
        num_urllc=2,
        slot_s=0.01,
        warmup_slots=1,
        fields={
            "tracking_error_m": error_m,
            "set_point_age_s": np.array([[9.0, 9.0], [0.01, 0.02], [0.03, 0.04], [0.05, 0.03]]),
            "backlog_packets": np.array([[9.0] * 3, [1, 2, 5], [0.5, 0, 9], [0, 0, 20.0]]),
            "arrivals_packets": np.array([[9] * 3, [2, 0, 6], [0, 0, 12], [2, 0, 0]], np.uint32),
            "superseded_packets": np.array([[9] * 3, [1, 0, 0], [0] * 3, [0] * 3], np.uint32),
            "service_packets": np.array([[9.0] * 3, [1.5, 5, 2], [1, 0, 1], [5, 0, 4.0]]),
            "due_packets": np.array([[9] * 3, [2, 1, 4], [0, 0, 4], [0, 0, 0]], np.uint32),
            "late_packets": np.array([[9] * 3, [1, 0, 1], [0, 0, 1], [0, 0, 0]], np.uint32),
        },
    )
    row = task_row(run, scenario)
    assert row["tracking_rms_cm"] == pytest.approx(100.0 * math.sqrt(0.0425 / 6))
    assert row["tracking_p99_cm"] == pytest.approx(20.0)
    assert row["off_track_slots_share"] == pytest.approx(1 / 6)
    assert row["set_point_age_s"] == pytest.approx(0.03)
    assert row["set_point_age_p99_s"] == 0.05
    assert row["urllc_late_share"] == pytest.approx(1 / 3)
    assert row["urllc_on_time_share"] == pytest.approx(2 / 4)  # of four offered
    assert row["superseded_share"] == pytest.approx(1 / 4)
    assert row["embb_late_share"] == pytest.approx(2 / 8)
    # 2 + 1 + 4 packets of 10 kbit in 30 ms; of URLLC 1.5 + 2 (the queue ran empty) + 0.5 + 2.
    assert row["embb_mbps"] == pytest.approx(7 * 0.01 / 0.03)
    assert row["urllc_mbps"] == pytest.approx(6 * 0.01 / 0.03)
    assert row["horizon_s"] == pytest.approx(0.03)
    assert (row["policy"], row["policy_seed"], row["seed"]) == ("urgency", None, 61)


def test_superseded_packets_are_not_served() -> None:
    fields = {name: np.array([[4.0]]) for name in ("backlog_packets", "arrivals_packets")}
    fields |= {"superseded_packets": np.array([[3.0]]), "service_packets": np.array([[100.0]])}
    assert served_packets(fields) == 5.0


# Statistics.


def test_holm_by_hand() -> None:
    np.testing.assert_allclose(holm([0.01, 0.04, 0.03]), [0.03, 0.06, 0.06])
    np.testing.assert_allclose(holm([0.5, math.nan, 0.9]), [1.0, math.nan, 1.0])
    assert holm([]).shape == (0,)


def test_p_value_is_that_of_the_paired_t_test() -> None:
    sample = np.array([-0.2, -0.1, 0.05, -0.15])
    assert p_value(sample) == pytest.approx(stats.ttest_1samp(sample, 0.0).pvalue)
    assert (p_value([0.0, 0.0]), p_value([1.0, 1.0])) == (1.0, 0.0)
    assert math.isnan(p_value([1.0]))


def test_p_value_is_below_five_per_cent_where_the_interval_has_no_zero() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        sample = rng.normal(0.5, 1.0, (4, 5)) + rng.normal(0.0, 0.5, (4, 1))
        _, lo, hi = mean_interval(sample)
        assert (p_value(sample) < 0.05) == (lo > 0.0 or hi < 0.0)


# Who is compared.


def test_kinds(scenario: Scenario) -> None:
    names = (REFERENCE, *FAMILIES, "ddpg", "pf")
    assert [kind_of(scenario, name) for name in names] == [
        *("reference", "classical", "classical", "control-blind", "control-aware"),
        *("control-aware", "learned", "other"),
    ]
    assert first_aware(scenario, "load_110") == "urgency"
    assert list(lines(scenario)) == ["load", "timely", "batch"]
    assert lines(scenario)["load"] == ["load_100", "load_110"]
    assert family_look(scenario, "calm").label == "calm"


def test_the_best_is_chosen_in_design_worlds_and_keeps_the_limit(study: Study) -> None:
    assert best_blind(study, "load_100") == "drift_k"
    assert best_family(study, "load_100", ("classical",)) == "drift_k"
    assert best_family(study, "load_100", ("control-aware",)) == "urgency"
    study.tunings["load_100"]["families"]["drift_k"]["keeps_limit"] = False
    assert best_family(study, "load_100", ("classical",)) is None
    study.tunings["load_100"]["families"]["drift_k"]["keeps_limit"] = True


def test_gains_by_hand(study: Study) -> None:
    table = task_gains(study).set_index(["cell", "policy"])
    row = table.loc["load_100", "urgency"]
    ratios = np.log([0.5, 0.55, 0.6])
    half = stats.t.ppf(0.975, 2) * ratios.std(ddof=1) / math.sqrt(3)
    assert row["rms_over_blind"] == pytest.approx(math.exp(ratios.mean()))
    assert row["rms_over_blind_lo"] == pytest.approx(math.exp(ratios.mean() - half))
    assert row["rms_over_blind_hi"] == pytest.approx(math.exp(ratios.mean() + half))
    p = stats.ttest_1samp(ratios, 0.0).pvalue
    assert row["rms_over_blind_p"] == pytest.approx(p)
    assert row["rms_over_blind_p_holm"] == pytest.approx(min(1.0, 4 * p))  # four cells
    assert (row["blind"], row["classical"], row["kind"]) == (
        *("drift_k", "drift_k", "control-aware"),
    )
    assert (row["expected_rms"], row["rms_outcome"]) == ("0.4 to 0.6", "open")
    assert table.loc["load_100", "calm"]["expected_rms"] == ""
    assert row["embb_share"] == 1.0
    errors = np.array([1.0, 1.1, 1.2])
    assert row["network_share"] == pytest.approx(np.mean(1 - (0.8 / errors) ** 2))
    learned = table.loc["load_100", "ddpg"]
    assert learned["rms_over_blind"] == pytest.approx(0.6)
    assert learned["kind"] == "learned"


def test_expectations() -> None:
    expected = (0.4, 0.6)
    assert in_range(Interval(0.5, 0.45, 0.55), expected) == "met"
    assert in_range(Interval(0.7, 0.65, 0.75), expected) == "missed"
    assert in_range(Interval(0.6, 0.55, 0.65), expected) == "open"
    assert in_range(Interval(0.6, 0.55, 0.65), None) == ""


def test_knobs_curves_and_superseding(study: Study) -> None:
    knobs = task_knobs(study)
    assert len(knobs) == 20
    assert knobs["least_embb_share"].unique() == [0.995]
    curves = task_pareto(study)
    urgency = curves[curves["policy"] == "urgency"]
    assert urgency["knob"].tolist() == [2.0, 0.25, 4.0]
    assert urgency["tuned"].tolist() == [True, False, False]
    (learned,) = curves[curves["policy"] == "ddpg"].to_dict("records")
    assert learned["tracking_rms_cm"] == pytest.approx(1.2)
    (row,) = task_superseding(study).to_dict("records")
    assert (row["cell"], row["without"], row["policy"]) == ("batch_100", "timely_100", "drift_k")
    assert row["rms_ratio"] == pytest.approx(0.5)


def test_the_claim_is_of_every_cell(study: Study) -> None:
    judged = task_improves(study)
    assert (judged.base.value, judged.base.axis) == ("load_100", "")
    assert [c.value for c in judged.others] == ["load_110", "timely_100", "batch_100"]
    assert judged.base.outcome == "holds"
    rms, _, embb = judged.base.statements
    assert rms.interval.mean == pytest.approx(math.exp(np.log([0.5, 0.55, 0.6]).mean()))
    assert embb.interval.mean == pytest.approx(1.0)


def test_figures_show_every_policy(study: Study) -> None:
    traces = pd.DataFrame(
        {
            **{"cell": "load_100", "policy": policy, "slot": slot, "robot": robot},
            **{"speed_mps": 0.1 * robot, "hol_delay_s": 0.01, "tracking_error_m": 0.02},
            "num_prb": 1,
        }
        for policy in FAMILIES
        for slot in range(40)
        for robot in range(2)
    )
    tables = {"traces": traces, "growth": study.measures("growth")}
    study.measures = tables.__getitem__  # type: ignore[method-assign, assignment]
    pareto = draw_pareto(study)
    (legend,) = pareto.legends
    labels = {text.get_text() for text in legend.get_texts()}
    assert {family_look(study.scenario, name).label for name in (*FAMILIES, "ddpg")} <= labels
    assert len(draw_gain(study).axes) == 2  # superseding alone sets a line apart
    assert len(draw_traces(study).axes) == 8


def test_a_rule_that_breaks_the_limit_confirms_nothing(study: Study) -> None:
    study.tunings["load_100"]["families"]["urgency"]["keeps_limit"] = False
    assert task_improves(study).base.outcome == "open"
    table = task_gains(study).set_index(["cell", "policy"])
    assert table.loc["load_100", "urgency"]["rms_outcome"] == ""
    study.tunings["load_100"]["families"]["urgency"]["keeps_limit"] = True


def test_a_rule_that_makes_video_late_does_not_improve_where_that_is_bounded(study: Study) -> None:
    is_aware = (study.task["policy"] == "urgency") & (study.task["cell"] == "timely_100")
    study.task.loc[is_aware, "embb_late_share"] = 0.6
    timely = next(c for c in task_improves(study).others if c.value == "timely_100")
    assert timely.statements[-1].name.startswith("share of late eMBB packets")
    assert timely.outcome == "contradicted"


def test_learners_by_hand(study: Study) -> None:
    """Of two training seeds; in the second world errors of `urgency` are 1.1 times as large."""
    table = task_learners(study).set_index("cell")
    row = table.loc["load_100"]
    assert (row["policy"], row["aware"], row["blind"], row["twin"]) == (
        "ddpg",
        "urgency",
        *("drift_k", ""),
    )
    errors = ERROR_CM["urgency"] * np.array([1.0, 1.1, 1.2])
    assert row["rms_over_aware"] == pytest.approx(math.exp(np.log(1.2 / errors).mean()))
    assert row["rms_seeds_std_cm"] == pytest.approx(0.0)
    assert row["embb_late_share_aware"] == 0.5
    assert row["keeps_limits"]
    study.task.loc[study.task["policy"] == "ddpg", "embb_mbps"] *= 0.99
    assert not task_learners(study).set_index("cell").loc["load_100"]["keeps_limits"]
    left, middle, right = draw_learners(study).axes
    assert left.get_xlabel() == "RMS error, change [%]"
    assert [len(panel.get_lines()) > 3 for panel in (left, middle, right)] == [True] * 3


def test_twins_differ_in_what_they_see_alone(scenario: Scenario) -> None:
    own = scenario.learning
    twins = {"sees": replace(own, observe_demand=True), "blind": own, "slow": own}
    twins["slow"] = replace(own, actor_lr=1e-5)
    study = replace(scenario.task_study, policies=("sees", "blind", "slow"))
    variant = replace(scenario, learners=twins, task_study=study)
    assert [twin_of(variant, name) for name in twins] == ["blind", "sees", None]


def test_lines_that_would_share_a_name_have_their_own(scenario: Scenario) -> None:
    cells = scenario.task_study.cells
    one = replace(cells["load_100"], values={"robot.reach_turn_rad": 1.0})
    two = replace(cells["load_100"], values={"robot.reach_turn_rad": 2.0})
    study = replace(scenario.task_study, cells={"turn_1": one, "turn_2": two})
    found = lines(replace(scenario, task_study=study))
    assert found == {"turn": ["turn_1"], "turn_2": ["turn_2"]}
