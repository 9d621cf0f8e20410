"""The nonlinear robot in the frame of its reference, with slip, saturation and a delayed loop.

State x = (e_x, e_y, e_theta, dv, dw): position and heading error in the reference's frame,
departure of speed and turn rate from the reference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.core.compiled import inner_kernel
from hiersched.core.numerics import cos_half, sin_half, sincos_f64, wrap_angle
from hiersched.core.parameters import Note
from hiersched.core.randomness import NormalScratch, draw_normals, normal_scratch
from hiersched.models.model import PLANT, Plant, Setup
from hiersched.models.plant.dexterity import MIN_SPEED_MPS, window_index
from hiersched.models.plant.estimator import (
    MAX_TURN_RATE_RADPS,
    MOTION_STEP_RADPS,
    note_arrivals,
)
from hiersched.models.plant.feedback import (
    LoopConstants,
    LoopMemory,
    close_loop,
    forget,
    note_loop,
)
from hiersched.models.plant.operator import OperatorWords, draw_references, operator_words
from hiersched.models.seams import DRIVE

if TYPE_CHECKING:
    from hiersched.control import DelayedPlant
    from hiersched.control.lqg import FilterModel
    from hiersched.scenario.schema import Scenario

NUM_STATES = 5
NUM_INPUTS = 2
NUM_SLIP = 2
"""States of the slip: of speed and of turn rate."""

LANES = 16
"""Robots that move side by side. A block of them is one flat array, field after field: with offsets
that the compiler knows, it proves that fields do not overlap, and uses whole vectors."""

STATE, SLIP, CONTROL, WINDOW_SUMS, SLOT_SQUARE, NORMALS, LAG, SLIP_STEP, _END = (
    LANES * place for place in (0, 5, 7, 9, 12, 13, 18, 20, 23)
)
"""Where the fields of a block begin: state (5), slip (2), control (2), window sums (3), the
slot's sum of squared position errors, normals (5), then what each robot is: what an actuator's
departure leaves, on average over a step and at its end (2), by what the slip is multiplied in a
slot, and the normals that come to it (3); each LANES times."""

NUM_PATH = 6
"""What a block gathers of each step's reference: the rows of `UnicycleWords.path`, of which the
speed is that of the set-point in force, and by how much faster than the reference that turns."""

SET_POINTS = ("present", "hold", "extrapolate")
PRESENT, EXTRAPOLATE = 0, 2


class UnicycleWords(NamedTuple):
    """Parameters, state and work arrays of R robots in each of E worlds."""

    step_s: float
    steps_per_slot: int
    steps_per_sample: int
    steps_per_window: int
    noise_position_m: NDArray[np.float64]  # (R,)
    noise_heading_rad: NDArray[np.float64]  # (R,)
    input_limits: NDArray[np.float64]  # (R, 2) m/s and rad/s
    set_point: int  # code in `SET_POINTS`
    is_spread: bool  # whether control samples have phases
    phase: NDArray[np.int64]  # (R,) of each robot's control samples, in steps
    reported_slots: int  # age of the error that the base station knows at the end of a slot
    reported: NDArray[np.float64]  # (E, R, reported_slots + 1) errors until it knows them
    newest: NDArray[np.int64]  # (E, R) slot whose set-point was the last to reach the queue
    peak: NDArray[np.int64]  # (E, R) slot of the fastest set-point that waits
    operator: OperatorWords  # references
    lanes: NDArray[np.float64]  # (E, blocks, 23 LANES) blocks of LANES robots
    memory: LoopMemory
    normals: NormalScratch
    gathered: NDArray[np.float64]  # reference of one block over one slot

    def set_state(self, value: NDArray[np.float64]) -> None:
        """Put all robots into states, shape (E, R, 5) or broadcast to it."""
        num_envs, num_robots = self.operator.offset.shape
        value = np.broadcast_to(value, (num_envs, num_robots, NUM_STATES))
        for robot in range(num_robots):
            block, lane = divmod(robot, LANES)
            self.lanes[:, block, STATE + lane : SLIP + lane : LANES] = value[:, robot]


LEAST_NOISE = 1e-4
"""Standard deviation [m, rad] of the pose in which a filter believes at least: it cannot weigh
measurements without error."""
ACTUATOR_NOISE = 1e-3
"""Likewise of both actuators' states [m/s, rad/s], which are measured without noise."""
POSE_DRIFT, ACTUATOR_DRIFT = 1e-4, 1e-5
"""Standard deviations that a filter adds to each state every sample: they keep it awake."""

ROBOT_KEYS = (
    *("actuator_lag_s", "max_speed_mps", "max_turn_rate_radps"),
    *("slip_speed_mps", "slip_turn_rate_radps", "slip_time_s"),
    *("noise_position_m", "noise_heading_rad"),
)
BELIEVED_KEYS = ("lag_s", "slip_speed_mps", "slip_turn_rate_radps", "slip_time_s")
"""In what robots may differ, and in what is believed of them."""

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
    num_disturbances: ClassVar[int] = NUM_SLIP
    kind_keys: ClassVar[tuple[str, ...]] = (
        *(f"robot.{name}" for name in ROBOT_KEYS),
        *(f"control.believed_{name}" for name in BELIEVED_KEYS),
    )

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
            *unicycle_error_model(robot.speed_mps, 0.0, scenario.believed("actuator_lag_s")),
            control.sampling_s,
        )
        Q, R = tracking_weights(control.weight, control.sampling_s)
        if control.loop != "split":
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

    def filter_model(self, scenario: Scenario) -> FilterModel:
        """Return the robot on a straight line, its slip and what disturbs it, as believed."""
        from hiersched.control.lqg import FilterModel
        from hiersched.models.plant.error_model import (
            discretise,
            discretise_noise,
            slipping_error_model,
        )

        robot, sampling_s = scenario.robot, scenario.control.sampling_s
        slip_time_s = scenario.believed("slip_time_s")
        A_c, B_c = slipping_error_model(
            robot.speed_mps, 0.0, scenario.believed("actuator_lag_s"), slip_time_s
        )
        A, B = discretise(A_c, B_c, sampling_s)
        density = np.zeros(A.shape)
        for state, name in ((-2, "slip_speed_mps"), (-1, "slip_turn_rate_radps")):
            density[state, state] = 2.0 * scenario.believed(name) ** 2 / slip_time_s
        drift = np.array([POSE_DRIFT] * 3 + [ACTUATOR_DRIFT] * 2 + [0.0] * NUM_SLIP)
        noise = [robot.noise_position_m, robot.noise_position_m, robot.noise_heading_rad]
        return FilterModel(
            A=A,
            B=B,
            process_covariance=discretise_noise(A_c, density, sampling_s) + np.diag(drift**2),
            measurement_variance=np.square(
                [*np.maximum(noise, LEAST_NOISE), ACTUATOR_NOISE, ACTUATOR_NOISE]
            ),
        )

    def motion_models(
        self, scenario: Scenario
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """As in `Plant`: the speed enters linearly, since the heading does not depend on it."""
        from hiersched.models.plant.error_model import discretise_alike, slipping_error_model

        count = round(MAX_TURN_RATE_RADPS / MOTION_STEP_RADPS)
        lag_s, slip_time_s = scenario.believed("actuator_lag_s"), scenario.believed("slip_time_s")
        of_speed = []
        for speed_mps in (0.0, 1.0):
            models = [
                slipping_error_model(speed_mps, number * MOTION_STEP_RADPS, lag_s, slip_time_s)
                for number in range(-count, count + 1)
            ]
            A_c, B_c = (np.stack(matrices) for matrices in zip(*models, strict=True))
            of_speed.append(discretise_alike(A_c, B_c, scenario.control.sampling_s))
        (A, B), (A_moving, B_moving) = of_speed
        return A, A_moving - A, B, B_moving - B

    def words(self, setup: Setup) -> UnicycleWords:
        """As in `Model`."""
        scenario, num_robots = setup.scenario, setup.scenario.users.num_urllc
        robot, control, slot_s = scenario.robot, scenario.control, scenario.radio.slot_s
        step_s = robot.substep_s
        steps_per_slot = round(slot_s / step_s)
        steps_per_sample = round(control.sampling_s / step_s)
        of_robots = (setup.num_envs, num_robots)
        reported_slots = math.ceil(robot.core_latency_s / slot_s - 1e-9)
        return UnicycleWords(
            step_s=step_s,
            steps_per_slot=steps_per_slot,
            steps_per_sample=steps_per_sample,
            steps_per_window=round(robot.window_s / step_s),
            noise_position_m=setup.of_robots(lambda own: own.robot.noise_position_m),
            noise_heading_rad=setup.of_robots(lambda own: own.robot.noise_heading_rad),
            input_limits=setup.of_robots(
                lambda own: (own.robot.max_speed_mps, own.robot.max_turn_rate_radps)
            ),
            set_point=SET_POINTS.index(robot.set_point),
            is_spread=control.sample_phases == "spread",
            phase=np.arange(num_robots) * steps_per_sample // num_robots,
            reported_slots=reported_slots,
            reported=np.zeros((*of_robots, reported_slots + 1)),
            newest=np.zeros(of_robots, np.int64),
            peak=np.zeros(of_robots, np.int64),
            operator=operator_words(setup),
            lanes=_lanes(setup),
            memory=setup.loop_memory(NUM_STATES, NUM_INPUTS),
            normals=normal_scratch(num_robots, 5),
            gathered=np.zeros(steps_per_slot * NUM_PATH * LANES),
        )

    def reset(self, words: UnicycleWords, keys: NDArray[np.uint64]) -> None:
        """As in `Model`: robots at rest on their reference."""
        draw_references(words.operator, keys)
        for values in (words.lanes[..., :LAG], words.reported, words.newest, words.peak):
            values[...] = 0
        forget(words.memory)


def _lanes(setup: Setup) -> NDArray[np.float64]:
    """Return blocks of robots at rest, each with what it is."""
    slot_s, step_s = setup.scenario.radio.slot_s, setup.scenario.robot.substep_s

    def constants(own: Scenario) -> tuple[float, ...]:
        robot = own.robot
        decay = math.exp(-step_s / robot.actuator_lag_s)
        slip_decay = math.exp(-slot_s / robot.slip_time_s)
        spread = math.sqrt(1.0 - slip_decay**2)
        return (
            (1.0 - decay) * robot.actuator_lag_s / step_s,
            decay,
            slip_decay,
            robot.slip_speed_mps * spread,
            robot.slip_turn_rate_radps * spread,
        )

    of_robots = setup.of_robots(constants)
    lanes = np.zeros((setup.num_envs, -(-len(of_robots) // LANES), _END))
    for robot, values in enumerate(of_robots):
        block, lane = divmod(robot, LANES)
        lanes[:, block, LAG + lane :: LANES] = values
    return lanes


@inner_kernel(forceinline=True)
def _start_slot(
    me: UnicycleWords,
    lanes: NDArray[np.float64],
    loop: LoopConstants,
    state: Any,
    slot: Any,
    env: int,
    begin: int,
    end: int,
) -> None:
    """Give a block, robots `begin` to `end`, its normals and its reference in the slot.

    The slip goes on by the normals; the slot's sum of squares starts at 0.
    """
    path, first = me.operator.path, state.slot[env] * me.steps_per_slot
    for robot in range(begin, end):
        if not loop.filter.all_arrive:
            held, phase = state.held_step[env, robot], me.phase[robot] if me.is_spread else 0
            note_arrivals(me.memory.filter, held, phase, me.steps_per_sample, env, robot)
        lane = robot - begin
        for j in range(5):
            lanes[NORMALS + j * LANES + lane] = np.float64(slot.robot_normal[robot, j])
        start = me.operator.offset[env, robot]
        place = start + first
        for step in range(me.steps_per_slot):
            for field in range(5):
                to = (step * NUM_PATH + field) * LANES + lane
                me.gathered[to] = path[place + step, field]
            to = (step * NUM_PATH + 4) * LANES + lane
            if me.set_point == PRESENT:
                me.gathered[to + LANES] = 0.0
            else:
                held = start + state.held_step[env, robot, step]
                me.gathered[to] = path[held, 4]
                me.gathered[to + LANES] = path[held, 0] - path[place + step, 0]
    for lane in range(LANES):
        decay = lanes[SLIP_STEP + lane]
        gain_mps, gain_radps = lanes[SLIP_STEP + LANES + lane], lanes[SLIP_STEP + 2 * LANES + lane]
        lanes[SLIP + lane] = decay * lanes[SLIP + lane] + gain_mps * lanes[NORMALS + lane]
        lanes[SLIP + LANES + lane] = (
            decay * lanes[SLIP + LANES + lane] + gain_radps * lanes[NORMALS + LANES + lane]
        )
        lanes[SLOT_SQUARE + lane] = 0.0


@njit(inline="always")
def _set_point(
    me: UnicycleWords, held: int, lag_steps: int
) -> tuple[float, float, float, float, float]:
    """Return x, y, heading, and its cosine and sine, of a set-point that is so many steps old.

    `held` is its row in the table; extrapolated, it goes on along an arc at its own speed and turn
    rate.
    """
    pose, direction = me.operator.pose[held], me.operator.direction[held]
    if me.set_point != EXTRAPOLATE or lag_steps == 0:
        return pose[0], pose[1], pose[2], direction[0], direction[1]
    motion = me.operator.path[held]
    lag_s = lag_steps * me.step_s
    half = 0.5 * motion[0] * lag_s
    chord = motion[4] * lag_s
    if abs(half) > 1e-6:  # below, sin(x) / x is 1 in double precision
        chord *= sincos_f64(half)[0] / half
    middle_sine, middle_cosine = sincos_f64(pose[2] + half)
    heading = pose[2] + 2.0 * half
    sine, cosine = sincos_f64(heading)
    x, y = pose[0] + chord * middle_cosine, pose[1] + chord * middle_sine
    return x, y, heading, cosine, sine


@inner_kernel(forceinline=True)
def _relate(me: UnicycleWords, now: NDArray[np.float64], place: int, held: int) -> None:
    """Turn the pose error against the reference at row `place` into that against a set-point."""
    pose, direction = me.operator.pose[place], me.operator.direction[place]
    x, y, heading, c, s = _set_point(me, held, place - held)
    forward = direction[0] * now[0] - direction[1] * now[1] + (pose[0] - x)
    sideways = direction[1] * now[0] + direction[0] * now[1] + (pose[1] - y)
    now[0] = c * forward + s * sideways
    now[1] = c * sideways - s * forward
    turned = pose[2] - heading
    turned -= 2.0 * math.pi * np.rint(turned / (2.0 * math.pi))
    now[2] = wrap_angle(now[2] + turned)


@inner_kernel(forceinline=True)
def _sample(
    me: UnicycleWords,
    lanes: NDArray[np.float64],
    loop: LoopConstants,
    state: Any,
    slot: Any,
    step: int,
    env: int,
    robot: int,
) -> None:
    """Measure one robot and close its loop; the last three normals are the noise.

    What it is measured against, and departs from, is the set-point in force.
    """
    sample = step // me.steps_per_sample
    lane = robot % LANES
    now = me.memory.history[env, robot, sample]
    for j in range(NUM_STATES):
        now[j] = lanes[STATE + j * LANES + lane]
    now[0] += me.noise_position_m[robot] * lanes[NORMALS + 2 * LANES + lane]
    now[1] += me.noise_position_m[robot] * lanes[NORMALS + 3 * LANES + lane]
    now[2] += me.noise_heading_rad[robot] * lanes[NORMALS + 4 * LANES + lane]
    place = me.operator.offset[env, robot] + step
    reference = place
    if me.set_point != PRESENT:
        reference -= step - state.held_step[env, robot, step % me.steps_per_slot]
        _relate(me, now, place, reference)
    if loop.filter.is_known:
        middle = min(reference + me.steps_per_sample // 2, me.operator.path.shape[0] - 1)
        me.memory.filter.motion[env, robot, sample, 0] = me.operator.path[middle, 4]
        me.memory.filter.motion[env, robot, sample, 1] = me.operator.path[middle, 0]
    close_loop(me.memory, me.input_limits[robot], loop, state, slot, sample, env, robot)
    for i in range(NUM_INPUTS):
        lanes[CONTROL + i * LANES + lane] = me.memory.control[env, robot, i]


@inner_kernel(forceinline=True)
def _move_lanes(me: UnicycleWords, path: NDArray[np.float64], lanes: NDArray[np.float64]) -> None:
    """Move a block of robots by one integration step, with the reference (5 LANES,) in it.

    Midpoint rule in the heading, exact in the actuator lag and in the rotation of the frame. The
    window sums grow by squared position error, absolute heading error and curvature at the end of
    the step, the slot's sum by the first of them. Speed and turn rate depart from those of the
    set-point in force, whose own the robot follows at once.
    """
    step_s = me.step_s
    for lane in range(LANES):
        turn_rate = path[lane]
        c = path[LANES + lane]
        s = path[2 * LANES + lane]
        chord = path[3 * LANES + lane]
        speed = path[4 * LANES + lane]
        lag_mean, lag_decay = lanes[LAG + lane], lanes[LAG + LANES + lane]
        control_v = lanes[CONTROL + lane]
        control_w = lanes[CONTROL + LANES + lane]
        heading = lanes[STATE + 2 * LANES + lane]
        dv = lanes[STATE + 3 * LANES + lane] - control_v
        dw = lanes[STATE + 4 * LANES + lane] - control_w
        velocity = speed + control_v + dv * lag_mean + lanes[SLIP + lane]
        turn_error = control_w + dw * lag_mean + lanes[SLIP + LANES + lane]
        turn_error += path[5 * LANES + lane]
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
    me: UnicycleWords,
    lanes: NDArray[np.float64],
    loop: LoopConstants,
    state: Any,
    slot: Any,
    env: int,
    robot: int,
) -> None:
    """Note where one robot stands after the slot's last step."""
    operator, start = me.operator, me.operator.offset[env, robot]
    lane = robot % LANES
    slot.tracking_error_m[robot] = math.sqrt(lanes[SLOT_SQUARE + lane] / me.steps_per_slot)
    for j in range(NUM_STATES):
        slot.state[robot, j] = lanes[STATE + j * LANES + lane]
    place = start + (state.slot[env] + 1) * me.steps_per_slot
    for j in range(3):
        slot.reference[robot, j] = operator.pose[place, j]
    slot.reference[robot, 3] = operator.path[place - 1, 4]
    slot.reference[robot, 4] = operator.path[place - 1, 0]
    if me.set_point != PRESENT:
        held = start + state.held_step[env, robot, me.steps_per_slot - 1]
        slot.state[robot, 3] += operator.path[held, 4] - operator.path[place - 1, 4]
        slot.state[robot, 4] += operator.path[held, 0] - operator.path[place - 1, 0]
        x, y, heading, _, _ = _set_point(me, held, place - held)
        slot.set_point[robot, 0] = x
        slot.set_point[robot, 1] = y
        slot.set_point[robot, 2] = heading
    for i in range(NUM_INPUTS):
        slot.control[robot, i] = me.memory.control[env, robot, i]
    since_first = (state.slot[env] + 1) * me.steps_per_slot - 1
    if me.is_spread:
        since_first -= me.phase[robot]
    if since_first >= 0:
        note_loop(loop, me.memory, state, since_first // me.steps_per_sample, env, robot)


@inner_kernel()
def _report_task(
    me: UnicycleWords,
    lanes: NDArray[np.float64],
    constants: Any,
    state: Any,
    slot: Any,
    env: int,
    robot: int,
) -> None:
    """Tell the base station of the coming slot what the operator of one robot asks for."""
    path, pose, steps = me.operator.path, me.operator.pose, me.steps_per_slot
    now, start, lane = state.slot[env], me.operator.offset[env, robot], robot % LANES
    if slot.arrivals_packets[robot] > 0:
        me.newest[env, robot] = now
    newest = me.newest[env, robot]
    place = start + newest * steps
    speed, turn_rate = path[place, 4], path[place, 0]
    along = (path[place + 1, 4] - speed) / me.step_s
    across = speed * turn_rate
    state.set_point_speed_mps[env, robot] = speed
    state.set_point_acceleration_mps2[env, robot] = math.sqrt(along * along + across * across)
    # The fastest that waits: it is sought anew only when the one of before has been delivered.
    oldest = now + 1 - np.int64(np.rint(state.hol_delay_s[env, robot] / constants.slot_s))
    oldest = min(oldest, newest)
    peak = me.peak[env, robot]
    if speed >= path[start + peak * steps, 4] or peak > newest:
        peak = newest
    if peak < oldest:
        peak = oldest
        for waiting in range(oldest + 1, newest + 1):
            if path[start + waiting * steps, 4] > path[start + peak * steps, 4]:
                peak = waiting
    me.peak[env, robot] = peak
    state.waiting_speed_mps[env, robot] = path[start + peak * steps, 4]
    if constants.tracks_age:
        held = start + state.held_step[env, robot, steps - 1]
        state.set_point_gap_m[env, robot] = math.hypot(
            pose[place, 0] - pose[held, 0], pose[place, 1] - pose[held, 1]
        )
    reported, ring = me.reported[env, robot], me.reported_slots + 1
    reported[now % ring] = math.hypot(lanes[STATE + lane], lanes[STATE + LANES + lane])
    state.reported_error_m[env, robot] = reported[(now + 1) % ring]


@DRIVE.kernel(UnicycleWords)
def drive_unicycles(me: UnicycleWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Move all robots of a world through the slot."""
    draw_normals(state.key[env], state.slot[env], me.normals, slot.robot_normal)
    first = state.slot[env] * me.steps_per_slot
    for block in range(me.lanes.shape[1]):
        lanes, begin = me.lanes[env, block], block * LANES
        end = min(begin + LANES, slot.delay_steps.shape[0])
        _start_slot(me, lanes, constants.loop, state, slot, env, begin, end)
        for step in range(first, first + me.steps_per_slot):
            if me.is_spread:
                for robot in range(begin, end):
                    if step % me.steps_per_sample == me.phase[robot]:
                        _sample(me, lanes, constants.loop, state, slot, step, env, robot)
            elif step % me.steps_per_sample == 0:
                for robot in range(begin, end):
                    _sample(me, lanes, constants.loop, state, slot, step, env, robot)
            place = (step - first) * NUM_PATH * LANES
            _move_lanes(me, me.gathered[place : place + NUM_PATH * LANES], lanes)
            if (step + 1) % me.steps_per_window == 0:
                _end_window(me, lanes, state.dexterity_index[env, begin:])
        for robot in range(begin, end):
            _record_robot(me, lanes, constants.loop, state, slot, env, robot)
            _report_task(me, lanes, constants, state, slot, env, robot)
