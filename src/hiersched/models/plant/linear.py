"""A robot that is a linear plant: x(k+1) = A x(k) + A_d x(k-d) + B u(k) + w(k).

The state is held between samples.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.core.compiled import kernel
from hiersched.models.plant.unicycle import RobotConstants, late_place, recall


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
