"""A robot that is a linear plant: x(k+1) = A x(k) + A_d x(k-d) + B u(k) + w(k).

The state is held between samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hiersched.core.compiled import inner_kernel
from hiersched.core.parameters import Matrix, NonEmpty, NonNegative, Note, Positive
from hiersched.core.randomness import (
    NormalScratch,
    draw_robot_normals,
    normal_rows,
    normal_scratch,
)
from hiersched.models.model import PLANT, Plant, Setup
from hiersched.models.plant.dexterity import window_index
from hiersched.models.plant.feedback import (
    LoopConstants,
    LoopMemory,
    entry_in_force,
    feedback,
    forget,
    late_place,
)
from hiersched.models.seams import DRIVE

if TYPE_CHECKING:
    from hiersched.control import DelayedPlant
    from hiersched.scenario.schema import Scenario


class LinearWords(NamedTuple):
    """Parameters and state of R plants in each of E worlds; n states, m inputs.

    Matrices, standard deviations a sample (n,), limits (m,), error states. `state` (E, R, n) now
    and `coming` after the sample, `past` (E, R, samples + 1, n) the states of the run, `control`
    (E, R, m), `window_square` (E, R) the squared errors of the window.
    """

    A: NDArray[np.float64]
    A_d: NDArray[np.float64]
    B: NDArray[np.float64]
    process_noise: NDArray[np.float64]
    measurement_noise: NDArray[np.float64]
    input_limits: NDArray[np.float64]
    error_states: NDArray[np.int64]
    slots_per_sample: int
    slots_per_window: int
    state: NDArray[np.float64]
    coming: NDArray[np.float64]
    past: NDArray[np.float64]
    control: NDArray[np.float64]
    window_square: NDArray[np.float64]
    memory: LoopMemory
    normals: NormalScratch
    normal_rows: NDArray[np.float32]


Index = Annotated[int, Field(ge=0)]


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

    design_keys: ClassVar[tuple[str, ...] | None] = ("A", "A_d", "B", "Q", "R")

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
        (``split``).

        Raises
        ------
        ValueError
            As `hiersched.control.DelayedPlant` and `dlqr`; the message begins with the matrix.
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
        arrays = {
            name: np.zeros((n, n)) if value is None else np.array(value, dtype=np.float64)
            for name in ("A", "A_d", "B", "process_noise", "measurement_noise")
            for value in [getattr(self, name)]
        }
        limits = self.input_limits
        return LinearWords(
            **arrays,
            input_limits=np.full(m, np.inf) if limits is None else np.array(limits, np.float64),
            error_states=np.array(self.error_states, np.int64),
            slots_per_sample=round(scenario.control.sampling_s / slot_s),
            slots_per_window=round(scenario.robot.window_s / slot_s),
            state=np.zeros((num_envs, num_robots, n)),
            coming=np.zeros((num_envs, num_robots, n)),
            past=np.zeros_like(memory.history),
            control=np.zeros((num_envs, num_robots, m)),
            window_square=np.zeros((num_envs, num_robots)),
            memory=memory,
            normals=normal_scratch(normal_rows(num_robots, num_normals)),
            normal_rows=np.zeros((normal_rows(num_robots, num_normals), 5), np.float32),
        )

    def reset(self, words: LinearWords, keys: NDArray[np.uint64]) -> None:
        """As in `Model`: plants at rest at the origin."""
        for values in (words.state, words.coming, words.past, words.control, words.window_square):
            values[...] = 0.0
        forget(words.memory)


@DRIVE.kernel(LinearWords)
def drive_linear(me: LinearWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Move all plants of a world through the slot.

    A sample begins with a slot. The state is held until the next sample; the record has it after
    the slot, as for unicycles. The window's index has the tracking error alone: no heading and no
    curvature.
    """
    draw_robot_normals(
        state.key[env], state.slot[env], me.normals, me.normal_rows, slot.robot_normal
    )
    now, loop = state.slot[env], constants.loop
    for robot in range(slot.delay_steps.shape[0]):
        body = me.state[env, robot]
        if now % me.slots_per_sample == 0:
            delay_steps = int(slot.delay_steps[robot])
            entry = entry_in_force(loop, delay_steps, me.memory.held[env, robot])
            slot.control_saturated[robot] += _sample(
                me,
                loop,
                now // me.slots_per_sample,
                delay_steps,
                entry,
                slot.robot_normal[robot],
                (env, robot),
            )
            state.gain_delay_steps[env, robot] = loop.adjusted_delay_steps[entry]
        square = _square_error(me, body)
        me.window_square[env, robot] += square
        if (now + 1) % me.slots_per_sample == 0:
            for j in range(body.shape[0]):
                body[j] = me.coming[env, robot, j]
        if (now + 1) % me.slots_per_window == 0:
            state.dexterity_index[env, robot] = window_index(
                me.window_square[env, robot], 0.0, 0.0, me.slots_per_window
            )
            me.window_square[env, robot] = 0.0
        slot.tracking_error_m[robot] = math.sqrt(square)
        slot.gain_delay_steps[robot] = state.gain_delay_steps[env, robot]
        for j in range(body.shape[0]):
            slot.state[robot, j] = body[j]
            state.robot_state[env, robot, j] = body[j]
        for i in range(me.control.shape[2]):
            slot.control[robot, i] = me.control[env, robot, i]


@inner_kernel()
def _sample(
    me: LinearWords,
    loop: LoopConstants,
    sample: int,
    delay_steps: int,
    entry: int,
    normals: NDArray[np.float32],
    place: tuple[int, int],
) -> int:
    """Measure one plant, set its inputs (`feedback`), and find x(k+1).

    Parameters
    ----------
    me, loop
        The plants; gains.
    sample, delay_steps, entry
        k, T_d and the entry of the tables in force.
    normals
        Standard normals, shape (2 n,): process noise, measurement noise.
    place
        World and robot.

    Returns
    -------
    int
        1 if an input met its limit, else 0.
    """
    n, m = me.B.shape
    history, commands = me.memory.history[place], me.memory.commands[place]
    state, past, control = me.state[place], me.past[place], me.control[place]
    late_sample = late_place(sample, delay_steps, history.shape[0])
    now, late, late_state = history[sample], history[late_sample], past[late_sample]
    for j in range(n):
        past[sample, j] = state[j]
        now[j] = state[j] + me.measurement_noise[j] * np.float64(normals[n + j])
    saturated = 0
    for i in range(m):
        command = feedback(loop, entry, i, late, now, sample, commands)
        if abs(command) > me.input_limits[i]:
            command = me.input_limits[i] if command > 0.0 else -me.input_limits[i]
            saturated = 1
        control[i] = command
    for i in range(m):
        commands[sample % commands.shape[0], i] = control[i]
    for i in range(n):
        value = me.process_noise[i] * np.float64(normals[i])
        for j in range(n):
            value += me.A[i, j] * state[j] + me.A_d[i, j] * late_state[j]
        for j in range(m):
            value += me.B[i, j] * control[j]
        me.coming[place][i] = value
    return saturated


@inner_kernel()
def _square_error(me: LinearWords, state: NDArray[np.float64]) -> float:
    """Sum of the squares of the states that count as tracking error."""
    total = 0.0
    for state_index in me.error_states:
        total += state[state_index] ** 2
    return total
