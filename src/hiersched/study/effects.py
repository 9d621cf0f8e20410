"""What the claims measure: differences, ratios, slopes, parts of training, paired by seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hiersched.study.statistics import (
    Interval,
    effect_size,
    log_ratios,
    mean_interval,
    paired_log_ratio,
)
from hiersched.study.verdicts import Statement

Sample: TypeAlias = "pd.Series[float]"

PAIRED = (("urllc", "URLLC"), ("embb", "eMBB"))
"""Slices of the cell, as columns and as readers know them."""

STRETCHES = 5


@dataclass(frozen=True, kw_only=True)
class Measured:
    """A number over seeds: a value or its logarithm for each, and the interval of the mean."""

    values: NDArray[np.float64]
    logarithms: bool
    interval: Interval

    def statement(self, name: str, unit: str, **claimed: float) -> Statement:
        """Return the statement that it lies within a claimed range (`above`, `below`)."""
        return Statement(
            name=name,
            unit=unit,
            interval=self.interval,
            effect=effect_size(self.values),
            values=tuple(self.values.tolist()),
            logarithms=self.logarithms,
            **claimed,
        )


def mean(values: NDArray[np.float64]) -> Measured:
    """Measure a mean over seeds, Student's t interval."""
    return Measured(values=values, logarithms=False, interval=mean_interval(values))


def difference(values: Sample, baseline: Sample) -> Measured:
    """Measure the mean of values - baseline, seed by seed."""
    return mean(values.to_numpy(np.float64) - baseline.to_numpy(np.float64))


def ratio(values: Sample, baseline: Sample, resolution: float = 0.0) -> Measured:
    """Measure the typical ratio of paired samples; see `statistics.paired_log_ratio`."""
    a, b = values.to_numpy(np.float64), baseline.to_numpy(np.float64)
    return Measured(
        values=log_ratios(a, b, resolution),
        logarithms=True,
        interval=paired_log_ratio(a, b, resolution=resolution),
    )


def slope(
    along: pd.DataFrame,
    policy: str,
    measure: str,
    position: Callable[[pd.DataFrame], NDArray[np.float64]],
) -> Measured:
    """Measure the least-squares slope of a measure along a sweep, one slope a seed.

    Parameters
    ----------
    along
        Runs of one axis, from `collect.sweep_frame`.
    policy, measure
        Which runs, which column.
    position
        Where the runs of one seed lie on the axis, shape (n,).
    """
    own = along[along["policy"] == policy]
    slopes = []
    for _, rows in own.groupby("seed", sort=False):
        x = position(rows) - position(rows).mean()
        y = rows[measure].to_numpy(np.float64)
        slopes.append(float(x @ (y - y[0]) / (x @ x)))  # exactly 0 where all are equal
    return mean(np.array(slopes))


def steps(checkpoints: pd.DataFrame, measure: str) -> NDArray[np.float64]:
    """Return a measure of every seed at its noise-free checkpoints, shape (seeds, checkpoints)."""
    table = checkpoints.pivot(index="seed", columns="episode", values=measure)
    return table.to_numpy(np.float64)


def change_in_training(training: pd.DataFrame, measure: str, block: int) -> Measured:
    """Measure the change from the first to the last fifth of training, noise included."""
    fifths = _fifths(training, measure, block)
    return mean(fifths[:, -1] - fifths[:, 0])


def _fifths(training: pd.DataFrame, measure: str, block: int) -> NDArray[np.float64]:
    """Mean of a measure over consecutive fifths of the rounds, by seed, shape (seeds, n).

    Trainings of fewer than five rounds count round by round.
    """
    number = (training["episode"] - 1) // block
    rounds = int(number.max()) + 1
    stretch = number * min(STRETCHES, rounds) // rounds
    means: Any = training.groupby(["seed", stretch.rename("stretch")])[measure].mean()
    table: NDArray[np.float64] = means.unstack("stretch").to_numpy(np.float64)
    return table


def doublings(rows: pd.DataFrame) -> NDArray[np.float64]:
    """Return the swept value of each run in doublings, log2."""
    values: NDArray[np.float64] = np.log2(rows["value"].astype(float).to_numpy())
    return values


def tenths_of_dexterity(
    rows: pd.DataFrame,
) -> NDArray[np.float64]:
    """Return the measured dexterity index of each run, in tenths."""
    values: NDArray[np.float64] = 10.0 * rows["dexterity_index"].to_numpy(np.float64)
    return values


def ends(along: pd.DataFrame, policy: str, measure: str) -> tuple[Sample, Sample]:
    """Return a measure at the least and the greatest value of a sweep, by seed."""
    own = along[along["policy"] == policy]
    by_value = own.assign(value=own["value"].astype(float)).pivot(
        index="seed", columns="value", values=measure
    )
    return by_value[min(by_value.columns)], by_value[max(by_value.columns)]


def in_the_same_worlds(
    runs: pd.DataFrame, policy: str, baseline: str, measure: str
) -> tuple[Sample, Sample]:
    """Return a measure of two policies in the same worlds, by seed."""
    by_policy = runs.pivot(index="seed", columns="policy", values=measure)
    return by_policy[policy], by_policy[baseline]


def percent(share: float) -> str:
    """Return a share as text in per cent."""
    return f"{100.0 * share:g} %"
