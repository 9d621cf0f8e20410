"""What the claims measure: differences, ratios, slopes, parts of training, paired by seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hiersched.study.claims.verdicts import Statement
from hiersched.study.samples import is_learned, paired, sample_of
from hiersched.study.statistics import (
    Interval,
    effect_size,
    log_ratios,
    mean_interval,
    paired_log_ratio,
)

Sample: TypeAlias = NDArray[np.float64]
"""One value a world, or of policies crossed with worlds: see `samples.sample_of`."""

PAIRED = (("urllc", "URLLC"), ("embb", "eMBB"))
"""Slices of the cell, as columns and as readers know them."""

STRETCHES = 5


@dataclass(frozen=True)
class Measured:
    """A number over seeds: the interval of the mean of values, or of their exponentials."""

    values: Sample
    interval: Interval
    logarithms: bool = False

    def statement(self, name: str, unit: str, **claimed: float) -> Statement:
        """Return the statement that it lies within a claimed range (`above`, `below`)."""
        return Statement(
            name=name,
            unit=unit,
            interval=self.interval,
            effect=effect_size(self.values),
            values=self.values,
            logarithms=self.logarithms,
            **claimed,
        )


def mean(values: Sample) -> Measured:
    """Measure a mean over seeds, Student's t interval."""
    if values.ndim == 2 and 1 in values.shape:
        values = values.ravel()  # a single policy, or world, is no part of the variance
    return Measured(values, mean_interval(values))


def difference(values: Sample, baseline: Sample) -> Measured:
    """Measure the mean of values - baseline, seed by seed."""
    return mean(values - baseline)


def ratio(values: Sample, baseline: Sample, resolution: float = 0.0) -> Measured:
    """Measure the typical ratio of paired samples; see `statistics.paired_log_ratio`."""
    interval = paired_log_ratio(values, baseline, resolution=resolution)
    return Measured(log_ratios(values, baseline, resolution), interval, logarithms=True)


def slope(
    along: pd.DataFrame, policy: str, measure: str, position: Callable[[pd.DataFrame], Sample]
) -> Measured:
    """Measure the least-squares slope of a measure along a sweep, one slope a world.

    Of a learned policy, one for each of its policies in each world. The runs are `along` one axis;
    `position` says where those of one policy in one world lie on it, shape (n,).
    """
    own = along[along["policy"] == policy]
    keys = ["policy_seed", "seed"] if is_learned(own) else ["seed"]
    slopes = []
    for _, rows in own.groupby(keys, sort=False):
        x = position(rows) - position(rows).mean()
        y = rows[measure].to_numpy(np.float64)
        # Exactly 0 where all are equal.
        slopes.append({**rows.iloc[0][keys], "slope": float(x @ (y - y[0]) / (x @ x))})
    return mean(sample_of(pd.DataFrame(slopes), "slope"))


def doublings(rows: pd.DataFrame) -> Sample:
    """Return the swept value of each run in doublings, log2."""
    values: Sample = np.log2(rows["value"].to_numpy(np.float64))
    return values


def tenths_of_dexterity(rows: pd.DataFrame) -> Sample:
    """Return the measured dexterity index of each run, in tenths."""
    return 10.0 * rows["dexterity_index"].to_numpy(np.float64)


def steps(checkpoints: pd.DataFrame, measure: str) -> Sample:
    """Return a measure of every seed at its noise-free checkpoints, shape (seeds, checkpoints)."""
    table = checkpoints.pivot(index="seed", columns="episode", values=measure)
    return table.to_numpy(np.float64)


def change_in_training(training: pd.DataFrame, measure: str, block: int) -> Measured:
    """Measure the change from the first to the last fifth of training, noise included.

    Trainings of fewer than five rounds, of `block` episodes each, count round by round.
    """
    number = (training["episode"] - 1) // block
    rounds = int(number.max()) + 1
    stretch = number * min(STRETCHES, rounds) // rounds
    means: Any = training.groupby(["seed", stretch.rename("stretch")])[measure].mean()
    fifths = means.unstack("stretch").to_numpy(np.float64)
    return mean(fifths[:, -1] - fifths[:, 0])


def ends(along: pd.DataFrame, policy: str, measure: str) -> tuple[Sample, Sample]:
    """Return a measure at the least and the greatest value of a sweep, in the same worlds."""
    own = along[along["policy"] == policy]
    values = own["value"].astype(float)
    return paired(own[values == values.min()], own[values == values.max()], measure)


def in_the_same_worlds(
    runs: pd.DataFrame, policy: str, baseline: str, measure: str
) -> tuple[Sample, Sample]:
    """Return a measure of two policies in the same worlds."""
    own, other = (runs[runs["policy"] == name] for name in (policy, baseline))
    return paired(own, other, measure)
