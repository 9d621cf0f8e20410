"""Filters in loops that are not what they believe: what certifies quadratic functions of each age.

Separation holds for the model. With another plant the error of the estimate depends on the inputs,
and the loop switches with the age of the newest measurement. A quadratic function for each age,
V_d = xi^T P_d xi, that falls at every step from any age d to any that a queue can make of it, 1 to
d + 1, proves the loop stable however its age switches.

`certify_age_functions` checks such functions for all plants of a box of parameters, and what lies
between two points of a grid too. Certified is the linear loop without saturation, with known inputs
and every measurement up to the stamp filtered, for parameters that are constant in each sampling
interval and may be others of the box in the next, in any order, as may the ages. What changes
within an interval is not covered.

How a cell of the box is covered. With G(theta) = [[A_c, B_c], [0, 0]] affine in theta, [A B] are
the first rows of exp(h G) (Van Loan 1978), and a step of the loop, M, is affine in [A B]. Let
[A B] = interpolation + remainder, the interpolation multilinear between the 2^p corners of the
cell. As P_d = L_d^T L_d, V falls where |L_d' M L_d^-1| < 1, spectral norm, which is convex in M:

- Interpolations are convex combinations of the corners' plants; no norm exceeds the largest there.
- Along one side of length s_i linear interpolation errs by at most s_i^2 / 8 times the largest
  second derivative, and interpolation along another side is a mean, which enlarges no norm: the
  remainder is at most sum_i s_i^2 / 8 max |d^2 exp(h G) / d theta_i^2|.
- That derivative is twice the integral over 0 < r < t < h of exp((h-t) G) G_i exp((t-r) G) G_i
  exp(r G) (Higham, Functions of Matrices, 2008, ch. 10). As |exp(t G)| <= exp(t mu), mu the
  logarithmic norm of G, it is at most h^2 |G_i|^2 exp(h mu), in any norm weighted by a diagonal
  matrix. The logarithmic norm is convex and G affine: mu is largest at a corner of the cell.

Cells in which corners and remainder do not stay below 1 are halved; remainders shrink by s_i^2.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple, SupportsIndex

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm, solve_triangular

from hiersched.control.checks import (
    FloatArray,
    as_definite,
    as_matrix,
    as_positive,
    as_samples,
    as_square,
    symmetrised,
)
from hiersched.control.lqg import Lqg

Plant = tuple[npt.ArrayLike, npt.ArrayLike]
"""A (n, n) and B (n, m) of x(k+1) = A x(k) + B u(k)."""

Cell = tuple[tuple[float, float], ...]
"""The least and the largest value of each parameter."""

ROUNDING = 1e3 * float(np.finfo(float).eps)
"""Rounding of |L_d' M L_d^-1|, relative to the product of the Frobenius norms of its factors.

An allowance, not a proof: the worst case of a triangular solve carries the condition of L_d, which
this leaves out. In 300 ill-conditioned cases of 35 rows the error was at most a thousandth of it.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlantFamily:
    """Plants x' = A_c x + B_c u under a zero-order hold, affine in p parameters theta.

    A_c = A_c[0] + sum theta_i A_c[i], B_c likewise. ValueError if a matrix is malformed.
    """

    A_c: Sequence[npt.ArrayLike]  # p + 1 of (n, n), a second
    B_c: Sequence[npt.ArrayLike]  # p + 1 of (n, m), a second
    sampling_s: float

    def __post_init__(self) -> None:
        """Check what it is made of."""
        as_positive("sampling_s", self.sampling_s)
        if not len(self.A_c) == len(self.B_c) > 0:
            raise ValueError(
                f"there are {len(self.A_c)} A_c and {len(self.B_c)} B_c; there must be as many of "
                "both, one more than parameters"
            )
        self.generators()

    @property
    def size(self) -> tuple[int, int]:
        """Return n and m."""
        n, m = as_matrix("B_c[0]", self.B_c[0]).shape
        return n, m

    def generators(self) -> FloatArray:
        """Return [[A_c, B_c], [0, 0]] times the sampling interval, (p + 1, n + m, n + m)."""
        n, m = self.size
        found = np.zeros((len(self.A_c), n + m, n + m))
        for i, (A_c, B_c) in enumerate(zip(self.A_c, self.B_c, strict=True)):
            found[i, :n, :n] = as_square(f"A_c[{i}]", A_c, n)
            found[i, :n, n:] = as_matrix(f"B_c[{i}]", B_c, (n, m))
        return found * self.sampling_s


@dataclass(frozen=True, kw_only=True)
class AgeCertificate:
    """Outcome of `certify_age_functions`."""

    certified: bool  # every cell of the box is covered
    contraction: float  # bound on the factor a sample of sqrt(V) in the cells that are covered
    tolerance: float  # for rounding, part of the contraction
    cells: int  # that were covered
    open_cell: Cell | None  # one that is not
    falls_at_corners: bool  # False: at a corner of the open cell some V is not shown to fall


def age_mode(lqg: Lqg, plant: Plant, age: int, next_age: int) -> FloatArray:
    """Return a step of the loop from an age d >= 1 to the next one, 1 to d + 1: xi' = M xi.

    xi = (x(k), ..., x(k-d+1), x^ at the newest stamp k - d, u(k-1), ..., u(k-d)), all that what
    comes depends on: (n + m) d + N numbers. The input is that of the filter's model predicted over
    the age; before the next sample all measurements up to its newest stamp are filtered.
    """
    n, m = lqg.model.num_measured, lqg.model.B.shape[1]
    step = _age_step(lqg, age, next_age)
    A, B = as_square("A", plant[0], n), as_matrix("B", plant[1], (n, m))
    return np.vstack([np.hstack([A, B]) @ step.now, step.others])


class _Step(NamedTuple):
    """A step without the plant: xi' = ([A B] now, others) xi."""

    now: FloatArray  # (x(k), u(k))
    others: FloatArray  # all but x(k+1)


def _age_step(lqg: Lqg, age: int, next_age: int) -> _Step:
    model = lqg.model
    n, size, m = model.num_measured, len(model.A), model.B.shape[1]
    parts = [n] * age + [size] + [m] * age
    unit = np.split(np.eye(sum(parts)), np.cumsum(parts)[:-1])
    states, estimate, inputs = unit[:age], unit[age], unit[age + 1 :]
    predicted = estimate
    for back in range(age, 0, -1):
        predicted = model.A @ predicted + model.B @ inputs[back - 1]
    u = -lqg.regulator @ predicted
    filtered = estimate
    for back in range(age, next_age - 1, -1):  # from the sample k - back to the one behind it
        before = model.A @ filtered + model.B @ inputs[back - 1]
        filtered = before + lqg.filter_gain @ (states[back - 1] - before[:n])
    others = [*states[: next_age - 1], filtered, u, *inputs[: next_age - 1]]
    return _Step(np.vstack([states[0], u]), np.vstack(others))


def age_steps(max_age: int) -> list[tuple[int, int]]:
    """Return the steps of an age from 1 to D that a queue makes: down at once, up by one."""
    ages = range(1, max_age + 1)
    return [(age, after) for age, after in product(ages, ages) if after <= age + 1]


def age_parts(plant: FloatArray, state: FloatArray, inputs: FloatArray, age: int) -> FloatArray:
    """Return a vector like xi at an age, of what belongs to x (n,), to x^ (N,) and to u (m,)."""
    return np.concatenate([np.tile(plant, age), state, np.tile(inputs, age)])


def age_scales(lqg: Lqg, max_age: SupportsIndex) -> dict[int, FloatArray]:
    """Return how large the parts of xi are in the model's loop, at the ages 1 to `max_age`."""
    longest = as_samples("max_age", max_age)
    state, inputs = _loop_scale(lqg, longest)
    plant = state[: lqg.model.num_measured]
    return {age: age_parts(plant, state, inputs, age) for age in range(1, longest + 1)}


def _loop_scale(lqg: Lqg, age: int) -> tuple[FloatArray, FloatArray]:
    """Return the standard deviations of states and inputs in the model's loop."""
    moment = lqg.second_moment(age)
    inputs = np.diag(lqg.regulator @ moment @ lqg.regulator.T)
    return np.sqrt(np.diag(moment)), np.sqrt(inputs)


def age_function_margin(
    lqg: Lqg, plants: Iterable[Plant], functions: Mapping[int, FloatArray]
) -> float:
    """Return by how much, relative to the functions, they fall at least: above 0 they hold.

    It is the least eigenvalue of P_d and of P_d - M^T P_d' M over all steps and these plants alone,
    in coordinates in which parts of xi are as large as in the model's loop.
    """
    scales = age_scales(lqg, max(functions))
    inner = {age: P * np.outer(scales[age], scales[age]) for age, P in functions.items()}
    least = min(float(np.linalg.eigvalsh(matrix)[0]) for matrix in inner.values())
    for (age, after), plant in product(age_steps(max(functions)), list(plants)):
        M = age_mode(lqg, plant, age, after) * scales[age] / scales[after][:, None]
        fall = inner[age] - M.T @ inner[after] @ M
        least = min(least, float(np.linalg.eigvalsh(symmetrised(fall))[0]))
    return least


def certify_age_functions(
    lqg: Lqg,
    family: PlantFamily,
    box: Sequence[tuple[float, float]],
    functions: Mapping[int, npt.ArrayLike],
    *,
    max_cells: int = 20_000,
) -> AgeCertificate:
    """Check that functions P_d of the ages d = 1 ... D fall for every plant of a box.

    The box has the least and the largest value of each parameter of the family. What is certified,
    and how, is above. A box is not certified as soon as V does not fall at a corner of a cell (a
    plant of the box), or where more than `max_cells` cells would have to be covered; the functions
    may still fall then, and other functions too. ValueError if ages or sides are malformed, or a
    P_d is not positive definite.
    """
    sides = [(float(least), float(most)) for least, most in box]
    if len(sides) != len(family.A_c) - 1:
        raise ValueError(f"box has {len(sides)} sides; there are {len(family.A_c) - 1} parameters")
    for i, side in enumerate(sides):
        if not (np.isfinite(side).all() and side[0] <= side[1]):
            raise ValueError(f"box[{i}] is {side}; it must be finite, the least value first")
    steps = _Steps(lqg, family, tuple(sides), functions)
    waiting, cells, worst = [tuple(sides)], 0, 0.0
    open_cell: Cell | None = None
    falls = True
    while waiting and open_cell is None:
        cell = waiting.pop()
        at_corners = steps.at_corners(cell)
        falls = bool((at_corners < 1.0).all())
        errors = remainder_bounds(steps.generators, steps.weights, cell)
        bound = float((at_corners + steps.sensitivity * sum(errors)).max())
        if bound < 1.0:
            cells, worst = cells + 1, max(worst, bound)
        elif not falls or cells + len(waiting) + 2 > max_cells:
            open_cell = cell
        else:
            waiting += _halves(cell, int(np.argmax(errors)))
    return AgeCertificate(
        certified=open_cell is None,
        contraction=worst,
        tolerance=float(steps.tolerance.max()),
        cells=cells,
        open_cell=open_cell,
        falls_at_corners=falls,
    )


def _halves(cell: Cell, side: int) -> list[Cell]:
    least, most = cell[side]
    middle = (least + most) / 2.0
    parts = (least, middle), (middle, most)
    return [(*cell[:side], part, *cell[side + 1 :]) for part in parts]


def remainder_bounds(generators: FloatArray, weights: FloatArray, cell: Cell) -> list[float]:
    """Return what each side of a cell adds to the remainder's bound, |W (exp - its mean) W^-1|.

    `generators` (p + 1, N, N) are those of `PlantFamily.generators`, `weights` (N,) the diagonal of
    W, `cell` the p sides; exp is the exponential of the generator, its mean the multilinear
    interpolation of those at the corners.
    """
    inner = generators * weights[:, None] / weights
    growth = max(
        float(np.linalg.eigvalsh(symmetrised(_combined(inner, theta)))[-1])
        for theta in product(*cell)
    )
    return [
        (most - least) ** 2 / 8.0 * float(np.linalg.norm(part, 2)) ** 2 * math.exp(growth)
        for (least, most), part in zip(cell, inner[1:], strict=True)
    ]


def _combined(generators: FloatArray, theta: Iterable[float]) -> FloatArray:
    return np.asarray(np.tensordot(np.array([1.0, *theta]), generators, 1))


class _Steps:
    """Norms of the steps of all ages in the coordinates in which V is a square."""

    def __init__(
        self,
        lqg: Lqg,
        family: PlantFamily,
        box: Cell,
        functions: Mapping[int, npt.ArrayLike],
    ) -> None:
        model = lqg.model
        n, m, longest = model.num_measured, model.B.shape[1], max(functions, default=0)
        if sorted(functions) != list(range(1, longest + 1)) or longest < 1:
            raise ValueError(f"functions are of the ages {sorted(functions)}; they must be 1 to D")
        self.generators = family.generators()
        if family.size != (n, m):
            raise ValueError(f"plants have {family.size} states and inputs; the filter's {n, m}")
        state, inputs = _loop_scale(lqg, longest)
        self.weights = 1.0 / np.concatenate([state[:n], inputs])
        scales = age_scales(lqg, longest)
        corners = [_combined(self.generators, theta) for theta in product(*box)]
        plant = math.exp(max(float(np.linalg.norm(corner)) for corner in corners))
        factors = {age: _factor(age, functions[age], scales[age]) for age in scales}
        self._pieces, sensitivity, rounding = [], [], []
        for age, after in age_steps(longest):
            step, before, behind = _age_step(lqg, age, after), factors[age], factors[after]
            now = _right(step.now, before)
            fixed = behind[:, n:] @ _right(step.others, before)
            self._pieces.append((behind[:, :n], now, fixed))
            into = behind[:, :n] / self.weights[:n]
            out = self.weights[:, None] * now
            sensitivity.append(np.linalg.norm(into, 2) * np.linalg.norm(out, 2))
            size = np.linalg.norm(behind) * np.linalg.norm(_right(np.eye(len(before)), before))
            rounding.append(size * (np.linalg.norm(step.others) + plant * np.linalg.norm(step.now)))
        self.sensitivity = np.array(sensitivity)
        self.tolerance = ROUNDING * np.array(rounding)
        self._norms: dict[tuple[float, ...], FloatArray] = {}

    def at_corners(self, cell: Cell) -> FloatArray:
        """Return the largest norm of each step at a corner, rounding included."""
        norms = np.array([self._at(theta) for theta in product(*cell)])
        return np.asarray(norms.max(axis=0) + self.tolerance)

    def _at(self, theta: tuple[float, ...]) -> FloatArray:
        if theta not in self._norms:
            n = self._pieces[0][0].shape[1]
            plant = expm(_combined(self.generators, theta))[:n]
            self._norms[theta] = np.array(
                [np.linalg.norm(into @ plant @ now + fixed, 2) for into, now, fixed in self._pieces]
            )
        return self._norms[theta]


def _factor(age: int, P: npt.ArrayLike, scale: FloatArray) -> FloatArray:
    """Return L with P = L^T L, upper triangular; V is |L xi|^2, whatever rounding made of P."""
    inner = as_square(f"functions[{age}]", P, len(scale)) * np.outer(scale, scale)
    inner = as_definite(f"functions[{age}]", inner, len(scale))
    return np.asarray(np.linalg.cholesky(inner).T / scale)


def _right(matrix: FloatArray, factor: FloatArray) -> FloatArray:
    """Return M L^-1."""
    return np.asarray(solve_triangular(factor, matrix.T, trans="T").T)
