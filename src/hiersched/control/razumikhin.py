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

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar

from hiersched.control.certificate import DelayRazumikhinWitness, RazumikhinWitness
from hiersched.control.checks import FloatArray, as_delay_steps, as_square, spectral_radius
from hiersched.control.lmi import balance, symmetrised

REACH = 12.0
"""The searches go over shares from 2^-REACH to 1 - 2^-REACH: where the best share is 0, they may
miss the last ten-thousandth of what a condition can certify."""


def razumikhin_gamma(decay_rate: float, delay_steps: int) -> float:
    """Return g = (1 - a)^-T, the bound V(k-d) <= g V(k) that certifies the decay rate a.

    Parameters
    ----------
    decay_rate : float
        Relative decay a of V per sample, in (0, 1).
    delay_steps : int
        Longest delay T in samples.

    Returns
    -------
    float
        At least the paper's 1 + a T (Bernoulli's inequality).

    Raises
    ------
    ValueError
        If a number is outside its range.
    """
    if not 0.0 < decay_rate < 1.0:
        raise ValueError(f"decay_rate is {decay_rate!r}; it must lie in (0, 1)")
    return float((1.0 - decay_rate) ** -as_delay_steps("delay_steps", delay_steps))


class WeightedMap:
    """The map Q -> sum_i F_i Q F_i^T / w_i of symmetric matrices, which decides on a P.

    With F = [F_1, ..., F_k] and Q = P^-1, the Schur complement turns the condition

        diag(w_1 P, ..., w_k P) - F^T P F > 0        (k n x k n)

    into Q > sum_i F_i Q F_i^T / w_i (n x n). The map keeps positive matrices positive, so there
    is such a P if and only if its spectral radius is below 1. This radius is a limit of sums of
    products of the 1/w_i with positive factors: its logarithm is convex in the weights, so that
    searches over them meet one valley only.

    Parameters
    ----------
    blocks : sequence of ndarray, shape (n, n) each
        F_1, ..., F_k.
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


def least(cost: Callable[[float], float]) -> tuple[float, float]:
    """Minimise a function of one valley over the shares (0, 1).

    Parameters
    ----------
    cost : callable
        Function of the share.

    Returns
    -------
    cost, share : float
        The least cost found and where; shares are compared as log2(share / (1 - share)), to 1e-5.
    """
    found = minimize_scalar(
        lambda position: cost(_share(position)),
        bounds=(-REACH, REACH),
        method="bounded",
        options={"xatol": 1e-5},
    )
    return float(found.fun), _share(float(found.x))


def _share(position: float) -> float:
    return float(1.0 / (1.0 + 2.0**-position))


def analyse_razumikhin(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, delay_steps: int, decay_rate: float
) -> RazumikhinWitness | None:
    """C1 analysis: search V = x^T P x with V(k+1) <= (1 - a - tau g) V(k) + tau V(k-d).

    With g = (1 - a)^-T, find P > 0 and tau > 0 such that (2n x 2n)

        diag((1 - a - tau g) P, tau P) - [A_c, A_d]^T P [A_c, A_d] > 0.

    Then V decays by 1 - a a sample for delays up to T, and the loop is stable under any delay.
    Exact for each tau (`WeightedMap`); tau is searched in (0, (1 - a - rho(A_c)^2) / g), outside
    of which there is no P.

    Parameters
    ----------
    A_c, A_d : array_like, shape (n, n)
        Undelayed and delayed matrix of the closed loop.
    delay_steps : int
        Longest delay T in samples over which the decay rate has to hold.
    decay_rate : float
        Relative decay a of V per sample, in (0, 1).

    Returns
    -------
    RazumikhinWitness or None
        What was found; only `certify` says whether it holds. None if no tau admits a P: always
        so where A_c is not stable by itself, because the delay may be infinite.

    Raises
    ------
    ValueError
        If a matrix or a number is malformed.
    """
    A_c = as_square("A_c", A_c)
    A_d = as_square("A_d", A_d, A_c.shape[0])
    gamma = razumikhin_gamma(decay_rate, delay_steps)
    largest = (1.0 - decay_rate - spectral_radius(A_c) ** 2) / gamma
    scaling = balance(A_c)
    if scaling is None or largest <= 0.0:
        return None
    inverse = np.linalg.inv(scaling)
    condition = WeightedMap([scaling @ A_c @ inverse, scaling @ A_d @ inverse])

    def weights(share: float) -> tuple[float, float]:
        return 1.0 - decay_rate - share * largest * gamma, share * largest

    radius, share = least(lambda share: condition.radius(*weights(share)))
    P = condition.solve(*weights(share)) if radius < 1.0 else None
    if P is None:
        return None
    P = symmetrised(scaling.T @ P @ scaling)
    return RazumikhinWitness(P=P, tau=share * largest, decay_rate=decay_rate)


def analyse_delay_razumikhin(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, delay_steps: int
) -> DelayRazumikhinWitness | None:
    """C2 analysis: search V = x^T P x with V(k+1) < max V over the last 2T + 1 samples.

    With M = A_c + A_d, B1 = -A_d (A_c - I) and B2 = -A_d A_d, find P > 0 and p + t1 + t2 < 1
    such that (3n x 3n)

        diag(p P, t1 P, t2 P) - [M, T B1, T B2]^T P [M, T B1, T B2] > 0.

    Exact for each (p, t1, t2) (`WeightedMap`); searched are p in (rho(A_c + A_d)^2, 1), below
    which there is no P, and the share of t1 in the rest.

    Parameters
    ----------
    A_c, A_d : array_like, shape (n, n)
        Undelayed and delayed matrix of the closed loop.
    delay_steps : int
        Longest delay T in samples.

    Returns
    -------
    DelayRazumikhinWitness or None
        What was found; only `certify` says whether it holds. None if A_c + A_d is unstable or no
        weights admit a P: C2 then says nothing (it is more conservative than C3).

    Raises
    ------
    ValueError
        If a matrix or the delay is malformed.
    """
    A_c = as_square("A_c", A_c)
    n = A_c.shape[0]
    A_d = as_square("A_d", A_d, n)
    T = as_delay_steps("delay_steps", delay_steps)
    slowest = spectral_radius(A_c + A_d) ** 2
    scaling = balance(A_c + A_d)
    if scaling is None or slowest >= 1.0:
        return None
    inverse = np.linalg.inv(scaling)
    A_z, D_z = scaling @ A_c @ inverse, scaling @ A_d @ inverse
    condition = WeightedMap([A_z + D_z, -T * D_z @ (A_z - np.eye(n)), -T * D_z @ D_z])

    def weights(share: float, first: float) -> tuple[float, float, float]:
        rest = (1.0 - slowest) * (1.0 - share)
        return slowest + (1.0 - slowest) * share, rest * first, rest * (1.0 - first)

    def best_first(share: float) -> tuple[float, float]:
        return least(lambda first: condition.radius(*weights(share, first)))

    radius, share = least(lambda share: best_first(share)[0])
    if radius >= 1.0:
        return None
    # Radius and sum of the weights trade one for one: half of the gap goes to each inequality.
    slack = np.sqrt(radius)
    p, t1, t2 = (float(slack * weight) for weight in weights(share, best_first(share)[1]))
    P = condition.solve(p, t1, t2)
    if P is None:
        return None
    P = symmetrised(scaling.T @ P @ scaling)
    return DelayRazumikhinWitness(P=P, p=p, t1=t1, t2=t2)
