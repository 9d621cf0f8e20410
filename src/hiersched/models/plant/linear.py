"""A robot that is a linear plant: x(k+1) = A x(k) + A_d x(k-d) + B u(k) + w(k).

The state is held between samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hiersched.core.compiled import kernel
from hiersched.core.parameters import Matrix, NonEmpty, NonNegative, Note, Positive
from hiersched.models.model import PLANT, Plant
from hiersched.models.plant.unicycle import RobotConstants, late_place, recall

if TYPE_CHECKING:
    from hiersched.control import DelayedPlant
    from hiersched.scenario.schema import Scenario

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
        if scenario.sweeps.sampling_s != (sampling_s,):
            faults.append(
                f"sweeps.sampling_s = {list(scenario.sweeps.sampling_s)}: must be [{sampling_s}] "
                "with plant.model = 'linear', whose matrices hold for control.sampling_s alone"
            )
        return faults


class LinearConstants(NamedTuple):
    """Matrices for n states and m inputs, standard deviations a sample, limits (m,), error states.

    All are empty where the robots are unicycles.
    """

    A: NDArray[np.float64]
    A_d: NDArray[np.float64]
    B: NDArray[np.float64]
    process_noise: NDArray[np.float64]
    measurement_noise: NDArray[np.float64]
    input_limits: NDArray[np.float64]
    error_states: NDArray[np.int64]


class LinearState(NamedTuple):
    """What evolves beside `RobotState`, one row an environment.

    `state` (E, R, n) now and `coming` after the sample, `past` (E, R, samples + 1, n) the states
    of the run, `control` (E, R, m), `window_square` (E, R) the squared errors of the window.
    """

    state: NDArray[np.float64]
    coming: NDArray[np.float64]
    past: NDArray[np.float64]
    control: NDArray[np.float64]
    window_square: NDArray[np.float64]


def linear_state(num_envs: int, num_robots: int, num_samples: int, n: int, m: int) -> LinearState:
    """Plants at rest at the origin, for runs of at most `num_samples` control samples."""
    return LinearState(
        state=np.zeros((num_envs, num_robots, n)),
        coming=np.zeros((num_envs, num_robots, n)),
        past=np.zeros((num_envs, num_robots, num_samples + 1, n)),
        control=np.zeros((num_envs, num_robots, m)),
        window_square=np.zeros((num_envs, num_robots)),
    )


@kernel()
def sample_linear(
    robots: RobotConstants,
    linear: LinearConstants,
    sample: int,
    delay_steps: int,
    entry: int,
    normals: NDArray[np.float32],
    history: NDArray[np.float64],
    commands: NDArray[np.float64],
    state: NDArray[np.float64],
    coming: NDArray[np.float64],
    past: NDArray[np.float64],
    control: NDArray[np.float64],
) -> int:
    """Measure one plant, set its inputs as `unicycle.close_loop` does, and find x(k+1).

    Parameters
    ----------
    robots, linear
        Gains; plant.
    sample, delay_steps, entry
        k, T_d and the entry of the tables in force.
    normals
        Standard normals, shape (2 n,): process noise, measurement noise.
    history, commands
        Measurements (samples + 1, n) and the ring of applied inputs (T_max + 1, m); written.
    state, coming, past, control
        Of this plant, as in `LinearState`; all but `state` are written.

    Returns
    -------
    int
        1 if an input met its limit, else 0.
    """
    n, m = linear.B.shape
    late_sample = late_place(sample, delay_steps, history.shape[0])
    now, late, late_state = history[sample], history[late_sample], past[late_sample]
    for j in range(n):
        past[sample, j] = state[j]
        now[j] = state[j] + linear.measurement_noise[j] * np.float64(normals[n + j])
    saturated = 0
    for i in range(m):
        command = 0.0
        for j in range(n):
            command -= robots.network_gain[entry, i, j] * late[j]
            command -= robots.local_gain[entry, i, j] * now[j]
        if robots.has_memory:
            command -= recall(robots.input_gain[entry, :, i], sample, commands)
        if abs(command) > linear.input_limits[i]:
            command = linear.input_limits[i] if command > 0.0 else -linear.input_limits[i]
            saturated = 1
        control[i] = command
    ring = robots.max_delay_steps + 1
    for i in range(m):
        commands[sample % ring, i] = control[i]
    for i in range(n):
        value = linear.process_noise[i] * np.float64(normals[i])
        for j in range(n):
            value += linear.A[i, j] * state[j] + linear.A_d[i, j] * late_state[j]
        for j in range(m):
            value += linear.B[i, j] * control[j]
        coming[i] = value
    return saturated


@kernel()
def square_error(linear: LinearConstants, state: NDArray[np.float64]) -> float:
    """Sum of the squares of the states that count as tracking error."""
    total = 0.0
    for state_index in linear.error_states:
        total += state[state_index] ** 2
    return total
