"""Arrivals: the Poisson quantile of a uniform; the uniform, not the count, is the world's."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hiersched.compiled import kernel

MAX_MEAN = 600.0
"""Largest mean of `poisson_quantiles`: exp(-mean) must stay a normal double."""

NEGLIGIBLE_TERM = 1e-17
"""Far in the tail the sum may have rounded below the uniform: no later term changes it."""

# Far beyond the largest k that a double in (0, 1) can reach at MAX_MEAN.
_RECIPROCAL = np.concatenate([[0.0], 1.0 / np.arange(1, 4096)])


@kernel()
def poisson_quantiles(
    uniform: NDArray[np.float64],
    mean: NDArray[np.float64],
    scratch: NDArray[np.float64],
    quantile: NDArray[np.int64],
) -> None:
    """Poisson quantiles of all users, in place: the least k whose distribution reaches the uniform.

    The users' sums run side by side until the last has ended: one after the other, each would end
    at an unforeseeable place, which stalls the processor.

    Parameters
    ----------
    uniform, mean
        Shape (U,); in (0, 1) and at most MAX_MEAN.
    scratch
        Terms and sums, shape (2, U).
    quantile
        Result, shape (U,).
    """
    count = mean.shape[0]
    for user in range(count):
        scratch[0, user] = math.exp(-mean[user])
        scratch[1, user] = scratch[0, user]
        quantile[user] = 0
    k = 0
    open_users = 1
    while open_users > 0:
        k += 1
        reciprocal = _RECIPROCAL[k]
        open_users = 0
        for user in range(count):
            is_open = scratch[1, user] < uniform[user]
            step = 1 if is_open else 0
            quantile[user] += step
            open_users += step
            term = scratch[0, user] * (mean[user] * reciprocal)
            scratch[0, user] = term
            ended = is_open and term < NEGLIGIBLE_TERM and k > mean[user]
            scratch[1, user] = 2.0 if ended else scratch[1, user] + term
