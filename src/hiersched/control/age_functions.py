"""Filters in loops that are not what they believe: quadratic functions under ages that switch.

Separation holds for the model. With another plant the error of the estimate depends on the inputs,
and the loop switches with the age of the newest measurement. Searched is one quadratic function for
each age, V_d = xi^T P_d xi, that falls at every step from any age d to any that a queue can make of
it, 1 to d + 1, for a set of plants: the loop is then stable however age and plant switch among
these.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import SupportsIndex

import numpy as np
import numpy.typing as npt

from hiersched.control.checks import FloatArray, as_matrix, as_samples, as_square
from hiersched.control.lqg import Lqg

Plant = tuple[npt.ArrayLike, npt.ArrayLike]
"""A (n, n) and B (n, m) of x(k+1) = A x(k) + B u(k)."""


def age_mode(lqg: Lqg, plant: Plant, age: int, next_age: int, max_age: int) -> FloatArray:
    """Return a step of the loop from an age to the next one, on xi.

    xi = (x(k), ..., x(k-D), x^ at the newest stamp, u(k-1), ..., u(k-D)) with D = `max_age`. The
    input is that of the filter's model predicted over `age`; before the next sample all
    measurements up to its newest stamp are filtered.
    """
    model = lqg.model
    n, size, m = model.num_measured, len(model.A), model.B.shape[1]
    A, B = as_square("A", plant[0], n), as_matrix("B", plant[1], (n, m))
    parts = [n] * (max_age + 1) + [size] + [m] * max_age
    unit = np.split(np.eye(sum(parts)), np.cumsum(parts)[:-1])
    states, estimate, inputs = unit[: max_age + 1], unit[max_age + 1], unit[max_age + 2 :]
    predicted = estimate
    for back in range(age, 0, -1):
        predicted = model.A @ predicted + model.B @ inputs[back - 1]
    u = -lqg.regulator @ predicted
    filtered = estimate
    for back in range(age, next_age - 1, -1):  # from the sample k - back to the one behind it
        applied = inputs[back - 1] if back > 0 else u
        before = model.A @ filtered + model.B @ applied
        filtered = before + lqg.filter_gain @ (states[max(back - 1, 0)] - before[:n])
    moved = [A @ states[0] + B @ u, *states[:-1], filtered, u, *inputs[:-1]]
    return np.vstack(moved)


def age_steps(max_age: int) -> list[tuple[int, int]]:
    """Return the steps of an age from 1 to D that a queue makes: down at once, up by one."""
    ages = range(1, max_age + 1)
    return [(age, after) for age, after in product(ages, ages) if after <= age + 1]


def search_age_functions(
    lqg: Lqg, plants: Sequence[Plant], max_age: SupportsIndex
) -> dict[int, FloatArray] | None:
    """Search P_d for the ages 1 to `max_age` and some plants; None where Clarabel finds none.

    Only `age_function_margin` says whether they hold, for these plants and for others. The problem
    has D matrices of n (D + 1) + N + m D rows: minutes for the unicycle from D = 3 on.
    """
    import cvxpy as cp

    from hiersched.control.lmi import solve

    longest = as_samples("max_age", max_age)
    scale = _scale(lqg, longest)
    size = len(scale)
    P = {age: cp.Variable((size, size), symmetric=True) for age in range(1, longest + 1)}
    margin = cp.Variable()
    constraints = [matrix << np.eye(size) for matrix in P.values()]
    constraints += [matrix >> margin * np.eye(size) for matrix in P.values()]
    for (age, after), plant in product(age_steps(longest), plants):
        M = age_mode(lqg, plant, age, after, longest) * scale / scale[:, None]
        change = M.T @ P[after] @ M - P[age]
        constraints.append((change + change.T) / 2 << -margin * np.eye(size))
    if not solve(cp.Problem(cp.Maximize(margin), constraints)) or margin.value <= 0.0:
        return None
    return {age: matrix.value / np.outer(scale, scale) for age, matrix in P.items()}


def age_function_margin(
    lqg: Lqg, plants: Iterable[Plant], functions: Mapping[int, FloatArray]
) -> float:
    """Return by how much, relative to the functions, they fall at least: above 0 they hold.

    It is the least eigenvalue of P_d and of P_d - M^T P_d' M over all steps and plants, in the
    coordinates of the search.
    """
    longest = max(functions)
    scale = _scale(lqg, longest)
    inner = {age: matrix * np.outer(scale, scale) for age, matrix in functions.items()}
    least = min(float(np.linalg.eigvalsh(matrix)[0]) for matrix in inner.values())
    for (age, after), plant in product(age_steps(longest), plants):
        M = age_mode(lqg, plant, age, after, longest) * scale / scale[:, None]
        fall = inner[age] - M.T @ inner[after] @ M
        least = min(least, float(np.linalg.eigvalsh((fall + fall.T) / 2.0)[0]))
    return least


def _scale(lqg: Lqg, longest: int) -> FloatArray:
    """Return how large the parts of xi are in the model's loop."""
    moment = lqg.second_moment(longest)
    state = np.sqrt(np.diag(moment))
    inputs = np.sqrt(np.diag(lqg.regulator @ moment @ lqg.regulator.T))
    n = lqg.model.num_measured
    return np.concatenate([np.tile(state[:n], longest + 1), state, np.tile(inputs, longest)])
