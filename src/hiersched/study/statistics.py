"""Means, differences and ratios over seeds with their intervals.

Seeds are few, so intervals use Student's t distribution; a bootstrap (BCa) is there as the
alternative that assumes no shape. Comparisons are paired: the i-th value of both samples comes from
the same world.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

LEVEL = 0.95


class Interval(NamedTuple):
    """An estimate and its interval; the bounds are NaN where a single seed allows none."""

    mean: float
    lo: float
    hi: float


def mean_interval(values: npt.ArrayLike, level: float = LEVEL) -> Interval:
    """Return the mean and its Student t interval, mean +- t s / sqrt(n).

    Parameters
    ----------
    values
        One value a seed, shape (n,). A NaN makes all of the result NaN.
    level
        Coverage.

    Raises
    ------
    ValueError
        If there is no value.
    """
    sample = _sample(values)
    mean = float(sample.mean())
    half = _t_quantile(len(sample), level) * _standard_error(sample)
    return Interval(mean, mean - half, mean + half)


def bootstrap_interval(
    values: npt.ArrayLike, level: float = LEVEL, *, resamples: int = 9999, seed: int = 0
) -> Interval:
    """Return the mean and its bias-corrected accelerated bootstrap interval (Efron 1987).

    Parameters
    ----------
    values
        One value a seed, shape (n,). A NaN makes all of the result NaN.
    level
        Coverage.
    resamples
        Resamples.
    seed
        Of the resampling: the same values give the same interval.
    """
    from scipy.stats import bootstrap

    sample = _sample(values)
    mean = float(sample.mean())
    if len(sample) < 2 or math.isnan(mean):
        return Interval(mean, math.nan, math.nan)
    if np.ptp(sample) == 0.0:  # scipy has no BCa interval for equal values
        return Interval(mean, mean, mean)
    result = bootstrap(
        (sample,),
        np.mean,
        confidence_level=level,
        n_resamples=resamples,
        method="BCa",
        rng=np.random.default_rng(seed),
    )
    bounds = result.confidence_interval
    return Interval(mean, float(bounds.low), float(bounds.high))


def paired_difference(
    values: npt.ArrayLike, baseline: npt.ArrayLike, level: float = LEVEL
) -> Interval:
    """Return the mean of values - baseline, world by world, with its Student t interval."""
    a, b = _pair(values, baseline)
    return mean_interval(a - b, level)


def paired_ratio(values: npt.ArrayLike, baseline: npt.ArrayLike, level: float = LEVEL) -> Interval:
    """Return the ratio of the means of paired samples with Fieller's interval.

    The interval holds every ratio q for which the mean of values - q baseline does not differ
    significantly from 0 (Fieller 1954). It needs no logarithm, so a value of 0 is no trouble; it is
    unbounded where the baseline's own mean does not differ significantly from 0, and may reach
    below 0 with few seeds.

    Parameters
    ----------
    values, baseline
        One value a world, shape (n,), in the same order of worlds.
    level
        Coverage.

    Raises
    ------
    ValueError
        If the samples are empty or of different lengths.
    """
    a, b = _pair(values, baseline)
    n = len(a)
    mean_a, mean_b = float(a.mean()), float(b.mean())
    ratio = mean_a / mean_b if mean_b != 0.0 else math.nan
    if n < 2 or not math.isfinite(ratio):
        return Interval(ratio, math.nan, math.nan)
    squared = _t_quantile(n, level) ** 2 / n
    covariance = np.cov(a, b, ddof=1)
    # (mean_a - q mean_b)^2 <= t^2 / n (s_aa - 2 q s_ab + q^2 s_bb), a quadratic inequality in q
    leading = mean_b**2 - squared * float(covariance[1, 1])
    if leading <= 0.0:
        return Interval(ratio, -math.inf, math.inf)
    middle = mean_a * mean_b - squared * float(covariance[0, 1])
    constant = mean_a**2 - squared * float(covariance[0, 0])
    root = math.sqrt(max(0.0, middle**2 - leading * constant))
    return Interval(ratio, (middle - root) / leading, (middle + root) / leading)


def interquartile_mean(values: npt.ArrayLike) -> float:
    """Return the mean of the middle half; a quarter of the sample is cut at each end."""
    sample = np.sort(_sample(values))
    cut = len(sample) / 4.0
    weights = np.clip(np.arange(1, len(sample) + 1) - cut, 0.0, 1.0)
    weights = np.minimum(weights, weights[::-1])
    return float(weights @ sample / weights.sum())


def _sample(values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    sample = np.asarray(values, dtype=np.float64)
    if sample.ndim != 1 or not sample.size:
        raise ValueError(f"values: shape {sample.shape}, must be (n,) with one value or more")
    return sample


def _pair(
    values: npt.ArrayLike, baseline: npt.ArrayLike
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    a, b = _sample(values), _sample(baseline)
    if len(a) != len(b):
        raise ValueError(f"{len(a)} values against {len(b)} of the baseline: must be as many")
    return a, b


def _t_quantile(count: int, level: float) -> float:
    from scipy.special import stdtrit

    if not 0.0 < level < 1.0:
        raise ValueError(f"level = {level}: must lie in (0, 1)")
    return float(stdtrit(count - 1, 0.5 + 0.5 * level)) if count > 1 else math.nan


def _standard_error(sample: npt.NDArray[np.float64]) -> float:
    if len(sample) < 2:
        return math.nan
    return float(sample.std(ddof=1)) / math.sqrt(len(sample))
