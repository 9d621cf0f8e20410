"""C1 synthesis: the gain of a split plant closest to its nominal one that C1 certifies."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cvxpy as cp
import numpy as np

from hiersched.control.certificate import RazumikhinWitness
from hiersched.control.checks import FloatArray, as_symmetric, require_definite
from hiersched.control.delayed_plant import DelayedPlant
from hiersched.control.lmi import STRICT, line_search, solve, symmetric_blocks, symmetrised
from hiersched.control.methods import DEFAULT_DECAY_RATE
from hiersched.control.razumikhin import razumikhin_gamma

CENTRAL_TAU = 2.0**-5
"""Middle of the scan of tau in synthesis, which reaches 4 octaves either way (2e-3 to 0.5)."""


class LargestMargin:
    """Search P of largest margin t: diag(weights x P) - F^T P F >= t I, P >= 0, trace P = n.

    Only for step (c), which needs room around P in every direction: whether there is a P at all
    is what `WeightedMap` decides, since t is next to 0 beside a P that is nearly singular.

    Parameters
    ----------
    F : ndarray, shape (n, k n)
        The blocks by which V(k+1) is formed from k states, in well scaled coordinates.
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


@dataclass(frozen=True, kw_only=True, eq=False)
class _Solution:
    """A gain with what proves it, in the coordinates of x."""

    K: FloatArray
    deviation: float
    P: FloatArray
    tau: float


class RazumikhinSynthesis:
    """C1 synthesis for one split plant and decay rate, compiled once and re-solved.

    Parameters
    ----------
    plant : DelayedPlant
        The plant; `plant.nominal_gain` is the gain to stay close to.
    decay_rate : float
        Relative decay a of V per sample, in (0, 1).

    Raises
    ------
    ValueError
        If the plant is no split plant: with all feedback delayed A_c = A, and C1, which holds for
        any delay, would need a stable A.
    """

    def __init__(self, plant: DelayedPlant, decay_rate: float) -> None:
        if plant.A_d is None:
            raise ValueError(
                f"kind is {plant.kind!r}; C1 synthesis needs a 'split' plant (A_c = A - B K)"
            )
        razumikhin_gamma(decay_rate, 0)
        self._rate, self._scaling = decay_rate, plant.scaling
        self._plant = (plant.A, plant.A_d, plant.B)
        self._nominal = plant.nominal_gain
        self._nominal_z = plant.nominal_gain @ np.linalg.inv(self._scaling)
        self._A, self._A_d, self._B = self._in_coordinates(self._scaling)
        self._build_free()
        self._build_fixed()

    def _build_free(self) -> None:
        """Build (b): Q = P^-1 and Y = K Q free, tau fixed."""
        n, m = self._B.shape
        self._Q, self._Y = cp.Variable((n, n), symmetric=True), cp.Variable((m, n))
        self._p, self._tau = cp.Parameter(nonneg=True), cp.Parameter(nonneg=True)
        self._weight = cp.Parameter((n, n))
        loop, delayed = self._A @ self._Q - self._B @ self._Y, self._A_d @ self._Q
        inequality = symmetric_blocks(
            [
                [self._p * self._Q, np.zeros((n, n)), loop.T],
                [self._tau * self._Q, delayed.T],
                [self._Q],
            ]
        )
        deviation = (self._Y - self._nominal_z @ self._Q) @ self._weight
        # Homogeneous in (Q, Y): without Q >= I the unknowns shrink to zero.
        self._free = cp.Problem(
            cp.Minimize(cp.sum_squares(deviation)),
            [inequality >> STRICT * np.eye(3 * n), self._Q >> np.eye(n)],
        )

    def _build_fixed(self) -> None:
        """Build (a): P fixed, K and tau free; exact and jointly convex.

        Posed in the coordinates w = C x where P is the identity, so that one tolerance suits
        every P. K_w = K C^-1.
        """
        n, m = self._B.shape
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
        self, delay_steps: int, *, max_reweights: int = 12, max_alternations: int = 30
    ) -> tuple[FloatArray, RazumikhinWitness] | None:
        """Return the gain closest to the nominal one that C1 admits, and why it is stable.

        (b) with a scan over tau, reweighted by Q^-1 while the deviation falls, then (c): (a)
        for the last P, alternating with the P of largest margin for the last gain.

        Parameters
        ----------
        delay_steps : int
            Longest delay T in samples over which the decay rate has to hold.
        max_reweights, max_alternations : int
            Most solves of either refinement.

        Returns
        -------
        (ndarray, shape (m, n), RazumikhinWitness) or None
            The gain and its witness, not yet certified; None if no tau is feasible.
        """
        gamma = razumikhin_gamma(self._rate, delay_steps)
        trials: dict[float, _Solution | None] = {}

        def deviation(exponent: float) -> float:
            if exponent not in trials:
                tau = CENTRAL_TAU * 2.0**exponent
                trials[exponent] = self._solve_free(gamma, tau, self._scaling)
            solution = trials[exponent]
            return math.inf if solution is None else solution.deviation

        best = trials[line_search(deviation, reach=4.0)]
        if best is None:
            return None
        for _ in range(max_reweights):
            weight = np.linalg.inv(self._scaling).T @ best.P
            candidate = self._solve_free(gamma, best.tau, weight / np.linalg.norm(weight, 2))
            if candidate is None or candidate.deviation >= best.deviation * (1.0 - 1e-3):
                break
            best = candidate
        for _ in range(max_alternations):
            candidate = self._improve(gamma, best)
            if candidate is None or candidate.deviation >= best.deviation * (1.0 - 1e-3):
                break
            best = candidate
        return best.K, RazumikhinWitness(P=best.P, tau=best.tau, decay_rate=self._rate)

    def _solve_free(self, gamma: float, tau: float, weight: FloatArray) -> _Solution | None:
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
        self, P: FloatArray, delay_steps: int
    ) -> tuple[FloatArray, RazumikhinWitness] | None:
        """Return the gain closest to the nominal one for a fixed P: (a), exact and convex.

        Minimises ||K^ - K||_F^2 over (K^, tau) subject to (3n x 3n)

            [[(1 - a - tau g) P, 0, (A - B K^)^T P], [0, tau P, A_d^T P], [*, *, P]] > 0.

        Parameters
        ----------
        P : ndarray, shape (n, n)
            Positive definite matrix of V = x^T P x.
        delay_steps : int
            Longest delay T in samples over which the decay rate has to hold.

        Returns
        -------
        (ndarray, shape (m, n), RazumikhinWitness) or None
            The gain and its witness, not yet certified; None if this P admits no gain.

        Raises
        ------
        ValueError
            If P is malformed or not positive definite, or the delay negative.
        """
        P = as_symmetric("P", P, self._B.shape[0])
        require_definite("P", P)
        gamma = razumikhin_gamma(self._rate, delay_steps)
        best = self._solve_fixed(gamma, np.asarray(np.linalg.cholesky(P).T, dtype=np.float64))
        if best is None:
            return None
        return best.K, RazumikhinWitness(P=best.P, tau=best.tau, decay_rate=self._rate)

    def _improve(self, gamma: float, last: _Solution) -> _Solution | None:
        """Take a step of (c): centre P for the last gain and tau, then solve (a) for that P."""
        C = np.asarray(np.linalg.cholesky(last.P).T, dtype=np.float64)
        A_w, A_d_w, B_w = self._in_coordinates(C)
        search = LargestMargin(np.hstack([A_w - B_w @ last.K @ np.linalg.inv(C), A_d_w]))
        found = search.solve(max(1.0 - self._rate - last.tau * gamma, 0.0), last.tau)
        if found is None or found[0] <= 0.0:
            return None
        C = np.asarray(np.linalg.cholesky(found[1]).T @ C, dtype=np.float64)
        return self._solve_fixed(gamma, C)

    def _solve_fixed(self, gamma: float, C: FloatArray) -> _Solution | None:
        """Solve (a) for P = C^T C."""
        self._A_w.value, self._A_d_w.value, self._B_w.value = self._in_coordinates(C)
        self._C.value, self._gamma.value = C, gamma
        if not solve(self._fixed) or self._K_w.value is None:
            return None
        return self._solution(self._K_w.value @ C, C.T @ C, float(self._free_tau.value))

    def _in_coordinates(self, C: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return A, A_d and B of the plant in w = C x."""
        A, A_d, B = self._plant
        inverse = np.linalg.inv(C)
        return C @ A @ inverse, C @ A_d @ inverse, C @ B

    def _solution(self, K: FloatArray, P: FloatArray, tau: float) -> _Solution | None:
        if not np.isfinite(K).all():
            return None
        deviation = float(np.linalg.norm(K - self._nominal))
        return _Solution(K=K, deviation=deviation, P=symmetrised(P), tau=tau)


def synthesise_razumikhin(
    plant: DelayedPlant, delay_steps: int, decay_rate: float = DEFAULT_DECAY_RATE
) -> tuple[FloatArray, RazumikhinWitness] | None:
    """C1 synthesis: the local gain of a split plant closest to its nominal one that C1 admits.

    With Q = P^-1, Y = K Q, g = (1 - a)^-T and p = 1 - a - tau g, min ||(Y - K_nominal Q) W||_F^2
    over Q >= I and Y subject to (3n x 3n)

        [[p Q, 0, (A Q - B Y)^T], [0, tau Q, (A_d Q)^T], [A Q - B Y, A_d Q, Q]] > 0,

    then reweighted and alternated as `RazumikhinSynthesis.minimal_deviation` says, which saves
    compiling the problems again for every T. Clarabel, in coordinates where the Riccati solution
    is the identity.

    Parameters
    ----------
    plant : DelayedPlant
        A split plant.
    delay_steps : int
        Longest delay T in samples over which the decay rate has to hold.
    decay_rate : float
        Relative decay a of V per sample, in (0, 1).

    Returns
    -------
    (ndarray, shape (m, n), RazumikhinWitness) or None
        The gain and its witness, which `certify` has yet to check. None if no tau in 2e-3..0.5 is
        feasible: no local gain was found for which any operator's delay would do no harm.

    Raises
    ------
    ValueError
        If the plant is no split plant or a number is outside its range.
    """
    return RazumikhinSynthesis(plant, decay_rate).minimal_deviation(delay_steps)
