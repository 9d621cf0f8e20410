"""Loops with a delay, lifted to delay-free systems: spectra and simulation, with NumPy alone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from hiersched.control.checks import FloatArray, as_delay_steps, as_square, spectral_radius

IntArray = npt.NDArray[np.int64]


def lift(A_c: npt.ArrayLike, A_d: npt.ArrayLike, delay_steps: int) -> FloatArray:
    """Return the delay-free matrix that acts on [x(k), ..., x(k-T)] at the constant delay T.

    Parameters
    ----------
    A_c, A_d : array_like, shape (n, n)
        Undelayed and delayed matrix.
    delay_steps : int
        Constant delay T in samples, at least 0.

    Returns
    -------
    ndarray, shape (n (T+1), n (T+1))
        First block row A_c at column 0 plus A_d at column T, identity shift below.

    Raises
    ------
    ValueError
        If a matrix is malformed or the delay negative.
    """
    A_c, A_d, steps = as_loop(A_c, A_d, delay_steps)
    n = A_c.shape[0]
    lifted = np.zeros((n * (steps + 1), n * (steps + 1)))
    lifted[:n, :n] = A_c
    lifted[:n, n * steps :] += A_d
    lifted[n:, : n * steps] = np.eye(n * steps)
    return lifted


def spectral_radius_by_delay(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, max_delay_steps: int
) -> FloatArray:
    """Return the spectral radius of the lifted system for each constant delay 0..T.

    With A_d = U V of rank r, only V x has to be remembered, so the matrix has n + r d rows
    rather than n (d+1); the nonzero eigenvalues are the same.

    Parameters
    ----------
    A_c, A_d : array_like, shape (n, n)
        Undelayed and delayed matrix.
    max_delay_steps : int
        Longest delay T in samples.

    Returns
    -------
    ndarray, shape (T + 1,)
        Spectral radii.

    Raises
    ------
    ValueError
        If a matrix is malformed or the delay negative.
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
    delay_steps: int,
    *,
    runs: int = 16,
    samples: int = 500,
    seed: int = 0,
) -> tuple[FloatArray, IntArray]:
    """Simulate x(k+1) = A_c x(k) + A_d x(k-d(k)) under delays that vary at random in 0..T.

    The runs differ in how often the delay changes: at every sample in the first, every 4 (T+1)
    samples on average in the last. Each starts from a random unit vector held for k <= 0.

    Parameters
    ----------
    A_c, A_d : array_like, shape (n, n)
        Undelayed and delayed matrix.
    delay_steps : int
        Longest delay T in samples.
    runs, samples : int
        Number of runs and their length, at least 1.
    seed : int
        Seed of starts and delays: the same seed gives the same runs.

    Returns
    -------
    states : ndarray, shape (samples + 1, runs, n)
        x(0), x(1), ...
    delays : ndarray, shape (samples, runs)
        d(0), d(1), ...

    Raises
    ------
    ValueError
        If a matrix is malformed, the delay negative or a number below 1.
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


def as_loop(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, delay_steps: int
) -> tuple[FloatArray, FloatArray, int]:
    """Return the checked matrices and delay of x(k+1) = A_c x(k) + A_d x(k-d), 0 <= d <= T."""
    A_c = as_square("A_c", A_c)
    A_d = as_square("A_d", A_d, A_c.shape[0])
    return A_c, A_d, as_delay_steps("delay_steps", delay_steps)
