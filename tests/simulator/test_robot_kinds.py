"""Robots that differ: each is the robot of a scenario in which all are of its kind."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hiersched.cli import main
from hiersched.control import GainSchedule, count_transitions, spectral_radius_by_delay
from hiersched.core.randomness import world_keys
from hiersched.experiments.events import slot_events
from hiersched.log import LogReader
from hiersched.scenario import (
    ScenarioError,
    kinds_of_robots,
    load_resolved,
    load_scenario,
    scenario_to_dict,
    with_values,
)
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
LAG = {"robot.actuator_lag_s": 0.2}
COMPARED = (
    *("state", "control", "tracking_error_m", "control_saturated"),
    *("gain_delay_steps", "model_values"),
)
FAST = {"robot.actuator_lag_s": 0.05, "robot.noise_heading_rad": 0.02}


def with_kinds(scenario, noise=None, **kinds):
    """Let robots differ; kinds are name -> (robots, values)."""
    data = scenario_to_dict(scenario)
    if noise is None:  # a study of noise is of robots that are alike in it
        data["gain_study"] |= {"noise_position_m": [], "noise_heading_rad": []}
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
    assert not any(kind.robot_kinds for kind in kinds)
    assert_robots_of_their_kinds(scenario, schedule, together)
    assert scenario.kind_of_robot == (0, 2, 1, 2)
    assert not np.array_equal(schedule.kinds[0].nominal, schedule.nominal)


def test_a_second_block_of_robots_has_its_kinds_too(smoke_scenario):
    """Lanes hold 16 robots; commands wait in a buffer, newer packets replace older ones."""
    many = vary(
        smoke_scenario,
        {"users": {"num_urllc": 19, "num_embb": 1}, "radio": {"num_prb": 20},
         "traffic": {"urllc_offered_mbps": 1.0, "embb_offered_mbps": 1.0}},
    )  # fmt: skip
    for control, robot in (
        ({"method": "lqg", "link": "playout", "playout_s": 0.06}, {}),
        ({"method": "lqg", "delay": "age"}, {"superseding": "packet"}),
    ):
        alike = vary(many, {"control": {**control, "hold_samples": 0}, "robot": robot})
        scenario = with_kinds(alike, slow=((1, 15, 17), SLOW), fast=((16, 18), FAST))
        schedule = design_schedule(scenario)
        assert_robots_of_their_kinds(scenario, schedule, run(scenario, schedule))


def assert_robots_of_their_kinds(scenario, schedule, together):
    """Compare each robot with the one of its number in a world in which all are of its kind."""
    num_robots = scenario.users.num_urllc
    of_kinds = [
        run(kind, replace(own, kinds=()))
        for kind, own in zip(kinds_of_robots(scenario), (schedule, *schedule.kinds), strict=True)
    ]
    for robot, kind in enumerate(scenario.kind_of_robot):
        for name in COMPARED:
            found, wanted = getattr(together, name), getattr(of_kinds[kind], name)
            if name == "model_values":
                found, wanted = found[..., robot::num_robots], wanted[..., robot::num_robots]
            else:
                found, wanted = found[:, :, robot], wanted[:, :, robot]
            assert found.tobytes() == wanted.tobytes(), (name, robot)


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
    assert_robots_of_their_kinds(scenario, schedule, together)
    assert together.control_saturated[:, :, 0].any()


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


def test_a_model_that_knows_no_kinds_refuses_them(smoke_scenario, monkeypatch):
    monkeypatch.setattr(type(smoke_scenario.plant), "kind_keys", ())
    with pytest.raises(ScenarioError, match="in: nothing"):
        with_kinds(smoke_scenario, slow=((1,), SLOW))


def test_the_order_of_kinds_changes_nothing(smoke_scenario):
    """Mappings are equal whatever their order, and so are the gains that each robot gets."""
    one = with_kinds(smoke_scenario, slow=((0,), SLOW), fast=((1,), FAST))
    other = with_kinds(smoke_scenario, fast=((1,), FAST), slow=((0,), SLOW))
    assert one == other
    assert scenario_key(one) == scenario_key(other)
    for scenario in (one, other):
        kinds = kinds_of_robots(scenario)
        lags = [kinds[kind].robot.actuator_lag_s for kind in scenario.kind_of_robot]
        own = smoke_scenario.robot.actuator_lag_s
        assert lags == [SLOW["robot.actuator_lag_s"], FAST["robot.actuator_lag_s"], own, own]


def test_a_key_in_which_robots_differ_is_not_varied(smoke_scenario):
    scenario = with_kinds(smoke_scenario, slow=((1,), {"robot.actuator_lag_s": 0.2}))
    with pytest.raises(ScenarioError, match="robots of the kind slow have their own"):
        with_values(scenario, {"robot.actuator_lag_s": 0.3}, "axis")
    assert smoke_scenario.gain_study.noise_position_m
    with pytest.raises(ScenarioError, match=r"must be \[\] where robots of a kind .*\.a\)"):
        with_kinds(smoke_scenario, noise="as it is", a=((1,), {"robot.noise_position_m": 0.01}))


def test_a_log_of_robots_that_differ_is_replayed(tmp_path, capsys):
    path, log = tmp_path / "kinds.yaml", tmp_path / "run.mcap"
    path.write_text(
        "extends: smoke\ncontrol: {method: lqg}\n"
        "robot_kinds: {slow: {robots: [1], values: {robot.actuator_lag_s: 0.2}}}\n"
    )
    run = ["run", str(path), "--policy", "pf", "--seconds", "2", "--out", str(log)]
    assert main(run) == 0
    assert main(["replay", str(log)]) == 0
    assert "every bit the same" in capsys.readouterr().out
    damaged = GainSchedule.from_json(LogReader(log).attachments["schedule.json"].decode())
    assert len(damaged.kinds) == 1


def test_an_event_names_robots_whose_own_gain_is_not_certified(smoke_scenario):
    control = {"method": "krasovskii", "hold_samples": 0, "gain": "adjusted"}
    scenario = with_kinds(vary(smoke_scenario, {"control": control}), slow=((1,), LAG))
    schedule = design_schedule(vary(smoke_scenario, {"control": control}))
    delay = schedule.status.index("adjusted")
    bad = replace(schedule.certificates[delay], certified=False)
    worse = replace(
        schedule,
        status=tuple("uncertified" if d == delay else s for d, s in enumerate(schedule.status)),
        certificates=tuple(bad if d == delay else c for d, c in enumerate(schedule.certificates)),
    )
    fields = {
        "hol_delay_s": np.zeros((6, scenario.num_users)),
        "delay_capped": np.zeros((6, 4)),
        "delay_steps": np.full((6, 4), delay, np.uint32),
        "control_saturated": np.zeros((6, 4), np.uint32),
    }
    events = slot_events(scenario, replace(schedule, kinds=(worse,)), fields)
    assert [event.message.partition(":")[0] for event in events] == ["robot 1"]
