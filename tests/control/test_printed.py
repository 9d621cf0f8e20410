from __future__ import annotations

import numpy as np
import pytest

from hiersched.control.printed import printed_inequality, violating_direction


def _definite(rng, n):
    factor = rng.standard_normal((n, n))
    return factor @ factor.T + 0.1 * np.eye(n)


def _indefinite(rng, n):
    factor = rng.standard_normal((n, n))
    return factor + factor.T


def _singular(rng, n):
    factor = rng.standard_normal((n, n - 1))
    return factor @ factor.T


@pytest.mark.parametrize("make_P", [_definite, _indefinite, _singular])
def test_printed_matrix_is_never_negative_definite(make_P):
    rng = np.random.default_rng(11)
    for _ in range(300):
        n, m = int(rng.integers(2, 5)), int(rng.integers(1, 3))
        scale = 10.0 ** rng.uniform(-3, 1)
        A, A_d = scale * rng.standard_normal((n, n)), scale * rng.standard_normal((n, n))
        B, K, P = rng.standard_normal((n, m)), rng.standard_normal((m, n)), make_P(rng, n)
        alpha, T = rng.uniform(0, 0.99), int(rng.integers(0, 30))
        M = printed_inequality(A, A_d, B, K, P, alpha, T)
        v = violating_direction(M, P)
        rounding = 1e-12 * np.linalg.norm(M)
        assert np.linalg.norm(v) == pytest.approx(1.0)
        assert v @ M @ v >= -rounding
        assert np.linalg.eigvalsh(M)[-1] >= -rounding


def test_a_trivially_stable_loop_fails_it_at_every_gain():
    # x+ = 0.5 x + 0.1 x_d + u is stable without any control, under any delay.
    gains = np.linspace(-2, 2, 81)
    largest = [
        np.linalg.eigvalsh(printed_inequality([[0.5]], [[0.1]], [[1.0]], [[k]], [[1.0]], a, T))[-1]
        for k in gains
        for a in (0.0, 0.01, 0.3)
        for T in (0, 1, 10)
    ]
    assert min(largest) >= 0.1**2  # the (2, 2) entry alone is gamma * 0.1^2, gamma >= 1


def test_its_blocks_are_a_congruence_plus_a_diagonal():
    rng = np.random.default_rng(5)
    n, m, alpha, T = 4, 2, 0.2, 7
    A, A_d = rng.standard_normal((n, n)), rng.standard_normal((n, n))
    B, K, P = rng.standard_normal((n, m)), rng.standard_normal((m, n)), _definite(rng, n)
    gamma, zero = 1 + alpha * T, np.zeros((n, n))
    F = np.hstack([A, A_d, B @ K @ P])
    diagonal = np.block(
        [
            [-(1 - alpha) * P, zero, zero],
            [zero, (gamma - 1) * A_d.T @ P @ A_d, zero],
            [zero, zero, -P],
        ]
    )
    M = printed_inequality(A, A_d, B, K, P, alpha, T)
    np.testing.assert_allclose(M, F.T @ P @ F + diagonal, atol=1e-12 * np.linalg.norm(M))


def test_the_loop_closes_only_on_a_fictitious_third_state():
    """(x, x_d, w): the matrix describes u = +Y w with w free; w = -P^-1 x gives back -K x."""
    rng = np.random.default_rng(6)
    n, m = 3, 2
    A, A_d, B = (rng.standard_normal(shape) for shape in ((n, n), (n, n), (n, m)))
    K, P = rng.standard_normal((m, n)), _definite(rng, n)
    x, x_d = rng.standard_normal(n), rng.standard_normal(n)
    F = np.hstack([A, A_d, B @ K @ P])
    closed = F @ np.concatenate([x, x_d, -np.linalg.solve(P, x)])
    np.testing.assert_allclose(closed, (A - B @ K) @ x + A_d @ x_d, atol=1e-10)


def test_printed_inequality_rejects():
    eye = np.eye(2)
    with pytest.raises(ValueError, match=r"decay_rate is 1\.0"):
        printed_inequality(eye, eye, eye, eye, eye, 1.0, 1)
    with pytest.raises(ValueError, match=r"K has shape \(1, 2\)"):
        printed_inequality(eye, eye, eye, np.ones((1, 2)), eye, 0.1, 1)
