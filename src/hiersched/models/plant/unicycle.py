"""The nonlinear robot in the frame of its reference, with slip, saturation and a delayed loop.

State x = (e_x, e_y, e_theta, dv, dw): position and heading error in the reference's frame,
departure of speed and turn rate from the reference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.core.compiled import inner_kernel
from hiersched.core.numerics import cos_half, sin_half, wrap_angle
from hiersched.core.parameters import Note
from hiersched.core.randomness import NormalScratch, draw_normals, normal_scratch
from hiersched.models.model import PLANT, Plant, Setup
from hiersched.models.plant.dexterity import MIN_SPEED_MPS, window_index
from hiersched.models.plant.feedback import LoopConstants, LoopMemory, close_loop, forget
from hiersched.models.plant.reference import reference_table
from hiersched.models.seams import DRIVE

if TYPE_CHECKING:
    from hiersched.control import DelayedPlant
    from hiersched.scenario.schema import Scenario

NUM_STATES = 5
NUM_INPUTS = 2

LANES = 16
"""Robots that move side by side. A block of them is one flat array, field after field: with offsets
that the compiler knows, it proves that fields do not overlap, and uses whole vectors."""

STATE, SLIP, CONTROL, WINDOW_SUMS, SLOT_SQUARE, NORMALS, _END = (
    LANES * place for place in (0, 5, 7, 9, 12, 13, 18)
)
"""Where the fields of a block begin: state (5), slip (2), control (2), window sums (3), the
slot's sum of squared position errors, normals (5), each LANES times."""

NUM_PATH = 5


class UnicycleWords(NamedTuple):
    """Parameters, state and work arrays of R robots in each of E worlds."""

    step_s: float
    steps_per_slot: int
    steps_per_sample: int
    steps_per_window: int
    lag_decay: float
    lag_mean: float
    slip_decay: float
    slip_gain_mps: float
    slip_gain_radps: float
    noise_position_m: float
    noise_heading_rad: float
    input_limits: NDArray[np.float64]  # (2,) m/s and rad/s
    path: NDArray[np.float64]  # (N, 5) reference of each step: `ReferenceTable.rows`
    pose: NDArray[np.float64]  # (N + 1, 3) its poses
    offset: NDArray[np.int64]  # (R,) where each robot starts in it
    lanes: NDArray[np.float64]  # (E, blocks, 18 LANES) blocks of LANES robots
    memory: LoopMemory
    normals: NormalScratch
    gathered: NDArray[np.float64]  # reference of one block over one slot

    def set_state(self, value: NDArray[np.float64]) -> None:
        """Put all robots into states, shape (E, R, 5) or broadcast to it."""
        num_envs, num_robots = len(self.lanes), len(self.offset)
        value = np.broadcast_to(value, (num_envs, num_robots, NUM_STATES))
        for robot in range(num_robots):
            block, lane = divmod(robot, LANES)
            self.lanes[:, block, STATE + lane : SLIP + lane : LANES] = value[:, robot]


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

    def words(self, setup: Setup) -> UnicycleWords:
        """As in `Model`."""
        scenario, num_robots = setup.scenario, setup.scenario.users.num_urllc
        robot, control, slot_s = scenario.robot, scenario.control, scenario.radio.slot_s
        step_s = robot.substep_s
        steps_per_slot = round(slot_s / step_s)
        table, offset = reference_table(robot, setup.num_slots * steps_per_slot, num_robots)
        decay = float(np.exp(-step_s / robot.actuator_lag_s))
        slip_decay = float(np.exp(-slot_s / robot.slip_time_s))
        slip_spread = float(np.sqrt(1.0 - slip_decay**2))
        return UnicycleWords(
            step_s=step_s,
            steps_per_slot=steps_per_slot,
            steps_per_sample=round(control.sampling_s / step_s),
            steps_per_window=round(robot.window_s / step_s),
            lag_decay=decay,
            lag_mean=(1.0 - decay) * robot.actuator_lag_s / step_s,
            slip_decay=slip_decay,
            slip_gain_mps=robot.slip_speed_mps * slip_spread,
            slip_gain_radps=robot.slip_turn_rate_radps * slip_spread,
            noise_position_m=robot.noise_position_m,
            noise_heading_rad=robot.noise_heading_rad,
            input_limits=np.array([robot.max_speed_mps, robot.max_turn_rate_radps]),
            path=table.rows(),
            pose=table.pose,
            offset=offset,
            lanes=np.zeros((setup.num_envs, -(-num_robots // LANES), _END)),
            memory=setup.loop_memory(NUM_STATES, NUM_INPUTS),
            normals=normal_scratch(num_robots, 5),
            gathered=np.zeros(steps_per_slot * NUM_PATH * LANES),
        )

    def reset(self, words: UnicycleWords, keys: NDArray[np.uint64]) -> None:
        """As in `Model`: robots at rest on their reference."""
        words.lanes[...] = 0.0
        forget(words.memory)


@inner_kernel(forceinline=True)
def _start_slot(
    me: UnicycleWords, lanes: NDArray[np.float64], slot: Any, first: int, begin: int, end: int
) -> None:
    """Give a block, robots `begin` to `end`, its normals and its reference from a step on.

    The slip goes on by the normals; the slot's sum of squares starts at 0.
    """
    for robot in range(begin, end):
        lane = robot - begin
        for j in range(5):
            lanes[NORMALS + j * LANES + lane] = np.float64(slot.robot_normal[robot, j])
        place = me.offset[robot] + first
        for step in range(me.steps_per_slot):
            for field in range(NUM_PATH):
                to = (step * NUM_PATH + field) * LANES + lane
                me.gathered[to] = me.path[place + step, field]
    for lane in range(LANES):
        lanes[SLIP + lane] = (
            me.slip_decay * lanes[SLIP + lane] + me.slip_gain_mps * lanes[NORMALS + lane]
        )
        lanes[SLIP + LANES + lane] = (
            me.slip_decay * lanes[SLIP + LANES + lane]
            + me.slip_gain_radps * lanes[NORMALS + LANES + lane]
        )
        lanes[SLOT_SQUARE + lane] = 0.0


@inner_kernel(forceinline=True)
def _sample(
    me: UnicycleWords,
    lanes: NDArray[np.float64],
    loop: LoopConstants,
    state: Any,
    slot: Any,
    sample: int,
    env: int,
    robot: int,
) -> None:
    """Measure one robot and close its loop; the last three normals are the noise."""
    lane = robot % LANES
    now = me.memory.history[env, robot, sample]
    for j in range(NUM_STATES):
        now[j] = lanes[STATE + j * LANES + lane]
    now[0] += me.noise_position_m * lanes[NORMALS + 2 * LANES + lane]
    now[1] += me.noise_position_m * lanes[NORMALS + 3 * LANES + lane]
    now[2] += me.noise_heading_rad * lanes[NORMALS + 4 * LANES + lane]
    close_loop(me.memory, me.input_limits, loop, state, slot, sample, env, robot)
    for i in range(NUM_INPUTS):
        lanes[CONTROL + i * LANES + lane] = me.memory.control[env, robot, i]


@inner_kernel(forceinline=True)
def _move_lanes(me: UnicycleWords, path: NDArray[np.float64], lanes: NDArray[np.float64]) -> None:
    """Move a block of robots by one integration step, with the reference (5 LANES,) in it.

    Midpoint rule in the heading, exact in the actuator lag and in the rotation of the frame. The
    window sums grow by squared position error, absolute heading error and curvature at the end of
    the step, the slot's sum by the first of them.
    """
    step_s, lag_mean, lag_decay = me.step_s, me.lag_mean, me.lag_decay
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


@inner_kernel()
def _end_window(me: UnicycleWords, lanes: NDArray[np.float64], index: NDArray[np.float64]) -> None:
    """Dexterity index of a block of robots, shape (robots from the block on,), and new sums."""
    for lane in range(min(LANES, index.shape[0])):
        index[lane] = window_index(
            lanes[WINDOW_SUMS + lane],
            lanes[WINDOW_SUMS + LANES + lane],
            lanes[WINDOW_SUMS + 2 * LANES + lane],
            me.steps_per_window,
        )
    for place in range(WINDOW_SUMS, WINDOW_SUMS + 3 * LANES):
        lanes[place] = 0.0


@inner_kernel(forceinline=True)
def _record_robot(
    me: UnicycleWords, lanes: NDArray[np.float64], slot: Any, last: int, env: int, robot: int
) -> None:
    """Note where one robot stands after the slot's last step."""
    lane = robot % LANES
    slot.tracking_error_m[robot] = math.sqrt(lanes[SLOT_SQUARE + lane] / me.steps_per_slot)
    for j in range(NUM_STATES):
        slot.state[robot, j] = lanes[STATE + j * LANES + lane]
    place = me.offset[robot] + last
    for j in range(3):
        slot.reference[robot, j] = me.pose[place, j]
    slot.reference[robot, 3] = me.path[place - 1, 4]
    slot.reference[robot, 4] = me.path[place - 1, 0]
    for i in range(NUM_INPUTS):
        slot.control[robot, i] = me.memory.control[env, robot, i]


@DRIVE.kernel(UnicycleWords)
def drive_unicycles(me: UnicycleWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Move all robots of a world through the slot."""
    draw_normals(state.key[env], state.slot[env], me.normals, slot.robot_normal)
    first = state.slot[env] * me.steps_per_slot
    last = first + me.steps_per_slot
    for block in range(me.lanes.shape[1]):
        lanes, begin = me.lanes[env, block], block * LANES
        end = min(begin + LANES, slot.delay_steps.shape[0])
        _start_slot(me, lanes, slot, first, begin, end)
        for step in range(first, last):
            if step % me.steps_per_sample == 0:
                sample = step // me.steps_per_sample
                for robot in range(begin, end):
                    _sample(me, lanes, constants.loop, state, slot, sample, env, robot)
            place = (step - first) * NUM_PATH * LANES
            _move_lanes(me, me.gathered[place : place + NUM_PATH * LANES], lanes)
            if (step + 1) % me.steps_per_window == 0:
                _end_window(me, lanes, state.dexterity_index[env, begin:])
        for robot in range(begin, end):
            _record_robot(me, lanes, slot, last, env, robot)
