"""The filter of the method lqg in the slot loop: an estimate at the newest stamp, predicted to now.

Derivation and what is certain of it: `hiersched.control.lqg`, docs/control.md.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.core.compiled import inner_kernel
from hiersched.core.numerics import copy

MOTION_STEP_RADPS, MAX_TURN_RATE_RADPS = 0.1, 25.6
"""Models of known motion are there for these turn rates of the reference, to either side."""


def estimate_fields(num_measured: int) -> dict[str, str]:
    """Return what a filter adds to the log, name -> unit: a number a robot, of its last sample.

    The estimate of each measured state; the standard deviation that the filter expects of its
    position error (a linear plant's `error_states`); the age of the newest measurement in it.
    """
    states = {f"estimate_{state}": "state" for state in range(num_measured)}
    return {**states, "estimate_std": "m", "estimate_age": "samples"}


class FilterConstants(NamedTuple):
    """What filters believe; N states, of which the first n are measured, and m inputs.

    There are G kinds of robots. The model of a kind at the speed v and the turn rate of index w is
    A[w] + v A_speed[w], likewise B. There is one, of which the speed is part already, unless the
    motion of the reference is known.
    """

    is_on: bool
    is_known: bool  # whether the reference's motion is known
    all_arrive: bool  # whether every measurement up to the newest arrives
    A: NDArray[np.float64]  # (G, W, N, N)
    A_speed: NDArray[np.float64]  # (G, W, N, N)
    B: NDArray[np.float64]  # (G, W, N, m)
    B_speed: NDArray[np.float64]  # (G, W, N, m)
    process_covariance: NDArray[np.float64]  # (G, N, N)
    measurement_variance: NDArray[np.float64]  # (G, n)
    gain: NDArray[np.float64]  # (G, N, n) of the stationary filter
    regulator: NDArray[np.float64]  # (G, m, N)
    straight: NDArray[np.float64]  # (G, N, N) A of the design, a straight line at its speed
    covariance: NDArray[np.float64]  # (G, N, N) of the stationary filter's error
    position_states: NDArray[np.int64]  # whose errors make the position error
    first_value: int  # of `estimate_fields` in `state.model_values[env]`


def no_filter(num_inputs: int) -> FilterConstants:
    """Return the constants of a loop without a filter: arrays of size 0."""
    nothing = np.zeros((1, 0, 0))
    A, B = np.zeros((1, 1, 0, 0)), np.zeros((1, 1, 0, num_inputs))
    return FilterConstants(
        is_on=False,
        is_known=False,
        all_arrive=True,
        A=A,
        A_speed=A,
        B=B,
        B_speed=B,
        process_covariance=nothing,
        measurement_variance=np.zeros((1, 0)),
        gain=nothing,
        regulator=np.zeros((1, num_inputs, 0)),
        straight=nothing,
        covariance=nothing,
        position_states=np.zeros(0, np.int64),
        first_value=0,
    )


class FilterMemory(NamedTuple):
    """What the filters of E worlds of R robots remember, and work arrays; empty without filters."""

    filtered: NDArray[np.int64]  # (E, R) samples: the estimate is of the last of them
    estimate: NDArray[np.float64]  # (E, R, N)
    covariance: NDArray[np.float64]  # (E, R, N, N) of its error, where that is not stationary
    motion: NDArray[np.float64]  # (E, R, samples + 1, 2) of the reference [m/s, rad/s] if known
    arrived: NDArray[np.bool_]  # (E, R, samples + 1) measurements, where not all arrive
    predicted: NDArray[np.float64]  # (E, R, N) estimate of the last control sample
    spread: NDArray[np.float64]  # (E, R, N, N) covariance of its error, likewise
    std_by_age: NDArray[np.float64]  # (G, ages) of a prediction where all arrive, as known
    num_ages: NDArray[np.int64]  # (G,) of which it is known
    ahead: NDArray[np.float64]  # (G, N, N) covariance at the last of these
    planned: NDArray[np.float64]  # (N,) and all below: work arrays
    scratch: NDArray[np.float64]  # (N,)
    A: NDArray[np.float64]  # (N, N)
    B: NDArray[np.float64]  # (N, m)
    product: NDArray[np.float64]  # (N, N)


def filter_memory(
    of_robot: tuple[int, int],
    samples: int,
    size: int,
    inputs: int,
    ahead: int = 0,
    *,
    kinds: int,
    is_known: bool,
) -> FilterMemory:
    """Return the memory of filters of `size` states, of so many kinds of robots: nothing yet.

    Predictions go up to `ahead` samples beyond the present.
    """
    states, matrix = (*of_robot, size), (*of_robot, size, size)
    return FilterMemory(
        filtered=np.zeros(of_robot, np.int64),
        estimate=np.zeros(states),
        covariance=np.zeros(matrix),
        motion=np.zeros((*of_robot, samples + 1 if is_known else 0, 2)),
        arrived=np.zeros((*of_robot, samples + 1 if size else 0), np.bool_),
        predicted=np.zeros(states),
        spread=np.zeros(matrix),
        std_by_age=np.zeros((kinds, samples + 1 + ahead if size else 0)),
        num_ages=np.zeros(kinds, np.int64),
        ahead=np.zeros((kinds, size, size)),
        planned=np.zeros(size),
        scratch=np.zeros(size),
        A=np.zeros((size, size)),
        B=np.zeros((size, inputs)),
        product=np.zeros((size, size)),
    )


@inner_kernel()
def estimate_now(
    loop: Any,
    memory: Any,
    inputs: NDArray[np.float64],
    until: int,
    sample: int,
    delay_steps: int,
    env: int,
    robot: int,
) -> None:
    """Filter what has arrived by a control sample, and predict: `memory.filter.predicted`.

    Of a loop's `LoopConstants` and `LoopMemory`: the newest measurement in `history` is T_d old,
    and thought to be newer by `stamp_error`; `commands` are those applied, sample by sample. From
    there on the prediction goes by `inputs`, likewise, to the sample `until`. At the start, and
    until a measurement arrives, the robot is known to stand on its reference.
    """
    _filter(loop, memory, sample, sample - delay_steps, env, robot)
    own = memory.filter
    predicted, spread = own.predicted[env, robot], own.spread[env, robot]
    copy(own.estimate[env, robot], predicted)
    copy(own.covariance[env, robot].reshape(-1), spread.reshape(-1))
    for stamp in range(max(own.filtered[env, robot] - 1, 0), until):
        advance(loop, own, predicted, inputs[stamp], min(stamp, sample), env, robot)
        _widen(loop, own, spread, robot)


@inner_kernel()
def _filter(loop: Any, memory: Any, sample: int, newest: int, env: int, robot: int) -> None:
    """Bring a robot's estimate to its newest measurement, that of the sample `newest`."""
    me, own, kind = loop.filter, memory.filter, loop.kind[robot]
    history, commands = memory.history[env, robot], memory.commands[env, robot]
    estimate, covariance = own.estimate[env, robot], own.covariance[env, robot]
    last = min(sample, newest + loop.stamp_error)
    if not me.all_arrive:  # behind the newest that is there others may still come
        while last >= 0 and not own.arrived[env, robot, max(last - loop.stamp_error, 0)]:
            last -= 1
    for stamp in range(own.filtered[env, robot], last + 1):
        if stamp > 0:
            advance(loop, own, estimate, commands[stamp - 1], stamp - 1, env, robot)
            _widen(loop, own, covariance, robot)
        own.filtered[env, robot] = stamp + 1
        taken = stamp - loop.stamp_error
        if not 0 <= taken <= newest:
            continue
        if me.all_arrive:
            _correct(me.gain[kind], own.scratch, estimate, history[taken])
        elif own.arrived[env, robot, taken]:
            variance = me.measurement_variance[kind]
            _update(variance, own.scratch, estimate, covariance, history[taken])


@inner_kernel()
def note_estimate(
    loop: Any,
    memory: FilterMemory,
    ahead: int,
    values: NDArray[np.float64],
    sample: int,
    env: int,
    robot: int,
) -> None:
    """Write what `estimate_fields` names, of the last control sample, into a world's `values`.

    It is the state for which a command was made, `ahead` of the sample.
    """
    me, kind = loop.filter, loop.kind[robot]
    num_robots, n = memory.filtered.shape[1], me.measurement_variance.shape[1]
    age = sample + ahead - (memory.filtered[env, robot] - 1)
    if me.all_arrive:
        _know_ages(me, memory, age, kind)
        std = memory.std_by_age[kind, age]
    else:
        std = _position_std(me, memory.spread[env, robot])
    place = me.first_value + robot
    for state in range(n):
        values[place + state * num_robots] = memory.predicted[env, robot, state]
    values[place + n * num_robots] = std
    values[place + (n + 1) * num_robots] = age


@inner_kernel()
def _know_ages(me: FilterConstants, memory: FilterMemory, age: int, kind: int) -> None:
    """Fill a kind's `memory.std_by_age` up to an age in samples, as on a straight line."""
    ahead = memory.ahead[kind]
    for known in range(memory.num_ages[kind], age + 1):
        if known == 0:
            copy(me.covariance[kind].reshape(-1), ahead.reshape(-1))
        else:
            _spread(me.process_covariance[kind], me.straight[kind], memory.product, ahead)
        memory.std_by_age[kind, known] = _position_std(me, ahead)
        memory.num_ages[kind] = known + 1


@inner_kernel()
def _position_std(me: FilterConstants, covariance: NDArray[np.float64]) -> float:
    variance = 0.0
    for state in me.position_states:
        variance += covariance[state, state]
    return math.sqrt(variance)


@inner_kernel()
def note_arrivals(
    memory: FilterMemory,
    held_step: NDArray[np.int64],
    phase: int,
    steps_per_sample: int,
    env: int,
    robot: int,
) -> None:
    """Note which measurements arrive in a slot where newer ones replace those that wait.

    `held_step` (S,) has the step of the newest that is there in each step of the slot.
    """
    for step in range(held_step.shape[0]):
        sample = (held_step[step] - phase) // steps_per_sample
        if sample >= 0:
            memory.arrived[env, robot, sample] = True


@inner_kernel()
def advance(
    loop: Any,
    memory: FilterMemory,
    state: NDArray[np.float64],
    command: NDArray[np.float64],
    sample: int,
    env: int,
    robot: int,
) -> None:
    """Predict a state (N,) over the interval that begins with a sample, in place."""
    me, kind = loop.filter, loop.kind[robot]
    A, B = me.A[kind, 0], me.B[kind, 0]
    if me.is_known:
        A, B = memory.A, memory.B
        _form_model(me, memory, memory.motion[env, robot, sample], kind)
    _move(A, B, memory.scratch, state, command)


@inner_kernel()
def _widen(loop: Any, memory: FilterMemory, covariance: NDArray[np.float64], robot: int) -> None:
    """Predict a covariance over the interval of the last `advance`, unless it is stationary."""
    me, kind = loop.filter, loop.kind[robot]
    if me.all_arrive:
        return
    A = me.A[kind, 0]
    if me.is_known:
        A = memory.A
    _spread(me.process_covariance[kind], A, memory.product, covariance)


@inner_kernel()
def regulate(
    regulator: NDArray[np.float64], state: NDArray[np.float64], out: NDArray[np.float64]
) -> None:
    """Write the inputs -K x (m,) of a state (N,)."""
    for i in range(regulator.shape[0]):
        command = 0.0
        for j in range(state.shape[0]):
            command -= regulator[i, j] * state[j]
        out[i] = command


@inner_kernel()
def _form_model(
    me: FilterConstants, memory: FilterMemory, motion: NDArray[np.float64], kind: int
) -> None:
    """Put the model of an interval into the work arrays: `motion` (2,) is that of the reference."""
    speed, turn_rate = motion[0], motion[1]
    if not abs(turn_rate) <= MAX_TURN_RATE_RADPS:
        raise ValueError("a reference turns at more than 25.6 rad/s, which known_motion allows")
    w = np.int64(np.rint((turn_rate + MAX_TURN_RATE_RADPS) / MOTION_STEP_RADPS))
    A, B = memory.A, memory.B
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            A[i, j] = me.A[kind, w, i, j] + speed * me.A_speed[kind, w, i, j]
        for j in range(B.shape[1]):
            B[i, j] = me.B[kind, w, i, j] + speed * me.B_speed[kind, w, i, j]


@inner_kernel()
def _move(
    A: NDArray[np.float64],
    B: NDArray[np.float64],
    moved: NDArray[np.float64],
    state: NDArray[np.float64],
    command: NDArray[np.float64],
) -> None:
    """Predict a state (N,) over a sample, in place: A x + B u; `moved` (N,) is a work array."""
    for i in range(state.shape[0]):
        total = 0.0
        for j in range(state.shape[0]):
            total += A[i, j] * state[j]
        for j in range(command.shape[0]):
            total += B[i, j] * command[j]
        moved[i] = total
    for i in range(state.shape[0]):
        state[i] = moved[i]


@inner_kernel()
def _spread(
    noise: NDArray[np.float64],
    A: NDArray[np.float64],
    product: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> None:
    """Predict a covariance (N, N) over a sample, in place: A P A^T + W, the process noise."""
    size = covariance.shape[0]
    for i in range(size):
        for j in range(size):
            total = 0.0
            for k in range(size):
                total += A[i, k] * covariance[k, j]
            product[i, j] = total
    for i in range(size):
        for j in range(i + 1):
            total = noise[i, j]
            for k in range(size):
                total += product[i, k] * A[j, k]
            covariance[i, j] = total
            covariance[j, i] = total


@inner_kernel()
def _correct(
    gain: NDArray[np.float64],
    innovation: NDArray[np.float64],
    state: NDArray[np.float64],
    measured: NDArray[np.float64],
) -> None:
    """Correct a state (N,) by a measurement (n,) with the gain (N, n), in place."""
    for j in range(measured.shape[0]):
        innovation[j] = measured[j] - state[j]
    for i in range(state.shape[0]):
        for j in range(measured.shape[0]):
            state[i] += gain[i, j] * innovation[j]


@inner_kernel()
def _update(
    variance: NDArray[np.float64],
    gain: NDArray[np.float64],
    state: NDArray[np.float64],
    covariance: NDArray[np.float64],
    measured: NDArray[np.float64],
) -> None:
    """Correct a state (N,) and its covariance (N, N) by a measurement (n,), in place.

    Its errors have the variances (n,). One component after the other: the errors are independent,
    and no matrix is inverted.
    """
    size = state.shape[0]
    for j in range(measured.shape[0]):
        scale = 1.0 / (covariance[j, j] + variance[j])
        for i in range(size):
            gain[i] = covariance[i, j] * scale
        innovation = measured[j] - state[j]
        for i in range(size):
            state[i] += gain[i] * innovation
        for i in range(size):
            for k in range(i + 1):
                # gain[k] / scale is covariance[j, k], which changes meanwhile.
                value = covariance[i, k] - gain[i] * gain[k] / scale
                covariance[i, k] = value
                covariance[k, i] = value
