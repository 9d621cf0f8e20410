"""C1 and C2: Razumikhin conditions, for the analysis of a given loop.

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

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar

from hiersched.control.certificate import DelayRazumikhinWitness, RazumikhinWitness
from hiersched.control.checks import (
    FloatArray,
    as_decay_rate,
    as_loop,
    as_samples,
    spectral_radius,
    symmetrised,
)
from hiersched.control.lmi import balance, transformed

REACH = 12.0
"""The searches go over shares from 2^-REACH to 1 - 2^-REACH: where the best share is 0, they may
miss the last ten-thousandth of what a condition can certify."""


def razumikhin_gamma(decay_rate: float, delay_steps: SupportsIndex) -> float:
    """Return g = (1 - a)^-T, the bound V(k-d) <= g V(k) that certifies the decay a in (0, 1).

    It is at least the paper's 1 + a T (Bernoulli's inequality).
    """
    return (1.0 - as_decay_rate(decay_rate)) ** -as_samples("delay_steps", delay_steps)


class WeightedMap:
    """The map Q -> sum_i F_i Q F_i^T / w_i of symmetric matrices, which decides on a P.

    With F = [F_1, ..., F_k] (`blocks`, (n, n) each) and Q = P^-1, the Schur complement turns

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
    such that (2n x 2n)

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
    such that (3n x 3n)

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
