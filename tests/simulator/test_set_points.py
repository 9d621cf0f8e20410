"""Robots whose set-points cross the network, and what their operators drive."""

from __future__ import annotations

import numpy as np
import pytest

from hiersched.core.randomness import world_keys

STILL = {
    "slip_speed_mps": 0.0,
    "slip_turn_rate_radps": 0.0,
    "noise_position_m": 0.0,
    "noise_heading_rad": 0.0,
}
LOCAL = {"loop": "local", "sampling_s": 0.0025, "hold_samples": 0}


@pytest.fixture
def forced(make_simulator):
    """A record of robots that run alone under one constant delay."""

    def run(delay_s, num_slots=300, num_envs=1, control=LOCAL, **robot):
        simulator = make_simulator(num_envs, num_slots, robot=robot, control=control)
        num_robots = simulator.scenario.users.num_urllc
        return simulator.run_robots(np.full((num_envs, num_slots, num_robots), delay_s))

    return run


@pytest.mark.parametrize("control", [LOCAL, {"delay": "age"}])
def test_a_set_point_without_age_is_the_reference(forced, control):
    present = forced(0.0, control=control, set_point="present")
    held = forced(0.0, control=control, set_point="hold")
    np.testing.assert_allclose(held.state, present.state, atol=1e-9)
    np.testing.assert_allclose(held.set_point[0, :, :, :2], held.reference[0, :, :, :2], atol=0.01)


def test_a_robot_that_holds_is_where_its_reference_was(forced):
    """Without slip and noise its error is the way that the reference has gone since."""
    slots = 5
    record = forced(0.01 * slots, set_point="hold", **STILL)
    pose = record.reference[0, :, :, :2]
    gone = np.linalg.norm(pose[slots:] - pose[:-slots], axis=-1)
    error = np.linalg.norm(record.state[0, slots:, :, :2], axis=-1)
    np.testing.assert_allclose(error[150:], gone[150:], rtol=2e-3)
    # What the log calls the set-point in force is a step younger than the delay of the next step.
    np.testing.assert_allclose(record.set_point_age_s[0, 20:], 0.01 * slots + 0.0025)


def test_a_robot_that_extrapolates_loses_nothing_on_an_arc(forced):
    held = forced(0.1, set_point="hold", reference="arc", **STILL)
    ahead = forced(0.1, set_point="extrapolate", reference="arc", **STILL)
    assert held.tracking_error_m[0, 200:].min() > 0.09
    assert ahead.tracking_error_m[0, 200:].max() < 1e-4
    np.testing.assert_allclose(ahead.set_point[0, 200:], ahead.reference[0, 200:, :, :3], atol=1e-6)


def test_a_local_loop_feels_no_delay_of_the_network(make_simulator):
    simulator = make_simulator(1, 200, control=LOCAL)
    record = simulator.run("pf")
    assert record.network_delay_s.max() > 0.02
    assert not record.delay_steps.any()
    assert not record.delay_capped.any()
    assert record.tracking_error_m.mean() < 0.03


def test_a_delay_can_be_an_age(make_simulator):
    """That of the newest packet delivered by the slot's start, from the packets' own times."""
    simulator = make_simulator(1, 400, control={"delay": "age"})
    record = simulator.run("pf")
    latency_s, slot_s = simulator.scenario.robot.core_latency_s, 0.01
    arrived = np.cumsum(record.arrivals_packets[0, :, :4].astype(float), axis=0)
    for robot in range(4):
        done = [(0.0, 0)]  # when, and of which slot, a packet is out
        for slot in range(400):
            backlog = record.backlog_packets[0, slot, robot]
            load = backlog + float(record.arrivals_packets[0, slot, robot])
            service = record.service_packets[0, slot, robot]
            number = arrived[slot, robot] - load  # fluid that is out at the slot's start
            for packet in range(int(np.floor(number)) + 1, int(arrived[slot, robot]) + 1):
                if packet - number <= service:
                    when = (slot + (packet - number) / service) * slot_s
                    done.append((when, int(np.searchsorted(arrived[:, robot], packet))))
        for slot in range(5, 400):
            by_now = [s for when, s in done if when + latency_s <= slot * slot_s + 1e-12]
            age_s = (slot - max(by_now, default=0)) * slot_s
            steps = int(np.ceil(age_s / simulator.scenario.control.sampling_s - 1e-9))
            assert record.delay_steps[0, slot, robot] == steps, (slot, robot)


def test_control_samples_can_have_phases(make_simulator):
    """Spread: a robot's command changes at its own steps only, a fourth of the interval apart."""
    simulator = make_simulator(1, 40, control={"sample_phases": "spread"})
    assert simulator.words["plant"].phase.tolist() == [0, 2, 4, 6]
    command = simulator.run("pf").control[0, :, :, 0]
    changed = np.diff(command, axis=0) != 0.0
    # Robots 0 and 1 sample in even slots, 2 and 3, from the fourth of eight steps on, in odd ones.
    assert changed[1::2, :2].any()
    assert not changed[0::2, :2].any()
    assert changed[0::2, 2:].any()
    assert not changed[1::2, 2:].any()


def test_what_the_base_station_knows_of_the_task(make_simulator):
    """Of the newest set-point, from the arrivals; of the robots, a slot and the latency late."""
    robot = {"reference": "reach", "set_point": "hold"}
    simulator = make_simulator(1, 400, robot=robot, control=LOCAL)
    state, operator = simulator.state, simulator.words["plant"].operator
    seen = {name: [] for name in ("speed", "acceleration", "gap", "error", "waiting", "age")}
    records = []
    for _ in range(400):
        records.append(simulator.run("pf", 1))
        seen["speed"].append(state.set_point_speed_mps[0].copy())
        seen["acceleration"].append(state.set_point_acceleration_mps2[0].copy())
        seen["gap"].append(state.set_point_gap_m[0].copy())
        seen["error"].append(state.reported_error_m[0].copy())
        seen["waiting"].append(state.waiting_speed_mps[0].copy())
        seen["age"].append(state.set_point_age_s[0].copy())
    read = {name: np.array(values) for name, values in seen.items()}
    error = np.array([np.linalg.norm(r.state[0, 0, :, :2], axis=-1) for r in records])
    np.testing.assert_allclose(read["error"][1:], error[:-1], rtol=1e-12)
    arrivals = np.array([r.arrivals_packets[0, 0, :4] for r in records])
    held = np.array([r.set_point[0, 0, :, :2] for r in records])
    hol = np.array([r.hol_delay_s[0, 0, :4] for r in records])
    moving = 0
    for robot_index in range(4):
        start = operator.offset[0, robot_index]
        newest = 0
        for slot in range(399):
            newest = slot if arrivals[slot, robot_index] else newest
            row = start + 4 * newest
            speed, turn_rate = operator.path[row, 4], operator.path[row, 0]
            along = (operator.path[row + 1, 4] - speed) / 0.0025
            place = slot, robot_index
            assert read["speed"][place] == speed
            wanted = np.hypot(along, speed * turn_rate)
            assert read["acceleration"][place] == pytest.approx(wanted, abs=1e-12)
            wanted = np.linalg.norm(operator.pose[row, :2] - held[place])
            assert read["gap"][place] == pytest.approx(wanted, abs=1e-12)
            oldest = slot + 1 - round(hol[slot + 1, robot_index] / 0.01)
            waiting = range(min(oldest, newest), newest + 1)
            wanted = max(operator.path[start + 4 * number, 4] for number in waiting)
            assert read["waiting"][place] == wanted
            moving += speed > 0.0
    assert moving > 100
    assert read["age"].max() > 0.03


def test_reaches_are_as_long_and_as_far_as_they_say(make_simulator):
    robot = {"reference": "reach", "reference_scale": (2.0, 1.0, 1.0, 0.5)}
    simulator = make_simulator(2, 6000, robot=robot)
    operator = simulator.words["plant"].operator
    given = simulator.scenario.robot
    starts = []
    for env in range(2):
        for number, scale in enumerate(given.reference_scale):
            first = operator.first[env, number]
            motion = operator.path[first : first + operator.num_steps]
            moves = np.concatenate([[0], (motion[:, 4] > 0.0).astype(int), [0]])
            begins, ends = np.flatnonzero(np.diff(moves) == 1), np.flatnonzero(np.diff(moves) == -1)
            whole = slice(0, -1)
            lasts = (ends - begins)[whole] * 0.0025
            assert 0.6 - 0.003 <= lasts.min()
            assert lasts.max() <= 1.4 + 0.003
            pauses = (begins[1:] - ends[:-1]) * 0.0025
            assert 0.5 - 0.003 <= pauses.min()
            assert pauses.max() <= 4.0 + 0.003
            ways = [motion[a:b, 4].sum() * 0.0025 for a, b in zip(begins, ends, strict=True)]
            ways = np.array(ways[:-1]) / scale
            assert 0.3 - 1e-3 <= ways.min()
            assert ways.max() <= 1.5 + 1e-3
            turns = [motion[a:b, 0].sum() * 0.0025 for a, b in zip(begins, ends, strict=True)]
            assert np.abs(turns).max() <= 1.2 + 1e-3
            assert 0.2 < moves.mean() < 0.45  # moving about a third of the time
            starts.append(tuple(begins[:3]))
    assert len(set(starts)) == 8  # every operator of every world has its own


def test_a_world_draws_its_operators_whatever_else_runs(make_simulator):
    robot = {"reference": "reach", "reference_shuffle": True}
    keys = world_keys("test", 5, 3)
    one = make_simulator(3, 100, keys=keys, robot=robot)
    record = one.run("pf")
    other = make_simulator(1, 100, keys=keys[1:2], robot=robot).run("edf")
    np.testing.assert_array_equal(record.reference[1], other.reference[0])
    one.reset(keys[::-1].copy())
    np.testing.assert_array_equal(one.run("pf").reference[::-1], record.reference)


@pytest.mark.parametrize("shuffle", [False, True])
def test_worlds_that_are_equal_or_stay_have_the_operators_of_each_alone(make_simulator, shuffle):
    robot = {"reference": "reach", "reference_shuffle": shuffle}
    keys = world_keys("test", 5, 3)
    alone = [make_simulator(1, 40, keys=keys[k : k + 1], robot=robot).run("pf") for k in range(3)]
    simulator = make_simulator(3, 40, keys=keys[[0, 1, 0]], robot=robot)
    for worlds in ((0, 1, 0), (0, 1, 0), (1, 0, 0), (2, 2, 2), (0, 2, 1), (1, 1, 0)):
        simulator.reset(keys[list(worlds)])
        record = simulator.run("pf")
        for env, world in enumerate(worlds):
            np.testing.assert_array_equal(record.rows[env], alone[world].rows[0])


def test_worlds_deal_the_references_to_their_robots(make_simulator):
    robot = {
        "reference": ("straight", "arc", "figure_eight", "zigzag"),
        "reference_scale": (1.0, 2.0, 1.0, 1.0),
        "reference_pace": (3.0, 1.0, 1.0, 1.0),
    }
    record = make_simulator(6, 20, robot=robot).run("pf")
    speeds = record.reference[:, -1, :, 3]
    np.testing.assert_allclose(speeds, np.tile([3.0, 2.0, 1.0, 1.0], (6, 1)))
    np.testing.assert_allclose(record.reference[:, -1, 1, 4], 0.1)  # the arc, twice as large
    shuffled = make_simulator(6, 20, robot={**robot, "reference_shuffle": True}).run("pf")
    dealt = shuffled.reference[:, -1, :, 3]
    np.testing.assert_allclose(np.sort(dealt), np.sort(speeds))
    assert len({tuple(np.round(row, 6)) for row in dealt}) > 1


def test_superseding_is_counted_and_conserves_packets(make_simulator):
    robot = {"superseding": "packet"}
    simulator = make_simulator(1, 300, robot=robot, traffic={"load": 1.3})
    record = simulator.run("max_rate")
    assert record.superseded_packets[..., :4].sum() > 100
    assert not record.superseded_packets[..., 4:].any()
    backlog = record.backlog_packets[0] - record.superseded_packets[0]
    after = np.maximum(0.0, backlog + record.arrivals_packets[0] - record.service_packets[0])
    np.testing.assert_allclose(record.backlog_packets[0, 1:], after[:-1], atol=1e-9)
