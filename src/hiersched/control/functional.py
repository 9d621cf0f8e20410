"""Quadratic functionals of the recent states as matrices: their decrease and their jumps.

A functional V = z^T F z of z = [x(k), ..., x(k-H)] proves stability in a mode z(k+1) = M z(k) if
M^T F M < F. Here that is checked with eigenvalues, mode by mode, with NumPy alone: it shares
nothing with the inequality that the functional came from, bounds and all.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hiersched.control.checks import FloatArray, symmetrised
from hiersched.control.lifted import lift


def lifted_modes(A_c: FloatArray, A_d: FloatArray, delay_steps: int, window: int) -> FloatArray:
    """Return M_d of z(k+1) = M_d z(k) for d = 0..T, shape (T + 1, n (H+1), n (H+1)), H >= T."""
    return np.stack([lift(A_c, A_d, delay, window) for delay in range(delay_steps + 1)])


def krasovskii_form(
    P: FloatArray, S: Sequence[FloatArray], R: Sequence[FloatArray], limits: Sequence[int]
) -> FloatArray:
    """Return the matrix of a Krasovskii functional whose weights change at h_1 < ... < h_N.

    V = x^T P x + sum_s [sum_{l in s} x(k-l)^T S_s x(k-l) + w_s sum_{j in s} sum_{l=1..j}
    eta(k-l)^T R_s eta(k-l)], where segment s holds h_{s-1} < l <= h_s (h_0 = 0), w_s = h_s -
    h_{s-1} and eta(k) = x(k+1) - x(k). N = 1 is C3's. P and the N weights S_s and R_s are (n, n),
    the h_s (`limits`) in samples; the result has shape (n (h_N + 1), n (h_N + 1)).
    """
    n, window = P.shape[0], limits[-1] if limits else 0
    past = np.split(np.eye(n * (window + 1)), window + 1)
    form = past[0].T @ P @ past[0]
    start = 0
    for S_s, R_s, stop in zip(S, R, limits, strict=True):
        for lag in range(start + 1, stop + 1):
            form += past[lag].T @ S_s @ past[lag]
        for lag in range(1, stop + 1):
            eta = past[lag - 1] - past[lag]
            count = (stop - start) * (stop - max(lag, start + 1) + 1)
            form += count * (eta.T @ R_s @ eta)
        start = stop
    return symmetrised(form)


def extended(form: FloatArray, P: FloatArray, contraction: float, window: int) -> FloatArray:
    """Return V plus a geometric tail over x(k-1), ..., x(k-H), so that it sees the whole window.

    If V falls by r (`contraction`, below 1) a sample and x^T P x <= V, the sum falls by at least
    theta = (1 + r) / 2: the tail (1-r)/2 sum_l theta^(l-1) x(k-l)^T P x(k-l) takes no more than
    that. Shape (n (H+1), n (H+1)).
    """
    theta = (1.0 + contraction) / 2.0
    weights = (1.0 - theta) * theta ** np.arange(window)
    result = np.kron(np.diag([0.0, *weights]), P)
    result[: len(form), : len(form)] += form
    return np.asarray(result, dtype=np.float64)


def contraction(form: FloatArray, modes: FloatArray) -> float:
    """Return the largest V(k+1) / V(k) over all states and modes; infinite if V is not positive.

    Below 1, V proves stability, however the modes M of z(k+1) = M z(k) follow each other. A bound
    on the rounding error, 100 eps times the condition of V, is added.
    """
    if np.linalg.eigvalsh(form)[0] <= 0.0:
        return np.inf
    L = np.linalg.cholesky(form)
    moved = L.T @ modes @ np.linalg.inv(L).T
    rounding = 100.0 * float(np.finfo(float).eps) * float(np.linalg.cond(form))
    return float(np.linalg.norm(moved, ord=2, axis=(1, 2)).max() ** 2) + rounding


def jump(entered: FloatArray, left: FloatArray) -> float:
    """Return the largest V_entered / V_left at one state: by how much a switch can raise V."""
    L_inverse = np.linalg.inv(np.linalg.cholesky(left))
    return float(np.linalg.eigvalsh(L_inverse @ entered @ L_inverse.T)[-1])


def worst_period(
    first: FloatArray, second: FloatArray, lengths: Sequence[int]
) -> tuple[float, int, int]:
    """Search a periodic switching, p samples in one mode and q in the other, that diverges.

    Returns the largest spectral radius per sample over p and q in `lengths`, exact for its period,
    with its p and q. At 1 or more no common function exists, quadratic or not.
    """
    powers = [[np.linalg.matrix_power(mode, k) for k in lengths] for mode in (first, second)]
    worst = (0.0, 0, 0)
    for p, F in zip(lengths, powers[0], strict=True):
        products = F @ np.stack(powers[1])
        radii = np.abs(np.linalg.eigvals(products)).max(axis=1) ** (1.0 / (p + np.array(lengths)))
        at = int(radii.argmax())
        if radii[at] > worst[0]:
            worst = float(radii[at]), p, lengths[at]
    return worst
