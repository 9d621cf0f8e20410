"""The filter in the slot loop, against a Kalman filter written out in NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hiersched.control import build_schedule, design_lqg, dlqr
from hiersched.core.randomness import world_keys
from hiersched.models.model import model_fields
from hiersched.models.plant.error_model import discretise, slipping_error_model
from hiersched.scenario import load_scenario
from hiersched.simulator import Simulator
from hiersched.simulator.gain_source import scenario_gains
from hiersched.simulator.loop_gains import filter_model_of, loop_gains, plant_of

from .conftest import vary

LQG = {"method": "lqg", "hold_samples": 0}
SLOTS = 160


@pytest.fixture(scope="module")
def run(smoke_scenario, make_simulator):
    """Simulator of robots with a filter, after forced delays that rise and fall."""

    def make(delay_s=None, **sections):
        sections = {**sections, "control": {**LQG, **sections.get("control", {})}}
        scenario = vary(smoke_scenario, sections)
        simulator = make_simulator(1, SLOTS, gains=scenario_gains(scenario), **sections)
        if delay_s is None:
            delay_s = np.random.default_rng(2).uniform(0.0, 0.3, (1, SLOTS, 4))
        return scenario, simulator, simulator.run_robots(delay_s)

    return make


def kalman(model, regulator, history, commands, steps, model_at=None, stamp_error=0):
    """Return the inputs -K x^(k) before limits, written out.

    `steps` (samples,) is how old the newest measurement is; `model_at(k)` gives A and B.
    """
    n, size = history.shape[1], len(model.A)
    A_of = (lambda k: (model.A, model.B)) if model_at is None else model_at
    C, x, stamp, found = np.eye(n, size), np.zeros(size), -1, []
    for k in range(len(steps)):
        newest = k - int(steps[k])
        while stamp < min(k, newest + stamp_error):
            if stamp >= 0:
                A, B = A_of(stamp)
                x = A @ x + B @ commands[stamp]
            stamp += 1
            if 0 <= stamp - stamp_error <= newest:
                x = x + model.gain @ (history[stamp - stamp_error] - C @ x)
        now = x.copy()
        for j in range(max(stamp, 0), k):
            A, B = A_of(j)
            now = A @ now + B @ commands[j]
        found.append(-regulator @ now)
    return np.array(found)


class _Model:
    """A filter's model with a gain that is found by iteration, not by a Riccati solver."""

    def __init__(self, model):
        self.A, self.B = model.A, model.B
        self.measurement_variance = model.measurement_variance
        n, size = len(model.measurement_variance), len(model.A)
        C, R, P = np.eye(n, size), np.diag(model.measurement_variance), np.eye(size)
        for _ in range(3000):
            before = self.A @ P @ self.A.T + model.process_covariance
            self.gain = before @ C.T @ np.linalg.inv(C @ before @ C.T + R)
            P = before - self.gain @ C @ before


def own_regulator(scenario, model):
    plant, size = plant_of(scenario), len(model.A)
    Q = np.zeros((size, size))
    Q[:5, :5] = plant.Q
    return dlqr(model.A, model.B, Q, plant.R)[0]


def expected(scenario, simulator, record, robot, **options):
    model = filter_model_of(scenario)
    memory = simulator.words["plant"].memory
    wanted = kalman(
        _Model(model),
        own_regulator(scenario, model),
        memory.history[0, robot],
        memory.commands[0, robot],
        record.delay_steps[0, ::2, robot],
        **options,
    )
    limits = [scenario.robot.max_speed_mps, scenario.robot.max_turn_rate_radps]
    return np.clip(wanted, -np.array(limits), limits)


@pytest.mark.parametrize("stamp_error", [0, 1, -1])
def test_commands_are_those_of_a_kalman_filter(run, stamp_error):
    scenario, simulator, record = run(control={"stamp_error_samples": stamp_error})
    assert len(np.unique(record.delay_steps)) > 10
    for robot in range(4):
        wanted = expected(scenario, simulator, record, robot, stamp_error=stamp_error)
        np.testing.assert_allclose(record.control[0, ::2, robot], wanted, rtol=1e-6, atol=1e-8)


def test_known_motion_is_that_of_the_reference(run):
    """The model of each interval, discretised by the library: speed and turn rate at its middle."""
    scenario, simulator, record = run(
        control={"known_motion": True}, robot={"reference": "zigzag", "reference_pace": 1.3}
    )
    operator = simulator.words["plant"].operator
    for robot in range(4):

        def model_at(k, start=int(operator.offset[0, robot])):
            row = operator.path[start + 8 * k + 4]
            turn_rate = round(row[0] / 0.1) * 0.1
            return discretise(*slipping_error_model(row[4], turn_rate, 0.1, 0.3), 0.02)

        wanted = expected(scenario, simulator, record, robot, model_at=model_at)
        np.testing.assert_allclose(record.control[0, ::2, robot], wanted, rtol=1e-6, atol=1e-8)
        assert np.abs(operator.path[:, 0]).max() > 4.0


def test_what_is_believed_decides_and_not_what_is(run):
    believed = {"believed_lag_s": 0.1, "believed_slip_time_s": 0.3}
    scenario, simulator, record = run(
        control=believed, robot={"actuator_lag_s": 0.15, "slip_time_s": 0.05}
    )
    wanted = expected(scenario, simulator, record, 0)
    np.testing.assert_allclose(record.control[0, ::2, 0], wanted, rtol=1e-6, atol=1e-8)
    A = filter_model_of(scenario).A
    assert A[3, 3] == pytest.approx(np.exp(-0.02 / 0.1))
    assert A[5, 5] == pytest.approx(np.exp(-0.02 / 0.3))


def test_no_age_is_capped_and_robots_start_known(run):
    """Until the first measurement arrives nothing is to be corrected."""
    delay_s = np.full((1, SLOTS, 4), 1.0)
    _, _, record = run(delay_s)
    assert not record.delay_capped.any()
    assert not record.control[0, :100].any()
    assert record.control[0, 102:].any()


def test_a_simulator_wants_the_filter_of_its_scenario(make_simulator, nominal_gains):
    with pytest.raises(ValueError, match="lqg: missing"):
        make_simulator(1, 10, control=LQG)


@pytest.mark.parametrize("known", [False, True])
def test_the_log_has_estimate_age_and_expected_error(run, smoke_scenario, known):
    """Estimates predict what the robots do: errors are as large as the filter expects them."""
    rng = np.random.default_rng(5)
    delay_s = rng.uniform(0.0, 0.24, (1, SLOTS, 4))
    scenario, _, record = run(
        delay_s, robot={"reference": "straight"}, control={"known_motion": known}
    )
    fields = {f.name: slice(f.start, f.start + f.count) for f in model_fields(scenario)}
    values = {name: record.model_values[0][:, place] for name, place in fields.items()}
    ages = values["plant/estimate_age"]
    assert (ages[1::2] == ages[0::2]).all()
    assert len(np.unique(ages)) > 6
    assert (ages[40::2] <= record.delay_steps[0, 40::2]).all()  # what has arrived stays there
    lqg = scenario_gains(scenario).lqg
    for age in (1, 5):
        E = lqg.prediction_covariance(age)
        expected = np.sqrt(E[0, 0] + E[1, 1])
        np.testing.assert_allclose(values["plant/estimate_std"][ages == age], expected, rtol=1e-9)
    # A sample's estimate against the state at its time, the end of the slot before.
    error = [values[f"plant/estimate_{i}"][2::2] - record.state[0, 1:-1:2, :, i] for i in range(2)]
    ratio = np.hypot(*error) / values["plant/estimate_std"][2::2]
    assert 0.8 < np.sqrt((ratio[20:] ** 2).mean()) < 1.25


@pytest.mark.parametrize("age", [1, 3, 6, 12])
def test_a_linear_robot_is_as_far_off_as_the_closed_form_says(age):
    """The pendulum in the slot loop, whose angle is state 2; no delay beyond the schedule's."""
    scenario = load_scenario("linear_plant")
    plant = replace(scenario.plant, error_states=(2,))
    control = replace(scenario.control, **LQG, max_delay_s=0.24)
    scenario = replace(scenario, plant=plant, control=control)
    lqg = design_lqg(plant_of(scenario), filter_model_of(scenario))
    gains = loop_gains(build_schedule(plant_of(scenario), 12, "lqg", model=lqg.model), "adjusted")
    simulator = Simulator(scenario, gains, world_keys("test", 1, 8), 3000)
    record = simulator.run_robots(np.full((8, 3000, 4), 0.02 * age))
    found = np.sqrt((record.tracking_error_m[:, 500:] ** 2).mean())
    assert found == pytest.approx(np.sqrt(lqg.second_moment(age)[2, 2]), rel=0.1)
    assert not record.control_saturated.any()


def test_superseded_measurements_are_predicted_over(run, make_simulator, smoke_scenario):
    """Only what arrived corrects: covariances then follow the textbook's recursion."""
    sections = {
        "robot": {"superseding": "batch"},
        "control": {**LQG, "delay": "age", "sampling_s": 0.005},
        "traffic": {"load": 2.5},
    }
    scenario = vary(smoke_scenario, sections)
    simulator = make_simulator(1, SLOTS, gains=scenario_gains(scenario), **sections)
    record = simulator.run("pf")
    assert record.superseded_packets.sum() > 50
    own = simulator.words["plant"].memory
    model, arrived = filter_model_of(scenario), own.filter.arrived[0]
    C, R = np.eye(5, 7), np.diag(model.measurement_variance)
    for robot in range(4):
        count = int(own.filter.filtered[0, robot])
        assert 0.1 * count < arrived[robot, :count].sum() < 0.8 * count
        x, P = np.zeros(7), np.zeros((7, 7))
        for stamp in range(count):
            if stamp > 0:
                x = model.A @ x + model.B @ own.commands[0, robot, stamp - 1]
                P = model.A @ P @ model.A.T + model.process_covariance
            if arrived[robot, stamp]:
                L = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
                x = x + L @ (own.history[0, robot, stamp] - C @ x)
                P = P - L @ C @ P
        np.testing.assert_allclose(own.filter.estimate[0, robot], x, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(own.filter.covariance[0, robot], P, rtol=1e-5, atol=1e-12)
