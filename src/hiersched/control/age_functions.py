"""Filters in loops that are not what they believe: a search for functions that fall.

What the functions are, and what certifies them, is in `hiersched.control.age_certificate`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any, SupportsIndex

import numpy as np
import numpy.typing as npt

from hiersched.control.age_certificate import Plant, age_mode, age_parts, age_scales, age_steps
from hiersched.control.checks import FloatArray
from hiersched.control.lqg import Lqg


def search_age_functions(
    lqg: Lqg,
    plants: Sequence[Plant],
    max_age: SupportsIndex,
    *,
    mirror: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
) -> dict[int, FloatArray] | None:
    """Search P_d for the ages 1 to `max_age` and some plants; None where Clarabel finds none.

    Only `certify_age_functions` says whether they hold, for these plants and for those between.
    P_d has (n + m) d + N rows.

    `mirror` has signs +1 and -1 of the N states and of the m inputs that change nothing in the
    filter. V is then the same for a state and its mirror image, and what it does for a plant it
    does for the mirrored one: of each such pair one is enough, and nothing is lost, since the mean
    of a V and its image falls where both do.
    """
    import cvxpy as cp

    from hiersched.control.lmi import solve

    scales = age_scales(lqg, max_age)
    P = {age: _symmetric(_parity(lqg, age, mirror)) for age in scales}
    margin = cp.Variable()
    constraints = [matrix << np.eye(len(scales[age])) for age, matrix in P.items()]
    constraints += [matrix >> margin * np.eye(len(scales[age])) for age, matrix in P.items()]
    for (age, after), plant in product(age_steps(len(scales)), plants):
        M = age_mode(lqg, plant, age, after) * scales[age] / scales[after][:, None]
        change = M.T @ P[after] @ M - P[age]
        constraints.append((change + change.T) / 2 << -margin * np.eye(len(scales[age])))
    problem = cp.Problem(cp.Maximize(margin), constraints)
    # Ten times Clarabel's default, with which it gives up on some problems of three ages at once.
    if not solve(problem, static_regularization_constant=1e-7) or margin.value <= 0.0:
        return None
    return {age: P[age].value / np.outer(scale, scale) for age, scale in scales.items()}


def _parity(lqg: Lqg, age: int, mirror: tuple[npt.ArrayLike, npt.ArrayLike] | None) -> FloatArray:
    """Return the sign of each part of xi under the mirror; all are +1 without one."""
    size, m = lqg.model.B.shape
    states, inputs = (np.ones(size), np.ones(m)) if mirror is None else map(np.asarray, mirror)
    if states.shape != (size,) or inputs.shape != (m,):
        raise ValueError(f"mirror has {states.shape} and {inputs.shape}; it must be {size} and {m}")
    A, B = lqg.model.A * np.outer(states, states), lqg.model.B * np.outer(states, inputs)
    K = lqg.regulator * np.outer(inputs, states)
    L = lqg.filter_gain * np.outer(states, states[: lqg.model.num_measured])
    model = (lqg.model.A, A), (lqg.model.B, B), (lqg.regulator, K), (lqg.filter_gain, L)
    if any(np.abs(own - image).max() > 1e-6 * np.abs(own).max() for own, image in model):
        raise ValueError("mirror changes the filter: signs must leave A, B, K and L as they are")
    return age_parts(states[: lqg.model.num_measured], states, inputs, age)


def _symmetric(parity: FloatArray) -> Any:
    """Return a symmetric matrix of unknowns without entries between parts of other parity."""
    import cvxpy as cp

    found = 0
    for sign in np.unique(parity):
        own = np.eye(len(parity))[:, parity == sign]
        inner = cp.Variable((own.shape[1], own.shape[1]), symmetric=True)
        found = found + own @ inner @ own.T
    return found
