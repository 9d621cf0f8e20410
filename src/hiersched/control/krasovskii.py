"""C3: the delay-dependent Lyapunov-Krasovskii condition, analysis and synthesis.

The closed loop is x(k+1) = A_c x(k) + A_d x(k-d(k)), 0 <= d(k) <= T, with the functional
V = x^T P x + (sum of x^T S x over T samples) + T (double sum of eta^T R eta), eta(k) = x(k+1) -
x(k). Throughout, S, R and X stand for T times the functional's, and eta is counted per delay
(T eta): the unknowns and the line search are then of order one at every T and sampling
interval, and the inequality is the one of a continuous system with delay 1 as T grows.
"""

from __future__ import annotations

from functools import cached_property
from typing import SupportsIndex

import cvxpy as cp
import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_discrete_lyapunov

from hiersched.control.certificate import KrasovskiiWitness
from hiersched.control.checks import (
    FloatArray,
    as_definite,
    as_loop,
    as_samples,
    as_symmetric,
    symmetrised,
)
from hiersched.control.delayed_plant import DelayedPlant
from hiersched.control.lmi import (
    STRICT,
    Solution,
    balance,
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


def analyse_krasovskii(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, delay_steps: SupportsIndex
) -> KrasovskiiWitness | None:
    """C3 analysis: search the Krasovskii functional of largest margin for a given loop.

    With x = x(k), o = x(k-T), d = x(k-d), e = eta(k) = (A_c - I) x + A_d d, find symmetric P, S, R
    and a full X such that for all (x, o, d) other than 0::

        2 x^T P e + e^T P e + x^T S x - o^T S o + T^2 e^T R e
            - [x - d; d - o]^T [[R, X], [X^T, R]] [x - d; d - o] < 0,

    P > 0, S > 0 and [[R, X], [X^T, R]] > 0: one inequality of 3n x 3n, whatever T. (The
    descriptor form with P2 and P3 free is equivalent to it and larger.) Solved by Clarabel in
    coordinates where A_c + A_d is well scaled.

    Only `certify` says whether what was found holds. None if A_c + A_d is unstable or the solver
    found no positive margin: C3 then says nothing. The condition is sufficient, so the loop may
    still be stable for all these delays.
    """
    A_c, A_d, T = as_loop(A_c, A_d, delay_steps)
    n = A_c.shape[0]
    scaling = balance(A_c + A_d)
    if scaling is None:
        return None
    if T == 0:
        loop, zero = A_c + A_d, np.zeros((n, n))
        P = symmetrised(np.asarray(solve_discrete_lyapunov(loop.T, np.eye(n))))
        return KrasovskiiWitness(P=P, S=zero, R=zero, X=zero)
    P, S, R = (cp.Variable((n, n), symmetric=True) for _ in range(3))
    X, margin = cp.Variable((n, n)), cp.Variable()
    coupling = symmetric_blocks([[R, X], [R]])
    now, oldest, delayed = np.split(np.eye(3 * n), 3)
    step, late = transformed(scaling, A_c) - np.eye(n), transformed(scaling, A_d)
    e = np.hstack([T * step, np.zeros((n, n)), T * late])
    gaps = np.vstack([now - delayed, delayed - oldest])
    cross = now.T @ P @ e
    # T times the bound on V(k+1) - V(k), as a matrix in (x, o, d).
    change = (
        cross
        + cross.T
        + e.T @ (P / T + coupling[:n, :n]) @ e
        + now.T @ S @ now
        - oldest.T @ S @ oldest
        - gaps.T @ coupling @ gaps
    )
    problem = cp.Problem(
        cp.Maximize(margin),
        [
            (change + change.T) / 2 << -margin * np.eye(3 * n),
            coupling >> margin * np.eye(2 * n),
            S >> margin * np.eye(n),
            P >> margin * np.eye(n),
            P << np.eye(n),
        ],
    )
    if not solve(problem) or margin.value <= 0.0:
        return None
    P, S, R, X = (scaling.T @ value @ scaling for value in (P.value, S.value, R.value, X.value))
    return KrasovskiiWitness(P=symmetrised(P), S=symmetrised(S) / T, R=symmetrised(R) / T, X=X / T)


class KrasovskiiSynthesis:
    """The synthesis inequality of one plant, compiled once and re-solved for each delay.

    With Q2 = P2^-1, Y = K Q2 and P3 = epsilon P2, min ||(Y - K_nominal Q2) W||_F^2 over
    Q2 + Q2^T >= 2 I, Y, P > 0, S > 0, R and X with [[R, X], [X^T, R]] > 0 subject to (4n x 4n)::

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
        if not solve(self._problem):
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
        if not solve(self._problem):
            return None
        S, X = (C.T @ M.value @ C / T for M in (self._S, self._X))
        witness = KrasovskiiWitness(P=P, S=symmetrised(S), R=R, X=X)
        return np.asarray(self._K.value @ C, dtype=np.float64), witness
