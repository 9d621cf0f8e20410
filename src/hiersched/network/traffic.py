"""Arrivals: the Poisson quantile of a uniform; the uniform, not the count, is the world's."""

from __future__ import annotations

import math

import numpy as np

from hiersched.compiled import kernel

MAX_MEAN = 600.0
"""Largest mean of `poisson_quantile`: exp(-mean) must stay a normal double."""


# Far beyond the largest k that a double in (0, 1) can reach at MAX_MEAN.
_RECIPROCAL = np.concatenate([[0.0], 1.0 / np.arange(1, 4096)])


@kernel()
def poisson_quantile(uniform: float, mean: float) -> int:
    """Return the least k whose Poisson distribution function reaches `uniform`, in (0, 1).

    `mean` is at most MAX_MEAN.
    """
    term = math.exp(-mean)
    cumulative = term
    k = 0
    while cumulative < uniform:
        k += 1
        term *= mean * _RECIPROCAL[k]
        if term < 1e-17 and k > mean:
            # Far in the tail the sum has rounded below the uniform, and no later term changes a sum
            # close to 1.
            break
        cumulative += term
    return k
