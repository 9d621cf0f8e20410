"""The matrix inequality as the paper prints it, and why it can never hold.

For tests and documentation only: no gain is computed from it. Write F = [A, A_d, B Y], 3n wide.
The printed matrix is M = F^T P F + diag(-(1-a) P, (g-1) A_d^T P A_d, -P), asked to be negative
definite. A - B K does not appear in it, Y = K P makes it cubic in (P, K), and

- if P is positive definite, (0, x_d, 0) gives g x_d^T A_d^T P A_d x_d >= 0;
- if P is singular with P v = 0, (0, 0, v) gives (B Y v)^T P (B Y v) >= 0 once P >= 0;
- if P has p negative eigenvalues, then on {(x, 0, w): x, w in their eigenspace}, of dimension
  2p, the diagonal part is positive definite and F^T P F has at most p negative directions, so M
  is positive somewhere.
"""

from __future__ import annotations

from typing import SupportsIndex

import numpy as np
import numpy.typing as npt

from hiersched.control.checks import FloatArray, as_plant, as_samples, as_square, as_symmetric


def printed_inequality(
    A: npt.ArrayLike,
    A_d: npt.ArrayLike,
    B: npt.ArrayLike,
    K: npt.ArrayLike,
    P: npt.ArrayLike,
    decay_rate: float,
    delay_steps: SupportsIndex,
) -> FloatArray:
    """Return the matrix M that the paper asks to be negative definite, shape (3n, 3n).

    K is the gain of the paper's Y = K P, `decay_rate` its alpha in [0, 1), `delay_steps` its T_d in
    gamma = 1 + alpha T_d.
    """
    A, B, K = as_plant(A, B, K)
    n = A.shape[0]
    A_d, P = as_square("A_d", A_d, n), as_symmetric("P", P, n)
    if not 0.0 <= decay_rate < 1.0:
        raise ValueError(f"decay_rate is {decay_rate!r}; it must lie in [0, 1)")
    gamma = 1.0 + decay_rate * as_samples("delay_steps", delay_steps)
    B_Y = B @ (K @ P)
    return np.block(
        [
            [A.T @ P @ A - P + decay_rate * P, A.T @ P @ A_d, A.T @ P @ B_Y],
            [A_d.T @ P @ A, gamma * A_d.T @ P @ A_d, A_d.T @ P @ B_Y],
            [B_Y.T @ P @ A, B_Y.T @ P @ A_d, B_Y.T @ P @ B_Y - P],
        ]
    )


def violating_direction(matrix: npt.ArrayLike, P: npt.ArrayLike) -> FloatArray:
    """Return a unit vector v, shape (3n,), in which the M made with P is not negative.

    v^T M v is at least 0 up to rounding. It is built from the argument at the top of this module,
    not from the spectrum of M.
    """
    P = as_symmetric("P", P)
    n = P.shape[0]
    M = as_symmetric("matrix", matrix, 3 * n)
    eigenvalues, vectors = np.linalg.eigh(P)
    tiny = n * np.finfo(float).eps * float(np.abs(eigenvalues).max())
    negative = vectors[:, eigenvalues < -tiny]
    if negative.shape[1]:
        zero = np.zeros_like(negative)
        subspace = np.block([[negative, zero], [zero, zero], [zero, negative]])
        restricted = np.linalg.eigh(subspace.T @ M @ subspace)
        return np.asarray(subspace @ restricted.eigenvectors[:, -1], dtype=np.float64)
    direction = np.zeros(3 * n)
    if abs(eigenvalues[0]) <= tiny:
        direction[2 * n :] = vectors[:, 0]
    else:
        direction[n] = 1.0
    return direction
