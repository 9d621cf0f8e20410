"""Hysteresis of a gain schedule: keep the gain of a longer delay for a while.

A gain whose certificate covers the delays 0..T stays valid while the delay is shorter, so the
gain may be changed late on the way down but never on the way up. Holding it for N samples makes
switches rare enough to be covered where no common function exists (`switching_report`). This is
for memoryless gains: a predictor made for T expects T exactly and must follow the delay, N = 0.
"""

from __future__ import annotations

import operator
from typing import SupportsIndex

import numpy as np
import numpy.typing as npt

IntArray = npt.NDArray[np.int64]


def hold_step(
    held: npt.ArrayLike,
    remaining: npt.ArrayLike,
    delay_steps: npt.ArrayLike,
    hold_samples: SupportsIndex,
) -> tuple[IntArray, IntArray]:
    """Advance the hysteresis by one sample: which entry of the table is in force now.

    A delay of at least the held one takes over at once and starts the count anew. A shorter one
    takes over once the delay has been shorter for N samples running, and then starts the count
    anew: every entry that is left for a shorter one was in force for more than N samples. N = 0
    follows the delay.

    Parameters
    ----------
    held : array_like of int, any shape
        Entry in force at the last sample; start with 0.
    remaining : array_like of int, same shape
        Samples for which it still has to be kept; start with 0.
    delay_steps : array_like of int, same shape
        Delay at this sample, in samples.
    hold_samples : int
        N, at least 0.

    Returns
    -------
    held, remaining : ndarray of int64
        The new state; `held` indexes the gain table, and is never below the delay.

    Raises
    ------
    ValueError
        If N is negative or not whole.
    """
    N = _as_hold_samples(hold_samples)
    held, remaining, delay = (np.asarray(a, dtype=np.int64) for a in (held, remaining, delay_steps))
    follow = (delay >= held) | (remaining == 0)
    return np.where(follow, delay, held), np.where(follow, N, remaining - 1)


def hold_delays(delay_steps: npt.ArrayLike, hold_samples: SupportsIndex) -> IntArray:
    """Return the entry in force at every sample of a history of delays.

    Parameters
    ----------
    delay_steps : array_like of int, shape (samples, ...)
        Delays in samples, one row a sample.
    hold_samples : int
        N of `hold_step`, at least 0.

    Returns
    -------
    ndarray of int64, same shape
        Never below `delay_steps`.

    Raises
    ------
    ValueError
        If N is negative or not whole.
    """
    delays = np.asarray(delay_steps, dtype=np.int64)
    if _as_hold_samples(hold_samples) == 0:
        return delays.copy()  # what the steps below come to, without a step a sample
    levels = np.empty_like(delays)
    held = remaining = np.zeros(delays.shape[1:], dtype=np.int64)
    for k, delay in enumerate(delays):
        held, remaining = hold_step(held, remaining, delay, hold_samples)
        levels[k] = held
    return levels


def _as_hold_samples(value: SupportsIndex) -> int:
    try:
        samples = operator.index(value)
    except TypeError:
        raise ValueError(f"hold_samples is {value!r}; it must be a whole number") from None
    if samples < 0:
        raise ValueError(f"hold_samples is {samples}; it must be at least 0")
    return samples
