"""A robot that is a linear plant: x(k+1) = A x(k) + A_d x(k-d) + B u(k) + w(k).

The state is held between samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from hiersched.core.compiled import inner_kernel
from hiersched.core.numerics import copy
from hiersched.core.parameters import Matrix, NonEmpty, NonNegative, Note, Positive
from hiersched.core.randomness import NormalScratch, draw_normals, normal_scratch
from hiersched.models.model import PLANT, Plant, Setup
from hiersched.models.plant.dexterity import window_index
from hiersched.models.plant.estimator import note_arrivals
from hiersched.models.plant.feedback import (
    LoopMemory,
    close_loop,
    forget,
    late_place,
    note_loop,
)
from hiersched.models.seams import DRIVE

if TYPE_CHECKING:
    from hiersched.control import DelayedPlant
    from hiersched.control.lqg import FilterModel
    from hiersched.scenario.schema import Scenario


class LinearWords(NamedTuple):
    """Parameters and state of R plants in each of E worlds; G kinds, n states, m inputs."""

    A: NDArray[np.float64]  # (G, n, n)
    A_d: NDArray[np.float64]  # (G, n, n)
    B: NDArray[np.float64]  # (G, n, m)
    process_noise: NDArray[np.float64]  # (G, n) standard deviations a sample
    measurement_noise: NDArray[np.float64]  # (G, n)
    input_limits: NDArray[np.float64]  # (G, m)
    error_states: NDArray[np.int64]
    slots_per_sample: int
    slots_per_window: int
    state: NDArray[np.float64]  # (E, R, n) now
    coming: NDArray[np.float64]  # (E, R, n) after the sample
    past: NDArray[np.float64]  # (E, R, samples + 1, n) of the run
    window_square: NDArray[np.float64]  # (E, R) squared errors of the window
    memory: LoopMemory
    normals: NormalScratch


Index = Annotated[int, Field(ge=0)]
_DESIGN_KEYS = ("A", "A_d", "B", "Q", "R")


@PLANT.model
@dataclass(frozen=True, kw_only=True)
class Linear(Plant):
    """Robots that are a discrete linear plant: n states, m inputs, matrices row by row."""

    model: Annotated[Literal["linear"], Note("model", "assumed", "linear (given by matrices)")] = (
        "linear"
    )
    A: Annotated[
        Matrix,
        Note(
            "1",
            "assumed",
            "x(k+1) = A x(k) + A_d x(k-d) + B u(k), n x n, for one interval of control.sampling_s",
        ),
    ]
    A_d: Annotated[
        Matrix | None,
        Note("1", "assumed", "n x n, what the network delays; null = the whole feedback"),
    ] = None
    B: Annotated[Matrix, Note("1", "assumed", "n x m")]
    Q: Annotated[
        Matrix,
        Note("1", "assumed", "state weight of the regulator, n x n; control.weight is not used"),
    ]
    R: Annotated[Matrix, Note("1", "assumed", "input weight, m x m")]
    process_noise: Annotated[
        tuple[NonNegative, ...], Note("states", "assumed", "n standard deviations, a sample")
    ]
    measurement_noise: Annotated[
        tuple[NonNegative, ...], Note("states", "assumed", "n standard deviations")
    ]
    input_limits: Annotated[
        tuple[Positive, ...] | None,
        Note("inputs", "assumed", "m limits of the inputs' size; null = none"),
    ] = None
    error_states: Annotated[
        Annotated[tuple[Index, ...], NonEmpty],
        Note(
            "indices",
            "assumed",
            "states, from 0 on, whose norm is the tracking error (1 counts as 1 m)",
        ),
    ]

    design_keys: ClassVar[tuple[str, ...] | None] = _DESIGN_KEYS
    kind_keys: ClassVar[tuple[str, ...]] = tuple(
        f"plant.{name}"
        for name in (*_DESIGN_KEYS, "process_noise", "measurement_noise", "input_limits")
    )

    def loop(self, scenario: Scenario) -> Literal["network", "split"]:
        """Return ``split`` where A_d says what the network delays."""
        return "network" if self.A_d is None else "split"

    def sizes(self, scenario: Scenario) -> tuple[int, int, int]:
        """Return n, m and 2n normals: process noise, then measurement noise."""
        return len(self.A), len(self.B[0]), 2 * len(self.A)

    def design(self, scenario: Scenario) -> DelayedPlant:
        """Return the plant itself.

        Without A_d the whole feedback crosses the network (``network``); with it the feedback K,
        the regulator of (A, B), acts at once, and A_d x(k-d) is what the network delays
        (``split``). Errors as those of `hiersched.control.DelayedPlant` and `dlqr`; the message
        begins with the matrix.
        """
        from hiersched.control import DelayedPlant, dlqr, network_plant

        sampling_s = scenario.control.sampling_s
        A, B, Q, R = (np.array(matrix) for matrix in (self.A, self.B, self.Q, self.R))
        if self.A_d is None:
            return network_plant(A, B, Q, R, sampling_s=sampling_s)
        return DelayedPlant(
            A=A,
            B=B,
            Q=Q,
            R=R,
            kind="split",
            nominal_gain=dlqr(A, B, Q, R)[0],
            A_d=np.array(self.A_d),
            sampling_s=sampling_s,
        )

    def position_states(self) -> tuple[int, ...]:
        """Return the key `error_states`."""
        return self.error_states

    def filter_model(self, scenario: Scenario) -> FilterModel:
        """Return the plant with its noise; ValueError if a state is measured without any."""
        from hiersched.control.lqg import FilterModel

        return FilterModel(
            A=np.array(self.A),
            B=np.array(self.B),
            process_covariance=np.diag(np.square(self.process_noise)),
            measurement_variance=np.square(self.measurement_noise),
        )

    def faults(self, scenario: Scenario) -> list[str]:
        """Say what is wrong with shapes, matrices and times."""
        ragged = [
            f"plant.{name}: rows of {sorted({len(row) for row in matrix})} values, must be as "
            "long as each other"
            for name in ("A", "A_d", "B", "Q", "R")
            if (matrix := getattr(self, name)) is not None and len({len(r) for r in matrix}) != 1
        ]
        if ragged:
            return ragged
        try:
            n, m = self.design(scenario).B.shape
        except ValueError as error:
            text = str(error)
            return [f"plant.{text}" if text[0].isalpha() else f"plant: {text}"]
        return [*self._vector_faults(n, m), *self._time_faults(scenario)]

    def _vector_faults(self, n: int, m: int) -> list[str]:
        faults = [
            f"plant.{name} = {list(values)}: {len(values)} values, must be {count}, one a {what}"
            for name, values, count, what in (
                ("process_noise", self.process_noise, n, "state"),
                ("measurement_noise", self.measurement_noise, n, "state"),
                ("input_limits", self.input_limits, m, "input"),
            )
            if values is not None and len(values) != count
        ]
        states = self.error_states
        if len(set(states)) != len(states) or any(state >= n for state in states):
            faults.append(
                f"plant.error_states = {list(states)}: must be different, from 0 to {n - 1}"
            )
        return faults

    def _time_faults(self, scenario: Scenario) -> list[str]:
        sampling_s, slot_s = scenario.control.sampling_s, scenario.radio.slot_s
        faults = []
        is_multiple = abs(sampling_s / slot_s - round(sampling_s / slot_s)) <= 1e-9
        if not is_multiple or sampling_s < 0.5 * slot_s:
            faults.append(
                f"control.sampling_s = {sampling_s}: must be a multiple of radio.slot_s = {slot_s} "
                "with plant.model = 'linear'"
            )
        swept = {"gain_study.sampling_s": scenario.gain_study.sampling_s} | {
            f"sweeps.axes.{name}.vary.control.sampling_s": axis.vary.get("control.sampling_s", ())
            for name, axis in scenario.sweeps.axes.items()
        }
        return faults + [
            f"{key} = {list(values)}: must be [{sampling_s}] or none with plant.model = 'linear', "
            "whose matrices hold for control.sampling_s alone"
            for key, values in swept.items()
            if set(values) - {sampling_s}
        ]

    def words(self, setup: Setup) -> LinearWords:
        """As in `Model`."""
        scenario, num_envs = setup.scenario, setup.num_envs
        n, m, num_normals = self.sizes(scenario)
        num_robots, slot_s = scenario.users.num_urllc, scenario.radio.slot_s
        memory = setup.loop_memory(n, m)

        def of_kinds(name: str, unless_given: ArrayLike = np.nan) -> NDArray[np.float64]:
            def value(own: Scenario) -> ArrayLike:
                given: ArrayLike | None = getattr(own.plant, name)
                return unless_given if given is None else given

            return setup.of_kinds(value)

        return LinearWords(
            A=of_kinds("A"),
            A_d=of_kinds("A_d", np.zeros((n, n))),
            B=of_kinds("B"),
            process_noise=of_kinds("process_noise"),
            measurement_noise=of_kinds("measurement_noise"),
            input_limits=of_kinds("input_limits", np.full(m, np.inf)),
            error_states=np.array(self.error_states, np.int64),
            slots_per_sample=round(scenario.control.sampling_s / slot_s),
            slots_per_window=round(scenario.robot.window_s / slot_s),
            state=np.zeros((num_envs, num_robots, n)),
            coming=np.zeros((num_envs, num_robots, n)),
            past=np.zeros_like(memory.history),
            window_square=np.zeros((num_envs, num_robots)),
            memory=memory,
            normals=normal_scratch(num_robots, num_normals),
        )

    def reset(self, words: LinearWords, keys: NDArray[np.uint64]) -> None:
        """As in `Model`: plants at rest at the origin."""
        for values in (words.state, words.coming, words.past, words.window_square):
            values[...] = 0.0
        forget(words.memory)


@DRIVE.kernel(LinearWords)
def drive_linear(me: LinearWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Move all plants of a world through the slot.

    A sample begins with a slot. The state is held until the next sample; the record has it after
    the slot, as for unicycles. The window's index has the tracking error alone: no heading and no
    curvature.
    """
    draw_normals(state.key[env], state.slot[env], me.normals, slot.robot_normal)
    now = state.slot[env]
    for robot in range(slot.delay_steps.shape[0]):
        body = me.state[env, robot]
        if not constants.loop.filter.all_arrive:
            held = state.held_step[env, robot]
            steps_per_sample = me.slots_per_sample * held.shape[0]
            note_arrivals(me.memory.filter, held, 0, steps_per_sample, env, robot)
        if now % me.slots_per_sample == 0:
            _sample(me, constants, state, slot, now // me.slots_per_sample, env, robot)
        square = 0.0
        for index in me.error_states:
            square += body[index] ** 2
        me.window_square[env, robot] += square
        if (now + 1) % me.slots_per_sample == 0:
            copy(me.coming[env, robot], body)
        if (now + 1) % me.slots_per_window == 0:
            state.dexterity_index[env, robot] = window_index(
                me.window_square[env, robot], 0.0, 0.0, me.slots_per_window
            )
            me.window_square[env, robot] = 0.0
        slot.tracking_error_m[robot] = math.sqrt(square)
        note_loop(constants.loop, me.memory, state, now // me.slots_per_sample, env, robot)
        copy(body, slot.state[robot])
        copy(me.memory.control[env, robot], slot.control[robot])


@inner_kernel()
def _sample(
    me: LinearWords, constants: Any, state: Any, slot: Any, sample: int, env: int, robot: int
) -> None:
    """Measure one plant, close its loop, and find x(k+1).

    Of its normals the first n are the process noise, the others that of the measurement.
    """
    kind, n, m = constants.loop.kind[robot], me.B.shape[1], me.B.shape[2]
    history, normals = me.memory.history[env, robot], slot.robot_normal[robot]
    body, past, control = me.state[env, robot], me.past[env, robot], me.memory.control[env, robot]
    copy(body, past[sample])
    for j in range(n):
        history[sample, j] = body[j] + me.measurement_noise[kind, j] * np.float64(normals[n + j])
    limits = me.input_limits[kind]
    close_loop(me.memory, limits, constants.loop, state, slot, sample, env, robot)
    late = past[late_place(sample, int(slot.delay_steps[robot]), history.shape[0])]
    for i in range(n):
        value = me.process_noise[kind, i] * np.float64(normals[i])
        for j in range(n):
            value += me.A[kind, i, j] * body[j] + me.A_d[kind, i, j] * late[j]
        for j in range(m):
            value += me.B[kind, i, j] * control[j]
        me.coming[env, robot, i] = value
