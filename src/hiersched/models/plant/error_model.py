"""Linear error model of a unicycle that follows a reference, and its exact discretisation."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from hiersched.control.age_certificate import PlantFamily
from hiersched.control.checks import as_matrix, as_positive, as_square

FloatArray = npt.NDArray[np.float64]


def unicycle_error_model(
    speed_mps: float, turn_rate_radps: float, actuator_lag_s: float
) -> tuple[FloatArray, FloatArray]:
    """Linearise the unicycle's tracking error about a reference, with first-order actuators.

    The error is expressed in the reference frame; the commands are corrections to the reference
    speed v_r [m/s] and turn rate w_r [rad/s] that act through a lag [s]::

        e_x'  = dv + w_r e_y        dv' = (u_v - dv) / lag
        e_y'  = v_r e_theta - w_r e_x        dw' = (u_w - dw) / lag
        e_theta' = dw

    Returns the continuous A_c (5, 5) of x = (e_x, e_y, e_theta, dv, dw) and B_c (5, 2) of u = (u_v,
    u_w). ValueError if a value is not finite, or the lag not positive.
    """
    for name, value in (("speed_mps", speed_mps), ("turn_rate_radps", turn_rate_radps)):
        if not math.isfinite(value):
            raise ValueError(f"{name} is {value!r}; it must be finite")
    as_positive("actuator_lag_s", actuator_lag_s)
    A_c = np.zeros((5, 5))
    A_c[0, 1], A_c[0, 3] = turn_rate_radps, 1.0
    A_c[1, 0], A_c[1, 2] = -turn_rate_radps, speed_mps
    A_c[2, 4] = 1.0
    A_c[3, 3] = A_c[4, 4] = -1.0 / actuator_lag_s
    B_c = np.zeros((5, 2))
    B_c[3, 0] = B_c[4, 1] = 1.0 / actuator_lag_s
    return A_c, B_c


def unicycle_family(speed_mps: float, sampling_s: float) -> PlantFamily:
    """Return `unicycle_error_model` as it depends on its turn rate [rad/s] and on 1 / lag [1/s].

    It is affine in these two, the family's parameters. Errors as there.
    """

    def at(turn_rate_radps: float, lag_s: float) -> tuple[FloatArray, FloatArray]:
        return unicycle_error_model(speed_mps, turn_rate_radps, lag_s)

    base, turning, faster = at(0.0, 1.0), at(1.0, 1.0), at(0.0, 0.5)
    A_c, B_c = (
        [2.0 * one - two, turn - one, two - one]
        for one, turn, two in zip(base, turning, faster, strict=True)
    )
    return PlantFamily(A_c=A_c, B_c=B_c, sampling_s=sampling_s)


def discretise(
    A_c: npt.ArrayLike, B_c: npt.ArrayLike, sampling_s: float
) -> tuple[FloatArray, FloatArray]:
    """Discretise a linear system (A_c (n, n), B_c (n, m), in 1/s) exactly under a zero-order hold.

    Returns A = exp(A_c h), and B, the integral of exp(A_c s) B_c over one interval h =
    `sampling_s`: blocks of the exponential of [[A_c, B_c], [0, 0]] h (Van Loan), which also holds
    for a singular A_c. ValueError if shapes do not fit, an entry is not finite, or the interval is
    not positive.
    """
    state = as_square("A_c", A_c)
    inputs = as_matrix("B_c", B_c, (len(state), None))
    as_positive("sampling_s", sampling_s)
    n, m = inputs.shape
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:] = state, inputs
    transition = np.asarray(expm(block * sampling_s), dtype=np.float64)
    return transition[:n, :n].copy(), transition[:n, n:].copy()


def slipping_error_model(
    speed_mps: float, turn_rate_radps: float, actuator_lag_s: float, slip_time_s: float
) -> tuple[FloatArray, FloatArray]:
    """Extend `unicycle_error_model` by slips of speed and turn rate, Ornstein-Uhlenbeck processes.

    The states (s_v, s_w), behind those of the robot, add to what moves it, and forget themselves in
    `slip_time_s`. Returns A_c (7, 7) and B_c (7, 2); errors as there.
    """
    A_c, B_c = unicycle_error_model(speed_mps, turn_rate_radps, actuator_lag_s)
    as_positive("slip_time_s", slip_time_s)
    n = len(A_c)
    extended = np.zeros((n + 2, n + 2))
    extended[:n, :n] = A_c
    extended[0, n] = extended[2, n + 1] = 1.0
    extended[n, n] = extended[n + 1, n + 1] = -1.0 / slip_time_s
    return extended, np.vstack([B_c, np.zeros((2, B_c.shape[1]))])


def discretise_noise(A_c: npt.ArrayLike, density: npt.ArrayLike, sampling_s: float) -> FloatArray:
    """Return the covariance (n, n) that white noise adds to the state in one interval.

    It is the integral of exp(A_c s) Q exp(A_c s)^T over `sampling_s`, Q the noise's spectral
    `density` (n, n) a second: from the exponential of [[-A_c, Q], [0, A_c^T]] (Van Loan 1978) over
    so short a time that no entry grows, doubled from there by W(2h) = W(h) + A(h) W(h) A(h)^T.
    """
    state = as_square("A_c", A_c)
    n = len(state)
    noise = as_square("density", density, n)
    as_positive("sampling_s", sampling_s)
    size = float(np.abs(state).sum(axis=1).max()) * sampling_s
    halvings = max(0, math.ceil(math.log2(size)) + 1) if size > 0.0 else 0
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n], block[:n, n:], block[n:, n:] = -state, noise, state.T
    transition = np.asarray(expm(block * (sampling_s / 2.0**halvings)), dtype=np.float64)
    A = transition[n:, n:].T
    covariance = A @ transition[:n, n:]
    for _ in range(halvings):
        covariance = covariance + A @ covariance @ A.T
        A = A @ A
    return np.asarray((covariance + covariance.T) / 2.0, dtype=np.float64)


def discretise_alike(
    A_c: FloatArray, B_c: FloatArray, sampling_s: float
) -> tuple[FloatArray, FloatArray]:
    """Discretise as `discretise` does, many systems at once (G, n, n), (G, n, m).

    By a Taylor series, halved and squared, of sums in a fixed order: the same bits on every
    machine, which a product of a linear-algebra library does not give.
    """
    count, n, m = B_c.shape
    block = np.zeros((count, n + m, n + m))
    block[:, :n, :n], block[:, :n, n:] = A_c * sampling_s, B_c * sampling_s
    size = float(np.abs(block).sum(axis=2).max())
    halvings = max(0, math.ceil(math.log2(size)) + 1) if size > 0.0 else 0
    block = block / 2.0**halvings
    total = np.broadcast_to(np.eye(n + m), block.shape) + block
    term = block
    for order in range(2, 18):  # 0.5^18 / 18! is far below the last bit
        term = _product(term, block) / order
        total = total + term
    for _ in range(halvings):
        total = _product(total, total)
    return total[:, :n, :n].copy(), total[:, :n, n:].copy()


def _product(left: FloatArray, right: FloatArray) -> FloatArray:
    """Return products (G, n, n) of matrices, each entry summed from first to last."""
    total = left[:, :, 0, None] * right[:, None, 0, :]
    for k in range(1, left.shape[2]):
        total = total + left[:, :, k, None] * right[:, None, k, :]
    return total
