"""C1 and C2: Razumikhin conditions, analysis of both and synthesis by C1.

The closed loop is x(k+1) = A_c x(k) + A_d x(k-d(k)), 0 <= d(k) <= T, with V = x^T P x.

C1: V(k+1) <= (1-a-tau g) V(k) + tau V(k-d) with g = (1-a)^-T proves stability under every
delay, and the decay 1-a of V for delays up to T. (g = 1 + a T, its first-order truncation,
proves stability but not that rate.) C2 bounds x(k) - x(k-d) instead and depends on T.

Neither analysis needs a solver of matrix inequalities: `WeightedMap` says exactly for which
weights a P exists, and a search over the weights finds the best ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import SupportsIndex

import cvxpy as cp
import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar

from hiersched.control.certificate import DelayRazumikhinWitness, RazumikhinWitness
from hiersched.control.checks import (
    FloatArray,
    as_decay_rate,
    as_definite,
    as_loop,
    as_samples,
    spectral_radius,
    symmetrised,
)
from hiersched.control.delayed_plant import DelayedPlant
from hiersched.control.lmi import (
    STRICT,
    Expression,
    Solution,
    balance,
    line_search,
    refine,
    solve,
    symmetric_blocks,
    transformed,
)

REACH = 12.0
"""The searches go over shares from 2^-REACH to 1 - 2^-REACH: where the best share is 0, they may
miss the last ten-thousandth of what a condition can certify."""

CENTRAL_TAU = 2.0**-5
"""Middle of the scan of tau in synthesis, which reaches 4 octaves either way (2e-3 to 0.5)."""

_Proven = Solution[RazumikhinWitness]


def razumikhin_gamma(decay_rate: float, delay_steps: SupportsIndex) -> float:
    """Return g = (1 - a)^-T, the bound V(k-d) <= g V(k) that certifies the decay a in (0, 1).

    It is at least the paper's 1 + a T (Bernoulli's inequality).
    """
    return (1.0 - as_decay_rate(decay_rate)) ** -as_samples("delay_steps", delay_steps)


class WeightedMap:
    """The map Q -> sum_i F_i Q F_i^T / w_i of symmetric matrices, which decides on a P.

    With F = [F_1, ..., F_k] (`blocks`, (n, n) each) and Q = P^-1, the Schur complement turns::

        diag(w_1 P, ..., w_k P) - F^T P F > 0        (k n x k n)

    into Q > sum_i F_i Q F_i^T / w_i (n x n). The map keeps positive matrices positive, so there
    is such a P if and only if its spectral radius is below 1. This radius is a limit of sums of
    products of the 1/w_i with positive factors: its logarithm is convex in the weights, so that
    searches over them meet one valley only.
    """

    def __init__(self, blocks: Sequence[FloatArray]) -> None:
        n = blocks[0].shape[0]
        rows, columns = np.triu_indices(n)
        entries = np.arange(rows.size)
        # Symmetric matrices have n (n + 1) / 2 coordinates, their upper triangle.
        self._basis = np.zeros((rows.size, n, n))
        self._basis[entries, rows, columns] = self._basis[entries, columns, rows] = 1.0
        self._identity = np.eye(n)[rows, columns]
        self._maps = [(F @ self._basis @ F.T)[:, rows, columns].T for F in blocks]

    def radius(self, *weights: float) -> float:
        """Return the spectral radius of the map; below 1, there is a P for these weights."""
        return spectral_radius(self._map(weights))

    def solve(self, *weights: float) -> FloatArray | None:
        """Return the P whose inverse is Q = I + sum_i F_i Q F_i^T / w_i; the radius is below 1.

        None where the radius is 1 but for rounding: Q is then beyond what numbers can hold.
        """
        matrix = np.eye(self._identity.size) - self._map(weights)
        try:
            Q = np.tensordot(np.linalg.solve(matrix, self._identity), self._basis, axes=1)
            return symmetrised(np.linalg.inv(Q))
        except np.linalg.LinAlgError:
            return None

    def _map(self, weights: Sequence[float]) -> FloatArray:
        total = np.zeros_like(self._maps[0])
        for own, weight in zip(self._maps, weights, strict=True):
            total += own / weight
        return total


def _least(cost: Callable[[float], float]) -> tuple[float, float]:
    """Return the least cost over the shares (0, 1), and where: log2(share / (1 - share)) to 1e-5.

    The cost must have one valley.
    """

    def share(position: float) -> float:
        return float(1.0 / (1.0 + 2.0**-position))

    found = minimize_scalar(
        lambda position: cost(share(position)),
        bounds=(-REACH, REACH),
        method="bounded",
        options={"xatol": 1e-5},
    )
    return float(found.fun), share(float(found.x))


def analyse_razumikhin(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, delay_steps: SupportsIndex, decay_rate: float
) -> RazumikhinWitness | None:
    """C1 analysis: search V = x^T P x with V(k+1) <= (1 - a - tau g) V(k) + tau V(k-d).

    With the relative decay a in (0, 1) of V a sample and g = (1 - a)^-T, find P > 0 and tau > 0
    such that (2n x 2n)::

        diag((1 - a - tau g) P, tau P) - [A_c, A_d]^T P [A_c, A_d] > 0.

    Then V decays by 1 - a a sample for delays up to T, and the loop is stable under any delay.
    Exact for each tau (`WeightedMap`); tau is searched in (0, (1 - a - rho(A_c)^2) / g), outside
    of which there is no P.

    Only `certify` says whether what was found holds. None if no tau admits a P: always so where
    A_c is not stable by itself, because the delay may be infinite.
    """
    A_c, A_d, T = as_loop(A_c, A_d, delay_steps)
    gamma = razumikhin_gamma(decay_rate, T)
    largest = (1.0 - decay_rate - spectral_radius(A_c) ** 2) / gamma
    scaling = balance(A_c)
    if scaling is None or largest <= 0.0:
        return None
    condition = WeightedMap([transformed(scaling, A_c), transformed(scaling, A_d)])

    def weights(share: float) -> tuple[float, float]:
        return 1.0 - decay_rate - share * largest * gamma, share * largest

    radius, share = _least(lambda share: condition.radius(*weights(share)))
    P = condition.solve(*weights(share)) if radius < 1.0 else None
    if P is None:
        return None
    P = symmetrised(scaling.T @ P @ scaling)
    return RazumikhinWitness(P=P, tau=share * largest, decay_rate=decay_rate)


def analyse_delay_razumikhin(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, delay_steps: SupportsIndex
) -> DelayRazumikhinWitness | None:
    """C2 analysis: search V = x^T P x with V(k+1) < max V over the last 2T + 1 samples.

    With M = A_c + A_d, B1 = -A_d (A_c - I) and B2 = -A_d A_d, find P > 0 and p + t1 + t2 < 1
    such that (3n x 3n)::

        diag(p P, t1 P, t2 P) - [M, T B1, T B2]^T P [M, T B1, T B2] > 0.

    Exact for each (p, t1, t2) (`WeightedMap`); searched are p in (rho(A_c + A_d)^2, 1), below
    which there is no P, and the share of t1 in the rest.

    Only `certify` says whether what was found holds. None if A_c + A_d is unstable or no weights
    admit a P: C2 then says nothing (it is more conservative than C3).
    """
    A_c, A_d, T = as_loop(A_c, A_d, delay_steps)
    slowest = spectral_radius(A_c + A_d) ** 2
    scaling = balance(A_c + A_d)
    if scaling is None or slowest >= 1.0:
        return None
    A_z, D_z = transformed(scaling, A_c), transformed(scaling, A_d)
    condition = WeightedMap([A_z + D_z, -T * D_z @ (A_z - np.eye(len(A_z))), -T * D_z @ D_z])

    def weights(share: float, first: float) -> tuple[float, float, float]:
        rest = (1.0 - slowest) * (1.0 - share)
        return slowest + (1.0 - slowest) * share, rest * first, rest * (1.0 - first)

    def best_first(share: float) -> tuple[float, float]:
        return _least(lambda first: condition.radius(*weights(share, first)))

    radius, share = _least(lambda share: best_first(share)[0])
    if radius >= 1.0:
        return None
    # Radius and sum of the weights trade one for one: half of the gap goes to each inequality.
    slack = np.sqrt(radius)
    p, t1, t2 = (float(slack * weight) for weight in weights(share, best_first(share)[1]))
    P = condition.solve(p, t1, t2)
    if P is None:
        return None
    return DelayRazumikhinWitness(P=symmetrised(scaling.T @ P @ scaling), p=p, t1=t1, t2=t2)


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
        if not solve(self._problem):
            return None
        return float(self._margin.value), np.asarray(self._P.value)


def _certifying(
    p: Expression, tau: Expression, Q: Expression, loop: Expression, delayed: Expression
) -> Expression:
    """Return [[p Q, 0, loop^T], [0, tau Q, delayed^T], [loop, delayed, Q]]."""
    zero = np.zeros(Q.shape)
    return symmetric_blocks([[p * Q, zero, loop.T], [tau * Q, delayed.T], [Q]])


class RazumikhinSynthesis:
    """C1 synthesis for one split plant and decay rate a in (0, 1), compiled once and re-solved.

    With Q = P^-1, Y = K Q, g = (1 - a)^-T and p = 1 - a - tau g, min ||(Y - K_nominal Q) W||_F^2
    over Q >= I and Y subject to (3n x 3n)::

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
        inequality = _certifying(
            self._p, self._tau, self._Q, A @ self._Q - B @ self._Y, A_d @ self._Q
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
        inequality = _certifying(
            weight, self._free_tau, np.eye(n), self._A_w - self._B_w @ self._K_w, self._A_d_w
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
        if not solve(self._free):
            return None
        P = symmetrised(np.linalg.inv(self._Q.value))
        K = np.asarray(self._Y.value) @ P @ self._scaling
        return self._solution(K, self._scaling.T @ P @ self._scaling, tau)

    def closest_for(
        self, P: FloatArray, delay_steps: SupportsIndex
    ) -> tuple[FloatArray, RazumikhinWitness] | None:
        """Return the gain closest to the nominal one for a fixed P > 0: (a), exact and convex.

        Minimises ||K^ - K||_F^2 over (K^, tau) subject to (3n x 3n)::

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
        if not solve(self._fixed):
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
