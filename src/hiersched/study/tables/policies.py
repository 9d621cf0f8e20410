"""Tables of policies: means over worlds with their intervals, paired comparisons."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from hiersched.experiments.points import BASELINE
from hiersched.policies.index_rules import CLASSICAL
from hiersched.scenario import Scenario
from hiersched.study.metrics import DELAY_QUANTILES, violation_column
from hiersched.study.registry import (
    axis_of,
    has_bound,
    has_cells,
    has_sweeps,
    learners_among,
    table,
    varies,
)
from hiersched.study.samples import (
    INTERVAL_NOTE,
    SYMMETRIC,
    counts,
    measure_interval,
    paired,
    resolution,
    smallest_late_share,
)
from hiersched.study.statistics import (
    mean_interval,
    paired_difference,
    paired_log_ratio,
    probability_of_improvement,
)
from hiersched.study.study import Study
from hiersched.study.tables.text import LEARNED_NOTE, LOOP_NOTE, NONE_NOTE, RATIO_NOTE

BACKLOG = "mean_square_backlog"
"""Time average of half the sum of squared backlogs: the measure by which policies are ranked."""
LOAD, SCALE = "traffic.load", "radio.fading.scale"

_LATE = ("urllc_late_share", "embb_late_share")
_RATES = ("urllc_rate_mbps", "embb_rate_mbps")
_BACKLOGS = ("urllc_backlog_packets", "embb_backlog_packets")
OF_ROBOTS = ("tracking_error_cm", "dexterity_index", "off_track_share")
"""Measures of what a loop does."""
_FIRST = (*_LATE, *_RATES, *_BACKLOGS, "urllc_delay_p99_s", *OF_ROBOTS[:2])
LEADING_MEASURES = (
    *_FIRST,
    *(f"urllc_delay_{name}_s" for name in DELAY_QUANTILES if name != "p99"),
    *(f"embb_delay_{name}_s" for name in DELAY_QUANTILES),
    *("off_track_share", BACKLOG),
)
TRAILING_MEASURES = (
    *("delay_steps", "delay_capped_share", "arrival_clamped_share"),
    *("control_saturations_per_s", "penalty_cost"),
)
COMPARED = (
    *("urllc_late_share", *_RATES, "embb_late_share", *_BACKLOGS, "urllc_delay_p99_s"),
    *("tracking_error_cm", "off_track_share", BACKLOG, "penalty_cost"),
)
CELL_MEASURES = ("urllc_late_share", *_RATES, "tracking_error_cm", BACKLOG, "penalty_cost")
LOOP = ("loop_growth", "loop")
"""Columns of `Study.loop_columns`."""
_READ_INTERVALS = tuple(
    f"{name}{end}" for name in (*_FIRST, BACKLOG, "penalty_cost") for end in ("", "_lo", "_hi")
)


def all_measures(scenario: Scenario) -> list[str]:
    """List every measure of the tables of policies and sweeps, in their order."""
    violating = [violation_column(level) for level in scenario.traffic.reliability_levels]
    return [*LEADING_MEASURES, *violating, *TRAILING_MEASURES]


def _means(runs: pd.DataFrame, names: Iterable[str], scenario: Scenario) -> dict[str, Any]:
    """Return columns of the runs of a policy: their `samples.counts`, intervals of measures."""
    row: dict[str, Any] = {**counts(runs)}
    for name in names:
        row |= measure_interval(name, runs, scenario).columns(name)
    return row


@table(
    "policies",
    title="Policies in the same worlds",
    note=f"{INTERVAL_NOTE} `…_median`: over worlds, of learned policies over policies and worlds. "
    "`urllc_late_share_smallest`: the least late share that these worlds tell from 0. "
    "`mean_square_backlog`: time average of ½ΣF² [packets²]. Delays are of delivered packets; "
    "packets that still wait count in the late shares alone. `backlog_over_best`, `improvement`: "
    "mean square backlog over that of the best classical scheduler, and the probability that it "
    f"is less in another world. {LOOP_NOTE} The CSV has more columns. {LEARNED_NOTE}",
    reads=("runs", "growth"),
    columns=(
        *("policy", "seeds", "training_seeds"),
        *_READ_INTERVALS,
        *(f"{name}_median" for name in ("urllc_late_share", "embb_late_share", BACKLOG)),
        "urllc_late_share_smallest",
        *("backlog_over_best", "backlog_over_best_lo", "backlog_over_best_hi"),
        *("improvement", "improvement_lo", "improvement_hi", "best_classical", *LOOP),
    ),
)
def policy_table(study: Study) -> pd.DataFrame:
    """Return `policy_rows` and how the second moment of the worst loop grows under each policy."""
    rows = policy_rows(study)
    loops = [study.loop_columns("evaluate", "", policy) for policy in rows["policy"]]
    return pd.concat([rows, pd.DataFrame(loops)], axis=1)


def policy_rows(study: Study) -> pd.DataFrame:
    """Return one row a policy: all measures over the evaluation's worlds, medians beside means."""
    runs, scenario = study.evaluation, study.scenario
    names = all_measures(scenario)
    rows = []
    for policy, own in runs.groupby("policy", sort=False):
        row: dict[str, Any] = {"policy": policy, **_means(own, names, scenario)}
        row |= {f"{name}_median": float(own[name].median()) for name in names}
        row["urllc_late_share_smallest"] = smallest_late_share(own, scenario)
        rows.append({**row, **_against_best(own, runs, improvement=True)})
    return pd.DataFrame(rows)


@table(
    "sweeps",
    title="Sweeps: one axis varied at a time",
    note=f"{INTERVAL_NOTE} {LOOP_NOTE} The CSV has more columns.",
    reads=("runs", "growth"),
    when=has_sweeps,
    columns=("axis", "value", "policy", *_READ_INTERVALS, *LOOP),
)
def sweep_table(study: Study) -> pd.DataFrame:
    """Return one row an axis, value and policy: all measures over the sweep's worlds."""
    rows = along_axes(study, *study.scenario.sweeps.axes)
    points = zip(rows["axis"], rows["value"], rows["policy"], strict=True)
    return pd.concat([rows, pd.DataFrame(study.loop_columns(*point) for point in points)], axis=1)


def along_axes(study: Study, *axes: str) -> pd.DataFrame:
    """Return the rows of `sweep_table` of some axes."""
    runs, keys = study.sweeps, ["axis", "value", "policy"]
    names = all_measures(study.scenario)
    rows = [
        {**dict(zip(keys, key, strict=True)), **_means(own, names, study.scenario_of(own))}
        for key, own in runs[runs["axis"].isin(axes)].groupby(keys, sort=False)
    ]
    return pd.DataFrame(rows)


@table("runs", title="Every run of a policy", reads=("runs", "growth"), columns=())
def run_table(study: Study) -> pd.DataFrame:
    """Return one row a run: numbers to compute with, and how loops of its point grow."""
    runs = pd.concat([study.evaluation, study.cells, study.sweeps], ignore_index=True)
    points = zip(runs["experiment"], runs["value"], runs["policy"], strict=True)
    runs = pd.concat([runs, pd.DataFrame(study.loop_columns(*point) for point in points)], axis=1)
    return runs.drop(columns=["experiment", "group"])


@table(
    "comparison",
    title="Policies against PF, and against the best classical scheduler, in the same worlds",
    note=f"{RATIO_NOTE} {NONE_NOTE} Differences with Student t 95 % intervals. {LEARNED_NOTE} "
    f"Beside measures of robots, of the policy and of the baseline: {LOOP_NOTE}",
    reads=("runs", "growth"),
)
def comparison_table(study: Study) -> pd.DataFrame:
    """Compare every policy with PF, then with the best classical scheduler, in the same worlds.

    Typical ratios and mean differences; both intervals are Student's, that of the ratio on its
    logarithm. `seeds_below_baseline` counts worlds, of a learned policy its pairs of policy and
    world.
    """
    runs, scenario = study.evaluation, study.scenario
    policies = list(dict.fromkeys(runs["policy"]))
    baselines = [name for name in (BASELINE, best_classical(runs)) if name in policies]
    rows = []
    for baseline, policy in product(dict.fromkeys(baselines), policies):
        if policy == baseline:
            continue
        own, other = (runs[runs["policy"] == name] for name in (policy, baseline))
        of_both = {"loop": policy, "baseline_loop": baseline}
        loops = {n: study.loop_columns("evaluate", "", of)["loop"] for n, of in of_both.items()}
        for name in COMPARED:
            a, b = paired(own, other, name)
            least = resolution(name, pd.concat([own, other]), scenario)
            rows.append(
                {
                    "policy": policy,
                    "baseline": baseline,
                    "measure": name,
                    **counts(own),
                    "mean": float(a.mean()),
                    "baseline_mean": float(b.mean()),
                    **paired_log_ratio(a, b, resolution=least).columns("ratio"),
                    **paired_difference(a, b).columns("difference"),
                    "seeds_below_baseline": int((a < b).sum()),
                    **(loops if name in OF_ROBOTS else dict.fromkeys(loops, "")),
                }
            )
    return pd.DataFrame(rows) if rows else pd.DataFrame(columns=["policy", "baseline", "measure"])


def best_classical(runs: pd.DataFrame) -> str | None:
    """Return the classical scheduler of least mean square backlog; the exact optimum is none.

    It is picked by the very runs with which it is compared, so a comparison with it is never too
    kind to others. None where no classical scheduler was run.
    """
    means = runs[runs["policy"].isin(CLASSICAL)].groupby("policy")[BACKLOG]
    return str(means.mean().idxmin()) if means.ngroups else None


def _against_best(
    own: pd.DataFrame, runs: pd.DataFrame, *, improvement: bool = False
) -> dict[str, Any]:
    """Return columns of a policy: its mean square backlog against the best classical scheduler's.

    The typical ratio in the same worlds and, if wanted, the probability that it is less in a world
    than that of the scheduler in another; no columns where no classical scheduler was run.
    """
    best = best_classical(runs)
    if best is None:
        return {}
    pair = paired(own, runs[runs["policy"] == best], BACKLOG)
    row = {"best_classical": best, **paired_log_ratio(*pair).columns("backlog_over_best")}
    if improvement:
        row |= probability_of_improvement(*pair).columns("improvement")
    return row


@table(
    "scores",
    title="Policies over all loads",
    note="Score: log(PF / own) / log(PF / best classical scheduler of the load) of mean square "
    "backlogs, both summed over the loads; 0 is PF, 1 the best. Mean and Student t 95 % "
    f"interval over worlds. {LEARNED_NOTE} `shorter_worlds`: share of worlds and loads in which "
    "the policy's mean square backlog is below that of the best classical scheduler.",
    reads=("runs",),
    when=varies(LOAD),
)
def score_table(study: Study) -> pd.DataFrame:
    """Return how the evaluated policies stand over all loads together, a row each.

    Of the score, both logarithms are summed over the loads and the lower one is averaged over
    worlds. `shorter_worlds` counts worlds, of a learned policy pairs of policy and world.
    """
    runs = study.evaluation
    along = study.sweeps[study.sweeps["axis"] == axis_of(study.scenario, LOAD)]
    if BASELINE not in set(along["policy"]):
        return pd.DataFrame(columns=["policy", "loads", "seeds", "training_seeds"])
    rows = []
    for policy in dict.fromkeys(runs["policy"]):
        gains, best_gains, shorter = [], [], []
        number: dict[str, int] = {}
        for _, group in along.groupby("value", sort=False):
            best = best_classical(group)
            by_policy = {str(name): rows for name, rows in group.groupby("policy")}
            if policy not in by_policy or best is None:
                continue
            own = by_policy[policy]
            number = counts(own)
            baseline_log, own_log, best_log = (
                np.log(paired(own, by_policy[name], BACKLOG)[1])
                for name in (BASELINE, policy, best)
            )
            gains.append(baseline_log - own_log)
            best_gains.append(baseline_log - best_log)
            shorter.append(own_log < best_log)
        if gains:
            most = float(np.sum(best_gains, axis=0).mean())
            scores = np.sum(gains, axis=0) / (most if most > 0.0 else math.nan)
            row = {"policy": policy, "loads": len(gains), **number}
            row |= mean_interval(scores).columns("score")
            rows.append({**row, "shorter_worlds": float(np.mean(shorter))})
    return pd.DataFrame(rows)


@table(
    "generalisation",
    title="Trained policies where they were not trained",
    note=f"{INTERVAL_NOTE} Cells: URLLC users, eMBB users, PRBs. `backlog_over_best`: mean square "
    "backlog over that of the best classical scheduler there, world by world. Sweeps: other "
    f"loads and scales. {LOOP_NOTE}",
    reads=("runs", "growth"),
    when=has_cells,
)
def generalisation_table(study: Study) -> pd.DataFrame:
    """Return a row an axis (cell, those of load and scale), value and policy."""
    scenario = study.scenario
    runs = pd.concat([study.cells, study.sweeps], ignore_index=True)
    axes = ("cell", axis_of(scenario, LOAD), axis_of(scenario, SCALE))
    rows = []
    for axis in filter(None, axes):
        for value, group in runs[runs["axis"] == axis].groupby("value", sort=False):
            for policy, own in group.groupby("policy", sort=False):
                row: dict[str, Any] = {"axis": axis, "value": value, "policy": policy}
                row |= _means(own, CELL_MEASURES, study.scenario_of(own))
                rows.append({**row, **_against_best(own, group), **study.loop_of(own)})
    return pd.DataFrame(rows)


@table(
    "bound",
    title="Distance from the exact optimum of a slot",
    note="`gap`: drift-plus-penalty Lagrangian of the decision minus that of the exact optimum in "
    "the same state, mean and Student t 95 % interval over worlds, world i under the learned "
    "policy of training seed i. `uncertified`: what the "
    "solver's bound leaves open. `first_gap`: sum from giving everyone the first PRB greedily "
    "minus exactly; `first_log_rate_gap`: the same for minus the logarithm of the rates.",
    reads=("bound",),
    when=has_bound,
)
def bound_table(study: Study) -> pd.DataFrame:
    """Return a row the policy whose states they are, and the decider that is asked there.

    Gaps are value - exact, means over the slots of a world. `gap_share`: gaps over sizes of the
    optima, in all; `share_optimal`: gaps of 0, to 1e-6 of the optimum; `uncertified`: largest
    exact - bound. Those of the first PRBs alone, greedy - exact, are sums over users.
    """
    rows = []
    for (policy, decider), group in study.bound.groupby(["policy", "decider"], sort=False):
        gaps = pd.DataFrame({"gap": group["value"] - group["exact"]})
        for name, of in (("first_gap", "lagrangian"), ("first_log_rate_gap", "log_rate")):
            gaps[name] = group[f"first_{of}_greedy"] - group[f"first_{of}_exact"]
        by_world = gaps.groupby(group["seed"]).mean()
        gap, size = gaps["gap"], group["exact"].abs()
        rows.append(
            {
                "states_of": policy,
                "decider": decider,
                "seeds": len(by_world),
                "slots": len(group),
                **mean_interval(by_world["gap"]).columns("gap"),
                "gap_max": float(gap.max()),
                "gap_share": float(gap.sum() / size.sum()),
                "share_optimal": float((gap <= 1e-6 * (1.0 + size)).mean()),
                "uncertified": float((group["exact"] - group["bound"]).max()),
                **mean_interval(by_world["first_gap"]).columns("first_gap"),
                **mean_interval(by_world["first_log_rate_gap"]).columns("first_log_rate_gap"),
            }
        )
    return pd.DataFrame(rows)


def differing_keys(scenario: Scenario, learner: str) -> dict[str, Any]:
    """Return the keys of a learner that differ from the section `learning`, with their values."""
    base, own = asdict(scenario.learning), asdict(scenario.learned[learner])
    return {key: value for key, value in own.items() if value != base[key]}


@table(
    "learners",
    title="Learners along the load, against the scenario's own",
    note=f"{INTERVAL_NOTE} `differs`: keys of the section `learning` that are not the scenario's. "
    "Columns `…_minus_own`, `…_over_own`: paired differences from the scenario's own learner, "
    f"and typical ratios, the k-th training seeds of both in the same world. {NONE_NOTE} "
    f"{LOOP_NOTE}",
    reads=("runs", "growth"),
    when=varies(LOAD, learners_among),
)
def learner_table(study: Study) -> pd.DataFrame:
    """Return what every learner reaches at every load, and how far that is from the own one's.

    Symmetric measures are compared by paired differences (suffix ``_minus_own``), skewed ones by
    typical ratios (``_over_own``).
    """
    scenario, sweeps = study.scenario, study.sweeps
    along = sweeps[sweeps["axis"] == axis_of(scenario, LOAD)]
    own, rows = scenario.learning.algorithm, []
    for load, group in along.groupby("value", sort=False):
        by_policy = {str(name): runs for name, runs in group.groupby("policy")}
        for learner in (name for name in scenario.learned if name in by_policy):
            runs = by_policy[learner]
            row: dict[str, Any] = {"load": load, "learner": learner}
            keys = differing_keys(scenario, learner)
            differs = ", ".join(f"{key} = {value}" for key, value in keys.items())
            row |= {"differs": differs or "as configured", **counts(runs)}
            for measure in CELL_MEASURES:
                at_load = study.scenario_of(runs)
                row |= measure_interval(measure, runs, at_load).columns(measure)
                if learner == own or own not in by_policy:
                    continue
                pair = paired(runs, by_policy[own], measure)
                if measure in SYMMETRIC:
                    row |= paired_difference(*pair).columns(f"{measure}_minus_own")
                else:
                    least = resolution(measure, runs, at_load)
                    over = paired_log_ratio(*pair, resolution=least)
                    row |= over.columns(f"{measure}_over_own")
            rows.append(row | study.loop_of(runs))
    return pd.DataFrame(rows)
