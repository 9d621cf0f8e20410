"""The loop that closes over the network: tables of gains, hysteresis, old measurements."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.core.compiled import kernel


class LoopConstants(NamedTuple):
    """What all plants need of the loop; n states, m inputs.

    `local_gain` and `network_gain`, shape (T_max + 1, m, n), act on the present and on the delayed
    measurement, `input_gain`, shape (T_max + 1, T_max, m, m), on past commands, the newest first;
    `has_memory` says whether any of it is not 0; an entry is held for `hold_samples`.
    `adjusted_delay_steps`, shape (T_max + 1,), is T where the gain for T is adjusted, 0 where it is
    nominal.
    """

    sampling_s: float
    core_latency_s: float
    max_delay_steps: int
    local_gain: NDArray[np.float64]
    network_gain: NDArray[np.float64]
    input_gain: NDArray[np.float64]
    has_memory: bool
    hold_samples: int
    adjusted_delay_steps: NDArray[np.uint32]


class LoopMemory(NamedTuple):
    """What the loops of E worlds of R robots remember.

    `history` (E, R, samples + 1, n) has the measured states of the whole run, `commands` (E, R,
    T_max + 1, m) is the ring of applied commands, kept for gains with memory only, `held` (E, R, 2)
    the entry in force and the samples for which it has to be kept.
    """

    history: NDArray[np.float64]
    commands: NDArray[np.float64]
    held: NDArray[np.int64]


def loop_memory(
    num_envs: int, num_robots: int, num_samples: int, max_delay_steps: int, n: int, m: int
) -> LoopMemory:
    """Nothing measured and nothing commanded yet, for runs of at most `num_samples` samples."""
    return LoopMemory(
        history=np.zeros((num_envs, num_robots, num_samples + 1, n)),
        commands=np.zeros((num_envs, num_robots, max_delay_steps + 1, m)),
        held=np.zeros((num_envs, num_robots, 2), np.int64),
    )


def forget(memory: LoopMemory) -> None:
    """Bring a memory back to the start, in place."""
    for values in memory:
        values[...] = 0


@njit(inline="always")
def steps_of_delay(delay_s: float, sampling_s: float) -> int:
    """T_d = ceil(D / h); a ratio within 1e-9 above an integer is that integer."""
    return int(np.ceil(delay_s / sampling_s - 1e-9))


@kernel()
def hold_entry(delay_steps: int, hold_samples: int, held: NDArray[np.int64]) -> int:
    """Entry of the tables in force: that of `control.hold_step`, whose state is `held` (2,)."""
    if delay_steps >= held[0] or held[1] == 0:
        held[0] = delay_steps
        held[1] = hold_samples
    else:
        held[1] -= 1
    return int(held[0])


@kernel()
def entry_in_force(loop: LoopConstants, delay_steps: int, held: NDArray[np.int64]) -> int:
    """Entry of the tables for a delay: at most T_max, or a longer one that is held."""
    entry = min(delay_steps, loop.max_delay_steps)
    return hold_entry(entry, loop.hold_samples, held) if loop.hold_samples > 0 else entry


@kernel()
def recall(gain: NDArray[np.float64], sample: int, commands: NDArray[np.float64]) -> float:
    """Sum_i H_i u(k-1-i) of one input: gain (T_max, m), ring of commands (T_max + 1, m)."""
    ring = commands.shape[0]
    total = 0.0
    for i in range(gain.shape[0]):
        past = commands[(sample - 1 - i) % ring]
        for j in range(gain.shape[1]):
            total += gain[i, j] * past[j]
    return total


@njit(inline="always")
def late_place(sample: int, delay_steps: int, num_places: int) -> int:
    """Place of sample k - T_d among `num_places` = samples + 1 places of a run.

    A delay that reaches behind the first sample finds a place that is not written yet: there the
    robot stands on its reference.
    """
    return int((sample - min(delay_steps, num_places - 1)) % num_places)


@njit(inline="always")
def feedback(
    loop: LoopConstants,
    entry: int,
    i: int,
    past: NDArray[np.float64],
    now: NDArray[np.float64],
    sample: int,
    commands: NDArray[np.float64],
) -> float:
    """Input i before saturation, u = -K_network x(k-T_d) - K_local x(k) - sum_j H_j u(k-1-j)."""
    command = 0.0
    for j in range(now.shape[0]):
        command -= loop.network_gain[entry, i, j] * past[j] + loop.local_gain[entry, i, j] * now[j]
    if loop.has_memory:
        command -= recall(loop.input_gain[entry, :, i], sample, commands)
    return command
