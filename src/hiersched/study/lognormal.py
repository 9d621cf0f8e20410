"""Interval of the mean of a lognormal sample, with or without zeros, by quadrature.

A generalised pivotal quantity of the mean has, given the sample, a known distribution; the bounds
are its quantiles. Of n positive values with mean y and variance s^2 of their logarithms it is

    log T = log P + y - Z sigma / sqrt(n) + sigma^2 / 2,    sigma^2 = (n - 1) s^2 / V,

with Z standard normal and V chi-square of n - 1 degrees of freedom (Krishnamoorthy and Mathew,
"Inferences on the means of lognormal distributions using generalized p-values and generalized
confidence intervals", J. Stat. Planning and Inference 115, 2003). P is the share of values that are
not 0: it is 1 without zeros (Tian, "Inferences on the mean of zero-inflated lognormal data: the
generalized variable approach", Statistics in Medicine 24, 2005, has the extension to zeros), and
with m zeros one half each of Beta(n, m + 1) and Beta(n + 1, m), the fiducial distribution of a
proportion (Hannig, "On generalized fiducial inference", Statistica Sinica 19, 2009).

Where those papers draw random numbers, Z is integrated in closed form and V and P on nodes of
Gauss and Legendre in their probabilities, so that equal samples give equal bounds.

Of policies crossed with worlds (every policy in every world) the values are Y = m A B with A of the
policy and B of the world, independent and lognormal with zeros. Given the worlds, the means of the
policies are a sample of such a distribution, and so are those of the worlds given the policies.
With T_A and T_B the pivotal quantities above of these two samples,

    log T = log T_A + log T_B - log(mean of Y)

is one of the mean E[Y] = m E[A] E[B]: exact where either part is alone, when it is that of a single
sample; approximate else, since three numbers are estimated from one table. What is neither the
policy's nor the world's enters both samples and so counts twice: the interval is then too wide, not
too narrow (`tests/study/test_coverage.py` has coverage and width). A pivotal quantity can also be
formed of the variance components of the logarithms, as for one random factor (Krishnamoorthy,
Mathew and Ramachandran, J. Occupational and Environmental Hygiene 3, 2006). By simulation it covers
as often, is a seventh narrower where each of the three parts has a third of the variance, and has
no place for zeros.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

NODES = 64
"""Nodes of each of the quadratures; bounds below `MOST_OVER_MEAN` are then good to two thousandths,
to two hundredths where positive values are all but equal beside zeros."""

CROSSED_NODES = 24
SHARE_NODES = 8
MOST_SHARES = 32
"""Nodes of V and P where two samples are crossed, which enter squared, and of the product of both
P; the probability beyond a bound is then good to two thousandths, and errs towards less where
positive values are all but equal beside zeros."""

MOST_OVER_MEAN = 1e6
"""An upper bound of more times the mean of the positive values is given as infinite. Two or three
values that differ give bounds like 1e240, which say nothing and which the nodes do not resolve."""

SINGLE_SPREAD = 1.6
"""Standard deviation of the logarithm that is taken where one positive value alone shows none: that
of the late shares of this study's policies between worlds."""


def mean_bounds(positive: FloatArray, zeros: int, level: float) -> tuple[float, float]:
    """Return the bounds of the mean of a sample of positive values and zeros.

    The positive values have shape (n,), one or more. A single one shows no spread: its logarithm is
    taken to spread by `SINGLE_SPREAD`. Of the coverage `level` as much is left out below as above;
    the upper bound is infinite beyond `MOST_OVER_MEAN`.
    """
    logs = np.log(positive)
    sigma, sigma_weight = _sigmas(logs, NODES)
    share, share_weight = _shares(len(logs), zeros, NODES)
    middle = np.log(share)[:, None] + logs.mean() + 0.5 * sigma**2
    error = sigma / math.sqrt(len(logs))
    weight = share_weight[:, None] * sigma_weight
    most = math.log(MOST_OVER_MEAN) + math.log(float(positive.mean()))
    return _bounds(middle, error, weight, level, start=float(logs.mean()), most=most)


def crossed_bounds(values: FloatArray, level: float) -> tuple[float, float]:
    """Return the bounds of the mean of values of policies crossed with worlds.

    Values are 0 or above, shape (P, W), not all 0; P and W two or more. Bounds are as of
    `mean_bounds`.
    """
    start = math.log(float(values.mean()))
    by_policy, by_world = (_Part.of(values.mean(axis=axis)) for axis in (1, 0))
    means = np.add.outer(by_policy.log_mean, by_world.log_mean).ravel() - start
    errors = np.sqrt(np.add.outer(by_policy.error**2, by_world.error**2)).ravel()
    shares, share_weight = _thinned(
        np.add.outer(by_policy.log_share, by_world.log_share).ravel(),
        np.multiply.outer(by_policy.share_weight, by_world.share_weight).ravel(),
    )
    weight = np.multiply.outer(by_policy.weight, by_world.weight).ravel()
    return _bounds(
        np.add.outer(shares, means),
        errors,
        np.multiply.outer(share_weight, weight),
        level,
        start=start,
        most=math.log(MOST_OVER_MEAN) + start,
    )


def _bounds(
    middle: FloatArray,
    error: FloatArray,
    weight: FloatArray,
    level: float,
    *,
    start: float,
    most: float,
) -> tuple[float, float]:
    """Return exponentials of the outer quantiles of a mixture of normal distributions.

    They are searched for from `start` on; the upper one is infinite where it is `most` or more.
    """
    from scipy.optimize import brentq
    from scipy.special import ndtr

    def probability_below(log_mean: float) -> float:
        return float((weight * ndtr((log_mean - middle) / error)).sum())

    def quantile(tail: float) -> float:
        low, high, step = start - 1.0, start + 1.0, 1.0
        while probability_below(low) > tail:
            step *= 2.0
            low -= step
        while probability_below(high) < tail:
            step *= 2.0
            high += step
        return float(brentq(lambda x: probability_below(x) - tail, low, high, xtol=1e-6))

    lower, upper = quantile(0.5 - 0.5 * level), quantile(0.5 + 0.5 * level)
    return math.exp(lower), math.exp(upper) if upper < most else math.inf


class _Part(NamedTuple):
    """Pivotal quantity of the logarithm of a mean: normal distributions, and P apart from them."""

    log_mean: FloatArray
    error: FloatArray
    weight: FloatArray
    log_share: FloatArray
    share_weight: FloatArray

    @classmethod
    def of(cls, sample: FloatArray) -> _Part:
        """Form that of a sample of values of 0 and above, one of them positive, shape (n,)."""
        logs = np.log(sample[sample > 0.0])
        sigma, weight = _sigmas(logs, CROSSED_NODES)
        share, share_weight = _shares(len(logs), len(sample) - len(logs), SHARE_NODES)
        error = sigma / math.sqrt(len(logs))
        return cls(logs.mean() + 0.5 * sigma**2, error, weight, np.log(share), share_weight)


def _thinned(values: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return values with weights that sum to 1 as at most `MOST_SHARES`, neighbours averaged."""
    order = np.argsort(values)
    values, weight = values[order], weight[order]
    # Each goes where the middle of its weight lies.
    group = ((np.cumsum(weight) - 0.5 * weight) * MOST_SHARES).astype(np.intp)
    total, sums = (
        np.bincount(group, each, MOST_SHARES).astype(np.float64)
        for each in (weight, weight * values)
    )
    held = total > 0.0
    return sums[held] / total[held], total[held]


def _sigmas(logs: FloatArray, nodes: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of the standard deviation of the logarithm."""
    from scipy.special import chdtri

    if len(logs) == 1:
        return np.array([SINGLE_SPREAD]), np.ones(1)
    probability, weight = _nodes(nodes)
    chi_square = chdtri(len(logs) - 1, probability)
    # Equal values have no spread; the least positive one keeps the division defined.
    spread = max(float(logs.std(ddof=1)), 1e-12)
    return spread * np.sqrt((len(logs) - 1) / chi_square), weight


@lru_cache
def _shares(positive: int, zeros: int, nodes: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of the share of values that are not 0."""
    from scipy.special import betaincinv

    if not zeros:
        return np.ones(1), np.ones(1)
    probability, weight = _nodes(nodes)
    shares = [betaincinv(positive + more, zeros + 1 - more, probability) for more in (0, 1)]
    return np.concatenate(shares), np.concatenate([0.5 * weight, 0.5 * weight])


@lru_cache
def _nodes(count: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of Gauss and Legendre in (0, 1)."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 + 0.5 * nodes, 0.5 * weights
