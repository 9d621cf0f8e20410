"""The predictor: feedback of the state that the delayed measurement and the inputs since imply."""

from __future__ import annotations

from typing import SupportsIndex

import numpy as np
import numpy.typing as npt

from hiersched.control.checks import FloatArray, as_plant, as_samples, spectral_radius


def predictor_gains(
    A: npt.ArrayLike, B: npt.ArrayLike, K: npt.ArrayLike, delay_steps: SupportsIndex
) -> tuple[FloatArray, FloatArray]:
    """Return the gains of u(k) = -K x^(k), x^ predicted over T samples from x(k-T) and inputs.

    x^(k) = A^T x(k-T) + sum_{i=0}^{T-1} A^i B u(k-1-i), so that u(k) = -G x(k-T) - sum H_i
    u(k-1-i) with G = K A^T, shape (m, n), and H_i = K A^i B, shape (T, m, m), the newest input
    first. If T is the delay at hand and the model is right, x^ = x: the loop is the one without
    delay, even while the delay varies. If not, nothing is proven; `input_memory_radii` shows the
    constant delays.
    """
    A, B, G = as_plant(A, B, K)
    T = as_samples("delay_steps", delay_steps)
    H = np.empty((T, B.shape[1], B.shape[1]))
    for i in range(T):
        H[i] = G @ B
        G = G @ A
    return G, H


def input_memory_radii(
    A: npt.ArrayLike,
    B: npt.ArrayLike,
    G: npt.ArrayLike,
    H: npt.ArrayLike,
    max_delay_steps: SupportsIndex,
) -> FloatArray:
    """Return the spectral radius of u(k) = -G x(k-d) - sum H_i u(k-1-i) at each delay d = 0..T.

    G has shape (m, n), H (inputs, m, m), the newest input first; the radii, shape (T + 1,), are
    exact for constant delays. The lifted state is [x(k), G x(k-1), ..., G x(k-d), u(k-1), ...].
    For a predictor made for T the entry T is the delay it expects; the others show what a mistaken
    delay does.
    """
    A, B, G = as_plant(A, B, G, "G")
    n, m = B.shape
    H = np.array(H, dtype=np.float64)
    if H.ndim != 3 or H.shape[1:] != (m, m) or not np.isfinite(H).all():
        raise ValueError(f"H has shape {H.shape}; it must be (any, {m}, {m}) and finite")
    steps = as_samples("max_delay_steps", max_delay_steps)
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
