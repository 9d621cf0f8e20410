"""Tables of policies: means over worlds with their intervals, paired comparisons."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import pandas as pd

from hiersched.experiments.points import BASELINE
from hiersched.policies.index_rules import CLASSICAL
from hiersched.scenario import Scenario
from hiersched.study.intervals import (
    INTERVAL_NOTE,
    SYMMETRIC,
    measure_interval,
    resolution,
    smallest_late_share,
)
from hiersched.study.metrics import violation_column
from hiersched.study.registry import (
    axis_of,
    has_bound,
    has_cells,
    has_sweeps,
    learners_among,
    table,
    varies,
)
from hiersched.study.samples import counts, paired
from hiersched.study.statistics import (
    Interval,
    interval_columns,
    mean_interval,
    paired_difference,
    paired_log_ratio,
    probability_of_improvement,
)
from hiersched.study.study import Study
from hiersched.study.tables.text import LEARNED_NOTE, NONE_NOTE, RATIO_NOTE

BACKLOG = "mean_square_backlog"
"""Time average of half the sum of squared backlogs: the measure by which policies are ranked."""
LOAD, SCALE = "traffic.load", "radio.fading.scale"

LEADING_MEASURES = (
    "urllc_late_share",
    "embb_late_share",
    "urllc_rate_mbps",
    "embb_rate_mbps",
    "urllc_backlog_packets",
    "embb_backlog_packets",
    "urllc_delay_p99_s",
    "tracking_error_cm",
    "dexterity_index",
    "urllc_delay_p50_s",
    "urllc_delay_p95_s",
    "urllc_delay_p999_s",
    "embb_delay_p50_s",
    "embb_delay_p95_s",
    "embb_delay_p99_s",
    "embb_delay_p999_s",
    "off_track_share",
    "mean_square_backlog",
)
TRAILING_MEASURES = (
    "delay_steps",
    "delay_capped_share",
    "arrival_clamped_share",
    "control_saturations_per_s",
    "penalty_cost",
)
COMPARED = (
    "urllc_late_share",
    "urllc_rate_mbps",
    "embb_rate_mbps",
    "embb_late_share",
    "urllc_backlog_packets",
    "embb_backlog_packets",
    "urllc_delay_p99_s",
    "tracking_error_cm",
    "off_track_share",
    "mean_square_backlog",
    "penalty_cost",
)
CELL_MEASURES = (
    "urllc_late_share",
    "urllc_rate_mbps",
    "embb_rate_mbps",
    "tracking_error_cm",
    BACKLOG,
    "penalty_cost",
)
_MEDIAN = "`…_median`: over worlds, of learned policies over policies and worlds."
_READ_MEASURES = (
    "urllc_late_share",
    "embb_late_share",
    "urllc_rate_mbps",
    "embb_rate_mbps",
    "urllc_backlog_packets",
    "embb_backlog_packets",
    "urllc_delay_p99_s",
    "tracking_error_cm",
    "dexterity_index",
    "mean_square_backlog",
    "penalty_cost",
)
_READ_INTERVALS = tuple(f"{name}{end}" for name in _READ_MEASURES for end in ("", "_lo", "_hi"))


def all_measures(scenario: Scenario) -> list[str]:
    """List every measure of the tables of policies and sweeps, in their order."""
    violating = [violation_column(level) for level in scenario.traffic.reliability_levels]
    return [*LEADING_MEASURES, *violating, *TRAILING_MEASURES]


def summarise(
    runs: pd.DataFrame, by: Sequence[str], names: Sequence[str], scenario: Scenario
) -> pd.DataFrame:
    """Return the mean of each measure over a group's runs, and its interval as ``_lo``, ``_hi``.

    `seeds` are the worlds, `training_seeds` the policies of a learner, 0 of a rule: see `samples`.

    Parameters
    ----------
    runs
        One row a run.
    by
        Columns that make up a group; groups keep the order of the rows.
    names
        Measures.
    scenario
        Of the runs.
    """
    rows = []
    for key, group in runs.groupby(list(by), sort=False):
        row: dict[str, Any] = dict(zip(by, key, strict=True))
        row |= counts(group)
        for name in names:
            row |= interval_columns(name, measure_interval(name, group, scenario))
        rows.append(row)
    return pd.DataFrame(rows)


@table(
    "policies",
    title="Policies in the same worlds",
    note=f"{INTERVAL_NOTE} {_MEDIAN} `urllc_late_share_smallest`: the least late share that these "
    "worlds tell from 0. `mean_square_backlog`: time average of ½ΣF² [packets²]. Delays are of "
    "delivered packets; packets that still wait count in the late shares alone. "
    "`backlog_over_best`, `improvement`: mean square backlog over that of the best classical "
    "scheduler, and the probability that it is less in another world. The CSV has more "
    f"columns. {LEARNED_NOTE}",
    reads=("runs",),
    columns=(
        *("policy", "seeds", "training_seeds"),
        *_READ_INTERVALS,
        *(f"{name}_median" for name in ("urllc_late_share", "embb_late_share", BACKLOG)),
        "urllc_late_share_smallest",
        *("backlog_over_best", "backlog_over_best_lo", "backlog_over_best_hi"),
        *("improvement", "improvement_lo", "improvement_hi", "best_classical"),
    ),
)
def policy_table(study: Study) -> pd.DataFrame:
    """Return one row a policy: all measures over the evaluation's worlds, medians beside means.

    Of a learned policy, over all its policies in all worlds. `urllc_late_share_smallest` is the
    least late share that these worlds tell from 0.
    """
    runs, scenario = study.evaluation, study.scenario
    names = all_measures(scenario)
    table = summarise(runs, ["policy"], names, scenario)
    groups = [group for _, group in runs.groupby("policy", sort=False)]
    medians = {f"{name}_median": [float(g[name].median()) for g in groups] for name in names}
    smallest = [smallest_late_share(group, scenario) for group in groups]
    medians["urllc_late_share_smallest"] = smallest
    table = pd.concat([table, pd.DataFrame(medians)], axis=1)
    return table.merge(standing(runs), on="policy")


@table(
    "sweeps",
    title="Sweeps: one axis varied at a time",
    note=f"{INTERVAL_NOTE} The CSV has more columns.",
    reads=("runs",),
    when=has_sweeps,
    columns=("axis", "value", "policy", *_READ_INTERVALS),
)
def sweep_table(study: Study) -> pd.DataFrame:
    """Return one row an axis, value and policy: all measures over the sweep's worlds."""
    return along_axes(study, *study.scenario.sweeps.axes)


def along_axes(study: Study, *axes: str) -> pd.DataFrame:
    """Return the rows of `sweep_table` of some axes."""
    runs = study.sweeps
    by = ["axis", "value", "policy"]
    own = runs[runs["axis"].isin(axes)]
    return summarise(own, by, all_measures(study.scenario), study.scenario)


@table(
    "runs",
    title="Every run of a policy",
    reads=("runs",),
    columns=(),
)
def run_table(study: Study) -> pd.DataFrame:
    """Return one row a run: numbers to compute with."""
    runs = pd.concat([study.evaluation, study.cells, study.sweeps], ignore_index=True)
    return runs.drop(columns=["experiment", "group"])


@table(
    "comparison",
    title="Policies against PF, and against the best classical scheduler, in the same worlds",
    note=f"{RATIO_NOTE} {NONE_NOTE} Differences with Student t 95 % intervals. {LEARNED_NOTE}",
    reads=("runs",),
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
    rows = [
        row
        for baseline in dict.fromkeys(baselines)
        for policy in policies
        if policy != baseline
        for row in _compared(runs, str(policy), str(baseline), scenario)
    ]
    columns = ["policy", "baseline", "measure"]
    return pd.DataFrame(rows) if rows else pd.DataFrame(columns=columns)


def _compared(
    runs: pd.DataFrame, policy: str, baseline: str, scenario: Scenario
) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    own, other = (runs[runs["policy"] == name] for name in (policy, baseline))
    both = pd.concat([own, other])
    for name in COMPARED:
        a, b = paired(own, other, name)
        rows.append(
            {
                "policy": policy,
                "baseline": baseline,
                "measure": name,
                **counts(own),
                "mean": float(a.mean()),
                "baseline_mean": float(b.mean()),
                **interval_columns(
                    "ratio", paired_log_ratio(a, b, resolution=resolution(name, both, scenario))
                ),
                **interval_columns("difference", paired_difference(a, b)),
                "seeds_below_baseline": int((a < b).sum()),
            }
        )
    return rows


def best_classical(runs: pd.DataFrame) -> str | None:
    """Return the classical scheduler of least mean square backlog; the exact optimum is none.

    It is picked by the very runs with which it is compared, so a comparison with it is never too
    kind to others. None where no classical scheduler was run.
    """
    means = runs[runs["policy"].isin(CLASSICAL)].groupby("policy")[BACKLOG]
    return str(means.mean().idxmin()) if means.ngroups else None


def standing(runs: pd.DataFrame) -> pd.DataFrame:
    """Return by policy how its mean square backlog compares with the best classical scheduler's.

    Returns
    -------
    DataFrame
        Columns policy, best_classical, backlog_over_best (bounds _lo, _hi: the typical ratio in the
        same worlds), and improvement (likewise): the probability that the policy's is less in a
        world than that of the best classical scheduler in another.
    """
    best = best_classical(runs)
    rows = []
    for policy, group in runs.groupby("policy", sort=False):
        row: dict[str, Any] = {"policy": policy}
        if best is not None:
            own, other = paired(group, runs[runs["policy"] == best], BACKLOG)
            row["best_classical"] = best
            row |= interval_columns("backlog_over_best", paired_log_ratio(own, other))
            row |= interval_columns("improvement", probability_of_improvement(own, other))
        rows.append(row)
    return pd.DataFrame(rows)


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
    """Return how the evaluated policies stand over all loads together.

    The score of a policy in a world is log(PF / its own) / log(PF / that of the best classical
    scheduler of the load), of mean square backlogs, both logarithms summed over the loads and the
    lower one averaged over worlds: 0 as PF, 1 as the best, more where its queues are shorter.

    Returns
    -------
    DataFrame
        Columns policy, loads, seeds (worlds), training_seeds (0 of a rule), score (_lo, _hi),
        shorter_worlds: the share of worlds, or of pairs of policy and world, in which its mean
        square backlog is below that of the best classical scheduler of the load.
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
            if policy not in set(group["policy"]) or best is None:
                continue
            by_policy = {str(name): rows for name, rows in group.groupby("policy")}
            own = by_policy[policy]
            number = counts(own)
            logs = {
                name: np.log(paired(own, by_policy[name], BACKLOG)[1])
                for name in (BASELINE, policy, best)
            }
            gains.append(logs[BASELINE] - logs[policy])
            best_gains.append(logs[BASELINE] - logs[best])
            shorter.append(logs[policy] < logs[best])
        if gains:
            most = float(np.sum(best_gains, axis=0).mean())
            scores = np.sum(gains, axis=0) / (most if most > 0.0 else math.nan)
            row = {"policy": policy, "loads": len(gains), **number}
            row |= interval_columns("score", mean_interval(scores))
            rows.append({**row, "shorter_worlds": float(np.mean(shorter))})
    return pd.DataFrame(rows)


@table(
    "generalisation",
    title="Trained policies where they were not trained",
    note=f"{INTERVAL_NOTE} Cells: URLLC users, eMBB users, PRBs. `backlog_over_best`: mean square "
    "backlog over that of the best classical scheduler there, world by world. Sweeps: other "
    "loads and scales.",
    reads=("runs",),
    when=has_cells,
)
def generalisation_table(study: Study) -> pd.DataFrame:
    """Return how policies do where they were not trained, beside the best scheduler there.

    Returns
    -------
    DataFrame
        One row an axis (cell, those of load and scale), value and policy: seeds, training_seeds,
        measures with their intervals, best_classical, and backlog_over_best: the typical ratio of
        the mean square backlogs in the same worlds.
    """
    scenario = study.scenario
    runs = pd.concat([study.cells, study.sweeps], ignore_index=True)
    axes = ("cell", axis_of(scenario, LOAD), axis_of(scenario, SCALE))
    rows = []
    for axis in filter(None, axes):
        for value, group in runs[runs["axis"] == axis].groupby("value", sort=False):
            best = best_classical(group)
            for policy, own in group.groupby("policy", sort=False):
                row: dict[str, Any] = {"axis": axis, "value": value, "policy": policy}
                row |= counts(own)
                for name in CELL_MEASURES:
                    row |= interval_columns(name, measure_interval(name, own, scenario))
                if best is not None:
                    row["best_classical"] = best
                    other = group[group["policy"] == best]
                    over = paired_log_ratio(*paired(own, other, BACKLOG))
                    row |= interval_columns("backlog_over_best", over)
                rows.append(row)
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
    """Return how far decisions are from the exact optimum of their slots.

    Returns
    -------
    DataFrame
        One row the policy whose states they are and the decider asked there: seeds, slots, gap
        (value - exact, mean over the slots of a world; interval over worlds), gap_max, gap_share
        (gaps over sizes of the optima, in all), share_optimal (gaps of 0, to 1e-6 of the optimum),
        uncertified (largest exact - bound), and of the first PRBs alone, greedy - exact: sums over
        users of the Lagrangian (first_gap) and of the logarithm of the rate.
    """
    slots = study.bound
    rows = []
    for (policy, decider), group in slots.groupby(["policy", "decider"], sort=False):
        gap = group["value"] - group["exact"]
        size = 1.0 + group["exact"].abs()
        by_world = group.assign(gap=gap).groupby("seed")
        first = group["first_lagrangian_greedy"] - group["first_lagrangian_exact"]
        log_rate = group["first_log_rate_greedy"] - group["first_log_rate_exact"]
        rows.append(
            {
                "states_of": policy,
                "decider": decider,
                "seeds": by_world.ngroups,
                "slots": len(group),
                **interval_columns("gap", mean_interval(by_world["gap"].mean())),
                "gap_max": float(gap.max()),
                "gap_share": float(gap.sum() / group["exact"].abs().sum()),
                "share_optimal": float((gap <= 1e-6 * size).mean()),
                "uncertified": float((group["exact"] - group["bound"]).max()),
                **interval_columns("first_gap", _by_world(first, group["seed"])),
                **interval_columns("first_log_rate_gap", _by_world(log_rate, group["seed"])),
            }
        )
    return pd.DataFrame(rows)


def _by_world(values: pd.Series, seeds: pd.Series) -> Interval:
    means: Sequence[float] = values.groupby(seeds).mean().to_list()
    return mean_interval(means)


def differing_keys(scenario: Scenario, learner: str) -> dict[str, Any]:
    """Return the keys of a learner that differ from the section `learning`, with their values."""
    base, own = asdict(scenario.learning), asdict(scenario.learned[learner])
    return {key: value for key, value in own.items() if value != base[key]}


def differing_text(scenario: Scenario, learner: str) -> str:
    """Return these keys as a line: ``network = mlp``; ``as configured`` where there are none."""
    keys = differing_keys(scenario, learner)
    return ", ".join(f"{key} = {value}" for key, value in keys.items()) or "as configured"


@table(
    "learners",
    title="Learners along the load, against the scenario's own",
    note=f"{INTERVAL_NOTE} `differs`: keys of the section `learning` that are not the scenario's. "
    "Columns `…_minus_own`, `…_over_own`: paired differences from the scenario's own learner, "
    f"and typical ratios, the k-th training seeds of both in the same world. {NONE_NOTE}",
    reads=("runs",),
    when=varies(LOAD, learners_among),
)
def learner_table(study: Study) -> pd.DataFrame:
    """Return what every learner reaches at every load, and how far that is from the own one's.

    Returns
    -------
    DataFrame
        One row a load and learner: load, learner, differs (the keys), seeds (worlds),
        training_seeds, then for every measure its mean over policies and worlds and how it compares
        with the own learner: the mean of the paired differences (suffix ``_minus_own``) of rates,
        the typical ratio (``_over_own``) of what is skewed, with bounds ``_lo`` and ``_hi``. Worlds
        are paired, and so are training seeds, the k-th with the k-th.
    """
    scenario, sweeps = study.scenario, study.sweeps
    rows = []
    own = scenario.learning.algorithm
    axis = axis_of(scenario, LOAD)
    along = sweeps[(sweeps["axis"] == axis) & sweeps["policy"].isin(list(scenario.learned))]
    for load, group in along.groupby("value", sort=False):
        by_learner = {str(name): runs for name, runs in group.groupby("policy")}
        for learner in scenario.learned:
            if learner not in by_learner:
                continue
            row: dict[str, Any] = {
                "load": load,
                "learner": learner,
                "differs": differing_text(scenario, learner),
                **counts(by_learner[learner]),
            }
            for measure in CELL_MEASURES:
                runs = by_learner[learner]
                row |= interval_columns(measure, measure_interval(measure, runs, scenario))
                if learner != own and own in by_learner:
                    values, base = paired(runs, by_learner[own], measure)
                    if measure in SYMMETRIC:
                        gain = paired_difference(values, base)
                        row |= interval_columns(f"{measure}_minus_own", gain)
                    else:
                        least = resolution(measure, runs, scenario)
                        over = paired_log_ratio(values, base, resolution=least)
                        row |= interval_columns(f"{measure}_over_own", over)
            rows.append(row)
    return pd.DataFrame(rows)
