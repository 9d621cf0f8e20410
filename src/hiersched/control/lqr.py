"""Discrete linear-quadratic regulator, and its usual correction for a known latency."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy.linalg import fractional_matrix_power, solve_discrete_are

from hiersched.control.checks import (
    FloatArray,
    as_definite,
    as_matrix,
    as_plant,
    as_positive,
    as_semidefinite,
    as_square,
)

ComplexArray = npt.NDArray[np.complex128]


def dlqr(
    A: npt.ArrayLike, B: npt.ArrayLike, Q: npt.ArrayLike, R: npt.ArrayLike
) -> tuple[FloatArray, FloatArray, ComplexArray]:
    """Solve the infinite-horizon discrete linear-quadratic regulator.

    Minimises the sum of x^T Q x + u^T R u over x(k+1) = A x(k) + B u(k) with u = -K x. Returns the
    gain K = (R + B^T S B)^-1 B^T S A, shape (m, n), the solution S of the Riccati equation, shape
    (n, n), and the n eigenvalues of A - B K, as python-control's `dlqr` does.

    Q must be positive semidefinite, R positive definite, (A, B) stabilisable, and Q must leave no
    mode on the unit circle unseen; else a ValueError says which is not so.
    """
    A = as_square("A", A)
    B = as_matrix("B", B, (A.shape[0], None))
    Q = as_semidefinite("Q", Q, A.shape[0])
    R = as_definite("R", R, B.shape[1])
    for eigenvalue in np.linalg.eigvals(A):
        if abs(eigenvalue) >= 1.0 - 1e-9 and _lost_rank(A, B, eigenvalue):
            raise ValueError(
                f"(A, B) is not stabilisable: no input moves the mode of A at {eigenvalue:.6g}"
            )
        if abs(abs(eigenvalue) - 1.0) < 1e-6 and _lost_rank(A.T, Q, eigenvalue):
            raise ValueError(
                f"Q does not see the mode of A at {eigenvalue:.6g}, on the unit circle: "
                "no solution of the Riccati equation is stabilising"
            )
    try:
        S = np.asarray(solve_discrete_are(A, B, Q, R), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise ValueError(f"the Riccati equation of (A, B, Q, R) was not solved: {error}") from error
    K = np.asarray(np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A), dtype=np.float64)
    return K, S, np.linalg.eigvals(A - B @ K).astype(np.complex128)


def _lost_rank(A: FloatArray, B: FloatArray, eigenvalue: complex) -> bool:
    """Popov-Belevitch-Hautus: B does not reach the mode where [lambda I - A, B] loses rank."""
    pencil = np.hstack([eigenvalue * np.eye(A.shape[0]) - A, B])
    singular = np.linalg.svd(pencil, compute_uv=False)
    return bool(singular[-1] <= 1e-10 * max(1.0, float(singular[0])))


def tracking_weights(weight: float, sampling_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the weights Q = h diag(q, q, q/10, 0, 0) and R = h I of the tracking regulator.

    They weigh x = (e_x, e_y, e_theta, dv, dw) and u = (u_v, u_w); q is in 1/m^2, relative to a
    unit weight on the commands, and the sampling interval h in s makes the sum approximate an
    integral. Both must be finite and greater than 0.
    """
    q, h = as_positive("weight", weight), as_positive("sampling_s", sampling_s)
    return h * np.diag([q, q, q / 10.0, 0.0, 0.0]), h * np.eye(2)


def latency_compensated(
    K: npt.ArrayLike, A: npt.ArrayLike, B: npt.ArrayLike, delay_steps: float
) -> FloatArray:
    """Detune a gain for a known constant latency of T samples: K (A - B K)^T, shape (m, n).

    The gain acts on the state that the loop is expected to reach after the latency (WPILib's
    `LinearQuadraticRegulator.latencyCompensate`). It carries no certificate. T need not be whole;
    a ValueError says where it is negative, or (A - B K)^T not real.
    """
    A, B, K = as_plant(A, B, K)
    if not (math.isfinite(delay_steps) and delay_steps >= 0.0):
        raise ValueError(f"delay_steps is {delay_steps!r}; it must be finite and at least 0")
    power = np.asarray(fractional_matrix_power(A - B @ K, delay_steps))
    if np.abs(np.imag(power)).max() > 1e-9 * max(1.0, float(np.abs(power).max())):
        raise ValueError(
            f"(A - B K)^{delay_steps:g} is not real: A - B K has an eigenvalue on the negative "
            "real axis; use a whole number of samples"
        )
    return K @ np.real(power).astype(np.float64)
