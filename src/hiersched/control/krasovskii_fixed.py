"""C3 synthesis for a fixed functional: linear in the gain, exact and convex."""

from __future__ import annotations

import cvxpy as cp
import numpy as np

from hiersched.control.certificate import KrasovskiiWitness
from hiersched.control.checks import FloatArray
from hiersched.control.delayed_plant import DelayedPlant
from hiersched.control.lmi import STRICT, solve, symmetric_blocks, symmetrised


class FixedFunctional:
    """The problem of one plant, compiled once and solved for any P, R and T.

    In coordinates w = C x where P = I, so that one tolerance suits every P; S, R and X stand for T
    times the functional's and the change of state is counted per delay, as in `krasovskii`.

    Parameters
    ----------
    plant : DelayedPlant
        The plant; `plant.nominal_gain` is the gain to stay close to.
    """

    def __init__(self, plant: DelayedPlant) -> None:
        self._plant = plant
        n, m = plant.B.shape
        self._K, self._S = cp.Variable((m, n)), cp.Variable((n, n), symmetric=True)
        self._X = cp.Variable((n, n))
        self._drift, self._late, self._C, self._R = (cp.Parameter((n, n)) for _ in range(4))
        self._drive, self._weight = cp.Parameter((n, m)), cp.Parameter((n, n))
        now, oldest, delayed = np.split(np.eye(3 * n), 3)
        moved = self._drive @ self._K
        if plant.A_d is None:
            change = self._drift @ now - moved @ delayed
        else:
            change = (self._drift - moved) @ now + self._late @ delayed
        coupling = symmetric_blocks([[self._R, self._X], [self._R]])
        gaps = np.vstack([now - delayed, delayed - oldest])
        decrease = (
            gaps.T @ coupling @ gaps
            - now.T @ change
            - change.T @ now
            - now.T @ self._S @ now
            + oldest.T @ self._S @ oldest
        )
        self._problem = cp.Problem(
            cp.Minimize(cp.sum_squares(self._K @ self._C - plant.nominal_gain)),
            [
                symmetric_blocks([[decrease, change.T], [self._weight]]) >> STRICT * np.eye(4 * n),
                coupling >> STRICT * np.eye(2 * n),
                self._S >> STRICT * np.eye(n),
            ],
        )

    def solve(
        self, P: FloatArray, R: FloatArray, T: int
    ) -> tuple[FloatArray, KrasovskiiWitness] | None:
        """Return the closest gain for these P and R, and its witness; None if there is none.

        Parameters
        ----------
        P, R : ndarray, shape (n, n)
            Weights of the functional, symmetric, P positive definite.
        T : int
            Longest delay in samples, at least 1.

        Returns
        -------
        (ndarray, shape (m, n), KrasovskiiWitness) or None
            Not yet certified.
        """
        C = np.linalg.cholesky(P).T
        inverse, identity = np.linalg.inv(C), np.eye(len(P))
        self._C.value, self._R.value = C, T * symmetrised(inverse.T @ R @ inverse)
        self._drift.value = T * (C @ self._plant.A @ inverse - identity)
        self._drive.value = T * (C @ self._plant.B)
        if self._plant.A_d is not None:
            self._late.value = T * (C @ self._plant.A_d @ inverse)
        self._weight.value = symmetrised(np.linalg.inv(identity / T + self._R.value))
        if not solve(self._problem) or self._K.value is None:
            return None
        S, X = (C.T @ M.value @ C / T for M in (self._S, self._X))
        witness = KrasovskiiWitness(P=P, S=symmetrised(S), R=R, X=X)
        return np.asarray(self._K.value @ C, dtype=np.float64), witness
