"""The nonlinear robot in the frame of its reference, with slip, saturation and a delayed loop.

State x = (e_x, e_y, e_theta, dv, dw): position and heading error in the reference's frame, departure of speed and turn
rate from the reference. Arrays keep the robots in the last axis: the compiler turns loops over robots into vectors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.numerics import cos_half, sin_half, wrap_angle
from hiersched.robot.dexterity import MIN_SPEED_MPS

NUM_STATES = 5
NUM_INPUTS = 2


class RobotConstants(NamedTuple):
    """What does not change during a run.

    `local_gain` and `network_gain`, shape (T_max + 1, 2, 5), act on the present and on the delayed measurement;
    `turn_rate`, `half_cos`, `half_sin` and `chord`, shape (N,), describe the reference in each step, `offset`, shape (R,),
    is where each robot starts in them.
    """

    step_s: float
    steps_per_slot: int
    steps_per_sample: int
    steps_per_window: int
    sampling_s: float
    lag_decay: float
    lag_mean: float
    slip_decay: float
    slip_gain_mps: float
    slip_gain_radps: float
    noise_position_m: float
    noise_heading_rad: float
    max_speed_mps: float
    max_turn_rate_radps: float
    core_latency_s: float
    max_delay_steps: int
    local_gain: NDArray[np.float64]
    network_gain: NDArray[np.float64]
    speed_mps: float
    turn_rate: NDArray[np.float64]
    half_cos: NDArray[np.float64]
    half_sin: NDArray[np.float64]
    chord: NDArray[np.float64]
    pose: NDArray[np.float64]
    offset: NDArray[np.int64]


class RobotState(NamedTuple):
    """What evolves, one row an environment: state (E, 5, R), slip (E, 2, R), control (E, 2, R), the ring of measured
    states `history` (E, T_max + 1, 5, R), sums over the window (E, 3, R) and the dexterity index in force (E, R)."""

    state: NDArray[np.float64]
    slip: NDArray[np.float64]
    control: NDArray[np.float64]
    history: NDArray[np.float64]
    window_sums: NDArray[np.float64]
    dexterity_index: NDArray[np.float64]


def robot_state(
    num_envs: int, num_robots: int, max_delay_steps: int, initial_dexterity_index: float
) -> RobotState:
    """Robots at rest on their reference."""
    return RobotState(
        state=np.zeros((num_envs, NUM_STATES, num_robots)),
        slip=np.zeros((num_envs, 2, num_robots)),
        control=np.zeros((num_envs, NUM_INPUTS, num_robots)),
        history=np.zeros((num_envs, max_delay_steps + 1, NUM_STATES, num_robots)),
        window_sums=np.zeros((num_envs, 3, num_robots)),
        dexterity_index=np.full((num_envs, num_robots), initial_dexterity_index),
    )


@njit(inline="always")
def steps_of_delay(delay_s: float, sampling_s: float) -> int:
    """T_d = ceil(D / h); a ratio within 1e-9 above an integer is that integer."""
    return int(np.ceil(delay_s / sampling_s - 1e-9))


@njit(error_model="numpy")
def close_loop(
    constants: RobotConstants,
    sample: int,
    delay_steps: NDArray[np.uint32],
    normals: NDArray[np.float32],
    state: NDArray[np.float64],
    history: NDArray[np.float64],
    control: NDArray[np.float64],
    saturated: NDArray[np.uint32],
) -> None:
    """Measure, and set the control u(k) = -K_local x(k) - K_network x(k - T_d) with the gains of T_d.

    Parameters
    ----------
    constants
        Gains, noise and limits.
    sample
        Index k of the control sample. Before the first sample the robot stood on its reference.
    delay_steps
        T_d of each robot, at most `constants.max_delay_steps`, shape (R,).
    normals
        Standard normals, shape (R, 5); the last three are the measurement noise.
    state, history, control
        Shapes (5, R), (T_max + 1, 5, R) and (2, R); the latter two are written.
    saturated
        Counts the samples at which a command met its limit, shape (R,).
    """
    ring = constants.max_delay_steps + 1
    now = sample % ring
    num_robots = state.shape[1]
    for robot in range(num_robots):
        history[now, 0, robot] = (
            state[0, robot] + constants.noise_position_m * normals[robot, 2]
        )
        history[now, 1, robot] = (
            state[1, robot] + constants.noise_position_m * normals[robot, 3]
        )
        history[now, 2, robot] = (
            state[2, robot] + constants.noise_heading_rad * normals[robot, 4]
        )
        history[now, 3, robot] = state[3, robot]
        history[now, 4, robot] = state[4, robot]
    for robot in range(num_robots):
        steps = delay_steps[robot]
        past = (sample - steps) % ring
        for i in range(NUM_INPUTS):
            command = 0.0
            for j in range(NUM_STATES):
                command -= constants.network_gain[steps, i, j] * history[past, j, robot]
                command -= constants.local_gain[steps, i, j] * history[now, j, robot]
            limit = constants.max_speed_mps if i == 0 else constants.max_turn_rate_radps
            if abs(command) > limit:
                command = limit if command > 0.0 else -limit
                saturated[robot] += 1
            control[i, robot] = command


@njit(error_model="numpy")
def move_step(
    constants: RobotConstants,
    step: int,
    slip: NDArray[np.float64],
    control: NDArray[np.float64],
    state: NDArray[np.float64],
    sums: NDArray[np.float64],
    square_error: NDArray[np.float64],
) -> None:
    """One integration step of all robots of an environment.

    Midpoint rule in heading, exact in the actuator lag and in the rotation of the reference's frame.

    Parameters
    ----------
    constants
        Reference and actuators.
    step
        Index of the integration step.
    slip, control
        Slip (2, R) in m/s and rad/s, command (2, R).
    state
        Shape (5, R), in place.
    sums
        Window sums of squared position error, absolute heading error and curvature, shape (3, R), in place.
    square_error
        Sum of the squared position error over the slot, shape (R,), in place, m².
    """
    dt = constants.step_s
    decay = constants.lag_decay
    mean = constants.lag_mean
    speed = constants.speed_mps
    for robot in range(state.shape[1]):
        place = constants.offset[robot] + step
        turn_rate = constants.turn_rate[place]
        c = constants.half_cos[place]
        s = constants.half_sin[place]
        dv = state[3, robot]
        dw = state[4, robot]
        dv_mean = control[0, robot] + (dv - control[0, robot]) * mean
        dw_mean = control[1, robot] + (dw - control[1, robot]) * mean
        velocity = speed + dv_mean + slip[0, robot]
        turn_error = dw_mean + slip[1, robot]
        middle = wrap_angle(state[2, robot] + 0.5 * dt * turn_error)
        half_sine = sin_half(middle)
        half_cosine = cos_half(middle)
        forward = velocity * dt * (1.0 - 2.0 * half_sine * half_sine)
        sideways = velocity * dt * (2.0 * half_sine * half_cosine)
        # Half a turn of the reference's frame, the displacement in it, the other half.
        x = c * state[0, robot] + s * state[1, robot] + forward - constants.chord[place]
        y = c * state[1, robot] - s * state[0, robot] + sideways
        e_x = c * x + s * y
        e_y = c * y - s * x
        e_theta = wrap_angle(state[2, robot] + dt * turn_error)
        state[0, robot] = e_x
        state[1, robot] = e_y
        state[2, robot] = e_theta
        state[3, robot] = control[0, robot] + (dv - control[0, robot]) * decay
        state[4, robot] = control[1, robot] + (dw - control[1, robot]) * decay
        square = e_x * e_x + e_y * e_y
        square_error[robot] += square
        sums[0, robot] += square
        sums[1, robot] += abs(e_theta)
        sums[2, robot] += abs(turn_rate + turn_error) / max(abs(velocity), MIN_SPEED_MPS)
