from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from hiersched.control import dlqr, latency_compensated, tracking_weights


def _elevator(motors, mass_kg, radius_m, gearing, sampling_s):
    """WPILib's elevator with n Vex 775 Pro motors."""
    volts, torque, current = 12.0, 0.71 * motors, 134.0 * motors
    free_current, free_speed = 0.7 * motors, 18730.0 * 2 * math.pi / 60
    resistance = volts / current
    kv = free_speed / (volts - resistance * free_current)
    kt = torque / current
    block = np.zeros((3, 3))
    block[0, 1] = 1.0
    block[1, 1] = -(gearing**2) * kt / (resistance * radius_m**2 * mass_kg * kv)
    block[1, 2] = gearing * kt / (resistance * radius_m * mass_kg)
    transition = expm(block * sampling_s)
    return transition[:2, :2], transition[:2, 2:]


def _bryson(tolerances):
    return np.diag([1 / q**2 for q in tolerances])


def test_wpilib_elevator():
    A, B = _elevator(2, 5.0, 0.0181864, 1.0, 0.00505)
    K, _, _ = dlqr(A, B, _bryson((0.02, 0.4)), _bryson((12.0,)))
    np.testing.assert_allclose(K, [[522.15314269, 38.20138596]], rtol=1e-9)


def test_wpilib_elevator_with_latency():
    A, B = _elevator(4, 8.0, 0.75 * 0.0254, 14.67, 0.020)
    K, _, _ = dlqr(A, B, _bryson((0.1, 0.2)), _bryson((12.0,)))
    np.testing.assert_allclose(K, [[10.38, 0.69]], atol=5e-3)
    compensated = latency_compensated(K, A, B, 0.010 / 0.020)
    np.testing.assert_allclose(compensated, [[8.97115941, 0.07904881]], atol=1e-3)


@st.composite
def systems(draw):
    n, m = draw(st.integers(1, 5)), draw(st.integers(1, 3))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    factor = rng.standard_normal((n, n))
    weight = rng.standard_normal((m, m))
    return (
        rng.standard_normal((n, n)),
        rng.standard_normal((n, m)),
        factor @ factor.T + 0.1 * np.eye(n),
        weight @ weight.T + 0.1 * np.eye(m),
    )


@settings(max_examples=60, deadline=None, derandomize=True)
@given(systems())
def test_riccati_residual_vanishes_and_the_loop_is_stable(system):
    A, B, Q, R = system
    K, S, E = dlqr(A, B, Q, R)
    gain = np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A)
    residual = A.T @ S @ A - S - A.T @ S @ B @ gain + Q
    assert np.abs(residual).max() < 1e-8 * np.linalg.norm(S)
    assert np.abs(E).max() < 1.0
    # The gain's cost from any state is x^T S x: solve the Lyapunov equation by summation.
    loop, cost = A - B @ K, Q + K.T @ R @ K
    total, power = np.zeros_like(S), np.eye(len(A))
    for _ in range(400):
        total += power.T @ cost @ power
        power = loop @ power
    if np.abs(E).max() < 0.95:
        np.testing.assert_allclose(total, S, rtol=1e-6, atol=1e-8 * np.linalg.norm(S))


def test_agrees_with_python_control():
    import control

    rng = np.random.default_rng(7)
    for n, m in ((1, 1), (3, 2), (5, 2)):
        A, B = rng.standard_normal((n, n)), rng.standard_normal((n, m))
        ours, theirs = dlqr(A, B, np.eye(n), np.eye(m)), control.dlqr(A, B, np.eye(n), np.eye(m))
        np.testing.assert_allclose(ours[0], theirs[0], rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(ours[1], theirs[1], rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(np.sort_complex(ours[2]), np.sort_complex(theirs[2]), atol=1e-8)


def test_tracking_weights():
    Q, R = tracking_weights(700.0, 0.02)
    np.testing.assert_allclose(Q, np.diag([14.0, 14.0, 1.4, 0.0, 0.0]))
    np.testing.assert_allclose(R, 0.02 * np.eye(2))


def test_latency_of_whole_samples_is_a_matrix_power():
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
    K = np.array([[3.0, 2.5]])
    loop = A - B @ K
    np.testing.assert_allclose(latency_compensated(K, A, B, 2), K @ loop @ loop, rtol=1e-12)
    np.testing.assert_allclose(latency_compensated(K, A, B, 0), K, rtol=1e-12)


def test_latency_needs_a_real_power():
    K, A, B = np.array([[1.5]]), np.array([[1.0]]), np.array([[1.0]])
    assert latency_compensated(K, A, B, 2)[0, 0] == pytest.approx(1.5 * 0.25)
    with pytest.raises(ValueError, match="not real"):
        latency_compensated(K, A, B, 0.5)
    with pytest.raises(ValueError, match="delay_steps is -1"):
        latency_compensated(K, A, B, -1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"A": np.ones((2, 3))}, r"A has shape \(2, 3\); it must be square"),
        ({"A": np.array([[1.0, np.nan], [0.0, 1.0]])}, r"A\[0, 1\] is nan"),
        ({"B": np.ones((3, 1))}, r"B has shape \(3, 1\); it must be \(2, any\)"),
        ({"Q": np.diag([1.0, -1.0])}, "Q is not positive semidefinite"),
        ({"Q": np.array([[1.0, 1.0], [0.0, 1.0]])}, "Q is not symmetric"),
        ({"R": np.zeros((1, 1))}, "R is not positive definite"),
        ({"B": np.array([[1.0], [0.0]]), "A": np.diag([0.5, 1.1])}, "not stabilisable"),
        ({"Q": np.zeros((2, 2))}, "Q does not see the mode"),
    ],
)
def test_dlqr_rejects(changes, message):
    arguments = {
        "A": np.array([[1.0, 0.1], [0.0, 1.0]]),
        "B": np.array([[0.005], [0.1]]),
        "Q": np.eye(2),
        "R": np.eye(1),
    } | changes
    with pytest.raises(ValueError, match=message):
        dlqr(**arguments)


@pytest.mark.parametrize(("weight", "sampling_s"), [(0.0, 0.02), (700.0, -1.0), (math.nan, 0.02)])
def test_tracking_weights_reject(weight, sampling_s):
    with pytest.raises(ValueError, match="greater than 0"):
        tracking_weights(weight, sampling_s)
