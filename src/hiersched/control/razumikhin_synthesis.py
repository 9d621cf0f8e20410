"""C1 synthesis: the gain of a split plant closest to its nominal one that C1 certifies."""

from __future__ import annotations

from typing import SupportsIndex

import cvxpy as cp
import numpy as np

from hiersched.control.certificate import DEFAULT_DECAY_RATE, RazumikhinWitness
from hiersched.control.checks import FloatArray, as_decay_rate, as_definite, symmetrised
from hiersched.control.delayed_plant import DelayedPlant
from hiersched.control.lmi import (
    STRICT,
    Solution,
    line_search,
    refine,
    solve,
    symmetric_blocks,
    transformed,
)
from hiersched.control.razumikhin import razumikhin_gamma

CENTRAL_TAU = 2.0**-5
"""Middle of the scan of tau in synthesis, which reaches 4 octaves either way (2e-3 to 0.5)."""

_Proven = Solution[RazumikhinWitness]


class LargestMargin:
    """Search P of largest margin t: diag(weights x P) - F^T P F >= t I, P >= 0, trace P = n.

    Only for step (c), which needs room around P in every direction: whether there is a P at all
    is what `WeightedMap` decides, since t is next to 0 beside a P that is nearly singular. F, shape
    (n, k n), holds the blocks by which V(k+1) is formed from k states, in well scaled coordinates.
    """

    def __init__(self, F: FloatArray) -> None:
        n = F.shape[0]
        blocks = F.shape[1] // n
        self._P = cp.Variable((n, n), symmetric=True)
        self._margin = cp.Variable()
        self._weights = [cp.Parameter(nonneg=True) for _ in range(blocks)]
        selectors = np.split(np.eye(blocks * n), blocks)
        decrease = -F.T @ self._P @ F
        for weight, selector in zip(self._weights, selectors, strict=True):
            decrease = decrease + weight * (selector.T @ self._P @ selector)
        constraints = [
            (decrease + decrease.T) / 2 >> self._margin * np.eye(blocks * n),
            self._P >> 0,
            cp.trace(self._P) == n,
        ]
        self._problem = cp.Problem(cp.Maximize(self._margin), constraints)

    def solve(self, *weights: float) -> tuple[float, FloatArray] | None:
        """Return (margin, P) for these weights, or None if the solver gave up."""
        for parameter, weight in zip(self._weights, weights, strict=True):
            parameter.value = weight
        if not solve(self._problem) or self._margin.value is None:
            return None
        return float(self._margin.value), np.asarray(self._P.value)


class RazumikhinSynthesis:
    """C1 synthesis for one split plant and decay rate a in (0, 1), compiled once and re-solved.

    With Q = P^-1, Y = K Q, g = (1 - a)^-T and p = 1 - a - tau g, min ||(Y - K_nominal Q) W||_F^2
    over Q >= I and Y subject to (3n x 3n)

        [[p Q, 0, (A Q - B Y)^T], [0, tau Q, (A_d Q)^T], [A Q - B Y, A_d Q, Q]] > 0.

    Clarabel, in coordinates where the Riccati solution is the identity. A network plant is a
    ValueError: with all feedback delayed A_c = A, and C1, which holds for any delay, would need a
    stable A.
    """

    def __init__(self, plant: DelayedPlant, decay_rate: float) -> None:
        if plant.A_d is None:
            raise ValueError(
                f"kind is {plant.kind!r}; C1 synthesis needs a 'split' plant (A_c = A - B K)"
            )
        self._rate, self._scaling = as_decay_rate(decay_rate), plant.scaling
        self._plant = (plant.A, plant.A_d, plant.B)
        self._nominal = plant.nominal_gain
        self._build_free()
        self._build_fixed()

    def _build_free(self) -> None:
        """Build (b): Q = P^-1 and Y = K Q free, tau fixed."""
        A, A_d, B = self._in_coordinates(self._scaling)
        n, m = B.shape
        self._Q, self._Y = cp.Variable((n, n), symmetric=True), cp.Variable((m, n))
        self._p, self._tau = cp.Parameter(nonneg=True), cp.Parameter(nonneg=True)
        self._weight = cp.Parameter((n, n))
        loop, delayed = A @ self._Q - B @ self._Y, A_d @ self._Q
        inequality = symmetric_blocks(
            [
                [self._p * self._Q, np.zeros((n, n)), loop.T],
                [self._tau * self._Q, delayed.T],
                [self._Q],
            ]
        )
        nominal = self._nominal @ np.linalg.inv(self._scaling)
        deviation = (self._Y - nominal @ self._Q) @ self._weight
        # Homogeneous in (Q, Y): without Q >= I the unknowns shrink to zero.
        self._free = cp.Problem(
            cp.Minimize(cp.sum_squares(deviation)),
            [inequality >> STRICT * np.eye(3 * n), self._Q >> np.eye(n)],
        )

    def _build_fixed(self) -> None:
        """Build (a): P = C^T C fixed, K and tau free, in the coordinates w = C x where P is I."""
        n, m = self._plant[2].shape
        self._K_w, self._free_tau = cp.Variable((m, n)), cp.Variable(nonneg=True)
        self._A_w, self._A_d_w, self._C = (cp.Parameter((n, n)) for _ in range(3))
        self._B_w, self._gamma = cp.Parameter((n, m)), cp.Parameter(nonneg=True)
        weight = 1.0 - self._rate - self._free_tau * self._gamma
        inequality = symmetric_blocks(
            [
                [weight * np.eye(n), np.zeros((n, n)), (self._A_w - self._B_w @ self._K_w).T],
                [self._free_tau * np.eye(n), self._A_d_w.T],
                [np.eye(n)],
            ]
        )
        deviation = self._K_w @ self._C - self._nominal
        self._fixed = cp.Problem(
            cp.Minimize(cp.sum_squares(deviation)), [inequality >> STRICT * np.eye(3 * n)]
        )

    def minimal_deviation(
        self, delay_steps: SupportsIndex, *, max_reweights: int = 12, max_alternations: int = 30
    ) -> tuple[FloatArray, RazumikhinWitness] | None:
        """Return the gain closest to the nominal one that C1 admits, and why it is stable.

        (b) with a scan over tau, reweighted by Q^-1 while the deviation falls, then (c): (a)
        for the last P, alternating with the P of largest margin for the last gain.

        The witness has yet to be certified. None if no tau in 2e-3..0.5 is feasible: no local gain
        was found for which any operator's delay would do no harm.
        """
        gamma = razumikhin_gamma(self._rate, delay_steps)
        best = line_search(lambda tau: self._solve_free(gamma, tau, self._scaling), CENTRAL_TAU)
        if best is None:
            return None

        def reweighted(last: _Proven) -> _Proven | None:
            weight = np.linalg.inv(self._scaling).T @ last.proof.P
            return self._solve_free(gamma, last.proof.tau, weight / np.linalg.norm(weight, 2))

        best = refine(best, reweighted, max_reweights)
        best = refine(best, lambda last: self._alternated(gamma, last), max_alternations)
        return best.K, best.proof

    def _solve_free(self, gamma: float, tau: float, weight: FloatArray) -> _Proven | None:
        p = 1.0 - self._rate - tau * gamma
        if p <= 0.0:
            return None
        self._p.value, self._tau.value, self._weight.value = p, tau, weight
        if not solve(self._free) or self._Q.value is None:
            return None
        P = symmetrised(np.linalg.inv(self._Q.value))
        K = np.asarray(self._Y.value) @ P @ self._scaling
        return self._solution(K, self._scaling.T @ P @ self._scaling, tau)

    def closest_for(
        self, P: FloatArray, delay_steps: SupportsIndex
    ) -> tuple[FloatArray, RazumikhinWitness] | None:
        """Return the gain closest to the nominal one for a fixed P > 0: (a), exact and convex.

        Minimises ||K^ - K||_F^2 over (K^, tau) subject to (3n x 3n)

            [[(1 - a - tau g) P, 0, (A - B K^)^T P], [0, tau P, A_d^T P], [*, *, P]] > 0.

        The witness has yet to be certified. None if this P admits no gain; ValueError if P is not
        positive definite.
        """
        P = as_definite("P", P, self._scaling.shape[0])
        gamma = razumikhin_gamma(self._rate, delay_steps)
        best = self._solve_fixed(gamma, np.asarray(np.linalg.cholesky(P).T, dtype=np.float64))
        return None if best is None else (best.K, best.proof)

    def _alternated(self, gamma: float, last: _Proven) -> _Proven | None:
        """Take a step of (c): centre P for the last gain and tau, then solve (a) for that P."""
        C = np.asarray(np.linalg.cholesky(last.proof.P).T, dtype=np.float64)
        A_w, A_d_w, B_w = self._in_coordinates(C)
        search = LargestMargin(np.hstack([A_w - B_w @ last.K @ np.linalg.inv(C), A_d_w]))
        tau = last.proof.tau
        found = search.solve(max(1.0 - self._rate - tau * gamma, 0.0), tau)
        if found is None or found[0] <= 0.0:
            return None
        return self._solve_fixed(gamma, np.linalg.cholesky(found[1]).T @ C)

    def _solve_fixed(self, gamma: float, C: FloatArray) -> _Proven | None:
        """Solve (a) for P = C^T C."""
        self._A_w.value, self._A_d_w.value, self._B_w.value = self._in_coordinates(C)
        self._C.value, self._gamma.value = C, gamma
        if not solve(self._fixed) or self._K_w.value is None:
            return None
        return self._solution(self._K_w.value @ C, C.T @ C, float(self._free_tau.value))

    def _in_coordinates(self, C: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return A, A_d and B of the plant in w = C x."""
        A, A_d, B = self._plant
        return transformed(C, A), transformed(C, A_d), C @ B

    def _solution(self, K: FloatArray, P: FloatArray, tau: float) -> _Proven | None:
        if not np.isfinite(K).all():
            return None
        witness = RazumikhinWitness(P=symmetrised(P), tau=tau, decay_rate=self._rate)
        return Solution(K, float(np.linalg.norm(K - self._nominal)), witness)


def synthesise_razumikhin(
    plant: DelayedPlant, delay_steps: SupportsIndex, decay_rate: float = DEFAULT_DECAY_RATE
) -> tuple[FloatArray, RazumikhinWitness] | None:
    """C1 synthesis at one delay: `RazumikhinSynthesis.minimal_deviation`, compiled for it alone."""
    return RazumikhinSynthesis(plant, decay_rate).minimal_deviation(delay_steps)
