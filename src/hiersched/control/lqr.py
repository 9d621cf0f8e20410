"""Discrete linear-quadratic regulator, and its usual correction for a known latency."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy.linalg import fractional_matrix_power, solve_discrete_are

from hiersched.control.checks import (
    FloatArray,
    as_matrix,
    as_square,
    as_symmetric,
    require_definite,
    require_semidefinite,
)

ComplexArray = npt.NDArray[np.complex128]


def dlqr(
    A: npt.ArrayLike, B: npt.ArrayLike, Q: npt.ArrayLike, R: npt.ArrayLike
) -> tuple[FloatArray, FloatArray, ComplexArray]:
    """Solve the infinite-horizon discrete linear-quadratic regulator.

    Minimises the sum of x^T Q x + u^T R u over x(k+1) = A x(k) + B u(k) with u = -K x; the
    same signature and order of results as python-control's `dlqr`.

    Parameters
    ----------
    A : array_like, shape (n, n)
        State matrix.
    B : array_like, shape (n, m)
        Input matrix.
    Q : array_like, shape (n, n)
        State weight, positive semidefinite.
    R : array_like, shape (m, m)
        Input weight, positive definite.

    Returns
    -------
    K : ndarray, shape (m, n)
        State feedback gain (R + B^T S B)^-1 B^T S A.
    S : ndarray, shape (n, n)
        Solution of the discrete algebraic Riccati equation.
    E : ndarray, shape (n,), complex
        Eigenvalues of A - B K.

    Raises
    ------
    ValueError
        If a shape is wrong, an entry is not finite, Q or R is not (semi)definite, (A, B) is not
        stabilisable, or Q leaves a mode on the unit circle unseen.
    """
    A = as_square("A", A)
    n = A.shape[0]
    B = as_matrix("B", B, (n, None))
    Q = as_symmetric("Q", Q, n)
    R = as_symmetric("R", R, B.shape[1])
    require_semidefinite("Q", Q)
    require_definite("R", R)
    _require_stabilisable(A, B)
    _require_seen_on_circle(A, Q)
    try:
        S = np.asarray(solve_discrete_are(A, B, Q, R), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise ValueError(f"the Riccati equation of (A, B, Q, R) was not solved: {error}") from error
    K = np.asarray(np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A), dtype=np.float64)
    return K, S, np.linalg.eigvals(A - B @ K).astype(np.complex128)


def _require_stabilisable(A: FloatArray, B: FloatArray) -> None:
    """Popov-Belevitch-Hautus: [lambda I - A, B] has full row rank where |lambda| >= 1."""
    for eigenvalue in np.linalg.eigvals(A):
        if abs(eigenvalue) >= 1.0 - 1e-9 and _lost_rank(A, B, eigenvalue):
            raise ValueError(
                f"(A, B) is not stabilisable: no input moves the mode of A at {eigenvalue:.6g}"
            )


def _require_seen_on_circle(A: FloatArray, Q: FloatArray) -> None:
    """Require that Q sees every mode with |lambda| = 1, or no solution is stabilising."""
    for eigenvalue in np.linalg.eigvals(A):
        if abs(abs(eigenvalue) - 1.0) < 1e-6 and _lost_rank(A.T, Q, eigenvalue):
            raise ValueError(
                f"Q does not see the mode of A at {eigenvalue:.6g}, on the unit circle: "
                "no solution of the Riccati equation is stabilising"
            )


def _lost_rank(A: FloatArray, B: FloatArray, eigenvalue: complex) -> bool:
    pencil = np.hstack([eigenvalue * np.eye(A.shape[0]) - A, B])
    singular = np.linalg.svd(pencil, compute_uv=False)
    return bool(singular[-1] <= 1e-10 * max(1.0, float(singular[0])))


def tracking_weights(weight: float, sampling_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the weights Q = h diag(q, q, q/10, 0, 0) and R = h I of the tracking regulator.

    Parameters
    ----------
    weight : float
        Position weight q in 1/m^2, greater than 0 (relative to a unit weight on the commands).
    sampling_s : float
        Sampling interval h in s, greater than 0; it makes the sum approximate an integral.

    Returns
    -------
    Q : ndarray, shape (5, 5)
        Weight of x = (e_x, e_y, e_theta, dv, dw).
    R : ndarray, shape (2, 2)
        Weight of u = (u_v, u_w).

    Raises
    ------
    ValueError
        If a value is not finite or not positive.
    """
    for name, value in (("weight", weight), ("sampling_s", sampling_s)):
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} is {value!r}; it must be finite and greater than 0")
    Q = sampling_s * np.diag([weight, weight, weight / 10.0, 0.0, 0.0])
    return Q, sampling_s * np.eye(2)


def latency_compensated(
    K: npt.ArrayLike, A: npt.ArrayLike, B: npt.ArrayLike, delay_steps: float
) -> FloatArray:
    """Detune a gain for a known constant latency: K (A - B K)^T.

    The gain acts on the state that the loop is expected to reach after the latency (WPILib's
    `LinearQuadraticRegulator.latencyCompensate`). It carries no certificate.

    Parameters
    ----------
    K : array_like, shape (m, n)
        Gain designed without latency.
    A : array_like, shape (n, n)
        State matrix.
    B : array_like, shape (n, m)
        Input matrix.
    delay_steps : float
        Latency T in samples, at least 0; need not be whole.

    Returns
    -------
    ndarray, shape (m, n)
        The compensated gain.

    Raises
    ------
    ValueError
        If a shape is wrong, T is negative, or (A - B K)^T is not real.
    """
    A = as_square("A", A)
    B = as_matrix("B", B, (A.shape[0], None))
    K = as_matrix("K", K, (B.shape[1], A.shape[0]))
    if not (math.isfinite(delay_steps) and delay_steps >= 0.0):
        raise ValueError(f"delay_steps is {delay_steps!r}; it must be finite and at least 0")
    power = np.asarray(fractional_matrix_power(A - B @ K, delay_steps))
    if np.abs(np.imag(power)).max() > 1e-9 * max(1.0, float(np.abs(power).max())):
        raise ValueError(
            f"(A - B K)^{delay_steps:g} is not real: A - B K has an eigenvalue on the negative "
            "real axis; use a whole number of samples"
        )
    return K @ np.real(power).astype(np.float64)
