"""Certificates of stability under delay, checked with NumPy alone.

Nothing here is shared with the code that solves the inequalities: a witness is a set of
matrices from anywhere, and the check recomputes its inequalities' eigenvalues in the original
state, besides the spectrum of every constant delay. The closed loop is always
x(k+1) = A_c x(k) + A_d x(k-d(k)) with 0 <= d(k) <= T.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from hiersched.control.checks import (
    FloatArray,
    as_delay_steps,
    as_square,
    as_symmetric,
    spectral_radius,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class RazumikhinWitness:
    """C1: V = x^T P x decays by 1 - decay_rate a sample; any delay is stable, rate up to T."""

    criterion: ClassVar[str] = "razumikhin"
    P: FloatArray
    tau: float
    decay_rate: float


@dataclass(frozen=True, kw_only=True, eq=False)
class DelayRazumikhinWitness:
    """C2: delay-dependent Razumikhin condition with the weights p + t1 + t2 < 1."""

    criterion: ClassVar[str] = "delay_razumikhin"
    P: FloatArray
    p: float
    t1: float
    t2: float


@dataclass(frozen=True, kw_only=True, eq=False)
class KrasovskiiWitness:
    """C3: delay-dependent Lyapunov-Krasovskii functional (P, S, R) with the coupling X."""

    criterion: ClassVar[str] = "krasovskii"
    P: FloatArray
    S: FloatArray
    R: FloatArray
    X: FloatArray


Witness = RazumikhinWitness | DelayRazumikhinWitness | KrasovskiiWitness


@dataclass(frozen=True, kw_only=True, eq=False)
class Certificate:
    """Outcome of a check.

    Parameters
    ----------
    certified : bool
        Whether every margin exceeds the rounding error and every spectral radius is below 1.
    criterion : str
        Name of the condition; "none" where no witness was found.
    delay_steps : int
        Longest delay T in samples that the condition covers.
    margins : mapping of str to float
        Smallest eigenvalue of every matrix that must be positive definite, in the coordinates
        where P is the identity; all must exceed `tolerance`.
    tolerance : float
        Bound on the rounding error of the margins.
    spectral_radii : ndarray, shape (T + 1,)
        Spectral radius of the lifted system at each constant delay 0..T.
    witness : RazumikhinWitness, DelayRazumikhinWitness, KrasovskiiWitness or None
        The matrices checked.
    """

    certified: bool
    criterion: str
    delay_steps: int
    margins: Mapping[str, float]
    tolerance: float
    spectral_radii: FloatArray
    witness: Witness | None


def lift(A_c: npt.ArrayLike, A_d: npt.ArrayLike, delay_steps: int) -> FloatArray:
    """Return the delay-free matrix that acts on [x(k), ..., x(k-T)] at the constant delay T.

    Parameters
    ----------
    A_c, A_d : array_like, shape (n, n)
        Undelayed and delayed matrix.
    delay_steps : int
        Constant delay T in samples, at least 0.

    Returns
    -------
    ndarray, shape (n (T+1), n (T+1))
        First block row A_c at column 0 plus A_d at column T, identity shift below.

    Raises
    ------
    ValueError
        If a matrix is malformed or the delay negative.
    """
    A_c, A_d, steps = _loop(A_c, A_d, delay_steps)
    n = A_c.shape[0]
    lifted = np.zeros((n * (steps + 1), n * (steps + 1)))
    lifted[:n, :n] = A_c
    lifted[:n, n * steps :] += A_d
    lifted[n:, : n * steps] = np.eye(n * steps)
    return lifted


def spectral_radius_by_delay(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, max_delay_steps: int
) -> FloatArray:
    """Return the spectral radius of the lifted system for each constant delay 0..T.

    With A_d = U V of rank r, only V x has to be remembered, so the matrix has n + r d rows
    rather than n (d+1); the nonzero eigenvalues are the same.

    Parameters
    ----------
    A_c, A_d : array_like, shape (n, n)
        Undelayed and delayed matrix.
    max_delay_steps : int
        Longest delay T in samples.

    Returns
    -------
    ndarray, shape (T + 1,)
        Spectral radii.

    Raises
    ------
    ValueError
        If a matrix is malformed or the delay negative.
    """
    A_c, A_d, steps = _loop(A_c, A_d, max_delay_steps)
    n = A_c.shape[0]
    left, singular, V = np.linalg.svd(A_d)
    rank = int(np.count_nonzero(singular > n * np.finfo(float).eps * singular[0]))
    U, V = left[:, :rank] * singular[:rank], V[:rank]
    radii = np.empty(steps + 1)
    radii[0] = spectral_radius(A_c + A_d)
    for delay in range(1, steps + 1):
        matrix = np.zeros((n + rank * delay, n + rank * delay))
        matrix[:n, :n] = A_c
        matrix[:n, n + rank * (delay - 1) :] = U
        matrix[n : n + rank, :n] = V
        matrix[n + rank :, n : n + rank * (delay - 1)] = np.eye(rank * (delay - 1))
        radii[delay] = spectral_radius(matrix)
    return radii


def certify(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, delay_steps: int, witness: Witness | None
) -> Certificate:
    """Check a witness of stability for all delays 0..T, constant or varying.

    Parameters
    ----------
    A_c, A_d : array_like, shape (n, n)
        Undelayed and delayed matrix of the closed loop.
    delay_steps : int
        Longest delay T in samples.
    witness : RazumikhinWitness, DelayRazumikhinWitness, KrasovskiiWitness or None
        The matrices to check; None (nothing found) is never certified.

    Returns
    -------
    Certificate
        The verdict with its margins; a witness that fails is no error.

    Raises
    ------
    ValueError
        If a matrix or a number is malformed.
    """
    A_c, A_d, steps = _loop(A_c, A_d, delay_steps)
    radii = spectral_radius_by_delay(A_c, A_d, steps)
    radii.setflags(write=False)
    if witness is None:
        return Certificate(
            certified=False,
            criterion="none",
            delay_steps=steps,
            margins={},
            tolerance=0.0,
            spectral_radii=radii,
            witness=None,
        )
    margins, scale = _margins(A_c, A_d, steps, witness)
    tolerance = 100.0 * float(np.finfo(float).eps) * scale
    return Certificate(
        certified=all(margin > tolerance for margin in margins.values())
        and bool((radii < 1.0).all()),
        criterion=witness.criterion,
        delay_steps=steps,
        margins=margins,
        tolerance=tolerance,
        spectral_radii=radii,
        witness=witness,
    )


def _margins(
    A_c: FloatArray, A_d: FloatArray, steps: int, witness: Witness
) -> tuple[dict[str, float], float]:
    """Return the eigenvalue margins, and the size of the numbers they were computed from."""
    P = as_symmetric("P", witness.P, A_c.shape[0])
    smallest = _min_eigenvalue(P)
    if smallest <= 0.0:
        return {"P": smallest}, 1.0
    # z = L^T x makes P the identity: margins then mean the same whatever the units of x.
    L = np.asarray(np.linalg.cholesky(P), dtype=np.float64)
    A_z, D_z = (np.asarray(np.linalg.solve(L, (L.T @ M).T).T, float) for M in (A_c, A_d))
    if isinstance(witness, RazumikhinWitness):
        return _razumikhin_margins(A_z, D_z, steps, witness)
    if isinstance(witness, DelayRazumikhinWitness):
        return _delay_razumikhin_margins(A_z, D_z, steps, witness)
    return _krasovskii_margins(A_z, D_z, steps, witness, L)


def _razumikhin_margins(
    A_c: FloatArray, A_d: FloatArray, steps: int, witness: RazumikhinWitness
) -> tuple[dict[str, float], float]:
    """C1 where P = I: diag((1 - a - tau g) I, tau I) - [A_c A_d]^T [A_c A_d], g = (1-a)^-T."""
    rate, tau = _number("decay_rate", witness.decay_rate), _number("tau", witness.tau)
    if not 0.0 < rate < 1.0:
        raise ValueError(f"decay_rate is {rate!r}; it must lie in (0, 1)")
    n = A_c.shape[0]
    gamma = (1.0 - rate) ** -steps
    F = np.hstack([A_c, A_d])
    weights = np.repeat([1.0 - rate - tau * gamma, tau], n)
    margin = _min_eigenvalue(np.diag(weights) - F.T @ F)
    return {"inequality": margin, "tau": tau}, 1.0 + float(np.linalg.norm(F) ** 2)


def _delay_razumikhin_margins(
    A_c: FloatArray, A_d: FloatArray, steps: int, witness: DelayRazumikhinWitness
) -> tuple[dict[str, float], float]:
    """C2 where P = I: diag(p, t1, t2) - G^T G, G = [A_c+A_d, -T A_d (A_c-I), -T A_d A_d]."""
    p, t1, t2 = (_number(name, getattr(witness, name)) for name in ("p", "t1", "t2"))
    n = A_c.shape[0]
    G = np.hstack([A_c + A_d, -steps * A_d @ (A_c - np.eye(n)), -steps * A_d @ A_d])
    margin = _min_eigenvalue(np.diag(np.repeat([p, t1, t2], n)) - G.T @ G)
    margins = {"inequality": margin, "contraction": 1.0 - (p + t1 + t2)}
    return margins, 1.0 + float(np.linalg.norm(G) ** 2)


def _krasovskii_margins(
    A_c: FloatArray, A_d: FloatArray, steps: int, witness: KrasovskiiWitness, L: FloatArray
) -> tuple[dict[str, float], float]:
    """C3 where P = I, as the decrease of V along (x(k), x(k-T), x(k-d)), shape (3n, 3n).

    V = x^T P x + sum of x^T S x over T samples + T times the double sum of eta^T R eta; the
    sums' difference is bounded by Jensen's inequality and the reciprocally convex bound with X.
    """
    n = A_c.shape[0]
    next_state = np.hstack([A_c, np.zeros((n, n)), A_d])
    if steps == 0:  # the delay is always 0: V = x^T P x alone
        loop = A_c + A_d
        margin = _min_eigenvalue(np.eye(n) - loop.T @ loop)
        return {"inequality": margin}, 1.0 + float(np.linalg.norm(loop) ** 2)
    S = _congruent(L, as_symmetric("S", witness.S, n))
    R = _congruent(L, as_symmetric("R", witness.R, n))
    X = _congruent(L, as_square("X", witness.X, n))
    now, oldest, delayed = np.split(np.eye(3 * n), 3)
    eta = next_state - now
    gaps = np.vstack([now - delayed, delayed - oldest])
    coupling = np.block([[R, X], [X.T, R]])
    terms = (
        next_state.T @ next_state - now.T @ now,
        now.T @ S @ now - oldest.T @ S @ oldest,
        steps**2 * eta.T @ R @ eta,
        -gaps.T @ coupling @ gaps,
    )
    margins = {
        "inequality": _min_eigenvalue(-sum(terms, np.zeros((3 * n, 3 * n)))),
        "coupling": _min_eigenvalue(coupling),
        "S": _min_eigenvalue(S),
    }
    return margins, 1.0 + sum(float(np.linalg.norm(term)) for term in terms)


def _congruent(L: FloatArray, matrix: FloatArray) -> FloatArray:
    """Return L^-1 M L^-T, the matrix of the same form in z = L^T x."""
    return np.linalg.solve(L, np.linalg.solve(L, matrix.T).T)


def _min_eigenvalue(matrix: FloatArray) -> float:
    return float(np.linalg.eigvalsh((matrix + matrix.T) / 2.0)[0])


def _number(name: str, value: float) -> float:
    if not np.isfinite(value):
        raise ValueError(f"{name} is {value!r}; it must be finite")
    return float(value)


def _loop(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, delay_steps: int
) -> tuple[FloatArray, FloatArray, int]:
    A_c = as_square("A_c", A_c)
    A_d = as_square("A_d", A_d, A_c.shape[0])
    return A_c, A_d, as_delay_steps("delay_steps", delay_steps)
