"""What the matrix inequalities share: coordinates, the solver call, the searches around it."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Callable
from functools import cache
from typing import Any, Generic, NamedTuple, TypeVar

import cvxpy as cp
import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from hiersched.control.checks import FloatArray, spectral_radius, symmetrised

logger = logging.getLogger(__name__)

Expression = Any  # cvxpy ships incomplete annotations

STRICT = 1e-6
"""Smallest eigenvalue that stands for a strict inequality, where the unknowns are of order 1."""


def solve(problem: cp.Problem, **settings: float) -> bool:
    """Solve with Clarabel and return whether the variables have values to look at.

    Inaccurate solutions count: whatever comes out passes the independent certificate before it
    is used, so the solver's word is never relied on.
    """
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Solution may be inaccurate")
            problem.solve(solver=cp.CLARABEL, **settings)
    except cp.SolverError as error:
        logger.debug("Clarabel gave up: %s", error)
        return False
    return problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)


def symmetric_blocks(upper: list[list[Expression]]) -> Expression:
    """Return the symmetric block matrix whose row i, from the diagonal on, is ``upper[i]``."""
    rows = range(len(upper))
    blocks = [[upper[i][j - i] if j >= i else upper[j][i - j].T for j in rows] for i in rows]
    matrix = cp.bmat(blocks)
    return (matrix + matrix.T) / 2  # rounding cannot make it asymmetric


def balance(M: FloatArray) -> FloatArray | None:
    """Return L^T of z = L^T x, coordinates in which a stable matrix is well scaled.

    L L^T solves M^T W M - W + I = 0. None if M is not stable, or so near to the edge that
    rounding leaves no such W.
    """
    if spectral_radius(M) >= 1.0:
        return None
    try:
        W = np.asarray(solve_discrete_lyapunov(M.T, np.eye(M.shape[0])), dtype=np.float64)
        return np.asarray(np.linalg.cholesky(symmetrised(W)).T, dtype=np.float64)
    except np.linalg.LinAlgError:
        return None


def transformed(C: FloatArray, A: FloatArray) -> FloatArray:
    """Return C A C^-1: the map A in the coordinates z = C x."""
    return np.asarray(C @ A @ np.linalg.inv(C), dtype=np.float64)


Proof = TypeVar("Proof")


class Solution(NamedTuple, Generic[Proof]):
    """A gain (m, n), its distance ||K - K_nominal||_F, and what it was found with."""

    K: FloatArray
    deviation: float
    proof: Proof


def line_search(
    solve_for: Callable[[float], Solution[Proof] | None], centre: float
) -> Solution[Proof] | None:
    """Return the solution of least deviation over a scalar, or None if no scalar has one.

    The scalar lies on the grid centre * 2^e, -4 <= e <= 4: the nearest feasible one to the centre,
    then downhill in steps of e from 1 to 1/4.
    """
    found = cache(lambda exponent: solve_for(centre * 2.0**exponent))

    def deviation(exponent: float) -> float:
        solution = found(exponent)
        return math.inf if solution is None else solution.deviation

    starts = sorted(range(-4, 5), key=lambda e: (abs(e), -e))
    best = next((float(start) for start in starts if math.isfinite(deviation(start))), None)
    if best is None:
        return None
    step = 1.0
    while step >= 0.25:
        neighbours = [e for e in (best - step, best + step) if abs(e) <= 4.0]
        candidate = min(neighbours, key=deviation)
        if deviation(candidate) < deviation(best):
            best = candidate
        else:
            step /= 2.0
    return found(best)


def refine(
    best: Solution[Proof],
    improve: Callable[[Solution[Proof]], Solution[Proof] | None],
    rounds: int,
) -> Solution[Proof]:
    """Improve a solution at most so many times, while its deviation falls by a thousandth."""
    for _ in range(rounds):
        candidate = improve(best)
        if candidate is None or candidate.deviation >= best.deviation * (1.0 - 1e-3):
            break
        best = candidate
    return best
