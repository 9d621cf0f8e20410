"""The robots in the slot loop: sampling, delays, the gain in force, stability, windows."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from hiersched.control import build_schedule, hold_delays
from hiersched.experiments.events import entries_in_force
from hiersched.models.plant.unicycle import LAG, SLIP, STATE
from hiersched.simulator.loop_gains import Gains, loop_gains, plant_of

STILL = {
    "slip_speed_mps": 0.0,
    "slip_turn_rate_radps": 0.0,
    "noise_position_m": 0.0,
    "noise_heading_rad": 0.0,
}
FREE = {"max_speed_mps": 1e9, "max_turn_rate_radps": 1e9}


def forced(delay_s, num_envs, num_slots, robots=4):
    return np.broadcast_to(np.asarray(delay_s, float), (num_envs, num_slots, robots)).copy()


def test_command_uses_the_delayed_state_and_the_gain_of_its_delay(make_simulator, smoke_scenario):
    """Samples every second slot: u = −K[T] x at the end of slot 2 (k − T) − 1, without noise."""
    count = smoke_scenario.max_delay_steps + 1
    rng = np.random.default_rng(1)
    gains = Gains.memoryless(rng.normal(size=(count, 2, 5)))
    quiet = {**STILL, "slip_speed_mps": 0.05, "slip_turn_rate_radps": 0.2, **FREE}
    simulator = make_simulator(1, 60, gains=gains, robot=quiet, control={"hold_samples": 0})
    delay_s = rng.uniform(0.0, 0.3, (1, 60, 4))
    record = simulator.run_robots(delay_s)
    steps = np.ceil(delay_s / 0.02).astype(int)
    np.testing.assert_array_equal(record.delay_steps, steps)
    # The gain in force is that of the last sample: slots without one keep it.
    entries = np.minimum(steps, count - 1)
    np.testing.assert_array_equal(record.gain_delay_steps[:, 0::2], entries[:, 0::2])
    np.testing.assert_array_equal(record.gain_delay_steps[:, 1::2], entries[:, 0::2])
    np.testing.assert_array_equal(record.delay_capped, steps > count - 1)
    assert record.delay_capped.any()
    for k in range(30):
        for robot in range(4):
            T = record.delay_steps[0, 2 * k, robot]
            late = 2 * (k - int(T)) - 1
            x = record.state[0, late, robot] if late >= 0 else np.zeros(5)
            expected = -gains.network_gains[min(T, count - 1)] @ x
            # Held over both slots of the sample.
            for slot in (2 * k, 2 * k + 1):
                got = record.control[0, slot, robot]
                np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-15)


def test_a_predictor_undoes_the_delay(make_simulator, smoke_scenario):
    """Slot loop against x⁺ = A x + B u in NumPy: tiny errors, so linear; delays that vary."""
    unheld = {"method": "predictor", "hold_samples": 0}
    scenario = replace(smoke_scenario, control=replace(smoke_scenario.control, **unheld))
    plant = plant_of(scenario)
    gains = loop_gains(build_schedule(plant, scenario.max_delay_steps, "predictor"), "adjusted")
    robot = {**STILL, **FREE, "reference": "straight"}
    simulator = make_simulator(1, 80, gains=gains, robot=robot, control=unheld)
    start = 1e-5 * np.array([1.0, -2.0, 1.5, 0.0, 0.0])
    simulator.words["plant"].set_state(start)
    delay_s = 0.02 * np.repeat(np.random.default_rng(6).integers(0, 13, (1, 40, 4)), 2, axis=1)
    record = simulator.run_robots(delay_s)
    for robot_index in range(4):
        x = [np.zeros(5)] * 13 + [start]
        u = [np.zeros(2)] * 13
        for k in range(40):
            T = int(record.delay_steps[0, 2 * k, robot_index])
            command = -gains.network_gains[T] @ x[-1 - T]
            command -= sum(gains.input_gains[T, i] @ u[-1 - i] for i in range(T))
            u.append(command)
            x.append(plant.A @ x[-1] + plant.B @ command)
            np.testing.assert_allclose(
                record.control[0, 2 * k, robot_index], command, rtol=2e-3, atol=1e-8
            )
        np.testing.assert_allclose(record.state[0, -1, robot_index], x[-1], rtol=2e-3, atol=1e-9)
    late = record.gain_delay_steps[:, 1::2] == record.delay_steps[:, 1::2]
    assert late.all()


def test_a_held_gain_acts_on_the_sample_that_the_delay_gives(make_simulator, smoke_scenario):
    """u = −K[T_held] x(k − T_d), both from NumPy; the log says which entry is in force."""
    count = smoke_scenario.max_delay_steps + 1
    rng = np.random.default_rng(7)
    gains = Gains.memoryless(rng.normal(size=(count, 2, 5)))
    quiet = {**STILL, "slip_speed_mps": 0.05, "slip_turn_rate_radps": 0.2, **FREE}
    simulator = make_simulator(1, 120, gains=gains, robot=quiet, control={"hold_samples": 3})
    record = simulator.run_robots(np.repeat(rng.uniform(0.0, 0.24, (1, 60, 4)), 2, axis=1))
    steps = record.delay_steps[0, ::2].astype(int)
    entries = hold_delays(steps, 3)
    assert (entries > steps).mean() > 0.5
    np.testing.assert_array_equal(record.gain_delay_steps[0, ::2], entries)
    np.testing.assert_array_equal(record.gain_delay_steps[0, 1::2], entries)
    np.testing.assert_array_equal(
        entries_in_force(simulator.scenario, record.delay_steps[0]), np.repeat(entries, 2, axis=0)
    )
    for k, robot in np.ndindex(60, 4):
        late = 2 * (k - steps[k, robot]) - 1
        x = record.state[0, late, robot] if late >= 0 else np.zeros(5)
        np.testing.assert_allclose(
            record.control[0, 2 * k, robot],
            -gains.network_gains[entries[k, robot]] @ x,
            rtol=1e-12,
            atol=1e-15,
        )


@pytest.mark.parametrize("sampling_s", [0.0025, 0.005, 0.01, 0.025, 0.04])
def test_entries_in_force_follow_the_slot_loop(make_simulator, smoke_scenario, sampling_s):
    """Sampling intervals shorter and longer than a slot of 10 ms, and not a multiple of it."""
    control = {"sampling_s": sampling_s, "max_delay_s": 8 * sampling_s, "hold_samples": 2}
    gains = Gains.memoryless(0.1 * np.random.default_rng(8).normal(size=(9, 2, 5)))
    simulator = make_simulator(1, 60, gains=gains, control=control)
    delay_s = np.random.default_rng(9).uniform(0.0, 9 * sampling_s, (1, 60, 4))
    record = simulator.run_robots(delay_s)
    np.testing.assert_array_equal(
        entries_in_force(simulator.scenario, record.delay_steps[0]), record.gain_delay_steps[0]
    )


def test_the_nominal_tables_are_the_schedules_nominal_gain(smoke_scenario):
    """Also where the schedule's own entry for T = 0 is another gain."""
    control = replace(smoke_scenario.control, loop="split", method="razumikhin", max_delay_s=0.02)
    scenario = replace(smoke_scenario, control=control)
    schedule = build_schedule(plant_of(scenario), 1, "razumikhin", decay_rate=0.06)
    assert (schedule.gains[0] != schedule.nominal).any()
    nominal, adjusted = (loop_gains(schedule, gain) for gain in ("nominal", "adjusted"))
    np.testing.assert_array_equal(nominal.local_gains, [schedule.nominal] * 2)
    np.testing.assert_array_equal(adjusted.local_gains, schedule.gains)
    np.testing.assert_array_equal(nominal.network_gains, [schedule.operator_gain] * 2)
    assert not nominal.adjusted.any()
    assert adjusted.adjusted.all()


def test_the_log_says_which_gain_is_in_force(make_simulator, smoke_scenario):
    """0 stands for the nominal gain: configured so, or K̂(T) = K, as where no gain is feasible."""
    count = smoke_scenario.max_delay_steps + 1
    network = np.random.default_rng(4).normal(size=(count, 2, 5)) * 0.1
    network[[1, 3]] = network[0]
    gains = Gains.memoryless(network)
    delay_s = np.repeat(np.random.default_rng(5).uniform(0.0, 0.2, (1, 20, 4)), 2, axis=1)
    constant = Gains.memoryless(np.repeat(network[:1], count, axis=0))
    nominal = make_simulator(1, 40, gains=constant).run_robots(delay_s)
    unheld = {"hold_samples": 0}
    adjusted = make_simulator(1, 40, gains=gains, control=unheld).run_robots(delay_s)
    assert not nominal.gain_delay_steps.any()
    steps = adjusted.delay_steps
    expected = np.where((steps == 1) | (steps == 3), 0, steps)
    np.testing.assert_array_equal(adjusted.gain_delay_steps, expected)
    assert (steps == 3).any()
    assert (expected > 3).any()


def test_saturation_is_counted_and_holds(make_simulator):
    limits = {"max_speed_mps": 0.01, "max_turn_rate_radps": 1e9}
    record = make_simulator(1, 60, robot=limits).run_robots(forced(0.02, 1, 60))
    assert np.abs(record.control[..., 0]).max() == 0.01
    hit = np.abs(record.control[..., 0]) == 0.01
    np.testing.assert_array_equal(record.control_saturated[0, ::2], hit[0, ::2])
    assert not record.control_saturated[0, 1::2].any()
    assert 0 < record.control_saturated.sum() < record.control_saturated[0, ::2].size


@pytest.mark.parametrize("reference", ["straight", "arc", "figure_eight", "zigzag"])
def test_without_slip_and_noise_robots_stay_on_their_reference(make_simulator, reference):
    simulator = make_simulator(1, 300, robot={**STILL, "reference": reference})
    record = simulator.run_robots(forced(0.05, 1, 300))
    assert record.tracking_error_m.max() < 1e-6


def test_robots_follow_a_file(make_simulator):
    """A quarter of a circle at a speed that rises from 0 to 2 m/s, then back along its like."""
    angle = np.linspace(0.0, math.pi / 2, 50)
    times = 2.0 * np.sqrt(angle)
    points = tuple(zip(times, 2 * np.sin(angle), 2 - 2 * np.cos(angle), angle, strict=True))
    robot = {**STILL, "reference": "file", "reference_points": points, "reference_repeat": True}
    record = make_simulator(1, 300, robot=robot).run_robots(forced(0.05, 1, 300))
    assert record.tracking_error_m.max() < 1e-4
    first = record.reference[0, :, 0]
    ends = 0.01 * np.arange(1, 251)
    driven = np.interp(ends, times, angle)
    np.testing.assert_allclose(first[:250, 2], driven, atol=1e-9)
    np.testing.assert_allclose(first[:250, 0], 2 * np.sin(driven), atol=1e-3)
    np.testing.assert_allclose(first[:250, 4], 0.5 * first[:250, 3], rtol=1e-6)
    assert first[:250, 3].max() > 1.9
    assert (record.reference[0, 0, :, 2] > 0.1).sum() == 3  # the others start further on


def growth(make_simulator, delay_steps, num_slots=800):
    """Factor a sample of the error of a disturbed robot, and the lifted linear system's radius."""
    robot = {**STILL, **FREE, "reference": "straight"}
    simulator = make_simulator(1, num_slots, robot=robot, control={"weight": 700.0})
    simulator.words["plant"].set_state(1e-9 * np.array([1.0, 1.0, 1.0, 0.0, 0.0]))
    record = simulator.run_robots(forced(delay_steps * 0.02, 1, num_slots))
    size = np.abs(record.state[0, :, 0]).max(axis=-1)
    factor = (size[-100:].max() / size[200:300].max()) ** (2 / (num_slots - 300))
    plant = plant_of(simulator.scenario)
    K = simulator.constants.loop.network_gain[delay_steps]
    lifted = np.eye(5 * (delay_steps + 1), k=-5)
    lifted[:5, :5] = plant.A
    lifted[:5, -5:] -= plant.B @ K
    return factor, np.abs(np.linalg.eigvals(lifted)).max()


def test_nominal_loop_is_stable_at_three_samples_and_unstable_at_four(make_simulator):
    """q = 700, h = 20 ms; the nonlinear loop grows at the linear one's spectral radius."""
    for delay_steps, stable in ((0, True), (3, True), (4, False), (5, False)):
        factor, radius = growth(make_simulator, delay_steps)
        assert (radius < 1) == stable
        assert (factor < 1) == stable
        if delay_steps >= 3:
            assert factor == pytest.approx(radius, abs=2e-3)


def test_index_of_a_window_is_that_of_its_steps(make_simulator, of_robots):
    """Slots of one step, so that the record has every step; one window of 400."""
    simulator = make_simulator(1, 401, robot=STILL, radio={"slot_s": 0.0025})
    simulator.words["plant"].set_state(np.array([0.03, -0.05, 0.2, 0.0, 0.1]))
    start = of_robots(simulator, STATE, 5)[0]
    record = simulator.run_robots(forced(0.02, 1, 401))
    lag_mean = of_robots(simulator, LAG, 1)[0]
    first = simulator.scenario.robot.initial_dexterity_index
    np.testing.assert_array_equal(record.dexterity_index[0, :400], first)
    state, control, reference = (
        field[0, :400] for field in (record.state, record.control, record.reference)
    )
    # Mean speed over a step: the lag decays from the speed before it towards the command.
    before = np.concatenate([start[None], state[:-1]])[..., 3:]
    speed = reference[..., 3:] + control + (before - control) * lag_mean
    te_cm = 100 * np.sqrt((state[..., :2] ** 2).sum(axis=-1).mean(axis=0))
    oe_deg = np.degrees(np.abs(state[..., 2]).mean(axis=0))
    curvature = (np.abs(speed[..., 1]) / np.maximum(np.abs(speed[..., 0]), 0.05)).mean(axis=0)
    expected = 0.4 * (1 - te_cm / 10) + 0.3 * (1 - oe_deg / 180) + 0.3 * (1 - curvature)
    assert (te_cm < 10).all()
    assert (curvature < 1).all()
    np.testing.assert_allclose(record.dexterity_index[0, 400], expected, rtol=1e-12)


def test_slip_and_noise_have_their_spread(make_simulator, of_robots):
    """Ornstein–Uhlenbeck: standard deviation 0.05 m/s and 0.2 rad/s, correlation e^(−τ/0.3)."""
    simulator = make_simulator(50, 400, robot=FREE)
    slips = []
    for _ in range(400):
        simulator.run_robots(forced(0.02, 50, 1))
        slips.append(of_robots(simulator, SLIP, 2))
    slip = np.array(slips)[150:]  # (T, E, R, 2)
    np.testing.assert_allclose(slip.std(axis=(0, 1, 2)), [0.05, 0.2], rtol=0.05)
    for lag in (1, 30):
        pair = (slip[lag:] * slip[:-lag]).mean(axis=(0, 1, 2)) / (slip**2).mean(axis=(0, 1, 2))
        np.testing.assert_allclose(pair, np.exp(-lag * 0.01 / 0.3), atol=0.05)


def test_a_sample_knows_the_delay_of_the_slot_before(make_simulator):
    """Robots that are fed with it do the same: what a slot delivers is known when it has ended."""
    whole = make_simulator(traffic={"load": 1.2}).run("pf")
    core_s = make_simulator().scenario.robot.core_latency_s
    first = np.full_like(whole.network_delay_s[:, :1], core_s)
    known = np.concatenate([first, whole.network_delay_s[:, :-1]], axis=1)
    assert (np.ceil(known / 0.02) != np.ceil(whole.network_delay_s / 0.02)).any()
    alone = make_simulator().run_robots(known)
    for name in ("state", "control", "delay_steps", "tracking_error_m", "reference"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(whole, name))


def test_robots_of_all_blocks_move_alike(make_simulator):
    """Eighteen robots fill one block of lanes and begin another; on a line they are alike."""
    many = {
        "users": {"num_urllc": 18},
        "radio": {"num_prb": 24},
        "traffic": {"urllc_offered_mbps": 15.0},
    }
    simulator = make_simulator(1, 150, robot={**STILL, "reference": "straight"}, **many)
    simulator.words["plant"].set_state(np.array([0.03, -0.05, 0.2, 0.0, 0.1]))
    record = simulator.run_robots(forced(0.05, 1, 150, robots=18))
    for name in ("state", "control", "tracking_error_m", "dexterity_index", "gain_delay_steps"):
        values = getattr(record, name)
        np.testing.assert_array_equal(values, np.broadcast_to(values[:, :, :1], values.shape))
    assert record.dexterity_index[0, 100, 17] != record.dexterity_index[0, 0, 17]


def test_slots_one_by_one_carry_the_delay_over(make_simulator):
    at_once = make_simulator(traffic={"load": 1.2}).run("pf")
    simulator = make_simulator(traffic={"load": 1.2})
    for slot in range(60):
        one = simulator.run("pf", 1)
        np.testing.assert_array_equal(one.delay_steps[:, 0], at_once.delay_steps[:, slot])
        np.testing.assert_array_equal(one.state[:, 0], at_once.state[:, slot])


def test_a_measurement_is_used_however_old_it_is(make_simulator, smoke_scenario):
    """Beyond T_max the gain is that of T_max, the measurement the one that has arrived."""
    count = smoke_scenario.max_delay_steps + 1
    gains = Gains.memoryless(np.random.default_rng(3).normal(size=(count, 2, 5)))
    quiet = {**STILL, "slip_speed_mps": 0.05, "slip_turn_rate_radps": 0.2, **FREE}
    simulator = make_simulator(1, 120, gains=gains, robot=quiet)
    record = simulator.run_robots(forced(0.6, 1, 120))
    assert (record.delay_steps == 30).all()
    assert record.delay_capped.all()
    assert not record.control[0, :60].any()  # nothing has arrived: on the reference, no command
    for k in range(31, 60):
        expected = -gains.network_gains[-1] @ record.state[0, 2 * (k - 30) - 1, 1]
        np.testing.assert_allclose(record.control[0, 2 * k, 1], expected, rtol=1e-12, atol=1e-15)
