"""Robots that differ: each is the robot of a scenario in which all are of its kind."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hiersched.control import GainSchedule, count_transitions, spectral_radius_by_delay
from hiersched.core.randomness import world_keys
from hiersched.scenario import (
    ScenarioError,
    kinds_of_robots,
    load_resolved,
    load_scenario,
    scenario_to_dict,
    with_values,
)
from hiersched.scenario.schema import RobotKind
from hiersched.simulator import Simulator
from hiersched.simulator.gain_source import check_gains, design_schedule, scenario_key
from hiersched.simulator.loop_gains import loop_gains, nominal_gains, plant_of
from hiersched.simulator.loop_growth import greatest_growth, growth_in_force, worst_unheld

from .conftest import vary

SLOTS = 150
SLOW = {
    "robot.actuator_lag_s": 0.2,
    "robot.slip_speed_mps": 0.1,
    "robot.slip_time_s": 0.1,
    "robot.noise_position_m": 0.01,
    "robot.max_turn_rate_radps": 0.7,
}
FAST = {"robot.actuator_lag_s": 0.05, "robot.noise_heading_rad": 0.02}


def with_kinds(scenario, **kinds):
    """Let robots differ; kinds are name -> (robots, values)."""
    data = scenario_to_dict(scenario)
    data["robot_kinds"] = {
        name: {"robots": list(robots), "values": values} for name, (robots, values) in kinds.items()
    }
    return load_resolved(json.dumps(data), Path("test"))[0]


def run(scenario, schedule, slots=SLOTS):
    """Run the robots after delays that rise and fall."""
    gains = loop_gains(schedule, scenario.control.gain)
    simulator = Simulator(scenario, gains, world_keys("test", 1, 1), slots)
    shape = (1, slots, scenario.users.num_urllc)
    delay_s = np.random.default_rng(2).uniform(0.0, 0.3, shape)
    return simulator.run_robots(delay_s)


@pytest.mark.parametrize(
    "control",
    [
        {"method": "latency_compensated", "hold_samples": 5},
        {"method": "lqg", "hold_samples": 0},
        {"method": "lqg", "hold_samples": 0, "known_motion": True},
        {"method": "lqg", "hold_samples": 0, "link": "packetised"},
    ],
    ids=["gains", "filter", "motion", "packets"],
)
def test_each_unicycle_is_that_of_a_world_of_its_kind(smoke_scenario, assert_same_bits, control):
    scenario = with_kinds(
        vary(smoke_scenario, {"control": control}), slow=((1, 3), SLOW), fast=((2,), FAST)
    )
    schedule = design_schedule(scenario)
    together = run(scenario, schedule)
    kinds = kinds_of_robots(scenario)
    for kind, own in zip(kinds, (schedule, *schedule.kinds), strict=True):
        assert not kind.robot_kinds
        alone = run(kind, replace(own, kinds=()))
        number = kinds.index(kind)
        for robot in np.flatnonzero(np.array(scenario.kind_of_robot) == number):
            for name in ("state", "control", "tracking_error_m", "control_saturated"):
                found, wanted = getattr(together, name), getattr(alone, name)
                assert found[:, :, robot].tobytes() == wanted[:, :, robot].tobytes(), name
    assert scenario.kind_of_robot == (0, 1, 2, 1)
    assert not np.array_equal(schedule.kinds[0].nominal, schedule.nominal)


@pytest.mark.parametrize("method", ["latency_compensated", "lqg"])
def test_each_linear_plant_is_that_of_a_world_of_its_kind(method):
    plain = load_scenario("pendulum")
    control = {"control.method": method, "control.hold_samples": 0, "gain_study.methods": [method]}
    plain = with_values(plain, {**control, "control.max_delay_s": 0.1}, "test")
    strong = (np.array(plain.plant.B) * 2.0).tolist()
    heavy = {"plant.B": strong, "plant.input_limits": [0.5]}
    scenario = with_kinds(plain, heavy=((0, 2), heavy))
    schedule = design_schedule(scenario)
    together = run(scenario, schedule)
    kinds = kinds_of_robots(scenario)
    of_kinds = [
        run(kind, replace(own, kinds=()))
        for kind, own in zip(kinds, (schedule, *schedule.kinds), strict=True)
    ]
    for robot, kind in enumerate(scenario.kind_of_robot):
        for name in ("state", "control", "tracking_error_m", "control_saturated"):
            found, wanted = getattr(together, name), getattr(of_kinds[kind], name)
            assert found[:, :, robot].tobytes() == wanted[:, :, robot].tobytes(), name
    assert of_kinds[1].control_saturated[:, :, 0].any()


def test_gains_are_read_back_and_checked_kind_by_kind(smoke_scenario):
    scenario = with_kinds(smoke_scenario, slow=((1,), SLOW))
    schedule = design_schedule(scenario)
    again = GainSchedule.from_json(schedule.to_json())
    check_gains(again, scenario)
    np.testing.assert_array_equal(again.kinds[0].gains, schedule.kinds[0].gains)
    others = replace(schedule, kinds=())
    with pytest.raises(ValueError, match="kinds are 0; they must be 1"):
        check_gains(others, scenario)
    with pytest.raises(ValueError, match=r"kinds\[0\]: "):
        check_gains(replace(schedule, kinds=(others,)), scenario)
    with pytest.raises(ValueError, match=r"kinds\[0\] has kinds"):
        replace(schedule, kinds=(schedule,))
    assert scenario_key(scenario) != scenario_key(smoke_scenario)
    with pytest.raises(ValueError, match=r"gains\.kinds: 0, must be 1"):
        Simulator(scenario, loop_gains(others, "adjusted"), world_keys("test", 1, 1), 10)
    Simulator(scenario, nominal_gains(scenario), world_keys("test", 1, 1), 10)


@pytest.mark.parametrize(
    ("kinds", "words"),
    [
        ({"a": ((4,), SLOW)}, ["robot_kinds.a.robots = [4]", "from 0 to 3", "num_urllc = 4"]),
        ({"a": ((1, 1), SLOW)}, ["robot_kinds.a.robots", "every robot once"]),
        ({"a": ((1,), SLOW), "b": ((2, 1), FAST)}, ["robot_kinds.b.robots", "of the kind a"]),
        ({"a": ((1,), {"robot.actuator_lag": 0.2})},
         ["robot_kinds.a.values.robot.actuator_lag", "did you mean robot.actuator_lag_s"]),
        ({"a": ((1,), {"robot.window_s": 2.0})}, ["a.values.robot.window_s", "may not differ"]),
        ({"a": ((1,), {"robot.actuator_lag_s": -0.2})},
         ["robot_kinds.a.values", "robot.actuator_lag_s", "-0.2", "greater than 0"]),
        ({"a": ((), SLOW)}, ["robot_kinds.a.robots"]),
        ({"a": ((1,), {})}, ["robot_kinds.a.values"]),
    ],
)  # fmt: skip
def test_kinds_that_cannot_be(smoke_scenario, kinds, words):
    with pytest.raises(ScenarioError) as caught:
        with_kinds(smoke_scenario, **kinds)
    for word in words:
        assert word in str(caught.value)


def test_growth_is_that_of_the_robots_own_kind(smoke_scenario):
    control = {"method": "latency_compensated", "hold_samples": 0, "gain": "nominal"}
    scenario = with_kinds(
        vary(smoke_scenario, {"control": control}), fast=((2,), {"robot.actuator_lag_s": 0.03})
    )
    schedule = design_schedule(scenario)
    counts = count_transitions(np.full((50, 1), 5))
    robot, worst = worst_unheld(scenario, schedule, [counts] * 4)
    kind = kinds_of_robots(scenario)[1]
    plant = plant_of(kind)
    wanted = spectral_radius_by_delay(*plant.closed_loop(plant.nominal_gain), 5)[5] ** 2
    assert robot == 2
    assert worst == pytest.approx(wanted, rel=1e-9)
    assert worst > 1.01 * growth_in_force(kinds_of_robots(scenario)[0], schedule, counts)
    assert greatest_growth(scenario, schedule, counts) == pytest.approx(wanted, rel=1e-9)


def test_a_model_that_knows_no_kinds_refuses_them(smoke_scenario):
    scenario = replace(
        smoke_scenario, robot_kinds={"a": RobotKind(robots=(0,), values={"plant.A": [[1.0]]})}
    )
    with pytest.raises(ScenarioError, match=r"plant\.A: robots may not differ in it"):
        with_values(scenario, {"traffic.load": 0.5}, "test")
