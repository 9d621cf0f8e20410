"""Predictor, latency compensation and H2: what they promise, and that nothing is pretended."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from hiersched.control import (
    build_schedule,
    certify,
    design_gain,
    h2_cost,
    h2_gain,
    input_memory_radii,
    latency_compensated,
    network_plant,
    predictor_gains,
    spectral_radius_by_delay,
)


@pytest.fixture(scope="module")
def small_plant():
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
    return network_plant(A, B, np.diag([3.0, 0.0]), np.array([[0.1]]), sampling_s=0.1)


def _run(plant, gain, input_gains, delays, x0):
    """u(k) = -G x(k-d) - sum H_i u(k-1-i), written out; the gains are those of the delay d."""
    states, inputs = [x0], []
    for k, d in enumerate(delays):
        u = -gain(d) @ states[max(k - d, 0)]
        for i, H in enumerate(input_gains(d)):
            if i < len(inputs):
                u = u - H @ inputs[-1 - i]
        inputs.append(u)
        states.append(plant.A @ states[-1] + plant.B @ u)
    return np.array(states)


def test_predicting_a_known_delay_is_the_loop_without_delay(small_plant):
    """Even while the delay varies: x^ = x once T samples of inputs exist."""
    plant, rng = small_plant, np.random.default_rng(1)
    K, x0 = plant.nominal_gain, np.array([1.0, -0.5])
    delays = np.minimum(rng.integers(0, 6, 80), np.arange(80))  # nothing is known before k = 0
    tables = {T: predictor_gains(plant.A, plant.B, K, T) for T in range(6)}
    states = _run(plant, lambda d: tables[d][0], lambda d: tables[d][1], delays, x0)
    expected, x = [x0], x0
    for _ in delays:
        x = (plant.A - plant.B @ K) @ x
        expected.append(x)
    np.testing.assert_allclose(states, expected, atol=1e-12)


def test_predictor_radii_are_those_of_the_recursion(small_plant):
    plant, T = small_plant, 4
    G, H = predictor_gains(plant.A, plant.B, plant.nominal_gain, T)
    assert H.shape == (T, 1, 1)
    radii = input_memory_radii(plant.A, plant.B, G, H, T)
    undelayed = np.abs(np.linalg.eigvals(plant.A - plant.B @ plant.nominal_gain)).max()
    assert radii[T] == pytest.approx(undelayed, rel=1e-6)
    for d in range(T + 1):
        states = _run(plant, lambda _: G, lambda _: H, [d] * 1200, np.array([1.0, 0.3]))
        sizes = np.linalg.norm(states, axis=1)
        growth = (sizes[900:1200].max() / sizes[600:900].max()) ** (1 / 300)
        assert growth == pytest.approx(radii[d], abs=2e-3)


def test_radii_without_input_memory_are_the_lifted_ones(small_plant):
    plant, K = small_plant, small_plant.nominal_gain
    ours = input_memory_radii(plant.A, plant.B, K, np.zeros((0, 1, 1)), 5)
    np.testing.assert_allclose(ours, spectral_radius_by_delay(*plant.closed_loop(K), 5), rtol=1e-9)


def test_h2_cost_is_the_mean_of_a_simulation(small_plant):
    plant, T = small_plant, 3
    K, rng = 0.5 * small_plant.nominal_gain, np.random.default_rng(5)
    x, pending, total, samples, runs = np.zeros((400, 2)), [], 0.0, 3000, 400
    for _ in range(samples):
        pending.append(x @ K.T)
        u = -pending.pop(0) if len(pending) > T else np.zeros((runs, 1))
        total += np.einsum("ri,ij,rj->", x, plant.Q, x) + np.einsum("ri,ij,rj->", u, plant.R, u)
        x = x @ plant.A.T + u @ plant.B.T + rng.standard_normal((runs, 2))
    assert h2_cost(plant, K, T) == pytest.approx(total / (samples * runs), rel=0.03)


def test_h2_without_delay_is_the_regulator(make_network_plant):
    plant = make_network_plant()
    np.testing.assert_array_equal(h2_gain(plant, 0, plant.nominal_gain), plant.nominal_gain)
    found = h2_gain(plant, 0, 0.7 * plant.nominal_gain)
    np.testing.assert_allclose(found, plant.nominal_gain, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("T", [1, 3, 6])
def test_h2_gain_is_a_local_optimum_that_another_optimiser_finds(small_plant, T):
    plant = small_plant
    start = plant.nominal_gain * np.array([0.02, 0.2])
    K = h2_gain(plant, T, start)
    other = minimize(
        lambda k: min(h2_cost(plant, k[None], T), 1e12),
        start[0],
        method="Nelder-Mead",
        options={"xatol": 1e-9, "fatol": 1e-12, "maxiter": 2000},
    )
    assert h2_cost(plant, K, T) == pytest.approx(other.fun, rel=1e-7)
    np.testing.assert_allclose(K[0], other.x, rtol=1e-3)


def test_h2_refuses_an_unstable_start(make_network_plant):
    plant = make_network_plant()
    assert h2_cost(plant, plant.nominal_gain, 6) == np.inf
    with pytest.raises(ValueError, match="start is not stable at the constant delay of 6 samples"):
        h2_gain(plant, 6, plant.nominal_gain)


@pytest.mark.parametrize(
    ("method", "T", "status"),
    [
        ("predictor", 6, "uncertified"),
        ("predictor", 0, "nominal"),
        ("latency_compensated", 2, "adjusted"),
        ("latency_compensated", 6, "uncertified"),
        ("latency_compensated", 0, "nominal"),
        ("h2", 6, "adjusted"),
        ("h2", 12, "uncertified"),
    ],
)
def test_alternatives_are_certified_only_where_c3_says_so(make_network_plant, method, T, status):
    plant = make_network_plant()
    design = design_gain(plant, T, method)
    assert design.status == status
    assert design.certified == (status != "uncertified")
    assert design.input_gains.shape == (T, 2, 2)
    assert design.input_gains.any() == (method == "predictor" and T > 0)
    if status == "adjusted":
        loop = plant.closed_loop(design.gain)
        assert certify(*loop, T, design.certificate.witness).certified
    if method == "latency_compensated" and T:
        expected = latency_compensated(plant.nominal_gain, plant.A, plant.B, T)
        np.testing.assert_array_equal(design.gain, expected)
    # Latency compensation is only a rule of thumb: here its loop diverges at its own delay.
    stable = design.certificate.spectral_radii[T] < 1.0
    assert stable == ((method, T) != ("latency_compensated", 6))


def test_the_predictor_reports_the_delays_it_does_not_expect(make_network_plant):
    radii = design_gain(make_network_plant(), 6, "predictor").certificate.spectral_radii
    assert radii.shape == (7,)
    assert (radii[2:4] > 1.0).all()  # a mistaken delay of 40 or 60 ms destabilises it
    assert radii[6] < 1.0


@pytest.mark.parametrize("method", ["predictor", "latency_compensated", "h2"])
def test_alternatives_need_a_network_plant(make_split_plant, method):
    with pytest.raises(ValueError, match=f"kind is 'split'; the method '{method}' needs"):
        design_gain(make_split_plant(), 2, method)


def test_tables_of_the_slot_loop_reproduce_the_predictor(make_network_plant):
    plant = make_network_plant()
    table = build_schedule(plant, 4, "predictor")
    assert table.status == ("nominal",) + ("uncertified",) * 4
    assert table.input_gains.shape == (5, 4, 2, 2)
    for T in range(5):
        G, H = predictor_gains(plant.A, plant.B, plant.nominal_gain, T)
        np.testing.assert_array_equal(table.network_gains[T], G)
        np.testing.assert_array_equal(table.input_gains[T, :T], H)
        assert not table.input_gains[T, T:].any()
    assert not table.local_gains.any()
    back = type(table).from_json(table.to_json())
    assert back.to_json() == table.to_json()
    assert back.input_gains.tobytes() == table.input_gains.tobytes()
    back.verify(plant)


def test_tables_of_a_split_plant_add_up_to_the_regulator(make_split_plant, make_network_plant):
    table = build_schedule(make_split_plant(100.0, 0.3), 1)
    regulator = make_network_plant(100.0).nominal_gain
    assert table.status == ("nominal", "nominal")
    for T in range(2):
        np.testing.assert_allclose(table.local_gains[T] + table.network_gains[T], regulator)
    assert not table.input_gains.any()
    again = type(table).from_json(table.to_json())
    assert again.network_gains.tobytes() == table.network_gains.tobytes()
