"""Means, differences and ratios over seeds with their intervals.

Seeds are few: means of what is roughly symmetric get Student's t interval, means of skewed measures
such as late shares the generalised pivotal one of a lognormal mean. Comparisons are paired: the
i-th value of both samples comes from the same world; of positive measures they are ratios, by their
logarithms.

A rule has one value a world, shape (W,). A learned policy has one for every trained policy in every
world, shape (P, W): policies and worlds are crossed, and the estimand is the mean over both, over
policies that other training seeds would give and over other worlds. Its variance is

    s_P^2 / P + s_W^2 / W + s_PW^2 / (P W)

of the components of policies, worlds and pairs. Of the means of the policies, over all worlds, the
sample variance over P estimates the first and the third term; of the means of the worlds, that over
W the second and the third. Their sum is the variance that is taken, with the degrees of freedom of
Satterthwaite ("An approximate distribution of estimates of variance components", Biometrics
Bulletin 2, 1946). So the third term counts twice: no interval is too narrow, and it is too wide by
a factor of sqrt(2) at most, where policies and worlds have no effects of their own. (To subtract
the mean square of the pairs would mend that, but may leave 0 or less: the interval of two by two
values would cover 71 %, and that of ten by ten be a fifth narrower at most.) A single policy or
world adds no part: its values are a sample of the other alone. Shares of pairs have Owen's
pigeonhole bootstrap, which draws rows and columns anew ("The pigeonhole bootstrap", Annals of
Applied Statistics 1, 2007).

The probability of improvement follows Agarwal et al. ("Deep reinforcement learning at
the edge of the statistical precipice", NeurIPS 2021).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from hiersched.study.lognormal import FloatArray, crossed_bounds, mean_bounds

IntArray = npt.NDArray[np.intp]

LEVEL = 0.95
"""Coverage of every interval."""
RESAMPLES = 9999
MOST_HALVINGS = 1000


class Interval(NamedTuple):
    """An estimate and its interval; the bounds are NaN where a single seed allows none."""

    mean: float
    lo: float
    hi: float

    def columns(self, name: str) -> dict[str, float]:
        """Return columns of a table: the estimate as `name`, its bounds as ``_lo`` and ``_hi``."""
        return {name: self.mean, f"{name}_lo": self.lo, f"{name}_hi": self.hi}


def mean_interval(values: npt.ArrayLike) -> Interval:
    """Return the mean and its Student t interval, mean +- t s / sqrt(n).

    Values are one a seed, shape (n,), or of policies crossed with worlds, shape (P, W). A NaN makes
    all of the result NaN; ValueError if there is no value.
    """
    sample = _sample(values)
    mean = float(sample.mean())
    if sample.ndim == 2 and max(np.ptp(sample.mean(axis=axis)) for axis in (0, 1)) == 0.0:
        sample = sample.ravel()  # neither policies nor worlds differ: what does is of the pairs
    if sample.ndim == 2:
        half = _crossed_half_width(sample)
    elif len(sample) < 2:
        half = math.nan
    else:
        half = _t_quantile(len(sample) - 1) * (float(sample.std(ddof=1)) / math.sqrt(len(sample)))
    return Interval(mean, mean - half, mean + half)


def skewed_interval(
    values: npt.ArrayLike, *, resolution: float = 0.0, most: float = math.inf
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
        One value a world, shape (n,), or of policies crossed with worlds, shape (P, W): see
        `lognormal.crossed_bounds`. A NaN makes all of the result NaN.
    resolution
        Least value above 0 that a world can show. Where all values are 0 the upper bound is the
        least mean that this many worlds tell from 0 (`smallest_mean`), and never less otherwise; of
        crossed values the fewer of policies and worlds count, of which so many pairs on a diagonal
        are independent.
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
    if sample.size < 2 or math.isnan(mean):
        return Interval(mean, math.nan, math.nan)
    least = smallest_mean(min(sample.shape), resolution)
    if not sample.any():
        return Interval(0.0, 0.0, min(least, most))
    parts = [sample.mean(axis=axis) for axis in (1, 0)] if sample.ndim == 2 else [sample]
    if sample.ndim == 2 and min(map(np.ptp, parts)) <= 1e-12 * mean:
        # Policies, or worlds, that are all alike are a single one; where both are, pairs are left.
        spread = max(parts, key=np.ptp)
        sample = spread if np.ptp(spread) > 1e-12 * mean else sample.ravel()
        parts = [sample]
    if sample.ndim == 2:
        lo, hi = crossed_bounds(sample, LEVEL)
    else:
        positive = sample[sample > 0.0]
        if len(positive) == len(sample) and np.ptp(sample) <= 1e-12 * mean:
            return Interval(mean, mean, mean)
        lo, hi = mean_bounds(positive, len(sample) - len(positive), LEVEL)
    if any(np.count_nonzero(part) == 1 for part in parts):
        lo = 0.0  # one world, or policy, alone does not bound the mean from below
    return Interval(mean, min(lo, mean), min(max(hi, mean, least), most))


def smallest_mean(count: int, resolution: float) -> float:
    """Return the least mean over worlds that a run tells from 0, with worlds as units.

    Whatever is seen in a share p of all worlds is seen in none of `count` worlds with probability
    (1 - p)^count. Above p = 1 - (1 - LEVEL)^(1 / count) that is rarer than 1 - LEVEL; a world in
    which it is seen shows at least `resolution`.

    Of late packets the resolution is those of a batch, which come and are late together, over all
    that are due.
    """
    return float((1.0 - (1.0 - LEVEL) ** (1.0 / count)) * resolution)


def paired_difference(values: npt.ArrayLike, baseline: npt.ArrayLike) -> Interval:
    """Return the mean of values - baseline, world by world, with its Student t interval.

    Values of policies crossed with worlds, shape (P, W), are paired by world within each policy.
    """
    a, b = _pair(values, baseline)
    return mean_interval(a - b)


def log_ratios(
    values: npt.ArrayLike, baseline: npt.ArrayLike, resolution: float = 0.0
) -> FloatArray:
    """Return the logarithm of the ratio of two positive measures, world by world.

    Both have one value a world, shape (n,), in the same order of worlds, or are of policies crossed
    with worlds, shape (P, n), and then of as many policies. The least value above 0 that a world
    can show, `resolution`, stands for values of 0, whose ratio it bounds from above, and for
    baselines of 0, whose ratio it bounds from below.

    Returns
    -------
    ndarray
        Shape (n,) or (P, n): 0 where both are equal; NaN where both are 0, one is and there is no
        resolution, or one is below 0.
    """
    a, b = _pair(values, baseline)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_a, log_b = (np.log(np.where(sample == 0.0, resolution, sample)) for sample in (a, b))
        ratios: FloatArray = log_a - log_b
    ratios[(a == 0.0) & (b == 0.0)] = math.nan
    ratios[~np.isfinite(ratios)] = math.nan
    return ratios


def paired_log_ratio(
    values: npt.ArrayLike, baseline: npt.ArrayLike, *, resolution: float = 0.0
) -> Interval:
    """Return the typical ratio of paired samples: geometric mean, Student t on its logarithm.

    Where values are 0, the ratio and its upper bound are upper bounds (see `log_ratios`), and the
    lower bound is 0. Where baselines are, ratio and lower bound are lower bounds, and the upper
    bound is infinite. All is NaN where values and baselines are, be it in different worlds, since
    nothing bounds the ratio then, and where there is no resolution to stand for a 0. ValueError if
    samples are empty or not of as many worlds or policies.
    """
    mean, lo, hi = mean_interval(log_ratios(values, baseline, resolution))
    no_value, no_baseline = ((_sample(sample) == 0.0).any() for sample in (values, baseline))
    if no_value and no_baseline:
        return Interval(math.nan, math.nan, math.nan)
    if no_value and not math.isnan(lo):
        lo = -math.inf
    if no_baseline and not math.isnan(hi):
        hi = math.inf
    highest = math.inf if hi > 709.0 else math.exp(hi)  # no double holds more
    return Interval(math.exp(mean), math.exp(lo), highest)


def p_value(differences: npt.ArrayLike) -> float:
    """Return the two-sided p-value that the mean is 0, of the same test as `mean_interval`.

    Values are paired differences, or logarithms of ratios, shape (n,) or (P, W). NaN for a single
    seed or a NaN among them; 1 where all are 0.
    """
    from scipy.special import stdtr

    sample = _sample(differences)
    mean = float(sample.mean())
    if sample.size < 2 or math.isnan(mean):
        return math.nan
    if sample.ndim == 2 and max(np.ptp(sample.mean(axis=axis)) for axis in (0, 1)) == 0.0:
        sample = sample.ravel()
    if sample.ndim == 2:
        variance, freedom = _crossed_variance(sample)
    else:
        variance, freedom = float(sample.var(ddof=1)) / len(sample), len(sample) - 1.0
    if variance == 0.0:
        return float(mean == 0.0)
    return 2.0 * float(stdtr(freedom, -abs(mean) / math.sqrt(variance)))


def holm(p_values: npt.ArrayLike) -> FloatArray:
    """Return p-values that hold for all of several comparisons together, shape (n,).

    Holm ("A simple sequentially rejective multiple test procedure", Scandinavian Journal of
    Statistics 6, 1979): the k-th smallest of n is multiplied by n - k + 1, and none is less than
    one before it. NaN stays NaN and is no comparison.
    """
    given = np.asarray(p_values, dtype=np.float64)
    adjusted: FloatArray = np.full(given.shape, np.nan)
    order = np.argsort(given, kind="stable")
    order = order[~np.isnan(given[order])]
    factors = np.arange(len(order), 0, -1)
    adjusted[order] = np.minimum(np.maximum.accumulate(factors * given[order]), 1.0)
    return adjusted


def halvings(count: int) -> list[tuple[IntArray, IntArray]]:
    """Return the ways to halve `count` seeds, each once: 126 for ten, none for fewer than two.

    Halves of an odd number differ by one. Of more than `MOST_HALVINGS` ways in lexicographic order,
    as many evenly spaced ones are taken. A half are the positions of its seeds.
    """
    if count < 2:
        return []
    half = count // 2
    total = math.comb(count, half)
    ways = total // 2 if count % 2 == 0 else total  # of even halves each way comes twice
    taken = min(ways, MOST_HALVINGS)
    halves = [_combination(number * ways // taken, count, half) for number in range(taken)]
    return [(part, np.setdiff1d(np.arange(count), part)) for part in halves]


def probability_of_improvement(values: npt.ArrayLike, baseline: npt.ArrayLike) -> Interval:
    """Return the probability that a value lies below one of the baseline, and its interval.

    Over all pairs of a value and one of the baseline, equal ones counting half (Mann and Whitney's
    statistic); both samples are resampled on their own, policies and worlds of crossed values too
    (pigeonhole bootstrap). Where no pair is out of order the bounds meet at 0 or 1: a bootstrap
    cannot know of values that were never seen. Less is better. There is one value a seed, shapes
    (n,) and (m,), the values also of policies crossed with worlds, shape (P, n); ValueError if a
    sample is empty.
    """
    from scipy.stats import bootstrap

    own, other = _sample(values), _sample(baseline)
    if np.isnan(own).any() or np.isnan(other).any():
        return Interval(math.nan, math.nan, math.nan)

    def share_below(a: Any, b: Any, axis: int = -1) -> Any:
        pairs = np.expand_dims(a, -1) - np.expand_dims(b, -2)
        return ((pairs < 0.0) + 0.5 * (pairs == 0.0)).mean(axis=(-2, -1))

    estimate, rng = float(share_below(own.ravel(), other)), np.random.default_rng(0)
    if own.ndim == 2 and len(other) > 1:
        return Interval(estimate, *_pigeonhole(own, other, rng))
    if min(len(own), len(other)) < 2:
        return Interval(estimate, math.nan, math.nan)
    options: dict[str, Any] = {"n_resamples": RESAMPLES, "method": "percentile", "rng": rng}
    resampled = bootstrap(
        (own, other), share_below, confidence_level=LEVEL, vectorized=True, **options
    )
    bounds = resampled.confidence_interval
    return Interval(estimate, float(bounds.low), float(bounds.high))


def effect_size(differences: npt.ArrayLike) -> float:
    """Return the mean of paired differences over their standard deviation (Cohen's d_z).

    Of policies crossed with worlds, shape (P, W), it is the standard deviation of a pair: the root
    of the sum of the three variance components.

    NaN where a single pair gives no standard deviation, infinite where all differences are equal
    and not 0, 0 where all are 0.
    """
    sample = _sample(differences)
    mean = float(sample.mean())
    if sample.size < 2 or math.isnan(mean):
        return math.nan
    spread = _crossed_spread(sample) if sample.ndim == 2 else float(sample.std(ddof=1))
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


def _pigeonhole(
    own: FloatArray, other: FloatArray, rng: np.random.Generator
) -> tuple[float, float]:
    """Percentile bootstrap of a share of pairs, rows and columns and baseline drawn anew."""
    below = (own[..., None] < other) + 0.5 * (own[..., None] == other)
    drawn = [
        rng.multinomial(count, np.full(count, 1.0 / count), RESAMPLES) / count
        for count in below.shape
    ]
    shares = (drawn[0] @ below.reshape(len(own), -1)).reshape(-1, *below.shape[1:])
    shares = np.einsum("bwo,bw,bo->b", shares, drawn[1], drawn[2])
    low, high = np.quantile(shares, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    return float(low), float(high)


def _sample(values: npt.ArrayLike) -> FloatArray:
    """Return values as (n,) or, of two policies or more crossed with two worlds or more, (P, W)."""
    sample = np.asarray(values, dtype=np.float64)
    if sample.ndim not in (1, 2) or not sample.size:
        raise ValueError(
            f"values: shape {sample.shape}, must be (n,) or (policies, worlds) with one value or "
            "more"
        )
    return sample.ravel() if 1 in sample.shape else sample


def _pair(values: npt.ArrayLike, baseline: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return both samples in one shape; a baseline of one value a world is paired with each row."""
    a, b = (np.asarray(sample, dtype=np.float64) for sample in (values, baseline))
    worlds = {sample.shape[-1] if sample.ndim else 0 for sample in (a, b)}
    rows = {len(sample) for sample in (a, b) if sample.ndim == 2}
    if len(worlds) > 1 or len(rows) > 1:
        shapes = [" by ".join(map(str, sample.shape)) for sample in (a, b)]
        raise ValueError(f"{shapes[0]} values against {shapes[1]} of the baseline: must be as many")
    a, b = np.broadcast_arrays(a, b)
    return _sample(a), _sample(b)


def _crossed_half_width(sample: FloatArray) -> float:
    """Half of the interval of the mean of policies crossed with worlds, shape (P, W)."""
    variance, freedom = _crossed_variance(sample)
    if math.isnan(variance) or variance == 0.0:
        return variance
    return _t_quantile(freedom) * math.sqrt(variance)


def _crossed_variance(sample: FloatArray) -> tuple[float, float]:
    """Variance of the mean of policies crossed with worlds, (P, W), and its degrees of freedom."""
    means = [sample.mean(axis=axis) for axis in (1, 0)]
    parts = [float(mean.var(ddof=1)) / len(mean) for mean in means]
    if math.isnan(sum(parts)):
        return math.nan, math.nan
    if sum(parts) <= (1e-15 * float(np.abs(sample).max())) ** 2:
        return 0.0, math.nan
    shares = [part / sum(parts) for part in parts]
    freedom = 1.0 / sum(
        share**2 / (len(mean) - 1) for share, mean in zip(shares, means, strict=True)
    )
    return sum(parts), freedom


def _crossed_spread(sample: FloatArray) -> float:
    """Return the standard deviation of a pair of policies crossed with worlds, by mean squares."""
    policies, worlds = sample.shape
    rows, columns = (sample.mean(axis=axis, keepdims=True) for axis in (1, 0))
    residual = sample - rows - columns + sample.mean()
    of_pairs = float((residual**2).sum()) / ((policies - 1) * (worlds - 1))
    alone = (1.0 - 1.0 / policies - 1.0 / worlds) * of_pairs
    return math.sqrt(float(rows.var(ddof=1)) + float(columns.var(ddof=1)) + alone)


def _t_quantile(freedom: float) -> float:
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.5 + 0.5 * LEVEL))
