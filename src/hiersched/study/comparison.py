"""How far policies are from the best classical scheduler, and from the exact optimum."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from hiersched.policies.index_rules import CLASSICAL
from hiersched.runs import paths
from hiersched.scenario import Scenario
from hiersched.study.collect import BASELINE
from hiersched.study.intervals import measure_interval
from hiersched.study.samples import counts, paired
from hiersched.study.statistics import (
    Interval,
    interval_columns,
    mean_interval,
    paired_log_ratio,
    probability_of_improvement,
)

BACKLOG = "mean_square_backlog"
"""Time average of half the sum of squared backlogs: the measure by which policies are ranked."""


CELL_AXES = ("cell", "load", "rayleigh_scale")
"""What a policy meets that it was not trained on."""

CELL_MEASURES = (
    "urllc_late_share",
    "urllc_rate_mbps",
    "embb_rate_mbps",
    "tracking_error_cm",
    BACKLOG,
    "penalty_cost",
)


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


def score_table(runs: pd.DataFrame, sweeps: pd.DataFrame) -> pd.DataFrame:
    """Return how policies stand over all loads together.

    The score of a policy in a world is log(PF / its own) / log(PF / that of the best classical
    scheduler of the load), of mean square backlogs, both logarithms summed over the loads and the
    lower one averaged over worlds: 0 as PF, 1 as the best, more where its queues are shorter.

    Parameters
    ----------
    runs
        From `collect.evaluation_frame`: only its policies are shown.
    sweeps
        From `collect.sweep_frame`.

    Returns
    -------
    DataFrame
        Columns policy, loads, seeds (worlds), training_seeds (0 of a rule), score (_lo, _hi),
        shorter_worlds: the share of worlds, or of pairs of policy and world, in which its mean
        square backlog is below that of the best classical scheduler of the load.
    """
    along = sweeps[sweeps["axis"] == "load"]
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


def generalisation_table(runs: pd.DataFrame, scenario: Scenario) -> pd.DataFrame:
    """Return how policies do where they were not trained, beside the best scheduler there.

    Parameters
    ----------
    runs
        Sweeps and cells of other sizes, one row a run.
    scenario
        The scenario that was run.

    Returns
    -------
    DataFrame
        One row an axis (cell, load, rayleigh_scale), value and policy: seeds, training_seeds,
        measures with their intervals, best_classical, and backlog_over_best: the typical ratio of
        the mean square backlogs in the same worlds.
    """
    rows = []
    for axis in CELL_AXES:
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


def bound_frame(results: Path) -> pd.DataFrame:
    """Read the decisions in sampled slots and their exact optima.

    Raises
    ------
    FileNotFoundError
        If they have not been computed.
    """
    path = results / paths.BOUND
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    return pd.read_csv(path)


def bound_table(slots: pd.DataFrame) -> pd.DataFrame:
    """Return how far decisions are from the exact optimum of their slots.

    Parameters
    ----------
    slots
        From `bound_frame`.

    Returns
    -------
    DataFrame
        One row the policy whose states they are and the decider asked there: seeds, slots, gap
        (value - exact, mean over the slots of a world; interval over worlds), gap_max, gap_share
        (gaps over sizes of the optima, in all), share_optimal (gaps of 0, to 1e-6 of the optimum),
        uncertified (largest exact - bound), and of the first PRBs alone, greedy - exact: sums over
        users of the Lagrangian (first_gap) and of the logarithm of the rate.
    """
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
