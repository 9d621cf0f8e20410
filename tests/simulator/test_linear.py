"""Robots that are linear plants, in the slot loop, against a twin in NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hiersched.control import build_schedule, hold_delays
from hiersched.core.randomness import world_keys
from hiersched.models.plant.linear import Linear
from hiersched.simulator import Simulator
from hiersched.simulator.loop_gains import loop_gains, plant_of

PLANT = Linear(
    A=((1.0, 0.02, 0.0), (0.0, 1.0, 0.02), (0.0, 0.0, 0.9)),
    A_d=None,
    B=((0.0, 0.0), (0.02, 0.0), (0.0, 0.1)),
    Q=((10.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.1)),
    R=((0.1, 0.0), (0.0, 0.1)),
    process_noise=(0.001, 0.0, 0.02),
    measurement_noise=(0.002, 0.003, 0.0),
    input_limits=(0.05, 0.08),
    error_states=(0, 2),
)
COUPLED = replace(PLANT, A_d=((0.0, 0.0, 0.0), (-0.03, -0.02, 0.0), (0.0, 0.0, 0.02)))


@pytest.fixture
def linear_simulator(smoke_scenario):
    """Simulator of four plants with its schedule, and the scenario."""

    def make(num_envs=2, num_slots=120, plant=PLANT, slot_s=0.01, **control):
        own = {"max_delay_s": 0.08, **control}
        scenario = replace(
            smoke_scenario,
            control=replace(smoke_scenario.control, **own),
            radio=replace(smoke_scenario.radio, slot_s=slot_s),
            plant=plant,
        )
        model = plant_of(scenario)
        schedule = build_schedule(model, scenario.max_delay_steps, scenario.control.method)
        gains = loop_gains(schedule, scenario.control.gain)
        keys = world_keys("linear", 1, num_envs)
        return Simulator(scenario, gains, keys, num_slots), gains

    return make


def twin(simulator, gains, record, env, robot):
    """States, inputs and whether they met their limits, sample by sample."""
    section, control = simulator.scenario.plant, simulator.scenario.control
    A, B = np.array(section.A), np.array(section.B)
    A_d = np.zeros_like(A) if section.A_d is None else np.array(section.A_d)
    limits = np.array(section.input_limits)
    per_sample = round(control.sampling_s / simulator.scenario.radio.slot_s)
    steps = record.delay_steps[env, ::per_sample, robot].astype(int)
    largest = simulator.scenario.max_delay_steps
    entries = hold_delays(np.minimum(steps, largest), control.hold_samples)
    normals = record.robot_normal[env, ::per_sample, robot].astype(float)
    n, before = len(A), max(largest, steps.max())
    x, y = [np.zeros(n)] * (before + 1), [np.zeros(n)] * before
    u, saturated = [np.zeros(B.shape[1])] * before, []
    for T, entry, z in zip(steps, entries, normals, strict=True):
        y.append(x[-1] + section.measurement_noise * z[n:])
        wanted = -gains.network_gains[entry] @ y[-1 - T] - gains.local_gains[entry] @ y[-1]
        wanted -= sum(gains.input_gains[entry, i] @ u[-1 - i] for i in range(largest))
        u.append(np.clip(wanted, -limits, limits))
        saturated.append((np.abs(wanted) > limits).any())
        x.append(A @ x[-1] + A_d @ x[-1 - T] + B @ u[-1] + section.process_noise * z[:n])
    return np.array(x[before:]), np.array(u[before:]), np.array(saturated)


@pytest.mark.parametrize(
    ("plant", "slot_s", "control"),
    [
        (PLANT, 0.01, {}),
        (PLANT, 0.02, {"hold_samples": 3}),
        (PLANT, 0.01, {"gain": "nominal"}),
        (PLANT, 0.01, {"method": "predictor", "hold_samples": 0}),
        (COUPLED, 0.01, {}),
    ],
)
def test_slot_loop_is_its_twin(linear_simulator, plant, slot_s, control):
    simulator, gains = linear_simulator(plant=plant, slot_s=slot_s, **control)
    delay_s = np.random.default_rng(1).uniform(0.0, 0.09, (2, 120, 4))
    record = simulator.run_robots(delay_s)
    per_sample = round(0.02 / slot_s)
    assert record.state.shape == (2, 120, 4, 3)
    assert record.control.shape == (2, 120, 4, 2)
    assert record.robot_normal.shape == (2, 120, 4, 6)
    for env, robot in np.ndindex(2, 4):
        x, u, saturated = twin(simulator, gains, record, env, robot)
        # At the end of a sample's last slot the state is the next one; it is held before.
        np.testing.assert_allclose(
            record.state[env, per_sample - 1 :: per_sample, robot], x[1:], rtol=1e-9, atol=1e-14
        )
        np.testing.assert_allclose(
            record.control[env, ::per_sample, robot], u, rtol=1e-9, atol=1e-14
        )
        held = np.repeat(np.hypot(x[:-1, 0], x[:-1, 2]), per_sample)
        np.testing.assert_allclose(
            record.tracking_error_m[env, :, robot], held, rtol=1e-9, atol=1e-14
        )
        np.testing.assert_array_equal(record.control_saturated[env, ::per_sample, robot], saturated)
    assert record.control_saturated.any()
    assert record.delay_capped.any()
    assert not record.reference.any()


def test_index_of_a_window_is_that_of_its_tracking_error(linear_simulator):
    simulator, _ = linear_simulator(num_slots=101)
    record = simulator.run_robots(np.full((2, 101, 4), 0.03))
    te_cm = 100 * np.sqrt((record.tracking_error_m[:, :100] ** 2).mean(axis=1))
    assert (te_cm < 10).all()
    expected = 0.4 * (1 - te_cm / 10) + 0.3 + 0.3
    np.testing.assert_allclose(record.dexterity_index[:, 100], expected, rtol=1e-12)


def test_normals_are_standard_and_their_own(linear_simulator):
    """Every state of every robot has its own draws, and another slot has others."""
    simulator, _ = linear_simulator(num_envs=8, num_slots=400)
    normals = simulator.run_robots(np.zeros((8, 400, 4))).robot_normal
    flat = normals.reshape(8 * 400, -1)
    assert abs(normals.mean()) < 0.02
    assert normals.std() == pytest.approx(1.0, abs=0.02)
    others = np.corrcoef(flat.T) - np.eye(24)
    assert np.abs(others).max() < 0.1
    assert len(np.unique(flat[:, 0])) == len(flat)


def test_the_whole_cell_runs(linear_simulator, assert_same_bits):
    """Delays come from the network; a batch has the bits of its worlds alone."""
    simulator, gains = linear_simulator()
    keys = simulator.state.key.copy()
    record = simulator.run("pf")
    assert record.network_delay_s.std() > 0
    assert 0 < record.tracking_error_m.max() < 1
    for env in range(2):
        alone = Simulator(simulator.scenario, gains, keys[env : env + 1], 120).run("pf")
        for name in record._fields:
            assert getattr(alone, name)[0].tobytes() == getattr(record, name)[env].tobytes(), name
