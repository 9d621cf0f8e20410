"""The nonlinear robot in the frame of its reference, with slip, saturation and a delayed loop.

State x = (e_x, e_y, e_theta, dv, dw): position and heading error in the reference's frame,
departure of speed and turn rate from the reference.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.core.compiled import kernel
from hiersched.core.numerics import cos_half, sin_half, wrap_angle
from hiersched.core.parameters import Note
from hiersched.models.model import PLANT, Plant
from hiersched.models.plant.dexterity import MIN_SPEED_MPS

if TYPE_CHECKING:
    from hiersched.control import DelayedPlant
    from hiersched.scenario.schema import Scenario

NUM_STATES = 5
NUM_INPUTS = 2

POSE_STATES = (0, 1, 2)
"""What the operator of a split plant feeds back: the pose that the video shows."""


@PLANT.model
@dataclass(frozen=True, kw_only=True)
class Unicycle(Plant):
    """A robot on two wheels that follows a reference; section `robot` holds its parameters."""

    model: Annotated[
        Literal["unicycle"],
        Note("model", "paper", "unicycle (section robot) | linear (matrices)"),
    ] = "unicycle"

    has_pose: ClassVar[bool] = True
    chooses_loop: ClassVar[bool] = True

    def sizes(self, scenario: Scenario) -> tuple[int, int, int]:
        """Return five states, two inputs, and five normals: two of slip, three of measurement."""
        return NUM_STATES, NUM_INPUTS, 5

    def design(self, scenario: Scenario) -> DelayedPlant:
        """Return the linear error model of a robot on a straight line."""
        # Scenarios are read often and gains are designed seldom: SciPy takes its time to import.
        from hiersched.control import network_plant, split_plant, tracking_weights
        from hiersched.models.plant.error_model import discretise, unicycle_error_model

        robot, control = scenario.robot, scenario.control
        A, B = discretise(
            *unicycle_error_model(robot.speed_mps, 0.0, robot.actuator_lag_s), control.sampling_s
        )
        Q, R = tracking_weights(control.weight, control.sampling_s)
        if control.loop == "network":
            return network_plant(A, B, Q, R, sampling_s=control.sampling_s)
        return split_plant(
            A,
            B,
            Q,
            R,
            operator_share=control.operator_share,
            operator_states=POSE_STATES,
            sampling_s=control.sampling_s,
        )


LANES = 16
"""Robots that move side by side. A block of them is one flat array, field after field: with offsets
that the compiler knows, it proves that fields do not overlap, and uses whole vectors."""

(
    STATE,
    SLIP,
    CONTROL,
    WINDOW_SUMS,
    SLOT_SQUARE,
    NORMALS,
    _END,
) = (LANES * place for place in (0, 5, 7, 9, 12, 13, 18))

NUM_PATH = 5


class RobotConstants(NamedTuple):
    """What does not change during a run.

    `adjusted_delay_steps`, shape (T_max + 1,), is T where the gain for T is adjusted, 0 where it is
    nominal. `local_gain` and `network_gain`, shape (T_max + 1, 2, 5), act on the present and on the
    delayed measurement, `input_gain`, shape (T_max + 1, T_max, 2, 2), on past commands, the newest
    first; `has_memory` says whether any of it is not 0; an entry is held for `hold_samples`.
    `path`, shape (N, 5), describes the reference in each step: turn rate, cosine and sine of half
    the step's turn, chord, speed; `offset`, shape (R,), is where each robot starts in it.
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
    input_gain: NDArray[np.float64]
    has_memory: bool
    hold_samples: int
    adjusted_delay_steps: NDArray[np.uint32]
    path: NDArray[np.float64]
    pose: NDArray[np.float64]
    offset: NDArray[np.int64]


class RobotState(NamedTuple):
    """What evolves, one row an environment.

    `lanes` (E, blocks, 18 LANES) holds, for blocks of LANES robots, state (5), slip (2), control
    (2), sums over the window (3), the slot's sum of squared position errors and its standard
    normals (5), each LANES times. `history` (E, R, samples + 1, 5) has the measured states of the
    whole run, `commands` (E, R, T_max + 1, 2) is the ring of applied commands, kept for gains with
    memory only, `held` (E, R, 2) the entry in force and the samples for which it has to be kept
    (hysteresis), `delay_s` (E, R) the network delay in force, `dexterity_index` (E, R) the index in
    force, `gain_delay_steps` (E, R) the delay whose adjusted gain is in force, 0 for the nominal
    gain.
    """

    lanes: NDArray[np.float64]
    history: NDArray[np.float64]
    commands: NDArray[np.float64]
    held: NDArray[np.int64]
    delay_s: NDArray[np.float64]
    dexterity_index: NDArray[np.float64]
    gain_delay_steps: NDArray[np.uint32]

    def field(self, start: int, count: int) -> NDArray[np.float64]:
        """Copy of a field of all robots, such as `STATE` with 5 values, shape (E, R, count)."""
        num_envs, num_robots = self.dexterity_index.shape
        lanes = self.lanes[:, :, start : start + count * LANES]
        by_robot = lanes.reshape(num_envs, -1, count, LANES).transpose(0, 1, 3, 2)
        return by_robot.reshape(num_envs, -1, count)[:, :num_robots].copy()

    def set_state(self, value: NDArray[np.float64]) -> None:
        """Put all robots into states, shape (E, R, 5) or broadcast to it."""
        num_envs, num_robots = self.dexterity_index.shape
        value = np.broadcast_to(value, (num_envs, num_robots, NUM_STATES))
        for robot in range(num_robots):
            block, lane = divmod(robot, LANES)
            self.lanes[:, block, STATE + lane : SLIP + lane : LANES] = value[:, robot]


def robot_state(
    num_envs: int,
    num_robots: int,
    max_delay_steps: int,
    num_samples: int,
    initial_dexterity_index: float,
    initial_delay_s: float,
    num_states: int = NUM_STATES,
    num_inputs: int = NUM_INPUTS,
) -> RobotState:
    """Robots at rest on their reference; of linear plants, all but the motion itself.

    A run takes at most `num_samples` control samples; `initial_delay_s` is in force until the
    network has delivered something.
    """
    return RobotState(
        lanes=np.zeros((num_envs, -(-num_robots // LANES), _END)),
        history=np.zeros((num_envs, num_robots, num_samples + 1, num_states)),
        commands=np.zeros((num_envs, num_robots, max_delay_steps + 1, num_inputs)),
        held=np.zeros((num_envs, num_robots, 2), np.int64),
        delay_s=np.full((num_envs, num_robots), initial_delay_s),
        dexterity_index=np.full((num_envs, num_robots), initial_dexterity_index),
        gain_delay_steps=np.zeros((num_envs, num_robots), np.uint32),
    )


def path_scratch(steps_per_slot: int) -> NDArray[np.float64]:
    """Work array for the reference of one block of robots over one slot."""
    return np.zeros(steps_per_slot * NUM_PATH * LANES)


@njit(inline="always")
def steps_of_delay(delay_s: float, sampling_s: float) -> int:
    """T_d = ceil(D / h); a ratio within 1e-9 above an integer is that integer."""
    return int(np.ceil(delay_s / sampling_s - 1e-9))


@kernel(forceinline=True)
def gather_path(
    path: NDArray[np.float64], place: int, steps: int, lane: int, gathered: NDArray[np.float64]
) -> None:
    """Put the reference of one robot for `steps` steps from `place` on into its lane."""
    for step in range(steps):
        for field in range(NUM_PATH):
            gathered[(step * NUM_PATH + field) * LANES + lane] = path[place + step, field]


@kernel(forceinline=True)
def start_slot(constants: RobotConstants, lanes: NDArray[np.float64]) -> None:
    """Next slip of a block of robots from its normals; the slot's sum of squares starts at 0."""
    for lane in range(LANES):
        lanes[SLIP + lane] = (
            constants.slip_decay * lanes[SLIP + lane]
            + constants.slip_gain_mps * lanes[NORMALS + lane]
        )
        lanes[SLIP + LANES + lane] = (
            constants.slip_decay * lanes[SLIP + LANES + lane]
            + constants.slip_gain_radps * lanes[NORMALS + LANES + lane]
        )
        lanes[SLOT_SQUARE + lane] = 0.0


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


@kernel(forceinline=True)
def close_loop(
    constants: RobotConstants,
    sample: int,
    delay_steps: int,
    entry: int,
    lane: int,
    lanes: NDArray[np.float64],
    history: NDArray[np.float64],
    commands: NDArray[np.float64],
) -> int:
    """Measure one robot and set u(k) = -K_local x(k) - K_network x(k-T_d) - sum_i H_i u(k-1-i).

    The gains are those of one entry of the tables.

    Parameters
    ----------
    constants
        Gains, noise and limits.
    sample
        Index k of the control sample. Before the first sample the robot stood on its reference.
    delay_steps
        T_d: the newest measurement that has arrived is so many samples old.
    entry
        The delay whose gains are in force: T_d, at most T_max, or a longer one that is held.
    lane
        The robot's lane.
    lanes
        Its block; the last three normals are the measurement noise, the control is written.
    history
        Its measured states, shape (samples + 1, 5), zero where nothing is measured yet; that of
        this sample is written.
    commands
        Its applied commands, shape (T_max + 1, 2); likewise, if the gains have a memory.

    Returns
    -------
    int
        1 if a command met its limit, else 0.
    """
    now = history[sample]
    now[0] = lanes[STATE + lane] + constants.noise_position_m * lanes[NORMALS + 2 * LANES + lane]
    now[1] = (
        lanes[STATE + LANES + lane] + constants.noise_position_m * lanes[NORMALS + 3 * LANES + lane]
    )
    now[2] = (
        lanes[STATE + 2 * LANES + lane]
        + constants.noise_heading_rad * lanes[NORMALS + 4 * LANES + lane]
    )
    now[3] = lanes[STATE + 3 * LANES + lane]
    now[4] = lanes[STATE + 4 * LANES + lane]
    past = history[late_place(sample, delay_steps, history.shape[0])]
    saturated = 0
    for i in range(NUM_INPUTS):
        network = constants.network_gain[entry, i]
        local = constants.local_gain[entry, i]
        command = 0.0
        for j in range(NUM_STATES):
            command -= network[j] * past[j] + local[j] * now[j]
        if constants.has_memory:
            command -= recall(constants.input_gain[entry, :, i], sample, commands)
        limit = constants.max_speed_mps if i == 0 else constants.max_turn_rate_radps
        if abs(command) > limit:
            command = limit if command > 0.0 else -limit
            saturated = 1
        lanes[CONTROL + i * LANES + lane] = command
    if constants.has_memory:
        ring = constants.max_delay_steps + 1
        for i in range(NUM_INPUTS):
            commands[sample % ring, i] = lanes[CONTROL + i * LANES + lane]
    return saturated


@kernel(forceinline=True)
def move_lanes(
    step_s: float,
    lag_mean: float,
    lag_decay: float,
    path: NDArray[np.float64],
    lanes: NDArray[np.float64],
) -> None:
    """Move a block of robots by one integration step.

    Midpoint rule in the heading, exact in the actuator lag and in the rotation of the frame. The
    window sums grow by squared position error, absolute heading error and curvature at the end of
    the step, the slot's sum by the first of them.

    Parameters
    ----------
    step_s, lag_mean, lag_decay
        As in `RobotConstants`.
    path
        Reference of this step, shape (5 LANES,), from `gather_path`.
    lanes
        The block, in place.
    """
    for lane in range(LANES):
        turn_rate = path[lane]
        c = path[LANES + lane]
        s = path[2 * LANES + lane]
        chord = path[3 * LANES + lane]
        speed = path[4 * LANES + lane]
        control_v = lanes[CONTROL + lane]
        control_w = lanes[CONTROL + LANES + lane]
        heading = lanes[STATE + 2 * LANES + lane]
        dv = lanes[STATE + 3 * LANES + lane] - control_v
        dw = lanes[STATE + 4 * LANES + lane] - control_w
        velocity = speed + control_v + dv * lag_mean + lanes[SLIP + lane]
        turn_error = control_w + dw * lag_mean + lanes[SLIP + LANES + lane]
        middle = wrap_angle(heading + 0.5 * step_s * turn_error)
        half_sine = sin_half(middle)
        half_cosine = cos_half(middle)
        forward = velocity * step_s * (1.0 - 2.0 * half_sine * half_sine)
        sideways = velocity * step_s * (2.0 * half_sine * half_cosine)
        # Half a turn of the reference's frame, the displacement in it, the other half.
        x = c * lanes[STATE + lane] + s * lanes[STATE + LANES + lane] + forward - chord
        y = c * lanes[STATE + LANES + lane] - s * lanes[STATE + lane] + sideways
        e_x = c * x + s * y
        e_y = c * y - s * x
        e_theta = wrap_angle(heading + step_s * turn_error)
        lanes[STATE + lane] = e_x
        lanes[STATE + LANES + lane] = e_y
        lanes[STATE + 2 * LANES + lane] = e_theta
        lanes[STATE + 3 * LANES + lane] = control_v + dv * lag_decay
        lanes[STATE + 4 * LANES + lane] = control_w + dw * lag_decay
        square = e_x * e_x + e_y * e_y
        curvature = abs(turn_rate + turn_error) / max(abs(velocity), MIN_SPEED_MPS)
        lanes[SLOT_SQUARE + lane] += square
        lanes[WINDOW_SUMS + lane] += square
        lanes[WINDOW_SUMS + LANES + lane] += abs(e_theta)
        lanes[WINDOW_SUMS + 2 * LANES + lane] += curvature
