"""The exact optimum of a slot's drift-plus-penalty Lagrangian, as a mixed-integer programme.

One number says how many PRBs a user has, so every user's Lagrangian is needed on narrow ranges of
its rate alone, one for each number. There it is convex (`convex_from`), and tangents bound it from
below: the programme with tangents for costs is a lower bound, the true value of its allocation an
upper one, and tangents at the rates found are added until both meet (outer approximation, Duran and
Grossmann, Math. Programming 1986). HiGHS solves the programmes, called by SciPy: it hands out the
bound that it has proved, so the gap holds even where a solve ends early.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.allocation.objective import UserTerms

FloatArray = NDArray[np.float64]

TOLERANCE = 1e-6
MAX_ROUNDS = 20
_FIRST_TANGENTS = (0.0, 0.5, 1.0)
"""Where the first tangents touch, as a share of each range."""


class ExactAllocation(NamedTuple):
    """An allocation, its Lagrangian, and what no allocation can fall below."""

    prb_owner: NDArray[np.uint32]  # (K,)
    value: float
    bound: float
    rounds: int


def lagrangian(
    terms: UserTerms, user: NDArray[np.int64], rate_mbps: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the Lagrangian of users at rates, and its slope.

    Computed apart from `lyapunov.user_lagrangian`, which the schedulers use.

    Parameters
    ----------
    terms
        The slot.
    user, rate_mbps
        Users and their rates, shapes that broadcast.

    Returns
    -------
    value, slope
        Slope by Mbit/s; at a kink, that to its right.
    """
    backlog, multiplier = terms.backlog_packets[user], terms.multiplier[user]
    per_mbps, served = terms.arrival_packets_per_mbps[user], terms.service_packets_per_mbps
    sensitivity, offset = terms.rate_sensitivity[user], terms.service_offset_mbps[user]
    offered = terms.offered_mbps[user] - sensitivity * rate_mbps
    arrivals = np.maximum(0.0, offered) * per_mbps
    after = np.maximum(0.0, backlog + arrivals - np.maximum(0.0, rate_mbps - offset) * served)
    after_slope = -sensitivity * per_mbps * (offered > 0.0) - served * (rate_mbps >= offset)
    square = rate_mbps**2 + terms.epsilon
    missed = np.exp(-terms.delay_exponent_per_mbps * rate_mbps)
    value = 0.5 * (after**2 - backlog**2) + terms.penalty_weight / square
    value = value - multiplier * (terms.violation_share - missed)
    slope = after * after_slope - 2.0 * terms.penalty_weight * rate_mbps / square**2
    slope = slope - multiplier * terms.delay_exponent_per_mbps * missed
    return value, slope


def convex_from(terms: UserTerms) -> FloatArray:
    """Return the rate from which each user's Lagrangian is convex, shape (U,), Mbit/s.

    The backlog after the slot is the greater of 0 and a convex function where the service is not
    cut off, so half its square is convex; 1 / (r^2 + epsilon) is where 3 r^2 > epsilon; the priced
    surrogate is everywhere.
    """
    return np.maximum(terms.service_offset_mbps, math.sqrt(terms.epsilon / 3.0))


def exact_allocation(
    rate_mbps: NDArray[np.float32],
    terms: UserTerms,
    *,
    tolerance: float = TOLERANCE,
    max_rounds: int = MAX_ROUNDS,
    time_limit_s: float = math.inf,
) -> ExactAllocation:
    """Allocate all PRBs of one slot at the least Lagrangian.

    Parameters
    ----------
    rate_mbps
        Rate of each user on each PRB, shape (U, K).
    terms
        The slot.
    tolerance
        Gap at which to stop, as a share of 1 plus the size of the Lagrangian.
    max_rounds
        Programmes to solve at most.
    time_limit_s
        Of each programme; the bound holds even when it runs out.

    Returns
    -------
    ExactAllocation
        Below `convex_from`, as in a deep fade, the bound may stay below the value.

    Raises
    ------
    ValueError
        If there are more users than PRBs.
    RuntimeError
        If HiGHS finds no allocation in time.
    """
    programme = _Programme(rate_mbps.astype(np.float64), terms)
    best = ExactAllocation(np.zeros(0, np.uint32), math.inf, -math.inf, 0)
    for count in range(1, max_rounds + 1):
        owner, bound = programme.solve(time_limit_s)
        rates = owned_rates(rate_mbps, owner)
        value = float(lagrangian(terms, np.arange(len(rates)), rates)[0].sum())
        if value < best.value:
            best = best._replace(prb_owner=owner, value=value)
        best = best._replace(bound=min(max(best.bound, bound), best.value), rounds=count)
        if best.value - best.bound <= tolerance * (1.0 + abs(best.value)):
            break
        programme.touch(rates, np.bincount(owner, minlength=len(rates)))
    return best


def owned_rates(rate_mbps: NDArray[np.float32], prb_owner: NDArray[np.uint32]) -> FloatArray:
    """Return the rate of every user under an allocation, shape (U,)."""
    own = rate_mbps[prb_owner, np.arange(len(prb_owner))].astype(np.float64)
    rates: FloatArray = np.zeros(len(rate_mbps))
    np.add.at(rates, prb_owner, own)
    return rates


@dataclass(frozen=True)
class _Columns:
    """Where the variables lie: x (U, K), then z, R and t (U, M) each."""

    num_users: int
    num_prb: int
    most: int

    def owns(self, user: int, prb: int) -> int:
        return user * self.num_prb + prb

    def part(self, kind: int, user: int, number: int) -> int:
        """Return the place of z (0), R (1) or t (2) for 1 + `number` PRBs."""
        first = self.num_users * self.num_prb
        return first + (kind * self.num_users + user) * self.most + number

    @property
    def count(self) -> int:
        return self.num_users * (self.num_prb + 3 * self.most)


class _Programme:
    """The mixed-integer programme of one slot; tangents are added as it goes.

    x_uk: user u owns PRB k. z_um: it owns 1 + m. R_um: its rate then, else 0. t_um: its cost.
    """

    def __init__(self, rate: FloatArray, terms: UserTerms) -> None:
        num_users, num_prb = rate.shape
        if num_users > num_prb:
            raise ValueError(f"{num_users} users: at most {num_prb}, the number of PRBs")
        self._columns = _Columns(num_users, num_prb, num_prb - num_users + 1)
        self._terms = terms
        ordered = np.sort(rate, axis=1)
        most = self._columns.most
        self._low = np.cumsum(ordered, axis=1)[:, :most]
        self._high = np.cumsum(ordered[:, ::-1], axis=1)[:, :most]
        self._convex = self._low >= convex_from(terms)[:, None]
        self._rows: list[tuple[list[int], list[float], float, float]] = []
        self._feasible(rate)
        for share in _FIRST_TANGENTS:
            self._tangents(self._low + share * (self._high - self._low))

    def _feasible(self, rate: FloatArray) -> None:
        """Every PRB one owner; counts and rates add up; rates lie in the range of their count."""
        columns = self._columns
        users, prbs, numbers = (
            range(n) for n in (columns.num_users, columns.num_prb, columns.most)
        )
        for prb in prbs:
            self._row([columns.owns(user, prb) for user in users], [1.0] * len(users), 1.0, 1.0)
        for user in users:
            own = [columns.owns(user, prb) for prb in prbs]
            has = [columns.part(0, user, number) for number in numbers]
            gets = [columns.part(1, user, number) for number in numbers]
            self._row(has, [1.0] * len(has), 1.0, 1.0)
            self._row(own + has, [1.0] * len(own) + [-1.0 - m for m in numbers], 0.0, 0.0)
            self._row(own + gets, [*rate[user], *[-1.0] * len(gets)], 0.0, 0.0)
            for m in numbers:
                pair = [gets[m], has[m]]
                self._row(pair, [1.0, -float(self._low[user, m])], 0.0, math.inf)
                self._row(pair, [1.0, -float(self._high[user, m])], -math.inf, 0.0)

    def _tangents(self, at: FloatArray) -> None:
        """Cost of every user and number is at least that of the tangent at a rate, (U, M)."""
        for user in range(self._columns.num_users):
            for number in range(self._columns.most):
                self._tangent(user, number, float(at[user, number]))

    def _tangent(self, user: int, number: int, rate: float) -> None:
        """Where the Lagrangian may not be convex, its value at the greatest rate bounds it."""
        convex = bool(self._convex[user, number])
        point = rate if convex else float(self._high[user, number])
        value, slope = (
            float(part[0]) for part in lagrangian(self._terms, np.array([user]), np.array([point]))
        )
        slope = slope if convex else 0.0
        cost, gets, has = (self._columns.part(kind, user, number) for kind in (2, 1, 0))
        self._row([cost, gets, has], [1.0, -slope, slope * point - value], 0.0, math.inf)

    def touch(self, rates: FloatArray, num_prb: NDArray[np.int64]) -> None:
        """Add tangents where the last allocation lies."""
        for user, (rate, count) in enumerate(zip(rates, num_prb, strict=True)):
            self._tangent(user, int(count) - 1, float(rate))

    def _row(self, places: list[int], factors: list[float], low: float, high: float) -> None:
        self._rows.append((places, factors, low, high))

    def solve(self, time_limit_s: float) -> tuple[NDArray[np.uint32], float]:
        """Return the owner of every PRB, and the bound that HiGHS has proved."""
        from scipy.optimize import Bounds, LinearConstraint, milp
        from scipy.sparse import csr_array

        columns = self._columns
        starts = np.cumsum([0, *(len(row[0]) for row in self._rows)])
        places = np.concatenate([row[0] for row in self._rows])
        factors = np.concatenate([row[1] for row in self._rows])
        matrix = csr_array((factors, places, starts), shape=(len(self._rows), columns.count))
        costs = columns.part(2, 0, 0)
        binary = np.arange(columns.count) < columns.part(1, 0, 0)
        lower = np.where(np.arange(columns.count) < costs, 0.0, -np.inf)
        result = milp(
            c=(np.arange(columns.count) >= costs).astype(float),
            integrality=binary.astype(int),
            bounds=Bounds(lower, np.where(binary, 1.0, np.inf)),
            constraints=LinearConstraint(
                matrix, [row[2] for row in self._rows], [row[3] for row in self._rows]
            ),
            options={"mip_rel_gap": 0.0, "time_limit": time_limit_s},
        )
        if result.x is None:
            raise RuntimeError(f"HiGHS found no allocation: {result.message}")
        owned = result.x[: columns.num_users * columns.num_prb]
        owner = owned.reshape(columns.num_users, columns.num_prb).argmax(axis=0)
        return owner.astype(np.uint32), float(result.mip_dual_bound)
