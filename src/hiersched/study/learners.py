"""The learners of a scenario against its own: what each is, and what it changes along the load."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import pandas as pd

from hiersched.scenario import Scenario
from hiersched.study.comparison import CELL_MEASURES
from hiersched.study.intervals import SYMMETRIC, measure_interval, resolution
from hiersched.study.samples import counts, paired
from hiersched.study.statistics import interval_columns, paired_difference, paired_log_ratio


def differing_keys(scenario: Scenario, learner: str) -> dict[str, Any]:
    """Return the keys of a learner that differ from the section `learning`, with their values."""
    base, own = asdict(scenario.learning), asdict(scenario.learned[learner])
    return {key: value for key, value in own.items() if value != base[key]}


def differing_text(scenario: Scenario, learner: str) -> str:
    """Return these keys as a line: ``network = mlp``; ``as configured`` where there are none."""
    keys = differing_keys(scenario, learner)
    return ", ".join(f"{key} = {value}" for key, value in keys.items()) or "as configured"


def learner_table(sweeps: pd.DataFrame, scenario: Scenario) -> pd.DataFrame:
    """Return what every learner reaches at every load, and how far that is from the own one's.

    Parameters
    ----------
    sweeps
        From `collect.sweep_frame`.
    scenario
        Its learners; the first is its own.

    Returns
    -------
    DataFrame
        One row a load and learner: load, learner, differs (the keys), seeds (worlds),
        training_seeds, then for every measure its mean over policies and worlds and how it compares
        with the own learner: the mean of the paired differences (suffix ``_minus_own``) of rates,
        the typical ratio (``_over_own``) of what is skewed, with bounds ``_lo`` and ``_hi``. Worlds
        are paired, and so are training seeds, the k-th with the k-th.
    """
    rows = []
    own = scenario.learning.algorithm
    along = sweeps[(sweeps["axis"] == "load") & sweeps["policy"].isin(list(scenario.learned))]
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
    return pd.DataFrame(rows) if rows else pd.DataFrame(columns=["load", "learner", "differs"])
