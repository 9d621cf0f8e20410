"""C3 synthesis: the gain closest to the nominal one that C3 certifies, for either plant.

As in `krasovskii`, S, R and X stand for T times the functional's, and the change of state is
counted per delay.
"""

from __future__ import annotations

from functools import cached_property
from typing import SupportsIndex

import cvxpy as cp
import numpy as np

from hiersched.control.certificate import KrasovskiiWitness
from hiersched.control.checks import (
    FloatArray,
    as_definite,
    as_samples,
    as_symmetric,
    symmetrised,
)
from hiersched.control.delayed_plant import DelayedPlant
from hiersched.control.krasovskii import analyse_krasovskii
from hiersched.control.lmi import (
    STRICT,
    Solution,
    line_search,
    refine,
    solve,
    symmetric_blocks,
    transformed,
)

CENTRAL_EPSILON = 5.0
"""Where the line search over epsilon/T starts: the optimum lay within 2..10 in every trial."""

_Slack = tuple[float, FloatArray]  # epsilon and Q2 of a solution of (b)
_Proven = Solution[KrasovskiiWitness]


class KrasovskiiSynthesis:
    """The synthesis inequality of one plant, compiled once and re-solved for each delay.

    With Q2 = P2^-1, Y = K Q2 and P3 = epsilon P2, min ||(Y - K_nominal Q2) W||_F^2 over
    Q2 + Q2^T >= 2 I, Y, P > 0, S > 0, R and X with [[R, X], [X^T, R]] > 0 subject to (4n x 4n)

        [[E0+E0^T+S-R, P-Q2+eps E0^T,           X,    R-X+F   ],
         [*,           -eps(Q2+Q2^T)+P+T^2 R,   0,    eps F   ],
         [*,           *,                      -S-R,  R-X^T   ],
         [*,           *,                       *,   -2R+X+X^T]] < 0,

    ``network``: E0 = (A-I) Q2, F = -B Y; ``split``: E0 = (A-I) Q2 - B Y, F = A_d Q2. Linear for
    each epsilon. Clarabel, in coordinates where the Riccati solution is the identity.
    """

    def __init__(self, plant: DelayedPlant) -> None:
        self._plant, self._scaling = plant, plant.scaling
        A, B = transformed(self._scaling, plant.A), self._scaling @ plant.B
        n, m = B.shape
        self._steps, self._per_step = cp.Parameter(nonneg=True), cp.Parameter(nonneg=True)
        self._epsilon, self._eps_steps = cp.Parameter(nonneg=True), cp.Parameter(nonneg=True)
        self._weight = cp.Parameter((n, n))
        P, S, R = (cp.Variable((n, n), symmetric=True) for _ in range(3))
        X, Q2, Y = cp.Variable((n, n)), cp.Variable((n, n)), cp.Variable((m, n))
        self._Q2, self._Y = Q2, Y
        if plant.A_d is None:
            E0, F = (A - np.eye(n)) @ Q2, -B @ Y
        else:
            E0, F = (A - np.eye(n)) @ Q2 - B @ Y, transformed(self._scaling, plant.A_d) @ Q2
        coupling = symmetric_blocks([[R, X], [R]])
        E = self._steps * E0
        slack = -self._epsilon * (Q2 + Q2.T) + self._per_step * P + R
        inequality = symmetric_blocks(
            [
                [E + E.T + S - R, P - Q2 + self._eps_steps * E0.T, X, R - X + self._steps * F],
                [slack, np.zeros((n, n)), self._eps_steps * F],
                [-S - R, R - X.T],
                [-2 * R + X + X.T],
            ]
        )
        nominal = plant.nominal_gain @ np.linalg.inv(self._scaling)
        deviation = (Y - nominal @ Q2) @ self._weight
        self._problem = cp.Problem(
            cp.Minimize(cp.sum_squares(deviation)),
            [
                inequality << -STRICT * np.eye(4 * n),
                coupling >> STRICT * np.eye(2 * n),
                P >> STRICT * np.eye(n),
                S >> STRICT * np.eye(n),
                # The rest is homogeneous: without this the unknowns shrink to zero.
                Q2 + Q2.T >> 2 * np.eye(n),
            ],
        )

    def minimal_deviation(
        self, delay_steps: SupportsIndex, *, max_reweights: int = 12, max_alternations: int = 0
    ) -> tuple[FloatArray, KrasovskiiWitness] | None:
        """Return the gain closest to the nominal one that C3 admits, and why it is stable.

        (b): minimises ||(Y - K Q2) W||_F in the units of x with a line search over epsilon
        (coarse to fine, on a logarithmic scale), then reweights W by the last Q2^-1 while the
        deviation ||K^ - K||_F falls. (c), where asked for: alternates `closest_for` with the
        functional of largest margin. It comes closer to K, and closer to the edge of stability.

        The witness has yet to be certified. None if no epsilon on the line is feasible: no gain
        was found, which does not prove that there is none.
        """
        # d = 0 alone needs no bound on eta; the condition for T = 1 covers it.
        T = max(as_samples("delay_steps", delay_steps), 1)
        free = line_search(lambda eps: self._solve(T, eps, self._scaling), CENTRAL_EPSILON)
        if free is None:
            return None

        def reweighted(last: Solution[_Slack]) -> Solution[_Slack] | None:
            epsilon, Q2 = last.proof
            weight = np.linalg.solve(Q2, self._scaling)
            weight = weight * (np.linalg.norm(self._scaling) / np.linalg.norm(weight))
            return self._solve(T, epsilon, np.asarray(weight, dtype=np.float64))

        def alternated(last: _Proven) -> _Proven | None:
            closest = self.closest_for(last.proof, T)
            return None if closest is None else self._centred(closest[0], T)

        best = self._centred(refine(free, reweighted, max_reweights).K, T)
        if best is None:
            return None
        best = refine(best, alternated, max_alternations)
        return best.K, best.proof

    def closest_for(
        self, functional: KrasovskiiWitness, delay_steps: SupportsIndex
    ) -> tuple[FloatArray, KrasovskiiWitness] | None:
        """Return the gain closest to the nominal one for a fixed P and R: (a), exact and convex.

        Minimises ||K^ - K||_F^2 over (K^, S, X) subject to C3 as in `analyse_krasovskii`, written
        with the Schur complement of e^T (P + T^2 R) e: e is linear in K^, so all is linear. P and R
        are those of `functional`; its S and X are not used. T is at least 1.

        The witness has yet to be certified. None if these P and R admit no gain; ValueError if P
        is not positive definite or T is 0.
        """
        T = as_samples("delay_steps", delay_steps)
        if T == 0:
            raise ValueError("delay_steps is 0; C3 with a fixed functional needs at least 1")
        n = self._plant.A.shape[0]
        P, R = as_definite("P", functional.P, n), as_symmetric("R", functional.R, n)
        return self._fixed.solve(P, R, T)

    @cached_property
    def _fixed(self) -> FixedFunctional:
        return FixedFunctional(self._plant)

    def _centred(self, K: FloatArray, T: int) -> _Proven | None:
        """Return a gain with its functional of largest margin."""
        witness = analyse_krasovskii(*self._plant.closed_loop(K), T)
        return None if witness is None else Solution(K, self._deviation(K), witness)

    def _deviation(self, K: FloatArray) -> float:
        return float(np.linalg.norm(K - self._plant.nominal_gain))

    def _solve(self, T: int, epsilon: float, weight: FloatArray) -> Solution[_Slack] | None:
        self._steps.value, self._per_step.value = float(T), 1.0 / T
        self._epsilon.value, self._eps_steps.value = epsilon, epsilon * T
        self._weight.value = weight
        if not solve(self._problem) or self._Q2.value is None:
            return None
        Q2 = np.asarray(self._Q2.value)
        K = np.linalg.solve(Q2.T, np.asarray(self._Y.value).T).T @ self._scaling
        if not np.isfinite(K).all():
            return None
        return Solution(K, self._deviation(K), (epsilon, Q2))


class FixedFunctional:
    """C3 for fixed P and R, linear in the gain: compiled once and solved for any P, R and T.

    In coordinates w = C x where P = I, so that one tolerance suits every P.
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
        """Return the closest gain and its witness, not yet certified; None if there is none."""
        C = np.asarray(np.linalg.cholesky(P).T, dtype=np.float64)
        inverse, identity = np.linalg.inv(C), np.eye(len(P))
        self._C.value, self._R.value = C, T * symmetrised(inverse.T @ R @ inverse)
        self._drift.value = T * (transformed(C, self._plant.A) - identity)
        self._drive.value = T * (C @ self._plant.B)
        if self._plant.A_d is not None:
            self._late.value = T * transformed(C, self._plant.A_d)
        self._weight.value = symmetrised(np.linalg.inv(identity / T + self._R.value))
        if not solve(self._problem) or self._K.value is None:
            return None
        S, X = (C.T @ M.value @ C / T for M in (self._S, self._X))
        witness = KrasovskiiWitness(P=P, S=symmetrised(S), R=R, X=X)
        return np.asarray(self._K.value @ C, dtype=np.float64), witness


def synthesise_krasovskii(
    plant: DelayedPlant, delay_steps: SupportsIndex, *, max_alternations: int = 0
) -> tuple[FloatArray, KrasovskiiWitness] | None:
    """C3 synthesis at one delay: `KrasovskiiSynthesis.minimal_deviation`, compiled for it alone."""
    synthesis = KrasovskiiSynthesis(plant)
    return synthesis.minimal_deviation(delay_steps, max_alternations=max_alternations)
