"""How often intervals of a mean hold it, by simulation, and what that costs in width.

Ten worlds each, and ten policies in each of them where policies are crossed with worlds, the seed
of the draws the first one tried. An interval that holds the mean in a share c of all samples is
counted at c +- 4 sqrt(c (1 - c) / samples) but for 1 run in 16 000.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from hiersched.study.lognormal import MOST_OVER_MEAN, crossed_bounds, mean_bounds
from hiersched.study.statistics import Interval, mean_interval, skewed_interval

SPREAD = 1.6
"""Standard deviation of the logarithm of late shares between worlds."""

WORLDS = 10
SAMPLES = 3000

FloatArray = NDArray[np.float64]


class Coverage(NamedTuple):
    """Shares of samples whose interval holds the mean, or lies beside it, and its width."""

    inside: float
    too_low: float
    too_high: float
    ratio: float
    """Median of upper over lower bound."""
    width: float
    """Median of their distance, over the mean."""


def coverage(
    samples: FloatArray, mean: float, interval: Callable[[FloatArray], tuple[float, float]]
) -> Coverage:
    """Count how often the intervals of samples, shape (samples, n), hold the mean."""
    lo, hi = np.array([interval(sample)[-2:] for sample in samples]).T
    return Coverage(
        inside=float(((lo <= mean) & (mean <= hi)).mean()),
        too_low=float((hi < mean).mean()),
        too_high=float((lo > mean).mean()),
        ratio=float(np.median(np.divide(hi, lo, out=np.full(len(lo), np.inf), where=lo != 0.0))),
        width=float(np.median(hi - lo)) / mean,
    )


def error(share: float, count: int = SAMPLES) -> float:
    """Four standard errors of a share that is counted in so many samples."""
    return 4.0 * math.sqrt(share * (1.0 - share) / count)


def lognormal(count: int = SAMPLES, zeros: float = 0.0) -> tuple[FloatArray, float]:
    """Draw samples of a lognormal distribution with zeros, and return its mean with them."""
    rng = np.random.default_rng(1)
    values = np.exp(rng.normal(0.0, SPREAD, (count, WORLDS)))
    values[rng.random(values.shape) < zeros] = 0.0
    return values, (1.0 - zeros) * math.exp(0.5 * SPREAD**2)


def bootstrap(sample: FloatArray) -> tuple[float, float]:
    """Percentile bootstrap of the mean."""
    drawn = np.random.default_rng(0).integers(0, len(sample), (999, len(sample)))
    low, high = np.quantile(sample[drawn].mean(axis=1), [0.025, 0.975])
    return float(low), float(high)


@pytest.mark.nightly
def test_skewed_shares_are_covered_where_t_and_bootstrap_fail() -> None:
    """What covers is wide: ten worlds of such a spread say little about their mean."""
    samples, mean = lognormal()
    pivotal = coverage(samples, mean, skewed_interval)
    assert pivotal.inside >= 0.93
    assert pivotal.inside <= 0.95 + error(0.95)
    assert max(pivotal.too_low, pivotal.too_high) <= 0.025 + error(0.025)
    assert pivotal.ratio == pytest.approx(56.0, rel=0.1)
    assert pivotal.width == pytest.approx(18.0, rel=0.1)

    student = coverage(samples, mean, mean_interval)
    assert student.inside == pytest.approx(0.69, abs=error(0.69))
    assert (
        student.too_low > 0.25
    )  # the mean lies above: a sample seldom has the worlds that make it
    assert student.width == pytest.approx(1.4, rel=0.1)

    percentile = coverage(samples[:1000], mean, bootstrap)
    assert percentile.inside == pytest.approx(0.66, abs=error(0.66, 1000))


@pytest.mark.nightly
def test_shares_that_are_0_in_three_worlds_of_ten_are_covered() -> None:
    count = 1000
    samples, mean = lognormal(count, zeros=0.3)
    pivotal = coverage(samples, mean, skewed_interval)
    assert 0.93 <= pivotal.inside <= 0.95 + error(0.95, count)
    assert max(pivotal.too_low, pivotal.too_high) <= 0.025 + error(0.025, count)
    assert coverage(samples, mean, mean_interval).inside < 0.7


def test_a_single_share_above_0_is_covered_from_above() -> None:
    """Where nine worlds of ten are 0: of samples that have one world that is not."""
    samples, mean = lognormal(2500, zeros=0.9)
    single = samples[(samples > 0.0).sum(axis=1) == 1]
    assert len(single) > 900
    assert all(skewed_interval(sample).lo == 0.0 for sample in single[:20])
    assert coverage(single, mean, skewed_interval).too_low <= 0.025 + error(0.025, len(single))


@pytest.mark.nightly
def test_values_about_normal_are_covered_as_closely_as_by_t() -> None:
    samples = np.random.default_rng(1).normal(1.0, 0.1, (SAMPLES, WORLDS))
    pivotal, student = (coverage(samples, 1.0, f) for f in (skewed_interval, mean_interval))
    assert pivotal.inside == pytest.approx(0.95, abs=error(0.95))
    assert student.inside == pytest.approx(0.95, abs=error(0.95))
    assert pivotal.width == pytest.approx(student.width, rel=0.03)


POLICIES = 10
CROSSED_SAMPLES = 1500


def crossed(parts: tuple[float, float, float], count: int, spread: float = SPREAD) -> FloatArray:
    """Draw logarithms whose variance has these shares of policies, worlds and pairs."""
    rng = np.random.default_rng(1)
    shapes = ((count, POLICIES, 1), (count, 1, WORLDS), (count, POLICIES, WORLDS))
    draws = (
        math.sqrt(part) * rng.normal(size=shape) for part, shape in zip(parts, shapes, strict=True)
    )
    return spread * sum(draws)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("parts", "ratio", "width"),
    [
        ((0.5, 0.5, 0.0), 35.0, 12.0),
        ((1.0, 0.0, 0.0), 56.0, 18.0),
        ((0.0, 1.0, 0.0), 56.0, 18.0),
        ((0.4, 0.4, 0.2), 24.0, 9.0),
        ((0.0, 0.0, 1.0), 5.0, 2.4),
    ],
)
def test_shares_of_policies_crossed_with_worlds_are_covered(
    parts: tuple[float, float, float], ratio: float, width: float
) -> None:
    """Of half and half the width is two thirds of that of ten worlds, each of its own policy."""
    samples = np.exp(crossed(parts, CROSSED_SAMPLES))
    mean = math.exp(0.5 * SPREAD**2)
    pivotal = coverage(samples, mean, skewed_interval)
    assert pivotal.inside >= 0.93
    assert pivotal.too_low <= 0.025 + error(0.025, CROSSED_SAMPLES)
    assert pivotal.ratio == pytest.approx(ratio, rel=0.15)
    assert pivotal.width == pytest.approx(width, rel=0.15)
    if parts[2] == 0.0:  # as one of 100 values would be, or of the worlds alone
        assert coverage(samples[:300], mean, lambda x: skewed_interval(x.ravel())).inside < 0.6
    if parts[0] == 0.5:
        for axis in (0, 1):
            alone = coverage(samples[:300], mean, lambda x, a=axis: skewed_interval(x.mean(axis=a)))
            assert alone.inside < 0.9


@pytest.mark.nightly
@pytest.mark.parametrize("where", ["policies", "worlds", "pairs"])
def test_zeros_of_policies_worlds_and_pairs_are_covered(where: str) -> None:
    """Three in ten are 0, and half of the logarithms' variance is each of both."""
    count = 400
    samples = np.exp(crossed((0.5, 0.5, 0.0), count))
    shape = {"policies": (POLICIES, 1), "worlds": (1, WORLDS), "pairs": (POLICIES, WORLDS)}[where]
    samples *= np.random.default_rng(2).random((count, *shape)) >= 0.3
    mean = 0.7 * math.exp(0.5 * SPREAD**2)
    pivotal = coverage(samples, mean, skewed_interval)
    assert pivotal.inside >= 0.93
    assert pivotal.too_low <= 0.025 + error(0.025, count)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("parts", "most"),
    [
        ((0.5, 0.5, 0.0), 0.95),
        ((1.0, 0.0, 0.0), 0.95),
        ((0.0, 1.0, 0.0), 0.95),
        ((1 / 3, 1 / 3, 1 / 3), 0.96),
        ((0.0, 0.0, 1.0), 0.993),
    ],
)
def test_means_of_policies_crossed_with_worlds_are_covered(
    parts: tuple[float, float, float], most: float
) -> None:
    """Student's t: what is of pairs alone counts twice, which covers more, never less."""
    samples = crossed(parts, SAMPLES, 1.0)
    lo, hi = np.array([mean_interval(sample)[1:] for sample in samples]).T
    inside = float(((lo <= 0.0) & (hi >= 0.0)).mean())
    assert 0.95 - error(0.95) <= inside <= most + error(most)


def draws_of_the_mean(positive: FloatArray, zeros: int, count: int = 200_000) -> FloatArray:
    """Draw the generalised pivotal quantity of the mean, as its papers do."""
    rng = np.random.default_rng(1)
    logs, n = np.log(positive), len(positive)
    variance = logs.var(ddof=1) * (n - 1) / rng.chisquare(n - 1, count)
    log_mean = logs.mean() - rng.normal(size=count) * np.sqrt(variance / n) + 0.5 * variance
    if zeros:
        first = rng.random(count) < 0.5
        share = np.where(first, rng.beta(n, zeros + 1, count), rng.beta(n + 1, zeros, count))
        log_mean += np.log(share)
    return log_mean


def some_samples() -> Iterator[tuple[FloatArray, int]]:
    rng = np.random.default_rng(1)
    for count, zeros, spread in (
        (10, 0, 1.6),
        (3, 0, 0.5),
        (10, 0, 0.1),
        (7, 3, 1.6),
        (2, 3, 0.05),
    ):
        yield np.exp(rng.normal(-8.0, spread, count)), zeros


@pytest.mark.parametrize(("positive", "zeros"), list(some_samples()))
def test_bounds_are_the_quantiles_of_drawn_means(positive: FloatArray, zeros: int) -> None:
    drawn = draws_of_the_mean(positive, zeros)
    for bound, tail in zip(mean_bounds(positive, zeros, 0.9), (0.05, 0.95), strict=True):
        below = float((drawn < math.log(bound)).mean())
        assert below == pytest.approx(tail, abs=error(tail, len(drawn)))


def test_equal_values_beside_zeros_leave_the_share_of_zeros_open() -> None:
    """Without any spread the bounds are those of the proportion, times the value."""
    rng = np.random.default_rng(1)
    first = rng.random(200_000) < 0.5
    share = np.where(first, rng.beta(4, 7, len(first)), rng.beta(5, 6, len(first)))
    lo, hi = mean_bounds(np.full(4, 1e-5), 6, 0.95)
    expected = 1e-5 * np.quantile(share, [0.025, 0.975])
    assert (lo, hi) == pytest.approx(tuple(expected), rel=0.02)


def test_bounds_that_say_nothing_are_infinite() -> None:
    """Of two values that differ 95 % of drawn means lie below 1e19, of three below 5e8."""
    for values in ([1.0, 1.5], [0.4, 1.0, 2.7]):
        sample = np.array(values)
        drawn = np.quantile(draws_of_the_mean(sample, 0), [0.025, 0.975])
        assert drawn[1] > math.log(MOST_OVER_MEAN * sample.mean())
        lo, hi = mean_bounds(sample, 0, 0.95)
        assert (math.log(lo), hi) == (pytest.approx(drawn[0], abs=0.02), math.inf)
        assert skewed_interval(sample, most=7.0).hi == 7.0


def test_estimate_lies_within_its_bounds() -> None:
    """One world far below the others makes the logarithms spread, not the mean."""
    sample = np.array([0.2, 0.21, 0.19, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 1e-9])
    assert mean_bounds(sample, 0, 0.95)[0] > sample.mean()
    assert skewed_interval(sample, most=1.0) == Interval(sample.mean(), sample.mean(), 1.0)


@pytest.mark.parametrize(
    ("spreads", "zeros", "exact"),
    [
        ((1.1, 1.1, 0.2), (0, 0), True),
        ((1.6, 0.1, 0.0), (0, 0), True),
        ((0.05, 0.01, 0.01), (0, 0), True),
        ((1.1, 1.1, 0.2), (3, 0), True),
        ((1.1, 1.1, 0.2), (3, 4), True),
        ((0.01, 0.01, 0.01), (5, 0), False),
    ],
)
def test_crossed_bounds_are_the_quantiles_of_drawn_means(
    spreads: tuple[float, float, float], zeros: tuple[int, int], exact: bool
) -> None:
    """Where values are all but equal beside zeros, the bounds leave out less than they should."""
    rng = np.random.default_rng(5)
    shapes = ((POLICIES, 1), (1, WORLDS), (POLICIES, WORLDS))
    values = np.exp(sum(s * rng.normal(size=n) for s, n in zip(spreads, shapes, strict=True)))
    values[: zeros[0]], values[:, : zeros[1]] = 0.0, 0.0
    drawn = sum(
        drawn_of(values.mean(axis=axis), number) for axis, number in ((1, 1), (0, 2))
    ) - math.log(values.mean())
    for bound, tail in zip(crossed_bounds(values, 0.95), (0.025, 0.975), strict=True):
        below = float((drawn < math.log(bound)).mean())
        beyond, wanted = (below, tail) if tail < 0.5 else (1.0 - below, 1.0 - tail)
        assert beyond <= wanted + 0.003
        assert not exact or beyond >= wanted - 0.003


def drawn_of(sample: FloatArray, seed: int) -> FloatArray:
    """Logarithms of drawn means of a sample with zeros, independent of those of other seeds."""
    positive = sample[sample > 0.0]
    drawn = draws_of_the_mean(positive, len(sample) - len(positive))
    return np.random.default_rng(seed).permutation(drawn)
