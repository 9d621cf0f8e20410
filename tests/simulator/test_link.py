"""Commands over the network: with their time of execution, or for the samples to come."""

from __future__ import annotations

import numpy as np
import pytest

from hiersched.models.model import model_fields
from hiersched.simulator.gain_source import scenario_gains

from .conftest import vary

LQG = {"method": "lqg", "hold_samples": 0}
ROBOTS, SLOTS = 4, 600


@pytest.fixture(scope="module")
def run(smoke_scenario, make_simulator):
    """Record, and what filter and link add to it, of robots under forced delays."""

    def make(delay_s, latency_s=0.005, **control):
        sections = {"control": {**LQG, **control}, "robot": {"core_latency_s": latency_s}}
        scenario = vary(smoke_scenario, sections)
        delay_s = np.broadcast_to(np.asarray(delay_s, float), (1, SLOTS, ROBOTS)).copy()
        simulator = make_simulator(1, SLOTS, gains=scenario_gains(scenario), **sections)
        record = simulator.run_robots(delay_s)
        values = {
            field.name.removeprefix("plant/"): record.model_values[
                0, :, field.start : field.start + field.count
            ]
            for field in model_fields(scenario)
        }
        return record, values

    return make


def test_a_playout_buffer_makes_delays_constant(run):
    """Whatever the delays up to 60 ms are: 20 ms of latency and 40 ms in the buffer."""
    delay_s = np.random.default_rng(1).uniform(0.001, 0.06, (1, SLOTS, ROBOTS))
    played, values = run(delay_s, link="playout", playout_s=0.04)
    wanted, others = run(0.06)
    np.testing.assert_allclose(played.control, wanted.control, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(played.state, wanted.state, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(values["estimate_age"][10:], others["estimate_age"][10:])
    assert not values["late_commands"].any()
    assert not values["command_gap"].any()


@pytest.mark.parametrize("steps", [1, 3, 6])
def test_packets_at_a_constant_delay_are_as_good_as_measurements(run, steps):
    """What was applied is known then, and every packet begins with it."""
    played, values = run(0.02 * steps, link="packetised")
    wanted, _ = run(0.02 * steps)
    np.testing.assert_allclose(
        played.control[0, -100:], wanted.control[0, -100:], rtol=1e-5, atol=1e-6
    )
    assert not values["late_commands"][2 * steps :].any()
    assert np.abs(values["command_gap"][-100:]).max() < 1e-12


@pytest.mark.parametrize(
    ("link", "keys", "depth"),
    [("playout", {"playout_s": 0.04}, 2), ("packetised", {"packet_samples": 3}, 3)],
)
def test_late_commands_are_counted_held_and_let_go(run, link, keys, depth):
    """Delays jump to 240 ms for half a second; the last command is held for 60 ms, then none."""
    delay_s = np.full((1, SLOTS, ROBOTS), 0.02)
    delay_s[0, 200:250] = 0.24
    record, values = run(delay_s, link=link, command_hold_s=0.06, **keys)
    steps = record.delay_steps[0, ::2].astype(int)
    samples = np.arange(SLOTS // 2)[:, None]
    newest = np.maximum.accumulate(samples - np.maximum(steps - 1, 0), axis=0)
    late = samples - newest > depth
    np.testing.assert_array_equal(values["late_commands"][0::2][5:], late[5:])
    assert not values["late_commands"][1::2].any()  # counted once
    assert 12 < late[:, 0].sum() < 30
    control = record.control[0, ::2]
    for robot in range(ROBOTS):
        begin = int(np.flatnonzero(late[:, robot])[0])
        count = int(late[:, robot].sum())
        for place in range(begin, begin + 3):
            np.testing.assert_array_equal(control[place, robot], control[begin - 1, robot])
        assert not control[begin + 3 : begin + count, robot].any()
        assert control[begin + count, robot].any()
    # What was taken for applied is not while the robot has none of it.
    gap = values["command_gap"][::2]
    assert gap[late & np.roll(late, 1, axis=0)].max() > 0.01


def test_packets_bridge_delays_that_grow(run):
    """The sawtooth: no command is missing, and robots stay near their references."""
    saw = np.repeat(np.resize([1, *range(1, 13), 12], SLOTS // 2), 2) * 0.02
    played, values = run(np.broadcast_to(saw[None, :, None], (1, SLOTS, ROBOTS)), link="packetised")
    timed, _ = run(
        np.broadcast_to(saw[None, :, None], (1, SLOTS, ROBOTS)), link="playout", playout_s=0.22
    )
    assert not values["late_commands"][30:].any()
    errors = [np.sqrt((record.tracking_error_m[0, 100:] ** 2).mean()) for record in (played, timed)]
    assert errors[0] < errors[1] < 0.04


@pytest.mark.parametrize("latency", [2, 3])
def test_packets_are_known_for_as_long_as_what_was_played_of_them(run, latency):
    """Old packets, of which a controller that hears late has to know what was in them."""
    delay_s, latency_s = 0.02 * (12 + latency), 0.02 * latency
    played, values = run(delay_s, latency_s, link="packetised")
    wanted, _ = run(delay_s, latency_s)
    np.testing.assert_allclose(
        played.control[0, -100:], wanted.control[0, -100:], rtol=1e-4, atol=1e-5
    )
    assert np.abs(values["command_gap"][-100:]).max() < 1e-12


@pytest.mark.parametrize(
    "control",
    [
        {"link": "playout", "playout_s": 3.9},
        {"link": "packetised", "packet_samples": 200},
        {"link": "playout", "stamp_error_samples": -300},
        {"stamp_error_samples": -300},
    ],
)
def test_plans_beyond_the_end_of_a_run_do_no_harm(smoke_scenario, make_simulator, control):
    """Twenty samples of a run whose commands are for later, or whose stamps lie before it."""
    sections = {"control": {**LQG, **control}}
    scenario = vary(smoke_scenario, sections)
    simulator = make_simulator(1, 40, gains=scenario_gains(scenario), **sections)
    record = simulator.run_robots(np.full((1, 40, ROBOTS), 0.1))
    assert np.isfinite(record.model_values).all()
    first = record.model_values.tobytes()
    simulator.reset(simulator.state.key.copy())
    assert simulator.run_robots(np.full((1, 40, ROBOTS), 0.1)).model_values.tobytes() == first
