"""Logs of robots that know their reference, scored as if their set-points had been late."""

from __future__ import annotations

import numpy as np
import pytest

from hiersched.core.randomness import world_keys
from hiersched.replay.measures import late_set_point_error_m
from hiersched.scenario import load_scenario, with_values
from hiersched.simulator import Simulator
from hiersched.simulator.gain_source import scenario_gains

PRESENT = {
    "robot.set_point": "present",
    "control.loop": "network",
    "control.sampling_s": 0.02,
    "control.delay": "sojourn",
}


def test_a_constant_delay_costs_its_way():
    error, speed, delay = np.full((50, 2), 0.03), np.full((50, 2), 0.8), np.full((50, 2), 0.05)
    scored = late_set_point_error_m(error, speed, delay, 0.01)
    np.testing.assert_allclose(scored, 0.05)  # 3 cm and 0.8 m/s for 50 ms: 5 cm


def test_a_lag_is_smoothed_by_the_loop():
    """A delay of 0.1 s from slot 1 on: after 0.1 s it counts for 1 - 1 / e."""
    delay = np.zeros((12, 1))
    delay[1:] = 0.1
    scored = late_set_point_error_m(np.zeros((12, 1)), np.ones((12, 1)), delay, 0.01)
    assert scored[10, 0] == pytest.approx(0.1 * (1.0 - np.exp(-1.0)))


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("policy", "load", "coefficient_mbps"),
    [
        ("edf", 0.9, 0.2),
        ("drift_plus_penalty", 0.9, 0.2),
        ("max_weight", 0.9, 0.2),
        ("edf", 1.0, 0.0),
        ("drift_plus_penalty", 1.0, 0.2),
        ("max_weight", 1.0, 0.2),
    ],
)
def test_the_score_is_that_of_robots_that_hold(policy, load, coefficient_mbps):
    """Within 5 % of the simulated robots, pooled over six worlds of 17 s.

    Where queues answer to how well the robots track, the two runs are of other queues: under EDF at
    load 1.0 that alone makes 13 %, so its robots do not act on their queues there.
    """
    keys = world_keys("late", 1, 6)
    records = {}
    for name, values in (("hold", {}), ("present", PRESENT)):
        values = {
            "traffic.load": load,
            "traffic.service_coefficient_mbps": coefficient_mbps,
            **values,
        }
        scenario = with_values(load_scenario("teleop_fading"), values, "")
        simulator = Simulator(scenario, scenario_gains(scenario), keys, 2000)
        records[name] = simulator.run(policy)
    present = records["present"]
    scored = [
        late_set_point_error_m(
            present.tracking_error_m[env],
            present.reference[env, ..., 3],
            present.network_delay_s[env],
            0.01,
        )
        for env in range(6)
    ]
    held = np.sqrt(np.mean(records["hold"].tracking_error_m[:, 300:] ** 2))
    assert np.sqrt(np.mean(np.array(scored)[:, 300:] ** 2)) == pytest.approx(held, rel=0.05)
