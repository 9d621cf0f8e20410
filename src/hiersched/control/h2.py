"""The H2-optimal memoryless gain at a constant delay: a local optimum, with no certificate."""

from __future__ import annotations

import math
from typing import SupportsIndex

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_discrete_lyapunov

from hiersched.control.checks import FloatArray, as_matrix, as_samples, spectral_radius
from hiersched.control.delayed_plant import DelayedPlant, require_network


class _LiftedLoop:
    """zeta(k+1) = (F + G K C) zeta(k): x(k) and the commands K x on their way, shape n + m T."""

    def __init__(self, plant: DelayedPlant, T: int) -> None:
        n, m = plant.B.shape
        size = n + m * T
        self.C = np.eye(n, size)
        self.F, self.G = np.eye(size, k=-m), np.zeros((size, m))
        self.F[: n + m if T else n] = 0.0
        self.F[:n, :n] = plant.A
        if T:
            self.F[:n, -m:] = -plant.B
            self.G[n : n + m] = np.eye(m)
        else:
            self.G[:n] = -plant.B
        self.Q, self.R = plant.Q, plant.R

    def evaluate(self, K: FloatArray) -> tuple[float, FloatArray] | None:
        """Return the stationary cost under unit noise on x and a better K; None if unstable.

        With X the covariance and P the cost-to-go, the gradient is 2 ((R + G^T P G) K + G^T P F X
        C^T (C X C^T)^-1) C X C^T; the better K is its root for fixed X and P (Anderson and Moore).
        """
        C, F, G, R = self.C, self.F, self.G, self.R
        loop = F + G @ K @ C
        if spectral_radius(loop) >= 1.0:
            return None
        X = np.asarray(solve_discrete_lyapunov(loop, C.T @ C))
        P = np.asarray(solve_discrete_lyapunov(loop.T, C.T @ (self.Q + K.T @ R @ K) @ C))
        curvature, drive = R + G.T @ P @ G, G.T @ P @ F @ X @ C.T
        better = -np.linalg.solve(curvature, np.linalg.solve(C @ X @ C.T, drive.T).T)
        return float(np.trace(C @ P @ C.T)), better


def h2_cost(plant: DelayedPlant, K: npt.ArrayLike, delay_steps: SupportsIndex) -> float:
    """Return the mean of x^T Q x + u^T R u with u(k) = -K x(k-T) under unit white noise on x.

    Infinite if the loop is unstable at the constant delay T. The plant must be a network plant.
    """
    require_network(plant, "the H2 cost")
    K = as_matrix("K", K, plant.nominal_gain.shape)
    found = _LiftedLoop(plant, as_samples("delay_steps", delay_steps)).evaluate(K)
    return math.inf if found is None else found[0]


def h2_gain(plant: DelayedPlant, delay_steps: SupportsIndex, start: npt.ArrayLike) -> FloatArray:
    """Return a memoryless gain that minimises `h2_cost` locally, going downhill from a stable one.

    Each of at most 500 steps goes towards the minimiser for fixed covariance and cost-to-go, halved
    until the cost falls: a descent method that never leaves the gains that are stable at T. `start`
    itself is returned where it is optimal to 1e-9 of its norm; one that is not stable is a
    ValueError. The plant must be a network plant.
    """
    require_network(plant, "the H2-optimal gain")
    T = as_samples("delay_steps", delay_steps)
    K = as_matrix("start", start, plant.nominal_gain.shape)
    loop = _LiftedLoop(plant, T)
    here = loop.evaluate(K)
    if here is None:
        raise ValueError(f"start is not stable at the constant delay of {T} samples")
    for _ in range(500):
        direction, step = here[1] - K, 1.0
        if np.linalg.norm(direction) <= 1e-9 * np.linalg.norm(K):
            break
        candidate = None
        while step > 1e-6:
            candidate = loop.evaluate(K + step * direction)
            if candidate is not None and candidate[0] < here[0]:
                break
            step, candidate = step / 2.0, None
        if candidate is None:
            break  # no descent left within rounding
        K, here = K + step * direction, candidate
    return K
