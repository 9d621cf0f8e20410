"""C3: the delay-dependent Lyapunov-Krasovskii condition, for the analysis of a given loop.

The closed loop is x(k+1) = A_c x(k) + A_d x(k-d(k)), 0 <= d(k) <= T, with the functional
V = x^T P x + (sum of x^T S x over T samples) + T (double sum of eta^T R eta), eta(k) = x(k+1) -
x(k). Throughout, S, R and X stand for T times the functional's, and eta is counted per delay
(T eta): the unknowns and the line search are then of order one at every T and sampling
interval, and the inequality is the one of a continuous system with delay 1 as T grows.
`krasovskii_synthesis` designs gains with the same functional.
"""

from __future__ import annotations

from typing import SupportsIndex

import cvxpy as cp
import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_discrete_lyapunov

from hiersched.control.certificate import KrasovskiiWitness
from hiersched.control.checks import FloatArray, as_loop, symmetrised
from hiersched.control.lmi import Expression, balance, solve, symmetric_blocks, transformed


def analyse_krasovskii(
    A_c: npt.ArrayLike, A_d: npt.ArrayLike, delay_steps: SupportsIndex
) -> KrasovskiiWitness | None:
    """C3 analysis: search the Krasovskii functional of largest margin for a given loop.

    With x = x(k), o = x(k-T), d = x(k-d), e = eta(k) = (A_c - I) x + A_d d, find symmetric P, S, R
    and a full X such that for all (x, o, d) other than 0

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
    decrease = _decrease(transformed(scaling, A_c), transformed(scaling, A_d), T, P, S, coupling)
    problem = cp.Problem(
        cp.Maximize(margin),
        [
            decrease << -margin * np.eye(3 * n),
            coupling >> margin * np.eye(2 * n),
            S >> margin * np.eye(n),
            P >> margin * np.eye(n),
            P << np.eye(n),
        ],
    )
    if not solve(problem) or margin.value is None or margin.value <= 0.0:
        return None
    P, S, R, X = (scaling.T @ value @ scaling for value in (P.value, S.value, R.value, X.value))
    return KrasovskiiWitness(P=symmetrised(P), S=symmetrised(S) / T, R=symmetrised(R) / T, X=X / T)


def _decrease(
    A_c: FloatArray, A_d: FloatArray, T: int, P: Expression, S: Expression, coupling: Expression
) -> Expression:
    """Return T times the bound on V(k+1) - V(k), as a matrix in (x(k), x(k-T), x(k-d))."""
    n = A_c.shape[0]
    now, oldest, delayed = np.split(np.eye(3 * n), 3)
    change = np.hstack([T * (A_c - np.eye(n)), np.zeros((n, n)), T * A_d])
    gaps = np.vstack([now - delayed, delayed - oldest])
    cross = now.T @ P @ change
    R = coupling[:n, :n]
    total = (
        cross
        + cross.T
        + change.T @ (P / T + R) @ change
        + now.T @ S @ now
        - oldest.T @ S @ oldest
        - gaps.T @ coupling @ gaps
    )
    return (total + total.T) / 2
