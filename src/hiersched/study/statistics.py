"""Means, differences and ratios over seeds with their intervals.

Seeds are few: means of what is roughly symmetric get Student's t interval, means of skewed measures
such as late shares the generalised pivotal one of a lognormal mean. Comparisons are paired: the
i-th value of both samples comes from the same world; of positive measures they are ratios, by their
logarithms. The probability of improvement follows Agarwal et al. ("Deep reinforcement learning at
the edge of the statistical precipice", NeurIPS 2021).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hiersched.study.lognormal import mean_bounds

IntArray = npt.NDArray[np.intp]

LEVEL = 0.95
RESAMPLES = 9999
MOST_HALVINGS = 1000


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


def skewed_interval(
    values: npt.ArrayLike,
    level: float = LEVEL,
    *,
    resolution: float = 0.0,
    most: float = math.inf,
) -> Interval:
    """Return the mean of values of 0 and above that are skewed, and its interval.

    Generalised pivotal interval of the mean of a lognormal distribution, with zeros beside it where
    there are any (see `lognormal`): for shares of late packets, whose spread is in their logarithm.
    Student's t covers such means too rarely. The estimate is the sample mean; it always lies within
    the bounds, which logarithms with a long lower tail could put beyond it. Where the sample does
    not bound the mean from above, as two values that differ hardly do, the upper bound is infinite.

    Parameters
    ----------
    values
        One value a world, shape (n,). A NaN makes all of the result NaN.
    level
        Coverage.
    resolution
        Least value above 0 that a world can show. Where all values are 0 the upper bound is the
        least mean that this many worlds tell from 0 (`smallest_mean`), and never less otherwise.
    most
        Greatest mean there can be, 1 for shares: bounds beyond it are cut.

    Raises
    ------
    ValueError
        If there is no value, an infinite one, or one below 0.
    """
    sample = _sample(values)
    wrong = sample[np.isinf(sample) | (sample < 0.0)]
    if wrong.size:
        raise ValueError(f"values: {wrong[0]:g}, must be 0 or above and finite")
    mean = float(sample.mean())
    if len(sample) < 2 or math.isnan(mean):
        return Interval(mean, math.nan, math.nan)
    positive = sample[sample > 0.0]
    least = smallest_mean(len(sample), resolution, level)
    if not positive.size:
        return Interval(0.0, 0.0, min(least, most))
    if len(positive) == len(sample) and np.ptp(sample) <= 1e-12 * mean:
        return Interval(mean, mean, mean)
    lo, hi = mean_bounds(positive, len(sample) - len(positive), level)
    if len(positive) == 1:  # one world alone does not bound the mean from below
        lo = 0.0
    return Interval(mean, min(lo, mean), min(max(hi, mean, least), most))


def smallest_mean(count: int, resolution: float, level: float = LEVEL) -> float:
    """Return the least mean over worlds that a run tells from 0, with worlds as units.

    Whatever is seen in a share p of all worlds is seen in none of `count` worlds with probability
    (1 - p)^count. Above p = 1 - (1 - level)^(1 / count) that is rarer than 1 - level; a world in
    which it is seen shows at least `resolution`.

    Parameters
    ----------
    count
        Worlds, n.
    resolution
        Least value above 0 that a world can show. Of late packets: those of a batch, which come
        and are late together, over all that are due.
    level
        Coverage.
    """
    return float((1.0 - (1.0 - level) ** (1.0 / count)) * resolution)


def paired_difference(
    values: npt.ArrayLike, baseline: npt.ArrayLike, level: float = LEVEL
) -> Interval:
    """Return the mean of values - baseline, world by world, with its Student t interval."""
    a, b = _pair(values, baseline)
    return mean_interval(a - b, level)


def log_ratios(
    values: npt.ArrayLike, baseline: npt.ArrayLike, resolution: float = 0.0
) -> npt.NDArray[np.float64]:
    """Return the logarithm of the ratio of two positive measures, world by world.

    Parameters
    ----------
    values, baseline
        One value a world, shape (n,), in the same order of worlds.
    resolution
        Least value above 0 that a world can show: stands for values of 0, whose ratio it bounds
        from above, and for baselines of 0, whose ratio it bounds from below.

    Returns
    -------
    ndarray
        Shape (n,): 0 where both are equal; NaN where both are 0, one is and there is no resolution,
        or one is below 0.
    """
    a, b = _pair(values, baseline)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_a, log_b = (np.log(np.where(sample == 0.0, resolution, sample)) for sample in (a, b))
        ratios: npt.NDArray[np.float64] = log_a - log_b
    ratios[(a == 0.0) & (b == 0.0)] = math.nan
    ratios[~np.isfinite(ratios)] = math.nan
    return ratios


def paired_log_ratio(
    values: npt.ArrayLike,
    baseline: npt.ArrayLike,
    level: float = LEVEL,
    *,
    resolution: float = 0.0,
) -> Interval:
    """Return the typical ratio of paired samples: geometric mean, Student t on its logarithm.

    Where values are 0, the ratio and its upper bound are upper bounds (see `log_ratios`), and the
    lower bound is 0. Where baselines are, ratio and lower bound are lower bounds, and the upper
    bound is infinite. All is NaN where values and baselines are, be it in different worlds, since
    nothing bounds the ratio then, and where there is no resolution to stand for a 0.

    Parameters
    ----------
    values, baseline, resolution
        As for `log_ratios`.
    level
        Coverage.

    Raises
    ------
    ValueError
        If the samples are empty or of different lengths.
    """
    mean, lo, hi = mean_interval(log_ratios(values, baseline, resolution), level)
    no_value, no_baseline = ((_sample(sample) == 0.0).any() for sample in (values, baseline))
    if no_value and no_baseline:
        return Interval(math.nan, math.nan, math.nan)
    if no_value and not math.isnan(lo):
        lo = -math.inf
    if no_baseline and not math.isnan(hi):
        hi = math.inf
    return Interval(math.exp(mean), math.exp(lo), _exp(hi))


def halvings(count: int) -> list[tuple[IntArray, IntArray]]:
    """Return the ways to halve `count` seeds, each once: 126 for ten, none for fewer than two.

    Halves of an odd number differ by one. Of more than `MOST_HALVINGS` ways in lexicographic order,
    as many evenly spaced ones are taken.

    Returns
    -------
    list of tuple of ndarray
        The positions of the seeds of both halves, shapes (count // 2,) and the rest.
    """
    if count < 2:
        return []
    half = count // 2
    total = math.comb(count, half)
    ways = total // 2 if count % 2 == 0 else total  # of even halves each way comes twice
    taken = min(ways, MOST_HALVINGS)
    halves = [_combination(number * ways // taken, count, half) for number in range(taken)]
    return [(part, np.setdiff1d(np.arange(count), part)) for part in halves]


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


def _combination(rank: int, count: int, size: int) -> IntArray:
    """Return a combination of `size` out of range(count) by its rank in lexicographic order."""
    chosen: list[int] = []
    for item in range(count):
        if len(chosen) == size:
            break
        with_item = math.comb(count - item - 1, size - len(chosen) - 1)
        if rank < with_item:
            chosen.append(item)
        else:
            rank -= with_item
    return np.array(chosen, dtype=np.intp)


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


def _exp(value: float) -> float:
    """Return e^x, infinite where no double can hold it."""
    return math.inf if value > 709.0 else math.exp(value)
