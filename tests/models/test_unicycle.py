"""One integration step and the loop around it; the whole loop is in tests/simulator."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hiersched.control import hold_delays
from hiersched.core.compiled import kernel
from hiersched.core.pointer import Pointer
from hiersched.core.randomness import normal_scratch
from hiersched.models.plant.command_link import NO_LINK, link_memory
from hiersched.models.plant.error_model import discretise, unicycle_error_model
from hiersched.models.plant.estimator import filter_memory, no_filter
from hiersched.models.plant.feedback import LoopConstants, LoopMemory, entry_in_force
from hiersched.models.plant.operator import OperatorWords
from hiersched.models.plant.reference import driven_table, reference_table
from hiersched.models.plant.unicycle import (
    CONTROL,
    LAG,
    LANES,
    NORMALS,
    NUM_PATH,
    SLIP,
    SLOT_SQUARE,
    STATE,
    WINDOW_SUMS,
    UnicycleWords,
    _move_lanes,
    _sample,
)

LAG_S = 0.1
SHAPE = {
    "arc_radius_m": 10.0,
    "eight_half_width_m": 4.0,
    "zigzag_heading_deg": 60.0,
    "zigzag_period_m": 1.6,
}


def constants(reference="straight", *, step_s=0.0025, speed_mps=1.0, noise=0.0, max_delay=3,
              local=None, network=None, inputs=None, limit=(2.0, 4.0)):  # fmt: skip
    if reference == "file":  # speeds from 0 to 1.6 m/s, turn rates from -0.9 to 0.9 rad/s
        time_s = np.linspace(0.0, 10.0, 201)
        table, offset = driven_table(
            time_s, 0.8 * time_s - 0.4 * np.sin(2 * time_s), 0.3 * np.sin(3 * time_s), np.zeros(2),
            repeat=False, step_s=step_s, num_steps=4000, num_robots=1,
        )  # fmt: skip
    else:
        robot = SimpleNamespace(
            reference=reference, substep_s=step_s, speed_mps=speed_mps, **SHAPE
        )  # fmt: skip
        table, offset = reference_table(robot, 4000, 1)
    decay = math.exp(-step_s / LAG_S)
    lanes = np.zeros((1, 1, 23 * LANES))
    lanes[0, 0, LAG : LAG + LANES] = (1 - decay) * LAG_S / step_s
    lanes[0, 0, LAG + LANES : LAG + 2 * LANES] = decay
    zeros = np.zeros((max_delay + 1, 2, 5))
    words = UnicycleWords(
        step_s=step_s, steps_per_slot=4, steps_per_sample=8, steps_per_window=400,
        noise_position_m=np.array([noise]), noise_heading_rad=np.array([2 * noise]),
        input_limits=np.array([limit]),
        set_point=0, is_spread=False, phase=np.zeros(1, np.int64), reported_slots=1,
        reported=np.zeros((1, 1, 2)), newest=np.zeros((1, 1), np.int64),
        peak=np.zeros((1, 1), np.int64),
        operator=OperatorWords(
            path=table.rows(), pose=table.pose, direction=np.zeros((0, 2)), offset=offset[None],
            first=offset[None], drawn=np.zeros(1, bool), world=np.zeros((1, 2), np.uint64),
            scale=np.ones(1), pace=np.ones(1),
            shuffles=False, reach=np.ones((3, 2)), reach_turn_rad=0.0, step_s=step_s,
            num_steps=4000,
        ),
        lanes=lanes,
        memory=LoopMemory(
            history=np.zeros((1, 1, 201, 5)), commands=np.zeros((1, 1, max_delay + 1, 2)),
            control=np.zeros((1, 1, 2)), held=np.zeros((1, 1, 2), np.int64),
            filter=filter_memory((1, 1), 200, 0, 2, kinds=1, is_known=False),
            link=link_memory((1, 1), 200, 2, 0, 0, 1),
        ),
        normals=normal_scratch(1, 5),
        gathered=np.zeros(4 * NUM_PATH * LANES),
    )  # fmt: skip
    loop = LoopConstants(
        sampling_s=0.02, core_latency_s=0.005, max_delay_steps=max_delay,
        kind=np.zeros(1, np.int64),
        local_gain=zeros if local is None else local,
        network_gain=zeros if network is None else network, has_memory=inputs is not None,
        input_gain=np.zeros((max_delay + 1, max_delay, 2, 2)) if inputs is None else inputs,
        hold_samples=0, stamp_error=0, is_local=False, by_age=False,
        adjusted_delay_steps=np.zeros(max_delay + 1, np.uint32), filter=no_filter(2),
        link=NO_LINK,
    )  # fmt: skip
    return words, loop


# The kernels within the slot loop have no entry for Python.
@kernel()
def move_lanes(me, path, lanes):
    _move_lanes(me, path, lanes)


class State(NamedTuple):
    """What closing a loop notes."""

    gain_delay_steps: np.ndarray
    held_step: np.ndarray


class Slot(NamedTuple):
    """What closing a loop goes by, and counts."""

    delay_steps: np.ndarray
    control_saturated: np.ndarray


@kernel()
def close_loop(me, loop, state, slot, sample):
    """Measure the first robot and close its loop."""
    _sample(me, me.lanes[0, 0], loop, state, slot, sample * me.steps_per_sample, 0, 0)


def put(lanes, field, values, lane):
    lanes[field + lane : field + lane + len(values) * LANES : LANES] = values


def take(lanes, field, count, lane):
    return lanes[field + lane : field + lane + count * LANES : LANES].copy()


def move(robot, state, control, slip=(0.0, 0.0), steps=1, place=0, lane=3):
    """Move one robot in one lane; the others stand still in theirs."""
    return take(move_in_lane(robot, state, control, slip, steps, place, lane), STATE, 5, lane)


def move_in_lane(robot, state, control, slip, steps, place, lane):
    lanes = np.zeros_like(robot.lanes[0, 0])
    lanes[LAG:] = robot.lanes[0, 0, LAG:]
    for field, values in ((STATE, state), (CONTROL, control), (SLIP, slip)):
        put(lanes, field, values, lane)
    path = np.zeros((steps, NUM_PATH, LANES))
    path[:, :5, lane] = robot.operator.path[place : place + steps]
    for step in path.reshape(steps, NUM_PATH * LANES):
        move_lanes(Pointer(robot), step, lanes)
    return lanes


@pytest.mark.parametrize("speed_mps", [1.0, 0.6])
def test_first_order_is_the_discretised_plant(speed_mps):
    """Jacobian of one sample (8 steps) against A, B: what the gains are designed for."""
    A, B = discretise(*unicycle_error_model(speed_mps, 0.0, LAG_S), 0.02)
    robot, d = constants(speed_mps=speed_mps)[0], 1e-5
    for j in range(5):
        x = d * np.eye(5)[j]
        column = (move(robot, x, (0, 0), steps=8) - move(robot, -x, (0, 0), steps=8)) / (2 * d)
        np.testing.assert_allclose(column, A[:, j], atol=2e-6)
    for j in range(2):
        u = d * np.eye(2)[j]
        zero = np.zeros(5)
        column = (move(robot, zero, u, steps=8) - move(robot, zero, -u, steps=8)) / (2 * d)
        np.testing.assert_allclose(column, B[:, j], atol=2e-6)


@pytest.mark.nightly
@pytest.mark.parametrize("reference", ["straight", "arc", "figure_eight", "zigzag", "file"])
def test_without_slip_a_robot_stays_on_its_reference(reference):
    """Open loop for 10 s: the midpoint rule drifts by v T (ω Δt)² / 24, 0.04 mm on the zig-zag."""
    robot, _ = constants(reference)
    end = move(robot, np.zeros(5), (0.0, 0.0), steps=4000)
    drift_m = 10.0 * (np.abs(robot.operator.path[:, 0]).max() * robot.step_s) ** 2 / 24
    assert np.hypot(*end[:2]) <= drift_m + 1e-12
    np.testing.assert_array_equal(end[2:], 0.0)


@pytest.mark.parametrize("reference", ["straight", "figure_eight", "zigzag", "file"])
def test_motion_is_that_of_the_unicycle_in_the_world(reference):
    """Integrate x' = v cos θ, y' = v sin θ, θ' = ω in the world, then change the frame."""
    start, control, slip = np.array([0.1, -0.2, 0.6, 0.3, -0.5]), (0.4, 1.1), (0.05, -0.2)
    robot, steps = constants(reference, speed_mps=0.9)[0], 200
    pose = robot.operator.pose

    def rate(z, reference_speed, turn):
        theta, v, w = z[2:]
        speed, omega = reference_speed + v + slip[0], turn + w + slip[1]
        lag = (control[0] - v) / LAG_S, (control[1] - w) / LAG_S
        return np.array([speed * math.cos(theta), speed * math.sin(theta), omega, *lag])

    def frame(heading):
        c, s = math.cos(heading), math.sin(heading)
        return np.array([[c, s], [-s, c]])

    z = np.array(
        [*(pose[0, :2] + frame(pose[0, 2]).T @ start[:2]), pose[0, 2] + start[2], *start[3:]]
    )
    for at in robot.operator.path[
        :steps, [4, 0]
    ]:  # Runge and Kutta's fourth order: exact beside the other
        h = robot.step_s
        k1 = rate(z, *at)
        k2 = rate(z + 0.5 * h * k1, *at)
        k3 = rate(z + 0.5 * h * k2, *at)
        z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(z + h * k3, *at))
    error = frame(pose[steps, 2]) @ (z[:2] - pose[steps, :2])
    heading = (z[2] - pose[steps, 2] + math.pi) % (2 * math.pi) - math.pi
    got = move(robot, start, control, slip, steps)
    np.testing.assert_allclose(got, [*error, heading, *z[3:]], atol=2e-5)


def test_halving_the_step_quarters_the_error():
    start, control = np.array([0.1, -0.2, 0.6, 0.3, -0.5]), (0.4, 1.1)
    ends = [
        move(constants("arc", step_s=0.02 / n)[0], start, control, steps=10 * n) for n in (2, 4, 64)
    ]
    coarse, fine = (np.abs(end - ends[2]).max() for end in ends[:2])
    assert 3.5 < coarse / fine < 4.5


def test_window_sums_by_hand():
    """Slip alone, straight: v = 1.5, ω = 0.3, so |ω| / |v| = 0.2; at v = 0.01 it is 0.3 / 0.05."""
    robot, _ = constants()
    lanes = move_in_lane(robot, np.zeros(5), np.zeros(2), (0.5, 0.3), 1, 0, 5)
    state, sums = take(lanes, STATE, 5, 5), take(lanes, WINDOW_SUMS, 3, 5)
    assert take(lanes, SLOT_SQUARE, 1, 5) == state[0] ** 2 + state[1] ** 2 == sums[0]
    assert state[0] == pytest.approx(0.5 * 0.0025, abs=1e-8)
    assert sums[1] == pytest.approx(0.3 * 0.0025)
    assert sums[2] == pytest.approx(0.2)
    lanes = move_in_lane(robot, np.zeros(5), np.zeros(2), (-0.99, 0.3), 2, 0, 5)
    assert take(lanes, WINDOW_SUMS, 3, 5)[2] == pytest.approx(2 * 0.3 / 0.05)


def random_gains(seed, max_delay=3, size=1.0):
    return size * np.random.default_rng(seed).normal(size=(2, max_delay + 1, 2, 5))


def close(robot, loop, sample, delay):
    """Close the loop of the robot with the gains of its delay: commands, and 1 at a limit."""
    state = State(np.zeros((1, 1), np.uint32), np.zeros((1, 1, 4), np.int64))
    slot = Slot(np.array([delay], np.uint32), np.zeros(1, np.uint32))
    close_loop(Pointer(robot), Pointer(loop), Pointer(state), Pointer(slot), sample)
    return take(robot.lanes[0, 0], CONTROL, 2, 0), slot.control_saturated[0]


@given(st.lists(st.integers(0, 3), min_size=8, max_size=20), st.integers(0, 100))
def test_command_is_the_delayed_feedback_with_the_gain_of_its_delay(delays, seed):
    """u(k) = −K_local[T] y(k) − K_network[T] y(k − T), y the noisy measurement, y = 0 before 0."""
    rng = np.random.default_rng(seed)
    local, network = random_gains(seed, size=0.05)
    robot, loop = constants(local=local, network=network, noise=0.01)
    measured = {k: np.zeros(5) for k in range(-3, 0)}
    for k, delay in enumerate(delays):
        x, normals = rng.normal(size=5), rng.normal(size=5).astype(np.float32)
        put(robot.lanes[0, 0], STATE, x, 0)
        put(robot.lanes[0, 0], NORMALS, normals, 0)
        control, saturated = close(robot, loop, k, delay)
        noise = np.array([0.01, 0.01, 0.02, 0.0, 0.0]) * [*normals[2:].astype(float), 0.0, 0.0]
        measured[k] = x + noise
        expected = -local[delay] @ measured[k] - network[delay] @ measured[k - delay]
        assert np.abs(expected).max() < 2.0
        np.testing.assert_allclose(control, expected, atol=1e-12)
        assert saturated == 0


@given(st.lists(st.integers(0, 3), min_size=8, max_size=20), st.integers(0, 100))
def test_gains_with_memory_see_the_commands_that_were_applied(delays, seed):
    """u(k) = −G_net[T] y(k−T) − G_loc[T] y(k) − Σ H[T,i] u(k−1−i), cut to its limits."""
    rng = np.random.default_rng(seed)
    local, network = random_gains(seed)
    inputs, limit = rng.normal(size=(4, 3, 2, 2)), np.array([0.5, 3.0])
    robot, loop = constants(local=local, network=network, inputs=inputs, limit=tuple(limit))
    measured = {k: np.zeros(5) for k in range(-3, 0)}
    applied = {k: np.zeros(2) for k in range(-4, 0)}
    for k, T in enumerate(delays):
        measured[k] = rng.normal(size=5) * 0.3
        put(robot.lanes[0, 0], STATE, measured[k], 0)
        control, saturated = close(robot, loop, k, T)
        wanted = -network[T] @ measured[k - T] - local[T] @ measured[k]
        wanted -= sum(inputs[T, i] @ applied[k - 1 - i] for i in range(3))
        applied[k] = np.clip(wanted, -limit, limit)
        np.testing.assert_allclose(control, applied[k], atol=1e-12)
        assert saturated == (np.abs(wanted) > limit).any()


@given(st.lists(st.integers(0, 6), min_size=1, max_size=60), st.integers(0, 5))
def test_entries_are_held_as_the_control_library_says(delays, hold_samples):
    held = np.zeros(2, np.int64)
    loop = constants(max_delay=6)[1]._replace(hold_samples=hold_samples)
    entries = [entry_in_force(loop, delay, held) for delay in delays]
    assert entries == hold_delays(delays, hold_samples).tolist()


def test_commands_stop_at_their_limits_and_say_so():
    network = np.zeros((4, 2, 5))
    network[0, 0, 0] = network[0, 1, 1] = 1.0
    robot, loop = constants(network=network, limit=(0.5, 3.0))
    for x, expected, saturated in [
        ([0.4, -2.0], [-0.4, 2.0], 0),
        ([0.6, 0.0], [-0.5, 0.0], 1),
        ([-0.6, 4.0], [0.5, -3.0], 1),
        ([0.5, 3.0], [-0.5, -3.0], 0),
    ]:
        put(robot.lanes[0, 0], STATE, x, 0)
        control, got = close(robot, loop, 0, 0)
        assert (control.tolist(), got) == (expected, saturated)
