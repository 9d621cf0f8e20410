"""The loop that closes over the network: tables of gains, hysteresis, old measurements."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.core.compiled import inner_kernel, kernel
from hiersched.models.plant.command_link import (
    MEASUREMENTS,
    LinkConstants,
    LinkMemory,
    assume_inputs,
    note_link,
    play_command,
    send_commands,
)
from hiersched.models.plant.estimator import (
    FilterConstants,
    FilterMemory,
    estimate_now,
    note_estimate,
    regulate,
)


class LoopConstants(NamedTuple):
    """What all plants need of the loop; n states, m inputs, delays of up to T_max samples.

    Tables have T_max + 1 entries for each kind of robot, J in all.
    """

    sampling_s: float
    core_latency_s: float
    max_delay_steps: int
    kind: NDArray[np.int64]  # (R,) of each robot
    local_gain: NDArray[np.float64]  # (J, m, n) on the present measurement
    network_gain: NDArray[np.float64]  # (J, m, n) on the delayed measurement
    input_gain: NDArray[np.float64]  # (J, T_max, m, m) on past commands, the newest first
    has_memory: bool  # whether any of `input_gain` is not 0
    hold_samples: int  # for which an entry of the tables is held
    stamp_error: int  # samples by which measurements are newer in the controller's belief
    is_local: bool  # whether the loop closes on the robot, without delay
    by_age: bool  # whether the delay is the age of the newest packet delivered
    adjusted_delay_steps: NDArray[np.uint32]  # (J,) T, but 0 where its gain is the nominal
    filter: FilterConstants  # of the method lqg, in place of the tables
    link: LinkConstants  # what of its feedback crosses the network


class LoopMemory(NamedTuple):
    """What the loops of E worlds of R robots remember."""

    history: NDArray[np.float64]  # (E, R, samples + 1, n) measured states of the whole run
    commands: NDArray[np.float64]  # (E, R, places, m) ring of applied commands
    control: NDArray[np.float64]  # (E, R, m) commands in force
    held: NDArray[np.int64]  # (E, R, 2) entry in force, samples for which it has to be kept
    filter: FilterMemory
    link: LinkMemory


def forget(memory: LoopMemory) -> None:
    """Bring a memory back to the start, in place."""
    for values in (*memory[:-2], *memory.filter, *memory.link):
        values[...] = 0


@njit(inline="always")
def steps_of_delay(delay_s: float, sampling_s: float) -> int:
    """T_d = ceil(D / h); a ratio within 1e-9 above an integer is that integer."""
    return int(np.ceil(delay_s / sampling_s - 1e-9))


@kernel()
def entry_in_force(loop: LoopConstants, delay_steps: int, held: NDArray[np.int64]) -> int:
    """Entry of a kind's tables for a delay: at most T_max, or a longer one that is held.

    That of `control.hold_step`, whose state is `held` (2,).
    """
    entry = min(delay_steps, loop.max_delay_steps)
    if loop.hold_samples == 0:
        return entry
    if entry >= held[0] or held[1] == 0:
        held[0] = entry
        held[1] = loop.hold_samples
    else:
        held[1] -= 1
    return int(held[0])


@njit(inline="always")
def late_place(sample: int, delay_steps: int, num_places: int) -> int:
    """Place of sample k - T_d among `num_places` = samples + 1 places of a run.

    A delay that reaches behind the first sample finds a place that is not written yet: there the
    robot stands on its reference.
    """
    return int((sample - min(delay_steps, num_places - 1)) % num_places)


@kernel()
def _recall(gain: NDArray[np.float64], sample: int, commands: NDArray[np.float64]) -> float:
    """Sum_i H_i u(k-1-i) of one input: gain (T_max, m), ring of commands (T_max + 1, m)."""
    ring = commands.shape[0]
    total = 0.0
    for i in range(gain.shape[0]):
        past = commands[(sample - 1 - i) % ring]
        for j in range(gain.shape[1]):
            total += gain[i, j] * past[j]
    return total


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
        command -= _recall(loop.input_gain[entry, :, i], sample, commands)
    return command


@inner_kernel(forceinline=True)
def close_loop(
    memory: LoopMemory,
    limits: NDArray[np.float64],
    loop: LoopConstants,
    state: Any,
    slot: Any,
    sample: int,
    env: int,
    robot: int,
) -> None:
    """Set a robot's inputs at sample k, whose measurement stands in `memory.history`.

    u = -K_network x(k-T_d) - K_local x(k) - sum_i H_i u(k-1-i), or -K x^(k) of the filter, cut to
    the limits (m,), stands in `memory.control` then. A sample that met a limit is counted; the
    gain in force is noted.
    """
    commands, control = memory.commands[env, robot], memory.control[env, robot]
    delay_steps = int(slot.delay_steps[robot])
    believed_steps = max(0, delay_steps - loop.stamp_error)
    entry = entry_in_force(loop, believed_steps, memory.held[env, robot])
    entry += loop.kind[robot] * (loop.max_delay_steps + 1)
    if loop.filter.is_on:
        _control_by_filter(memory, limits, loop, sample, delay_steps, env, robot)
    else:
        history = memory.history[env, robot]
        now, past = history[sample], history[late_place(sample, delay_steps, history.shape[0])]
        for i in range(limits.shape[0]):
            control[i] = feedback(loop, entry, i, past, now, sample, commands)
    saturated = 0
    for i in range(limits.shape[0]):
        if abs(control[i]) > limits[i]:
            control[i] = limits[i] if control[i] > 0.0 else -limits[i]
            saturated = 1
    if loop.has_memory or loop.filter.is_on:
        for i in range(limits.shape[0]):
            commands[sample % commands.shape[0], i] = control[i]
    slot.control_saturated[robot] += saturated
    state.gain_delay_steps[env, robot] = loop.adjusted_delay_steps[entry]


@inner_kernel()
def _control_by_filter(
    memory: LoopMemory,
    limits: NDArray[np.float64],
    loop: LoopConstants,
    sample: int,
    delay_steps: int,
    env: int,
    robot: int,
) -> None:
    """Set a robot's inputs, before limits, by the filter and over the link."""
    if loop.link.kind == MEASUREMENTS:
        inputs = memory.commands[env, robot]
        estimate_now(loop, memory, inputs, sample, sample, delay_steps, env, robot)
        predicted = memory.filter.predicted[env, robot]
        regulate(loop.filter.regulator[loop.kind[robot]], predicted, memory.control[env, robot])
        return
    assume_inputs(loop, memory, sample, env, robot)
    inputs, until = memory.link.assumed[env, robot], sample + memory.link.ahead[env, robot]
    estimate_now(loop, memory, inputs, until, sample, loop.link.latency_steps, env, robot)
    send_commands(loop, memory, limits, sample, env, robot)
    play_command(loop, memory, sample, delay_steps, env, robot)


@inner_kernel()
def note_loop(
    loop: LoopConstants, memory: LoopMemory, state: Any, sample: int, env: int, robot: int
) -> None:
    """Note for the record what a robot's filter and link say at the end of a slot, if it has any.

    `sample` is its last control sample. Kernels of plants call this after the last step.
    """
    if loop.filter.is_on:
        values, ahead = state.model_values[env], memory.link.ahead[env, robot]
        note_estimate(loop, memory.filter, ahead, values, sample, env, robot)
        if loop.link.kind != MEASUREMENTS:
            note_link(loop, memory, values, sample, env, robot)
