"""Filter, prediction and regulator: by hand, against python-control, and by simulation."""

from __future__ import annotations

import math

import numpy as np
import pytest

import control
from hiersched.control import (
    FilterModel,
    build_schedule,
    design_lqg,
    network_plant,
    simulate_lqg,
    stationary_filter,
)


def scalar(a=1.1, b=1.0, w=0.4, v=0.3):
    return FilterModel(
        A=[[a]], B=[[b]], process_covariance=[[w]], measurement_variance=np.array([v])
    )


def scalar_lqg(a=1.1, b=1.0, w=0.4, v=0.3, q=2.0, r=0.7):
    plant = network_plant([[a]], [[b]], [[q]], [[r]], sampling_s=0.1)
    return design_lqg(plant, scalar(a, b, w, v))


@pytest.fixture(scope="module")
def model():
    """Two coupled states of a plant, and a third that disturbs it."""
    return FilterModel(
        A=[[1.0, 0.1, 0.02], [0.0, 0.95, 0.1], [0.0, 0.0, 0.9]],
        B=[[0.005], [0.1], [0.0]],
        process_covariance=np.diag([1e-6, 1e-6, 0.04]),
        measurement_variance=np.array([1e-3, 1e-2]),
    )


@pytest.fixture(scope="module")
def lqg(model):
    plant = network_plant(
        model.A[:2, :2], model.B[:2], np.diag([10.0, 0.1]), [[0.1]], sampling_s=0.1
    )
    return design_lqg(plant, model)


def test_a_scalar_plant_by_hand():
    """Both Riccati equations are quadratics: p = a² p − (a b p)²/(r + b² p) + q, dually."""
    a, b, w, v, q, r = 1.1, 1.0, 0.4, 0.3, 2.0, 0.7

    def root(cost, price):
        # b = 1: p² + (price − a² price − cost) p − cost price = 0, its positive root.
        linear = price - a * a * price - cost
        return (-linear + math.sqrt(linear * linear + 4.0 * cost * price)) / 2.0

    p, s = root(w, v), root(q, r)
    found = scalar_lqg(a, b, w, v, q, r)
    assert found.regulator[0, 0] == pytest.approx(a * s / (r + s), rel=1e-12)
    assert found.filter_gain[0, 0] == pytest.approx(p / (p + v), rel=1e-12)
    assert found.covariance[0, 0] == pytest.approx(p * v / (p + v), rel=1e-12)
    # Two samples ahead: a⁴ P + a² w + w.
    ahead = a**4 * p * v / (p + v) + a * a * w + w
    assert found.prediction_covariance(2)[0, 0] == pytest.approx(ahead, rel=1e-12)


def test_the_filter_is_that_of_python_control(model):
    """Its gain is of the predictor form, A L."""
    gain, covariance = stationary_filter(model)
    C = np.eye(2, 3)
    theirs, before, _ = control.dlqe(
        model.A, np.eye(3), C, model.process_covariance, np.diag(model.measurement_variance)
    )
    np.testing.assert_allclose(model.A @ gain, theirs, rtol=1e-9)
    np.testing.assert_allclose(covariance, before - gain @ C @ before, rtol=1e-8, atol=1e-14)


def test_the_regulator_begins_with_the_nominal_gain(lqg, model):
    plant = network_plant(
        model.A[:2, :2], model.B[:2], np.diag([10.0, 0.1]), [[0.1]], sampling_s=0.1
    )
    np.testing.assert_allclose(lqg.regulator[:, :2], plant.nominal_gain, rtol=1e-9)


@pytest.mark.parametrize("age", [0, 1, 3, 6, 12])
def test_moments_at_a_constant_age_are_those_of_a_simulation(lqg, age):
    """Means over 400 runs; 1 % is five standard errors."""
    states, errors = simulate_lqg(lqg, np.full((600, 400), age), seed=age)
    for found, wanted in (
        (states[200:], lqg.second_moment(age)),
        (errors[200:], lqg.prediction_covariance(age)),
    ):
        simulated = (found**2).mean(axis=(0, 1))
        np.testing.assert_allclose(np.sqrt(simulated), np.sqrt(np.diag(wanted)), rtol=0.02)


def test_prediction_errors_are_not_white(lqg):
    """A recursion that adds them as white noise underestimates the state at long ages."""
    model, age = lqg.model, 12
    loop = model.A - model.B @ lqg.regulator
    E, X = lqg.prediction_covariance(age), np.zeros((3, 3))
    drive = model.B @ lqg.regulator
    for _ in range(2000):
        X = loop @ X @ loop.T + drive @ E @ drive.T + model.process_covariance
    assert math.sqrt(X[0, 0]) < 0.9 * math.sqrt(lqg.second_moment(age)[0, 0])


def test_no_sequence_of_known_ages_makes_the_loop_grow(lqg):
    """A sawtooth and ages that jump at random, under which gains for each delay may diverge."""
    rng = np.random.default_rng(0)
    saw = np.resize([1, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 12], 3000)
    jumps = rng.integers(0, 13, 3000)
    states, _ = simulate_lqg(lqg, np.stack([saw, jumps], axis=1), seed=1)
    bound = 6.0 * math.sqrt(lqg.second_moment(12)[0, 0])
    assert np.abs(states[:, :, 0]).max() < bound


def test_what_separation_certifies(lqg):
    certificate = lqg.certificate(5)
    assert certificate.certified
    assert certificate.criterion == "separation"
    loop = lqg.model.A - lqg.model.B @ lqg.regulator
    regulated = np.abs(np.linalg.eigvals(loop)).max()
    corrected = lqg.model.A - lqg.filter_gain @ np.eye(2, 3) @ lqg.model.A
    filtered = np.abs(np.linalg.eigvals(corrected)).max()
    assert certificate.margins["regulator"] == pytest.approx(1.0 - regulated)
    assert certificate.margins["filter"] == pytest.approx(1.0 - filtered)
    assert certificate.spectral_radii.tolist() == [max(regulated, filtered)] * 6


def test_a_schedule_carries_the_filter_and_is_read_back(lqg, model):
    plant = network_plant(
        model.A[:2, :2], model.B[:2], np.diag([10.0, 0.1]), [[0.1]], sampling_s=0.1
    )
    schedule = build_schedule(plant, 4, "lqg", model=model)
    read = type(schedule).from_json(schedule.to_json())
    read.verify(plant, model)
    assert read.lqg is not None
    assert set(read.status) == {"nominal"}
    for name in ("regulator", "filter_gain", "covariance"):
        np.testing.assert_array_equal(getattr(read.lqg, name), getattr(lqg, name))
    assert read.key == schedule.key != build_schedule(plant, 5, "lqg", model=model).key


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"measurement_variance": np.array([0.0])}, "measurement_variance is"),
        ({"measurement_variance": np.ones(2)}, "measurement_variance has shape"),
        ({"process_covariance": [[-1.0]]}, "process_covariance is not positive semidefinite"),
        ({"B": [[1.0], [2.0]]}, "B has shape"),
    ],
)
def test_a_malformed_model_is_named(values, message):
    good = {"A": [[1.0]], "B": [[1.0]], "process_covariance": [[1.0]]}
    with pytest.raises(ValueError, match=message):
        FilterModel(**{**good, "measurement_variance": np.ones(1), **values})


def test_a_mode_that_nothing_disturbs_has_no_stationary_filter():
    with pytest.raises(ValueError, match="no stationary filter"):
        stationary_filter(scalar(a=1.0, w=0.0))


def test_the_method_needs_a_model_and_no_other_has_one(model):
    plant = network_plant([[0.9]], [[1.0]], [[1.0]], [[1.0]], sampling_s=0.1)
    with pytest.raises(ValueError, match="model is missing"):
        build_schedule(plant, 2, "lqg")
    with pytest.raises(ValueError, match="model is given"):
        build_schedule(plant, 2, "krasovskii", model=scalar())
    with pytest.raises(ValueError, match="measures 2 states"):
        design_lqg(plant, model)
