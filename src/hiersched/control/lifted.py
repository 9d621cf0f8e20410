"""Loops with a delay, lifted to delay-free systems: spectra and simulation, with NumPy alone."""

from __future__ import annotations

from typing import SupportsIndex

import numpy as np
import numpy.typing as npt

from hiersched.control.checks import FloatArray, as_loop, spectral_radius

IntArray = npt.NDArray[np.int64]


def lift(
    A_c: npt.ArrayLike,
    A_d: npt.ArrayLike,
    delay_steps: SupportsIndex,
    window: int | None = None,
) -> FloatArray:
    """Return M of z(k+1) = M z(k), z = [x(k), ..., x(k-H)], at the constant delay T.

    The first block row has A_c at column 0 plus A_d at column T, the others shift; H is `window`,
    at least T, or T where none is given. Shape (n (H+1), n (H+1)).
    """
    A_c, A_d, T = as_loop(A_c, A_d, delay_steps)
    n, H = A_c.shape[0], T if window is None else window
    lifted = np.eye(n * (H + 1), k=-n)
    lifted[:n, :n] = A_c
    lifted[:n, n * T : n * (T + 1)] += A_d
    return lifted


def spectral_radius_by_delay(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, max_delay_steps: SupportsIndex
) -> FloatArray:
    """Return the spectral radius of the lifted system at each constant delay 0..T, shape (T + 1,).

    With A_d = U V of rank r, only V x has to be remembered, so the matrix has n + r d rows
    rather than n (d+1); the nonzero eigenvalues are the same.
    """
    A_c, A_d, steps = as_loop(A_c, A_d, max_delay_steps)
    n = A_c.shape[0]
    left, singular, V = np.linalg.svd(A_d)
    rank = int(np.count_nonzero(singular > n * np.finfo(float).eps * singular[0]))
    U, V = left[:, :rank] * singular[:rank], V[:rank]
    radii = np.empty(steps + 1)
    radii[0] = spectral_radius(A_c + A_d)
    for delay in range(1, steps + 1):
        matrix = np.zeros((n + rank * delay, n + rank * delay))
        matrix[:n, :n] = A_c
        matrix[:n, n + rank * (delay - 1) :] = U
        matrix[n : n + rank, :n] = V
        matrix[n + rank :, n : n + rank * (delay - 1)] = np.eye(rank * (delay - 1))
        radii[delay] = spectral_radius(matrix)
    return radii


def simulate_random_delays(
    A_c: npt.ArrayLike,
    A_d: npt.ArrayLike,
    delay_steps: SupportsIndex,
    *,
    runs: int = 16,
    samples: int = 500,
    seed: int = 0,
) -> tuple[FloatArray, IntArray]:
    """Simulate x(k+1) = A_c x(k) + A_d x(k-d(k)) under delays that vary at random in 0..T.

    Returns x(0), x(1), ..., shape (samples + 1, runs, n), and the delays, shape (samples, runs).
    Each run starts from a random unit vector held for k <= 0. The delay changes at every sample in
    the first run, every 4 (T+1) samples on average in the last. The same seed gives the same runs.
    """
    A_c, A_d, T = as_loop(A_c, A_d, delay_steps)
    for name, count in (("runs", runs), ("samples", samples)):
        if count < 1:
            raise ValueError(f"{name} is {count}; it must be at least 1")
    rng = np.random.default_rng(seed)
    starts = rng.standard_normal((runs, A_c.shape[0]))
    delays = rng.integers(0, T + 1, (samples, runs))
    kept = rng.random((samples, runs)) >= np.geomspace(1.0, 1.0 / (4 * (T + 1)), runs)
    # Index of the last sample at which the delay changed; the first draw always counts.
    last_change = np.where(kept, 0, np.arange(samples)[:, None])
    delays = np.take_along_axis(delays, np.maximum.accumulate(last_change, axis=0), axis=0)
    states = np.empty((samples + 1, *starts.shape))
    states[0] = starts / np.linalg.norm(starts, axis=1, keepdims=True)
    columns = np.arange(runs)
    for k in range(samples):
        late = states[np.maximum(k - delays[k], 0), columns]
        states[k + 1] = states[k] @ A_c.T + late @ A_d.T
    return states, delays
