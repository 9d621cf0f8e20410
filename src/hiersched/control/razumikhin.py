"""C1 and C2: Razumikhin conditions, for the analysis of a given loop.

The closed loop is x(k+1) = A_c x(k) + A_d x(k-d(k)), 0 <= d(k) <= T, with V = x^T P x.

C1: V(k+1) <= (1-a-tau g) V(k) + tau V(k-d) with g = (1-a)^-T proves stability under every
delay, and the decay 1-a of V for delays up to T. (g = 1 + a T, its first-order truncation,
proves stability but not that rate.) C2 bounds x(k) - x(k-d) instead and depends on T.
"""

from __future__ import annotations

import math

import cvxpy as cp
import numpy as np
import numpy.typing as npt

from hiersched.control.certificate import DelayRazumikhinWitness, RazumikhinWitness
from hiersched.control.checks import FloatArray, as_delay_steps, as_square, spectral_radius
from hiersched.control.lmi import balance, line_search, solve, symmetrised


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


class LargestMargin:
    """Search P of largest margin t: diag(weights x P) - F^T P F >= t I, P >= 0, trace P = n.

    The fixed trace keeps t informative where it is negative: it guides the scans.

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


def analyse_razumikhin(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, delay_steps: int, decay_rate: float
) -> RazumikhinWitness | None:
    """C1 analysis: search V = x^T P x with V(k+1) <= (1 - a - tau g) V(k) + tau V(k-d).

    With g = (1 - a)^-T, find P > 0 and tau > 0 such that (2n x 2n)

        diag((1 - a - tau g) P, tau P) - [A_c, A_d]^T P [A_c, A_d] > 0.

    Then V decays by 1 - a a sample for delays up to T, and the loop is stable under any delay.
    Linear in P for each tau: Clarabel solves one compiled problem along a scan of tau in
    (0, (1 - a - rho(A_c)^2) / g).

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
        What was found; only `certify` says whether it holds. None if no tau gave a positive
        margin: always so where A_c is not stable by itself, because the delay may be infinite.

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
    search = LargestMargin(np.hstack([scaling @ A_c @ inverse, scaling @ A_d @ inverse]))
    found: dict[float, tuple[float, FloatArray] | None] = {}

    def tau(position: float) -> float:
        return float(largest / (1.0 + 2.0**-position))

    def cost(position: float) -> float:
        if position not in found:
            t = tau(position)
            found[position] = search.solve(1.0 - decay_rate - t * gamma, t)
        best = found[position]
        return math.inf if best is None else -best[0]

    position = line_search(cost, reach=8.0, step=2.0)
    best = found[position]
    if best is None or best[0] <= 0.0:
        return None
    P = symmetrised(scaling.T @ best[1] @ scaling)
    return RazumikhinWitness(P=P, tau=tau(position), decay_rate=decay_rate)


def analyse_delay_razumikhin(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, delay_steps: int
) -> DelayRazumikhinWitness | None:
    """C2 analysis: search V = x^T P x with V(k+1) < max V over the last 2T + 1 samples.

    With M = A_c + A_d, B1 = -A_d (A_c - I) and B2 = -A_d A_d, find P > 0 and p + t1 + t2 < 1
    such that (3n x 3n)

        diag(p P, t1 P, t2 P) - [M, T B1, T B2]^T P [M, T B1, T B2] > 0.

    Linear in P for each (p, t1, t2): Clarabel solves one compiled problem along a search over p
    in (rho(A_c + A_d)^2, 1) and t1 / t2.

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
        weights gave a positive margin: C2 then says nothing (it is more conservative than C3).

    Raises
    ------
    ValueError
        If a matrix or the delay is malformed.
    """
    A_c = as_square("A_c", A_c)
    n = A_c.shape[0]
    A_d = as_square("A_d", A_d, n)
    T = as_delay_steps("delay_steps", delay_steps)
    scaling = balance(A_c + A_d)
    if scaling is None:
        return None
    inverse = np.linalg.inv(scaling)
    A_z, D_z = scaling @ A_c @ inverse, scaling @ A_d @ inverse
    search = LargestMargin(np.hstack([A_z + D_z, -T * D_z @ (A_z - np.eye(n)), -T * D_z @ D_z]))
    slowest = spectral_radius(A_c + A_d) ** 2
    found: dict[tuple[float, float], tuple[float, FloatArray] | None] = {}

    def weights(share: float, first: float) -> tuple[float, float, float]:
        p = slowest + (1.0 - slowest) / (1.0 + 2.0**-share)
        rest = (1.0 - 1e-9) - p
        return p, rest / (1.0 + 2.0**-first), rest / (1.0 + 2.0**first)

    def cost(share: float, first: float) -> float:
        if (share, first) not in found:
            found[share, first] = search.solve(*weights(share, first))
        best = found[share, first]
        return math.inf if best is None else -best[0]

    def best_first(share: float) -> float:
        return line_search(lambda first: cost(share, first), reach=6.0, step=2.0)

    share = line_search(lambda share: cost(share, best_first(share)), reach=6.0, step=2.0)
    first = best_first(share)
    best = found[share, first]
    if best is None or best[0] <= 0.0:
        return None
    p, t1, t2 = weights(share, first)
    P = symmetrised(scaling.T @ best[1] @ scaling)
    return DelayRazumikhinWitness(P=P, p=p, t1=t1, t2=t2)
