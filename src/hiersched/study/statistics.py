"""Means, differences and ratios over seeds with their intervals.

Seeds are few, so intervals use Student's t distribution; a bootstrap is there as the alternative
that assumes no shape. Comparisons are paired: the i-th value of both samples comes from the same
world. Interquartile mean, stratified bootstrap and probability of improvement follow Agarwal et al.
("Deep reinforcement learning at the edge of the statistical precipice", NeurIPS 2021).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

LEVEL = 0.95
RESAMPLES = 9999


class Interval(NamedTuple):
    """An estimate and its interval; the bounds are NaN where a single seed allows none."""

    mean: float
    lo: float
    hi: float


def interval_columns(name: str, interval: Interval) -> dict[str, float]:
    """Return columns of a table: the estimate as `name`, its bounds as ``_lo`` and ``_hi``."""
    return {name: interval.mean, f"{name}_lo": interval.lo, f"{name}_hi": interval.hi}


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
    values: npt.ArrayLike, level: float = LEVEL, *, resamples: int = RESAMPLES, seed: int = 0
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
    return float(_interquartile_means(_sample(values)))


def interquartile_interval(
    strata: Sequence[npt.ArrayLike],
    level: float = LEVEL,
    *,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Interval:
    """Return the interquartile mean of all values and its stratified bootstrap interval.

    Every resample draws as many values from each stratum as it has, so that a stratum (a load, a
    cell) never weighs more than it does; the bounds are percentiles.

    Parameters
    ----------
    strata
        Samples, one value a seed each.
    level
        Coverage.
    resamples, seed
        Of the resampling: the same values give the same interval.

    Raises
    ------
    ValueError
        If there is no stratum, or one without a value.
    """
    samples = [_sample(stratum) for stratum in strata]
    if not samples:
        raise ValueError("strata: must be one or more")

    def of_all(*drawn: Any, axis: int = -1) -> Any:
        return _interquartile_means(np.concatenate(drawn, axis=axis))

    estimate = interquartile_mean(np.concatenate(samples))
    if math.isnan(estimate):
        return Interval(math.nan, math.nan, math.nan)
    if min(map(len, samples)) < 2:
        return Interval(estimate, math.nan, math.nan)
    return Interval(estimate, *_percentiles(samples, of_all, level, resamples, seed))


def probability_of_improvement(
    values: npt.ArrayLike,
    baseline: npt.ArrayLike,
    level: float = LEVEL,
    *,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Interval:
    """Return the probability that a value lies below one of the baseline, and its interval.

    Over all pairs of a value and one of the baseline, equal ones counting half (Mann and Whitney's
    statistic); both samples are resampled on their own. Where no pair is out of order the bounds
    meet at 0 or 1: a bootstrap cannot know of values that were never seen.

    Parameters
    ----------
    values, baseline
        One value a seed, shapes (n,) and (m,); of measures of which less is better.
    level
        Coverage.
    resamples, seed
        Of the resampling.

    Raises
    ------
    ValueError
        If a sample is empty.
    """
    own, other = _sample(values), _sample(baseline)
    if np.isnan(own).any() or np.isnan(other).any():
        return Interval(math.nan, math.nan, math.nan)

    def share_below(a: Any, b: Any, axis: int = -1) -> Any:
        pairs = np.expand_dims(a, -1) - np.expand_dims(b, -2)
        return ((pairs < 0.0) + 0.5 * (pairs == 0.0)).mean(axis=(-2, -1))

    estimate = float(share_below(own, other))
    if min(len(own), len(other)) < 2:
        return Interval(estimate, math.nan, math.nan)
    return Interval(estimate, *_percentiles([own, other], share_below, level, resamples, seed))


def effect_size(differences: npt.ArrayLike) -> float:
    """Return the mean of paired differences over their standard deviation (Cohen's d_z).

    NaN where a single pair gives no standard deviation, infinite where all differences are equal
    and not 0, 0 where all are 0.
    """
    sample = _sample(differences)
    mean = float(sample.mean())
    if len(sample) < 2 or math.isnan(mean):
        return math.nan
    spread = float(sample.std(ddof=1))
    if spread <= 1e-12 * abs(mean):
        return math.copysign(math.inf, mean) if mean != 0.0 else 0.0
    return mean / spread


def _interquartile_means(samples: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Interquartile means along the last axis, shape (..., n) -> (...)."""
    count = samples.shape[-1]
    weights = np.clip(np.arange(1, count + 1) - count / 4.0, 0.0, 1.0)
    weights = np.minimum(weights, weights[::-1])
    means: npt.NDArray[np.float64] = np.sort(samples, axis=-1) @ (weights / weights.sum())
    return means


def _percentiles(
    samples: Sequence[npt.NDArray[np.float64]],
    statistic: Any,
    level: float,
    resamples: int,
    seed: int,
) -> tuple[float, float]:
    """Percentile bootstrap of a statistic of samples that are resampled on their own."""
    from scipy.stats import bootstrap

    result = bootstrap(
        tuple(samples),
        statistic,
        confidence_level=level,
        n_resamples=resamples,
        method="percentile",
        vectorized=True,
        rng=np.random.default_rng(seed),
    )
    bounds = result.confidence_interval
    return float(bounds.low), float(bounds.high)


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
