"""Delays of an interval: a stronger Krasovskii functional than C3's, analysis alone.

The closed loop is x(k+1) = A_c x(k) + A_d x(k-d(k)) with h1 <= d(k) <= h2. With eta(k) = x(k+1) -
x(k), h12 = h2 - h1 and xi = (x(k), mean of the last h1 states, mean of the h12 before them),

    V = xi^T P xi + sum over h1 of x^T Q1 x + sum over the h12 before of x^T Q2 x
        + h1 (double sum over h1 of eta^T R1 eta) + h12 (double sum over h12 of eta^T R2 eta).

Sums of eta are bounded by the Wirtinger-based summation inequality (Seuret, Gouaisbaut, Fridman,
IEEE TAC 60(10), 2015), h sum eta^T R eta >= u^T R u + 3 w^T R w, with u = x(k) - x(k-h) and w =
x(k) + x(k-h) - 2 (mean of the h + 1 states), and the two parts into which d cuts the second sum by
the reciprocally convex bound with X. The change of V is then affine in d: both ends decide.
"""

from __future__ import annotations

from typing import Any, NamedTuple, SupportsIndex

import numpy as np
import numpy.typing as npt

from hiersched.control.certificate import Certificate, IntervalWitness, judged
from hiersched.control.checks import FloatArray, as_loop, as_samples, as_symmetric, symmetrised
from hiersched.control.lifted import lift, spectral_radius_by_delay


class _Vectors(NamedTuple):
    """Everything as a linear map of what is free, of N = n times its number: each (n, N)."""

    now: FloatArray  # x(k)
    recent: FloatArray  # x(k-h1)
    delayed: FloatArray  # x(k-d)
    oldest: FloatArray  # x(k-h2)
    mean: FloatArray  # of the states from k-h1 to k, and the next two likewise
    mean_before: FloatArray  # from k-d to k-h1
    mean_last: FloatArray  # from k-h2 to k-d


def _vectors(n: int, least: int, most: int) -> _Vectors:
    """Return the vectors; of those that are the same for these bounds one is free."""
    names = ["now"]
    names += ["recent"] if least > 0 else []
    names += ["mean"] if least > 1 else []
    names += ["delayed", "oldest", "mean_before", "mean_last"] if most > least else []
    free = dict(zip(names, np.split(np.eye(n * len(names)), len(names)), strict=True))
    now = free["now"]
    recent = free.get("recent", now)
    return _Vectors(
        now=now,
        recent=recent,
        delayed=free.get("delayed", recent),
        oldest=free.get("oldest", recent),
        mean=free.get("mean", (now + recent) / 2.0),
        mean_before=free.get("mean_before", recent),
        mean_last=free.get("mean_last", recent),
    )


def _parts(
    vectors: _Vectors, eta: FloatArray, least: int, most: int, delay: int
) -> tuple[FloatArray, FloatArray]:
    """Return xi at a delay, and how it changes, as maps of the free vectors."""
    now, recent, delayed, oldest, mean, mean_before, mean_last = vectors
    xi, change = [now], [eta]
    if least > 0:
        xi.append(((least + 1) * mean - now) / least)
        change.append((now - recent) / least)
    if most > least:
        total = (delay - least + 1) * mean_before + (most - delay + 1) * mean_last
        xi.append((total - recent - delayed) / (most - least))
        change.append((recent - oldest) / (most - least))
    return np.vstack(xi), np.vstack(change)


def _bounds(vectors: _Vectors, least: int) -> tuple[FloatArray, FloatArray, float]:
    """Return u and w over the last h1 states with w's factor, and (u, w) of both later parts."""
    now, recent, delayed, oldest, mean, mean_before, mean_last = vectors
    first = np.vstack([now - recent, now + recent - 2.0 * mean])
    later = np.vstack(
        [
            recent - delayed,
            recent + delayed - 2.0 * mean_before,
            delayed - oldest,
            delayed + oldest - 2.0 * mean_last,
        ]
    )
    return first, later, 3.0 * (least + 1.0) / (least - 1.0) if least > 1 else 0.0


def _interval(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, least_steps: SupportsIndex, most_steps: SupportsIndex
) -> tuple[FloatArray, FloatArray, int, int]:
    least = as_samples("least_steps", least_steps)
    A_c, A_d, most = as_loop(A_c, A_d, most_steps)
    if least > most:
        raise ValueError(f"least_steps is {least}; it must be at most most_steps = {most}")
    return A_c, A_d, least, most


def analyse_interval(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, least_steps: SupportsIndex, most_steps: SupportsIndex
) -> IntervalWitness | None:
    """Search the functional of largest margin for all delays from the least to the longest.

    Solved by Clarabel. Only `certify_interval` says whether what was found holds. None if A_c + A_d
    is unstable or the solver found no positive margin: the loop may still be stable. ValueError if
    the bounds are no interval.
    """
    import cvxpy as cp

    from hiersched.control.lmi import balance, solve, transformed

    A_c, A_d, least, most = _interval(A_c, A_d, least_steps, most_steps)
    n, h = len(A_c), max(most, 1)
    scaling = balance(A_c + A_d)
    if scaling is None:
        return None
    vectors = _vectors(n, least, most)
    eta = (transformed(scaling, A_c) - np.eye(n)) @ vectors.now
    eta = eta + transformed(scaling, A_d) @ vectors.delayed
    size, blocks = eta.shape[1], 1 + (least > 0) + (most > least)
    P = cp.Variable((n * blocks, n * blocks), symmetric=True)
    Q1, Q2, R1, R2 = (cp.Variable((n, n), symmetric=True) for _ in range(4))
    X, margin = cp.Variable((2 * n, 2 * n)), cp.Variable()
    first, later, factor = _bounds(vectors, least)
    zero = np.zeros((n, n))
    R2_twice = cp.bmat([[R2, zero], [zero, 3.0 * R2]])
    coupling = cp.bmat([[R2_twice, X], [X.T, R2_twice]])
    constraints = [P << np.eye(n * blocks), P >> margin * np.eye(n * blocks)]
    constraints += [matrix >> margin * np.eye(n) for matrix in (Q1, Q2, R1, R2)]
    constraints.append((coupling + coupling.T) / 2 >> margin * np.eye(4 * n))
    for delay in {least, most}:
        xi, change = _parts(vectors, eta, least, most, delay)
        cross = h * xi.T @ P @ change
        # h times the bound on V(k+1) - V(k); Q and R stand for h times the functional's.
        total = cross + cross.T + h * change.T @ P @ change
        if least > 0:
            total += vectors.now.T @ Q1 @ vectors.now - vectors.recent.T @ Q1 @ vectors.recent
            total += least**2 * eta.T @ R1 @ eta - first[:n].T @ R1 @ first[:n]
            total -= factor * first[n:].T @ R1 @ first[n:]
        if most > least:
            total += vectors.recent.T @ Q2 @ vectors.recent
            total -= vectors.oldest.T @ Q2 @ vectors.oldest
            total += (most - least) ** 2 * eta.T @ R2 @ eta - later.T @ coupling @ later
        constraints.append((total + total.T) / 2 << -margin * np.eye(size))
    if not solve(cp.Problem(cp.Maximize(margin), constraints)) or margin.value <= 0.0:
        return None

    def back(matrix: Any, copies: int = 1) -> FloatArray:
        L = np.kron(np.eye(copies), scaling)
        return np.asarray(L.T @ matrix.value @ L)

    return IntervalWitness(
        P=symmetrised(back(P, blocks)),
        Q1=symmetrised(back(Q1)) / h,
        Q2=symmetrised(back(Q2)) / h,
        R1=symmetrised(back(R1)) / h,
        R2=symmetrised(back(R2)) / h,
    )


def certify_interval(
    A_c: npt.ArrayLike,
    A_d: npt.ArrayLike,
    least_steps: SupportsIndex,
    most_steps: SupportsIndex,
    witness: IntervalWitness | None,
) -> Certificate:
    """Check a functional for all delays from the least to the longest, constant or varying.

    V is written out as a quadratic form of the lifted state (x(k), ..., x(k-h2)), and its fall over
    a step taken at each delay: no inequality of the analysis is used. What falls strictly at every
    delay falls under every sequence. None is never certified.
    """
    A_c, A_d, least, most = _interval(A_c, A_d, least_steps, most_steps)
    radii = spectral_radius_by_delay(A_c, A_d, most)[least:]
    if witness is None:
        return Certificate(spectral_radii=radii.copy())
    margins, size = _margins(A_c, A_d, least, most, witness)
    return judged(margins, size, radii.copy(), witness)


def _margins(
    A_c: FloatArray, A_d: FloatArray, least: int, most: int, witness: IntervalWitness
) -> tuple[dict[str, float], float]:
    """Return the least eigenvalues of V and of its fall at any of the delays, and V's size."""
    n = len(A_c)
    value = _lifted_value(n, least, most, witness)
    falls = []
    for delay in range(least, most + 1):
        step = lift(A_c, A_d, delay, most)
        fall = symmetrised(value - step.T @ value @ step)
        falls.append(float(np.linalg.eigvalsh(fall)[0]))
    margins = {"V": float(np.linalg.eigvalsh(value)[0]), "fall": min(falls)}
    return margins, 1.0 + float(np.linalg.norm(value))


def _lifted_value(n: int, least: int, most: int, witness: IntervalWitness) -> FloatArray:
    """Return V as a matrix in (x(k), ..., x(k-h2))."""
    states = np.split(np.eye(n * (most + 1)), most + 1)
    changes = [states[j - 1] - states[j] for j in range(1, most + 1)]  # eta(k-j)
    parts = [states[0]]
    parts += [np.mean(states[1 : least + 1], axis=0)] if least > 0 else []
    parts += [np.mean(states[least + 1 :], axis=0)] if most > least else []
    xi = np.vstack(parts)
    P = as_symmetric("P", witness.P, len(xi))
    Q1, Q2, R1, R2 = (
        as_symmetric(name, getattr(witness, name), n) for name in ("Q1", "Q2", "R1", "R2")
    )
    value = xi.T @ P @ xi
    between = most - least
    for j in range(1, most + 1):
        Q, change = (Q1 if j <= least else Q2), changes[j - 1]
        weight = between * min(between, most - j + 1) * R2
        if j <= least:
            weight = weight + least * (least - j + 1) * R1
        value = value + states[j].T @ Q @ states[j] + change.T @ weight @ change
    return symmetrised(value)
