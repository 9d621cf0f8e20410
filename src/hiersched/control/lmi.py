"""What the matrix inequalities share: the solver call, symmetry, coordinates."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Callable
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from hiersched.control.checks import FloatArray, spectral_radius

logger = logging.getLogger(__name__)

Expression = Any  # cvxpy ships incomplete annotations

STRICT = 1e-6
"""Smallest eigenvalue that stands for a strict inequality, where the unknowns are of order 1."""


def solve(problem: cp.Problem) -> bool:
    """Solve with Clarabel and return whether there is a solution to look at.

    Inaccurate solutions count: whatever comes out passes the independent certificate before it
    is used, so the solver's word is never relied on.
    """
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Solution may be inaccurate")
            problem.solve(solver=cp.CLARABEL)
    except cp.SolverError as error:
        logger.debug("Clarabel gave up: %s", error)
        return False
    return problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)


def symmetric_blocks(upper: list[list[Expression]]) -> Expression:
    """Return the symmetric block matrix whose upper triangle, row by row, is given.

    Parameters
    ----------
    upper : list of list
        Row i holds the blocks (i, i), ..., (i, last).

    Returns
    -------
    cvxpy expression
        The full matrix, symmetrised so that rounding cannot make it asymmetric.
    """
    size = len(upper)
    full = [
        [upper[i][j - i] if j >= i else upper[j][i - j].T for j in range(size)] for i in range(size)
    ]
    matrix = cp.bmat(full)
    return (matrix + matrix.T) / 2


def balance(M: FloatArray) -> FloatArray | None:
    """Return coordinates in which a stable matrix is well scaled.

    Parameters
    ----------
    M : ndarray, shape (n, n)
        A matrix that has to be stable for the inequality to be feasible.

    Returns
    -------
    ndarray, shape (n, n), or None
        L^T of z = L^T x, where L L^T solves M^T W M - W + I = 0; None if M is not stable, or so
        near to the edge that rounding leaves no such W.
    """
    if spectral_radius(M) >= 1.0:
        return None
    try:
        W = np.asarray(solve_discrete_lyapunov(M.T, np.eye(M.shape[0])), dtype=np.float64)
        return np.asarray(np.linalg.cholesky((W + W.T) / 2.0).T, dtype=np.float64)
    except np.linalg.LinAlgError:
        return None


def symmetrised(matrix: FloatArray) -> FloatArray:
    """Return (M + M^T) / 2."""
    return np.asarray((matrix + matrix.T) / 2.0, dtype=np.float64)


def line_search(
    cost: Callable[[float], float], *, reach: float, step: float = 1.0, finest: float = 0.25
) -> float:
    """Minimise a costly function of one number on a grid, from coarse to fine.

    Parameters
    ----------
    cost : callable
        The function; infinite where infeasible. It should remember what it has computed.
    reach : float
        Only points within this distance of 0 are tried.
    step, finest : float
        First and last distance between neighbours; it is halved in between.

    Returns
    -------
    float
        The best point found: the nearest feasible one to 0, then downhill. 0 if none is feasible.
    """
    count = int(reach / step)
    starts = sorted((k * step for k in range(-count, count + 1)), key=lambda x: (abs(x), -x))
    best = next((start for start in starts if math.isfinite(cost(start))), None)
    if best is None:
        return 0.0
    while step >= finest:
        neighbours = [x for x in (best - step, best + step) if abs(x) <= reach]
        candidate = min(neighbours, key=cost)
        if cost(candidate) < cost(best):
            best = candidate
        else:
            step /= 2.0
    return best
