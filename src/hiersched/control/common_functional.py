"""A common Krasovskii functional for loops that are switched while they run."""

from __future__ import annotations

from collections.abc import Sequence

import cvxpy as cp
import numpy as np

from hiersched.control.checks import FloatArray, symmetrised
from hiersched.control.functional import krasovskii_form
from hiersched.control.lmi import Expression, balance, solve, symmetric_blocks, transformed

Loop = tuple[FloatArray, FloatArray]


def common_functional(loops: Sequence[Loop], limits: Sequence[int]) -> FloatArray | None:
    """Search one functional that falls in every loop (A_c, A_d)_i under all delays 0..T_i.

    C3 with weights S_s, R_s that may differ between the segments h_{s-1} < l <= h_s, where the h_s
    are the distinct T_i > 0. With w_s = h_s - h_{s-1}, e = (A_c - I) x(k) + A_d x(k-d) and x_s =
    x(k-h_s), for every loop i and segment q with h_q <= T_i (the delay lies in q):

        2 x^T P e + e^T P e + sum_s (x_{s-1}^T S_s x_{s-1} - x_s^T S_s x_s + w_s^2 e^T R_s e)
            - sum_{s != q} (x_{s-1} - x_s)^T R_s (x_{s-1} - x_s)
            - [x_{q-1} - x_d; x_d - x_q]^T [[R_q, X_iq], [X_iq^T, R_q]] [same] < 0.

    Linear in everything, with (N + 2) n rows for N segments. Clarabel, in coordinates where the
    first loop without delay is well scaled.

    `limits` are the T_i in samples. Returns the functional of z = [x(k), ..., x(k-H)], H = max T_i,
    shape (n (H+1), n (H+1)); `functional.contraction` says whether it falls. None if the first loop
    is unstable without delay or no margin was found.
    """
    scaling = balance(loops[0][0] + loops[0][1])
    if scaling is None:
        return None
    n = scaling.shape[0]
    edges = [0, *sorted({limit for limit in limits if limit > 0})]
    P, *weights = (cp.Variable((n, n), symmetric=True) for _ in range(2 * len(edges) - 1))
    S, R = weights[: len(edges) - 1], weights[len(edges) - 1 :]
    margin = cp.Variable()
    constraints = [P << np.eye(n), *(weight >> margin * np.eye(n) for weight in (P, *weights))]
    for (A_c, A_d), limit in zip(loops, limits, strict=True):
        loop = transformed(scaling, A_c), transformed(scaling, A_d)
        for segment in range(edges.index(limit)) if limit else [-1]:
            X = cp.Variable((n, n))
            change = _change(loop, edges, P, S, R, X, segment)
            if segment < 0:
                change = change[:-n, :-n]  # without a delay there is no x_d
            constraints.append(change << -margin * np.eye(change.shape[0]))
            if segment >= 0:
                constraints.append(symmetric_blocks([[R[segment], X], [R[segment]]]) >> 0)
    if not solve(cp.Problem(cp.Maximize(margin), constraints)) or margin.value <= 0.0:
        return None
    P, *weights = (symmetrised(scaling.T @ M.value @ scaling) for M in (P, *weights))
    weights = [weight / max(edges[-1], 1) for weight in weights]
    return krasovskii_form(P, weights[: len(S)], weights[len(S) :], edges[1:])


def _change(
    loop: Loop,
    edges: Sequence[int],
    P: Expression,
    S: Sequence[Expression],
    R: Sequence[Expression],
    X: Expression,
    segment: int,
) -> Expression:
    """Return H times the bound on V(k+1) - V(k) in (x_0, ..., x_N, x_d), as in `krasovskii`.

    S and R stand for H times the functional's. Segment -1 means no delay: x_d = x_0.
    """
    A_c, A_d = loop
    n, H = A_c.shape[0], max(edges[-1], 1)
    *x, x_d = np.split(np.eye((len(edges) + 1) * n), len(edges) + 1)
    if segment < 0:
        x_d = x[0]
    e = H * ((A_c - np.eye(n)) @ x[0] + A_d @ x_d)
    cross = x[0].T @ P @ e
    total = cross + cross.T + e.T @ P @ e / H
    for s, (S_s, R_s) in enumerate(zip(S, R, strict=True)):
        total += x[s].T @ S_s @ x[s] - x[s + 1].T @ S_s @ x[s + 1]
        total += ((edges[s + 1] - edges[s]) / H) ** 2 * (e.T @ R_s @ e)
        if s == segment:
            gaps = np.vstack([x[s] - x_d, x_d - x[s + 1]])
            total -= gaps.T @ symmetric_blocks([[R_s, X], [R_s]]) @ gaps
        else:
            gap = x[s] - x[s + 1]
            total -= gap.T @ R_s @ gap
    return (total + total.T) / 2
