"""The nonlinear robot in the frame of its reference, with slip, saturation and a delayed loop.

State x = (e_x, e_y, e_theta, dv, dw): position and heading error in the reference's frame,
departure of speed and turn rate from the reference.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.compiled import kernel
from hiersched.numerics import cos_half, sin_half, wrap_angle
from hiersched.robot.dexterity import MIN_SPEED_MPS

NUM_STATES = 5
NUM_INPUTS = 2


class RobotConstants(NamedTuple):
    """What does not change during a run.

    `adjusted_delay_steps`, shape (T_max + 1,), is T where the gain for T is adjusted, 0 where it is
    nominal. `local_gain` and `network_gain`, shape (T_max + 1, 2, 5), act on the present and on the
    delayed measurement; `turn_rate`, `half_cos`, `half_sin` and `chord`, shape (N,), describe the
    reference in each step, `offset`, shape (R,), is where each robot starts in them.
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
    adjusted_delay_steps: NDArray[np.uint32]
    speed_mps: float
    turn_rate: NDArray[np.float64]
    half_cos: NDArray[np.float64]
    half_sin: NDArray[np.float64]
    chord: NDArray[np.float64]
    pose: NDArray[np.float64]
    offset: NDArray[np.int64]


class RobotState(NamedTuple):
    """What evolves, one row an environment.

    State (E, R, 5), slip (E, R, 2), control (E, R, 2), the ring of measured states `history`
    (E, R, T_max + 1, 5), sums over the window (E, R, 3), the dexterity index in force (E, R) and
    the delay whose adjusted gain is in force, 0 for the nominal gain (E, R).
    """

    state: NDArray[np.float64]
    slip: NDArray[np.float64]
    control: NDArray[np.float64]
    history: NDArray[np.float64]
    window_sums: NDArray[np.float64]
    dexterity_index: NDArray[np.float64]
    gain_delay_steps: NDArray[np.uint32]


def robot_state(
    num_envs: int, num_robots: int, max_delay_steps: int, initial_dexterity_index: float
) -> RobotState:
    """Robots at rest on their reference."""
    return RobotState(
        state=np.zeros((num_envs, num_robots, NUM_STATES)),
        slip=np.zeros((num_envs, num_robots, 2)),
        control=np.zeros((num_envs, num_robots, NUM_INPUTS)),
        history=np.zeros((num_envs, num_robots, max_delay_steps + 1, NUM_STATES)),
        window_sums=np.zeros((num_envs, num_robots, 3)),
        dexterity_index=np.full((num_envs, num_robots), initial_dexterity_index),
        gain_delay_steps=np.zeros((num_envs, num_robots), np.uint32),
    )


@njit(inline="always")
def steps_of_delay(delay_s: float, sampling_s: float) -> int:
    """T_d = ceil(D / h); a ratio within 1e-9 above an integer is that integer."""
    return int(np.ceil(delay_s / sampling_s - 1e-9))


@kernel()
def close_loop(
    constants: RobotConstants,
    sample: int,
    delay_steps: int,
    normals: NDArray[np.float32],
    state: NDArray[np.float64],
    history: NDArray[np.float64],
    control: NDArray[np.float64],
) -> int:
    """Measure one robot and set u(k) = -K_local x(k) - K_network x(k - T_d), gains of T_d.

    Parameters
    ----------
    constants
        Gains, noise and limits.
    sample
        Index k of the control sample. Before the first sample the robot stood on its reference.
    delay_steps
        T_d, at most `constants.max_delay_steps`.
    normals
        Standard normals, shape (5,); the last three are the measurement noise.
    state, history, control
        Shapes (5,), (T_max + 1, 5) and (2,); the latter two are written.

    Returns
    -------
    int
        1 if a command met its limit, else 0.
    """
    ring = constants.max_delay_steps + 1
    now = history[sample % ring]
    now[0] = state[0] + constants.noise_position_m * normals[2]
    now[1] = state[1] + constants.noise_position_m * normals[3]
    now[2] = state[2] + constants.noise_heading_rad * normals[4]
    now[3] = state[3]
    now[4] = state[4]
    past = history[(sample - delay_steps) % ring]
    saturated = 0
    for i in range(NUM_INPUTS):
        network = constants.network_gain[delay_steps, i]
        local = constants.local_gain[delay_steps, i]
        command = 0.0
        for j in range(NUM_STATES):
            command -= network[j] * past[j] + local[j] * now[j]
        limit = constants.max_speed_mps if i == 0 else constants.max_turn_rate_radps
        if abs(command) > limit:
            command = limit if command > 0.0 else -limit
            saturated = 1
        control[i] = command
    return saturated


@kernel()
def move_step(
    constants: RobotConstants,
    place: int,
    slip: NDArray[np.float64],
    control: NDArray[np.float64],
    state: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> float:
    """Move one robot by one integration step.

    Midpoint rule in the heading, exact in the actuator lag and in the rotation of the frame.

    Parameters
    ----------
    constants
        Reference and actuators.
    place
        Step within the reference.
    slip, control
        Slip in m/s and rad/s, command, shape (2,) each.
    state
        Shape (5,), in place.
    sums
        Window sums of squared position error, absolute heading error and curvature, shape (3,), in
        place.

    Returns
    -------
    float
        Squared position error at the end of the step, m².
    """
    dt = constants.step_s
    turn_rate = constants.turn_rate[place]
    c = constants.half_cos[place]
    s = constants.half_sin[place]
    dv = state[3] - control[0]
    dw = state[4] - control[1]
    velocity = constants.speed_mps + control[0] + dv * constants.lag_mean + slip[0]
    turn_error = control[1] + dw * constants.lag_mean + slip[1]
    middle = wrap_angle(state[2] + 0.5 * dt * turn_error)
    half_sine = sin_half(middle)
    half_cosine = cos_half(middle)
    forward = velocity * dt * (1.0 - 2.0 * half_sine * half_sine)
    sideways = velocity * dt * (2.0 * half_sine * half_cosine)
    # Half a turn of the reference's frame, the displacement in it, the other half.
    x = c * state[0] + s * state[1] + forward - constants.chord[place]
    y = c * state[1] - s * state[0] + sideways
    e_x = c * x + s * y
    e_y = c * y - s * x
    e_theta = wrap_angle(state[2] + dt * turn_error)
    state[0] = e_x
    state[1] = e_y
    state[2] = e_theta
    state[3] = control[0] + dv * constants.lag_decay
    state[4] = control[1] + dw * constants.lag_decay
    square = e_x * e_x + e_y * e_y
    sums[0] += square
    sums[1] += abs(e_theta)
    sums[2] += abs(turn_rate + turn_error) / max(abs(velocity), MIN_SPEED_MPS)
    return float(square)
