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
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.allocation.objective import UserTerms

FloatArray = NDArray[np.float64]

TOLERANCE = 1e-6
"""Gap at which to stop, as a share of 1 plus the size of the Lagrangian."""
MAX_ROUNDS = 20
"""Programmes to solve at most."""
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
    """Return the Lagrangian of users at rates, and its slope by Mbit/s (at a kink, to its right).

    `user` and `rate_mbps` have shapes that broadcast. Computed apart from
    `objective.user_lagrangian`, which the schedulers use.
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
    drift_weight = terms.drift_weight[user]
    value = drift_weight * (0.5 * (after**2 - backlog**2)) + terms.penalty_weight / square
    value = value - multiplier * (terms.violation_share - missed)
    slope = (
        drift_weight * (after * after_slope) - 2.0 * terms.penalty_weight * rate_mbps / square**2
    )
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
    rate_mbps: NDArray[np.float32], terms: UserTerms, *, time_limit_s: float = math.inf
) -> ExactAllocation:
    """Allocate all PRBs of one slot, whose rates have shape (U, K), at the least Lagrangian.

    Programmes are solved until value and bound meet, each within `time_limit_s`, where the bound
    holds even if the time runs out. Below `convex_from`, as in a deep fade, the bound may stay
    below the value. ValueError if there are more users than PRBs, RuntimeError if HiGHS finds no
    allocation in time.
    """
    programme = _Programme(rate_mbps.astype(np.float64), terms)
    best = ExactAllocation(np.zeros(0, np.uint32), math.inf, -math.inf, 0)
    for count in range(1, MAX_ROUNDS + 1):
        owner, bound = programme.solve(time_limit_s)
        rates = owned_rates(rate_mbps, owner)
        value = float(lagrangian(terms, np.arange(len(rates)), rates)[0].sum())
        if value < best.value:
            best = best._replace(prb_owner=owner, value=value)
        best = best._replace(bound=min(max(best.bound, bound), best.value), rounds=count)
        if best.value - best.bound <= TOLERANCE * (1.0 + abs(best.value)):
            break
        programme.touch(rates, np.bincount(owner, minlength=len(rates)))
    return best


def owned_rates(rate_mbps: NDArray[np.float32], prb_owner: NDArray[np.uint32]) -> FloatArray:
    """Return the rate of every user under an allocation, shape (U,)."""
    own = rate_mbps[prb_owner, np.arange(len(prb_owner))].astype(np.float64)
    rates: FloatArray = np.zeros(len(rate_mbps))
    np.add.at(rates, prb_owner, own)
    return rates


class _Programme:
    """The mixed-integer programme of one slot; tangents are added as it goes.

    x_uk: user u owns PRB k. z_um: it owns 1 + m. R_um: its rate then, else 0. t_um: its cost.
    """

    def __init__(self, rate: FloatArray, terms: UserTerms) -> None:
        num_users, num_prb = rate.shape
        if num_users > num_prb:
            raise ValueError(f"{num_users} users: at most {num_prb}, the number of PRBs")
        most = num_prb - num_users + 1
        # Where the variables lie.
        self._owns = np.arange(rate.size).reshape(rate.shape)
        rest = rate.size + np.arange(3 * num_users * most)
        self._has, self._gets, self._costs = rest.reshape(3, num_users, most)
        self._terms = terms
        ordered = np.sort(rate, axis=1)
        self._low = np.cumsum(ordered, axis=1)[:, :most]
        self._high = np.cumsum(ordered[:, ::-1], axis=1)[:, :most]
        self._convex = self._low >= convex_from(terms)[:, None]
        self._rows: list[tuple[Any, Any, float, float]] = []  # places, factors, bounds of the sum
        self._feasible(rate)
        for share in _FIRST_TANGENTS:
            rates = self._low + share * (self._high - self._low)
            for user, number in np.ndindex(rates.shape):
                self._tangent(user, number, float(rates[user, number]))

    def _feasible(self, rate: FloatArray) -> None:
        """Every PRB one owner; counts and rates add up; rates lie in the range of their count."""
        for owns in self._owns.T:
            self._rows.append((owns, np.ones(len(owns)), 1.0, 1.0))
        for user, (owns, has, gets) in enumerate(
            zip(self._owns, self._has, self._gets, strict=True)
        ):
            ones, counts = np.ones(len(has)), np.arange(1.0, 1.0 + len(has))
            self._rows.append((has, ones, 1.0, 1.0))
            adds_up = np.concatenate([np.ones(len(owns)), -counts])
            self._rows.append((np.concatenate([owns, has]), adds_up, 0.0, 0.0))
            adds_up = np.concatenate([rate[user], -ones])
            self._rows.append((np.concatenate([owns, gets]), adds_up, 0.0, 0.0))
            for pair, low, high in zip(
                zip(gets, has, strict=True), self._low[user], self._high[user], strict=True
            ):
                self._rows.append((pair, (1.0, -low), 0.0, math.inf))
                self._rows.append((pair, (1.0, -high), -math.inf, 0.0))

    def _tangent(self, user: int, number: int, rate: float) -> None:
        """Bound the cost by the tangent at a rate; where it may not be convex, by its least."""
        convex = bool(self._convex[user, number])
        point = rate if convex else float(self._high[user, number])
        value, slope = (
            float(part[0]) for part in lagrangian(self._terms, np.array([user]), np.array([point]))
        )
        slope = slope if convex else 0.0
        places = tuple(part[user, number] for part in (self._costs, self._gets, self._has))
        self._rows.append((places, (1.0, -slope, slope * point - value), 0.0, math.inf))

    def touch(self, rates: FloatArray, num_prb: NDArray[np.int64]) -> None:
        """Add tangents where the last allocation lies."""
        for user, (rate, count) in enumerate(zip(rates, num_prb, strict=True)):
            self._tangent(user, int(count) - 1, float(rate))

    def solve(self, time_limit_s: float) -> tuple[NDArray[np.uint32], float]:
        """Return the owner of every PRB, and the bound that HiGHS has proved."""
        from scipy.optimize import Bounds, LinearConstraint, milp
        from scipy.sparse import csr_array

        count, costs = int(self._costs[-1, -1]) + 1, self._costs[0, 0]
        columns = np.arange(count)
        starts = np.cumsum([0, *(len(row[0]) for row in self._rows)])
        places, factors = (np.concatenate([row[part] for row in self._rows]) for part in (0, 1))
        matrix = csr_array((factors, places, starts), shape=(len(self._rows), count))
        binary = columns < self._gets[0, 0]
        result = milp(
            c=(columns >= costs).astype(float),
            integrality=binary.astype(int),
            bounds=Bounds(np.where(columns < costs, 0.0, -np.inf), np.where(binary, 1.0, np.inf)),
            constraints=LinearConstraint(
                matrix, [row[2] for row in self._rows], [row[3] for row in self._rows]
            ),
            options={"mip_rel_gap": 0.0, "time_limit": time_limit_s},
        )
        if result.x is None:
            raise RuntimeError(f"HiGHS found no allocation: {result.message}")
        owner = result.x[self._owns].argmax(axis=0)
        return owner.astype(np.uint32), float(result.mip_dual_bound)
