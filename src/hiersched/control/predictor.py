"""The predictor: feedback of the state that the delayed measurement and the inputs since imply."""

from __future__ import annotations

from typing import SupportsIndex

import numpy as np
import numpy.typing as npt

from hiersched.control.checks import (
    FloatArray,
    as_delay_steps,
    as_matrix,
    as_square,
    spectral_radius,
)


def predictor_gains(
    A: npt.ArrayLike, B: npt.ArrayLike, K: npt.ArrayLike, delay_steps: SupportsIndex
) -> tuple[FloatArray, FloatArray]:
    """Return the gains of u(k) = -K x^(k), x^ predicted over T samples from x(k-T) and inputs.

    x^(k) = A^T x(k-T) + sum_{i=0}^{T-1} A^i B u(k-1-i), so that u(k) = -G x(k-T) - sum H_i
    u(k-1-i) with G = K A^T and H_i = K A^i B. If T is the delay at hand and the model is right,
    x^ = x: the loop is the one without delay, even while the delay varies. If not, nothing is
    proven; `input_memory_radii` shows the constant delays.

    Parameters
    ----------
    A : array_like, shape (n, n)
        State matrix.
    B : array_like, shape (n, m)
        Input matrix.
    K : array_like, shape (m, n)
        Gain designed without delay.
    delay_steps : int
        Delay T in samples.

    Returns
    -------
    G : ndarray, shape (m, n)
        Gain on the delayed state.
    H : ndarray, shape (T, m, m)
        Gains on the last T inputs, the newest first.

    Raises
    ------
    ValueError
        If a matrix is malformed or the delay negative.
    """
    A = as_square("A", A)
    B = as_matrix("B", B, (A.shape[0], None))
    K = as_matrix("K", K, (B.shape[1], A.shape[0]))
    T = as_delay_steps("delay_steps", delay_steps)
    H = np.empty((T, B.shape[1], B.shape[1]))
    G = K
    for i in range(T):
        H[i] = G @ B
        G = G @ A
    return G, H


def input_memory_radii(
    A: npt.ArrayLike, B: npt.ArrayLike, G: npt.ArrayLike, H: npt.ArrayLike, max_delay_steps: int
) -> FloatArray:
    """Return the spectral radius of u(k) = -G x(k-d) - sum H_i u(k-1-i) at each delay d = 0..T.

    The lifted state is [x(k), G x(k-1), ..., G x(k-d), u(k-1), ..., u(k-T)]. For a predictor made
    for T the entry T is the delay it expects; the others show what a mistaken delay does.

    Parameters
    ----------
    A, B : array_like, shape (n, n) and (n, m)
        Plant.
    G : array_like, shape (m, n)
        Gain on the delayed state.
    H : array_like, shape (inputs, m, m)
        Gains on past inputs, the newest first.
    max_delay_steps : int
        Longest delay T in samples.

    Returns
    -------
    ndarray, shape (T + 1,)
        Spectral radii, each exact for its constant delay.

    Raises
    ------
    ValueError
        If a matrix is malformed or the delay negative.
    """
    A = as_square("A", A)
    n = A.shape[0]
    B = as_matrix("B", B, (n, None))
    m = B.shape[1]
    G, H = as_matrix("G", G, (m, n)), np.array(H, dtype=np.float64)
    if H.ndim != 3 or H.shape[1:] != (m, m) or not np.isfinite(H).all():
        raise ValueError(f"H has shape {H.shape}; it must be (any, {m}, {m}) and finite")
    steps = as_delay_steps("max_delay_steps", max_delay_steps)
    inputs = len(H)
    radii = np.empty(steps + 1)
    for delay in range(steps + 1):
        late, size = n + m * delay, n + m * (delay + inputs)
        # The input as a function of the lifted state: G x(k-d) is its last remembered product.
        u = np.zeros((m, size))
        u[:, late - m : late] = -np.eye(m)
        if delay == 0:
            u[:, :n] = -G
        u[:, late:] = -np.hstack(list(H)) if inputs else 0.0
        lifted = np.eye(size, k=-m)  # every memory moves down by one sample
        lifted[:n] = B @ u
        lifted[:n, :n] += A
        lifted[n : n + m if delay else n] = 0.0
        if delay:
            lifted[n : n + m, :n] = G
        if inputs:
            lifted[late : late + m] = u
        radii[delay] = spectral_radius(lifted)
    return radii
