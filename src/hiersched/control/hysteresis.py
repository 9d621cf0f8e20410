"""Hysteresis of a gain schedule: keep the gain of a longer delay for a while.

A gain whose certificate covers the delays 0..T stays valid while the delay is shorter, so the
gain may be changed late on the way down but never on the way up. Holding it for N samples makes
switches rare enough to be covered where no common function exists (`switching_report`). This is
for memoryless gains: a predictor made for T expects T exactly and must follow the delay, N = 0.
"""

from __future__ import annotations

from typing import SupportsIndex

import numpy as np
import numpy.typing as npt

from hiersched.control.checks import as_samples

IntArray = npt.NDArray[np.int64]


def hold_step(
    held: npt.ArrayLike,
    remaining: npt.ArrayLike,
    delay_steps: npt.ArrayLike,
    hold_samples: SupportsIndex,
) -> tuple[IntArray, IntArray]:
    """Advance the hysteresis by one sample: which entry of the table is in force now.

    A delay of at least the held one takes over at once and starts the count anew. A shorter one
    takes over once the delay has been shorter for N = `hold_samples` samples running, and then
    starts the count anew: every entry that is left for a shorter one was in force for more than N
    samples. N = 0 follows the delay.

    `held`, the entry in force at the last sample, and `remaining`, the samples for which it has to
    be kept, start with 0; both are returned anew. They and the delay have one shape, any.
    """
    N = as_samples("hold_samples", hold_samples)
    held, remaining, delay = (np.asarray(a, dtype=np.int64) for a in (held, remaining, delay_steps))
    follow = (delay >= held) | (remaining == 0)
    return np.where(follow, delay, held), np.where(follow, N, remaining - 1)


def hold_delays(delay_steps: npt.ArrayLike, hold_samples: SupportsIndex) -> IntArray:
    """Return the entry in force at every sample of a history of delays, shape (samples, ...)."""
    delays = np.asarray(delay_steps, dtype=np.int64)
    if as_samples("hold_samples", hold_samples) == 0:
        return delays.copy()  # what the steps below come to, without a step a sample
    entries = np.empty_like(delays)
    held = remaining = np.zeros(delays.shape[1:], dtype=np.int64)
    for k, delay in enumerate(delays):
        held, remaining = hold_step(held, remaining, delay, hold_samples)
        entries[k] = held
    return entries
