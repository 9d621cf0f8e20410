"""C3 synthesis: the gain closest to the nominal one that C3 certifies, for either plant."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cvxpy as cp
import numpy as np

from hiersched.control.certificate import KrasovskiiWitness
from hiersched.control.checks import FloatArray, as_delay_steps, as_symmetric, require_definite
from hiersched.control.delayed_plant import DelayedPlant
from hiersched.control.krasovskii import analyse_krasovskii
from hiersched.control.krasovskii_fixed import FixedFunctional
from hiersched.control.lmi import (
    STRICT,
    Expression,
    line_search,
    solve,
    symmetric_blocks,
)

CENTRAL_EPSILON = 5.0
"""Where the line search over epsilon/T starts: the optimum lay within 2..10 in every trial."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Solution:
    """A gain in the coordinates of x, its deviation and the slack matrix Q2 it came with."""

    K: FloatArray
    deviation: float
    Q2: FloatArray


class KrasovskiiSynthesis:
    """The synthesis inequality of one plant, compiled once and re-solved for each delay.

    With Q2 = P2^-1, Y = K Q2, P3 = epsilon P2 and z = L^T x, the inequality is linear in
    (P, S, R, X, Q2, Y) once epsilon is fixed. ``network``: E0 = (A-I) Q2, F = -B Y; ``split``:
    E0 = (A-I) Q2 - B Y, F = A_d Q2; both times T here.

    Parameters
    ----------
    plant : DelayedPlant
        The plant; `plant.nominal_gain` is the gain to stay close to.
    """

    def __init__(self, plant: DelayedPlant) -> None:
        self._plant, self._scaling = plant, plant.scaling
        self._fixed: FixedFunctional | None = None  # compiled when it is first asked for
        inverse = np.linalg.inv(self._scaling)
        A, B = self._scaling @ plant.A @ inverse, self._scaling @ plant.B
        n, m = B.shape
        self._nominal = plant.nominal_gain
        self._steps, self._per_step = cp.Parameter(nonneg=True), cp.Parameter(nonneg=True)
        self._epsilon, self._eps_steps = cp.Parameter(nonneg=True), cp.Parameter(nonneg=True)
        self._weight = cp.Parameter((n, n))
        P, S, R = (cp.Variable((n, n), symmetric=True) for _ in range(3))
        X, self._Q2, self._Y = cp.Variable((n, n)), cp.Variable((n, n)), cp.Variable((m, n))
        Q2, Y = self._Q2, self._Y
        if plant.A_d is None:
            E0, F = (A - np.eye(n)) @ Q2, -B @ Y
        else:
            A_d = self._scaling @ plant.A_d @ inverse
            E0, F = (A - np.eye(n)) @ Q2 - B @ Y, A_d @ Q2
        coupling = symmetric_blocks([[R, X], [R]])
        inequality = self._inequality(P, S, R, X, E0, F)
        deviation = (Y - self._nominal @ inverse @ Q2) @ self._weight
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

    def _inequality(
        self,
        P: Expression,
        S: Expression,
        R: Expression,
        X: Expression,
        E0: Expression,
        F: Expression,
    ) -> Expression:
        """Return the matrix in (x, T eta, x(k-T), x(k-d)) that must be negative definite."""
        n = P.shape[0]
        E = self._steps * E0
        row1 = [
            E + E.T + S - R,
            P - self._Q2 + self._eps_steps * E0.T,
            X,
            R - X + self._steps * F,
        ]
        row2 = [
            -self._epsilon * (self._Q2 + self._Q2.T) + self._per_step * P + R,
            np.zeros((n, n)),
            self._eps_steps * F,
        ]
        return symmetric_blocks([row1, row2, [-S - R, R - X.T], [-2 * R + X + X.T]])

    def minimal_deviation(
        self, delay_steps: int, *, max_reweights: int = 12, max_alternations: int = 0
    ) -> tuple[FloatArray, KrasovskiiWitness] | None:
        """Return the gain closest to the nominal one that C3 admits, and why it is stable.

        (b): minimises ||(Y - K Q2) W||_F in the units of x with a line search over epsilon
        (coarse to fine, on a logarithmic scale), then reweights W by the last Q2^-1 while the
        deviation ||K^ - K||_F falls. (c), where asked for: alternates `closest_for` with the
        functional of largest margin. It comes closer to K, and closer to the edge of stability.

        Parameters
        ----------
        delay_steps : int
            Longest delay T in samples.
        max_reweights, max_alternations : int
            Most solves of either refinement.

        Returns
        -------
        (ndarray, shape (m, n), KrasovskiiWitness) or None
            The gain and its witness, not yet certified; None if no epsilon is feasible.
        """
        # d = 0 alone needs no bound on eta; the condition for T = 1 covers it.
        T = max(as_delay_steps("delay_steps", delay_steps), 1)
        trials: dict[float, _Solution | None] = {}

        def deviation(exponent: float) -> float:
            if exponent not in trials:
                epsilon = CENTRAL_EPSILON * 2.0**exponent
                trials[exponent] = self._solve(T, epsilon, self._scaling)
            solution = trials[exponent]
            return math.inf if solution is None else solution.deviation

        exponent = line_search(deviation, reach=4.0)
        best = trials[exponent]
        if best is None:
            return None
        epsilon = CENTRAL_EPSILON * 2.0**exponent
        for _ in range(max_reweights):
            weight = np.linalg.solve(best.Q2, self._scaling)
            weight = weight * (np.linalg.norm(self._scaling) / np.linalg.norm(weight))
            candidate = self._solve(T, epsilon, np.asarray(weight, dtype=np.float64))
            if candidate is None or candidate.deviation >= best.deviation * (1.0 - 1e-3):
                break
            best = candidate
        witness = analyse_krasovskii(*self._plant.closed_loop(best.K), T)
        if witness is None:
            return None
        gain, shortest = best.K, best.deviation
        for _ in range(max_alternations):
            closest = self.closest_for(witness, T)
            if closest is None:
                break
            distance = float(np.linalg.norm(closest[0] - self._nominal))
            centred = analyse_krasovskii(*self._plant.closed_loop(closest[0]), T)
            if centred is None or distance >= shortest * (1.0 - 1e-3):
                break
            gain, shortest, witness = closest[0], distance, centred
        return gain, witness

    def closest_for(
        self, functional: KrasovskiiWitness, delay_steps: int
    ) -> tuple[FloatArray, KrasovskiiWitness] | None:
        """Return the gain closest to the nominal one for a fixed P and R: (a), exact and convex.

        Minimises ||K^ - K||_F^2 over (K^, S, X) subject to C3 as in `analyse_krasovskii`, written
        with the Schur complement of e^T (P + T^2 R) e: e is linear in K^, so all is linear.

        Parameters
        ----------
        functional : KrasovskiiWitness
            Its P (positive definite) and R are kept; its S and X are not used.
        delay_steps : int
            Longest delay T in samples, at least 1.

        Returns
        -------
        (ndarray, shape (m, n), KrasovskiiWitness) or None
            The gain and its witness, not yet certified; None if these P and R admit no gain.

        Raises
        ------
        ValueError
            If a matrix is malformed, P is not positive definite, or T is 0.
        """
        T = as_delay_steps("delay_steps", delay_steps)
        if T == 0:
            raise ValueError("delay_steps is 0; C3 with a fixed functional needs at least 1")
        n = self._plant.A.shape[0]
        P, R = as_symmetric("P", functional.P, n), as_symmetric("R", functional.R, n)
        require_definite("P", P)
        if self._fixed is None:
            self._fixed = FixedFunctional(self._plant)
        return self._fixed.solve(P, R, T)

    def _solve(self, T: int, epsilon: float, weight: FloatArray) -> _Solution | None:
        self._steps.value, self._per_step.value = float(T), 1.0 / T
        self._epsilon.value, self._eps_steps.value = epsilon, epsilon * T
        self._weight.value = weight
        if not solve(self._problem) or self._Q2.value is None:
            return None
        Q2 = np.asarray(self._Q2.value)
        K = np.linalg.solve(Q2.T, np.asarray(self._Y.value).T).T @ self._scaling
        if not np.isfinite(K).all():
            return None
        return _Solution(K=K, deviation=float(np.linalg.norm(K - self._nominal)), Q2=Q2)


def synthesise_krasovskii(
    plant: DelayedPlant, delay_steps: int, *, max_alternations: int = 0
) -> tuple[FloatArray, KrasovskiiWitness] | None:
    """C3 synthesis: the gain closest to the nominal one that C3 admits, for either plant.

    With Q2 full, Y = K Q2, min ||(Y - K_nominal Q2) W||_F^2 over Q2 + Q2^T >= 2 I, Y, P > 0,
    S > 0, R and X with [[R, X], [X^T, R]] > 0 subject to (4n x 4n)

        [[E0+E0^T+S-R, P-Q2+eps E0^T,           X,    R-X+F   ],
         [*,           -eps(Q2+Q2^T)+P+T^2 R,   0,    eps F   ],
         [*,           *,                      -S-R,  R-X^T   ],
         [*,           *,                       *,   -2R+X+X^T]] < 0,

    ``network``: E0 = (A-I) Q2, F = -B Y; ``split``: E0 = (A-I) Q2 - B Y, F = A_d Q2. Linear for
    each eps: a line search over eps, then reweighting, as `KrasovskiiSynthesis.minimal_deviation`
    says, which saves compiling the problem again for every T. Clarabel, in coordinates where the
    Riccati solution is the identity.

    Parameters
    ----------
    plant : DelayedPlant
        The plant; `plant.nominal_gain` is the gain to stay close to.
    delay_steps : int
        Longest delay T in samples.
    max_alternations : int
        Most rounds of (c), after which the gain is closer still, but nearer to instability.

    Returns
    -------
    (ndarray, shape (m, n), KrasovskiiWitness) or None
        The gain and its witness, which `certify` has yet to check. None if no eps on the line is
        feasible: no gain was found, which does not prove that there is none.

    Raises
    ------
    ValueError
        If the delay is negative or not whole.
    """
    synthesis = KrasovskiiSynthesis(plant)
    return synthesis.minimal_deviation(delay_steps, max_alternations=max_alternations)
