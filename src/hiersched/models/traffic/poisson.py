"""Arrivals: the Poisson quantile of a uniform; the uniform, not the count, is the world's."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hiersched.core.compiled import kernel
from hiersched.core.numerics import exp_f64
from hiersched.models.queue.fifo import LANES

MAX_MEAN = 600.0
"""Largest mean of `poisson_quantiles`: exp(-mean) must stay a normal double."""

NEGLIGIBLE_TERM = 1e-17
"""Far in the tail the sum may have rounded below the uniform: no later term changes it."""

# Far beyond the largest k that a double in (0, 1) can reach at MAX_MEAN.
_RECIPROCAL = np.concatenate([[0.0], 1.0 / np.arange(1, 4096)])

UNIFORM, MEAN, QUANTILE, _TERM, _SUM, NUM_ARRIVAL_LANES = (LANES * place for place in range(6))


@kernel(forceinline=True)
def poisson_quantiles(lanes: NDArray[np.float64]) -> None:
    """Poisson quantiles of a block of users: the least k whose distribution reaches the uniform.

    The users' sums run side by side until the last has ended: one after the other, each would end
    at an unforeseeable place, which stalls the processor.

    Parameters
    ----------
    lanes
        Flat, LANES of each: `UNIFORM` in (0, 1) and `MEAN`, at most MAX_MEAN, are read, `QUANTILE`
        is written. Lanes without a user have a uniform of 0.
    """
    for lane in range(LANES):
        lanes[_TERM + lane] = exp_f64(-lanes[MEAN + lane])
        lanes[_SUM + lane] = lanes[_TERM + lane]
        lanes[QUANTILE + lane] = 0.0
    k = 0
    open_users = 1
    while open_users > 0:
        k += 1
        reciprocal = _RECIPROCAL[k]
        count = np.float64(k)
        open_users = 0
        for lane in range(LANES):
            is_open = lanes[_SUM + lane] < lanes[UNIFORM + lane]
            mean = lanes[MEAN + lane]
            term = lanes[_TERM + lane] * (mean * reciprocal)
            ended = is_open and term < NEGLIGIBLE_TERM and count > mean
            lanes[QUANTILE + lane] += 1.0 if is_open else 0.0
            lanes[_TERM + lane] = term
            lanes[_SUM + lane] = 2.0 if ended else lanes[_SUM + lane] + term
            open_users += 1 if is_open else 0
