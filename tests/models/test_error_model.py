from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hiersched.models.plant.error_model import discretise, unicycle_error_model


def _nonlinear_error_rate(x, u, speed, turn_rate, lag):
    """Exact error dynamics of a unicycle about its reference, in the reference frame."""
    e_x, e_y, e_theta, dv, dw = x
    v, w = speed + dv, turn_rate + dw
    return np.array(
        [
            v * math.cos(e_theta) - speed + turn_rate * e_y,
            v * math.sin(e_theta) - turn_rate * e_x,
            w - turn_rate,
            (u[0] - dv) / lag,
            (u[1] - dw) / lag,
        ]
    )


@pytest.mark.parametrize(("speed", "turn_rate", "lag"), [(1.0, 0.0, 0.1), (0.7, -0.8, 0.25)])
def test_model_is_the_jacobian_of_the_nonlinear_unicycle(speed, turn_rate, lag):
    A_c, B_c = unicycle_error_model(speed, turn_rate, lag)
    step = 1e-6
    for j in range(5):
        d = step * np.eye(5)[j]
        forward = _nonlinear_error_rate(d, (0, 0), speed, turn_rate, lag)
        backward = _nonlinear_error_rate(-d, (0, 0), speed, turn_rate, lag)
        np.testing.assert_allclose(A_c[:, j], (forward - backward) / (2 * step), atol=1e-8)
    for j in range(2):
        rate = _nonlinear_error_rate(np.zeros(5), np.eye(2)[j], speed, turn_rate, lag)
        np.testing.assert_allclose(B_c[:, j], rate, atol=1e-12)


def test_zero_order_hold_agrees_with_integration():
    A_c, B_c = unicycle_error_model(1.0, 0.4, 0.1)
    A, B = discretise(A_c, B_c, 0.07)
    x0, u = np.array([0.1, -0.2, 0.3, 0.4, -0.5]), np.array([0.6, -0.7])
    end = solve_ivp(lambda _, x: A_c @ x + B_c @ u, (0, 0.07), x0, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(A @ x0 + B @ u, end.y[:, -1], rtol=0, atol=1e-10)


def test_two_steps_make_one_of_twice_the_interval():
    model = unicycle_error_model(1.3, 0.2, 0.15)
    A, B = discretise(*model, 0.02)
    A2, B2 = discretise(*model, 0.04)
    np.testing.assert_allclose(A @ A, A2, atol=1e-14)
    np.testing.assert_allclose(A @ B + B, B2, atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((math.nan, 0.0, 0.1), "speed_mps is nan"),
        ((1.0, math.inf, 0.1), "turn_rate_radps is inf"),
        ((1.0, 0.0, 0.0), "actuator_lag_s is 0.0"),
    ],
)
def test_model_rejects(arguments, message):
    with pytest.raises(ValueError, match=message):
        unicycle_error_model(*arguments)


@pytest.mark.parametrize(
    ("A_c", "B_c", "sampling_s", "message"),
    [
        (np.zeros((2, 3)), np.zeros((2, 1)), 0.1, r"A_c has shape \(2, 3\)"),
        (np.zeros((2, 2)), np.zeros((3, 1)), 0.1, r"B_c has shape \(3, 1\)"),
        (np.full((2, 2), np.nan), np.zeros((2, 1)), 0.1, r"A_c\[0, 0\] is nan"),
        (np.zeros((2, 2)), np.zeros((2, 1)), -0.1, "sampling_s is -0.1"),
    ],
)
def test_discretise_rejects(A_c, B_c, sampling_s, message):
    with pytest.raises(ValueError, match=message):
        discretise(A_c, B_c, sampling_s)
