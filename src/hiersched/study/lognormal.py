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
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

NODES = 64
"""Nodes of each of the quadratures; bounds below `MOST_OVER_MEAN` are then good to two thousandths,
to two hundredths where positive values are all but equal beside zeros."""

MOST_OVER_MEAN = 1e6
"""An upper bound of more times the mean of the positive values is given as infinite. Two or three
values that differ give bounds like 1e240, which say nothing and which the nodes do not resolve."""

SINGLE_SPREAD = 1.6
"""Standard deviation of the logarithm that is taken where one positive value alone shows none: that
of the late shares of this study's policies between worlds."""


def mean_bounds(positive: FloatArray, zeros: int, level: float) -> tuple[float, float]:
    """Return the bounds of the mean of a sample of positive values and zeros.

    Parameters
    ----------
    positive
        Positive values, shape (n,), one or more. A single one shows no spread: its logarithm is
        taken to spread by `SINGLE_SPREAD`.
    zeros
        Zeros in the sample.
    level
        Coverage; as much is left out below as above.

    Returns
    -------
    tuple of float
        Lower and upper bound; the upper one is infinite beyond `MOST_OVER_MEAN`.
    """
    from scipy.special import ndtr

    logs = np.log(positive)
    sigma, sigma_weight = _sigmas(logs)
    share, share_weight = _shares(len(logs), zeros)
    middle = np.log(share)[:, None] + logs.mean() + 0.5 * sigma**2
    error = sigma / math.sqrt(len(logs))
    weight = share_weight[:, None] * sigma_weight

    def probability_below(log_mean: float) -> float:
        return float((weight * ndtr((log_mean - middle) / error)).sum())

    start = float(logs.mean())
    lower, upper = (
        _quantile(probability_below, tail, start) for tail in (0.5 - 0.5 * level, 0.5 + 0.5 * level)
    )
    most = math.log(MOST_OVER_MEAN) + math.log(float(positive.mean()))
    return math.exp(lower), math.exp(upper) if upper < most else math.inf


def _sigmas(logs: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of the standard deviation of the logarithm."""
    from scipy.special import chdtri

    if len(logs) == 1:
        return np.array([SINGLE_SPREAD]), np.ones(1)
    probability, weight = _nodes()
    chi_square = chdtri(len(logs) - 1, probability)
    # Equal values have no spread; the least positive one keeps the division defined.
    spread = max(float(logs.std(ddof=1)), 1e-12)
    return spread * np.sqrt((len(logs) - 1) / chi_square), weight


@lru_cache
def _shares(positive: int, zeros: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of the share of values that are not 0."""
    from scipy.special import betaincinv

    if not zeros:
        return np.ones(1), np.ones(1)
    probability, weight = _nodes()
    shares = [betaincinv(positive + more, zeros + 1 - more, probability) for more in (0, 1)]
    return np.concatenate(shares), np.concatenate([0.5 * weight, 0.5 * weight])


@lru_cache
def _nodes() -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of Gauss and Legendre in (0, 1)."""
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    return 0.5 + 0.5 * nodes, 0.5 * weights


def _quantile(probability_below: Callable[[float], float], tail: float, start: float) -> float:
    """Return where a distribution function reaches `tail`, searched for from `start` on."""
    from scipy.optimize import brentq

    low, high, step = start - 1.0, start + 1.0, 1.0
    while probability_below(low) > tail:
        step *= 2.0
        low -= step
    while probability_below(high) < tail:
        step *= 2.0
        high += step
    return float(brentq(lambda x: probability_below(x) - tail, low, high, xtol=1e-6))
