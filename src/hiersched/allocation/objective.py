"""The drift-plus-penalty Lagrangian of a slot and its parts.

L = Delta L + V h - lambda y with Delta L = (F(t+1)^2 - F(t)^2) / 2 summed over users, h = 1 / (r^2
+ epsilon) summed over users and y = (1 - chi) - exp(-alpha_1 r D_max), which is at least 0 where
the rate is high enough (the paper prints the opposite sign: docs/paper_notes.md).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numba.extending import register_jitable
from numpy.typing import NDArray

from hiersched.core.numerics import exp_f64


class UserTerms(NamedTuple):
    """What a slot's Lagrangian needs of each user; arrays have shape (U,), URLLC users first."""

    backlog_packets: NDArray[np.float64]
    offered_mbps: NDArray[np.float64]
    rate_sensitivity: NDArray[np.float64]
    arrival_packets_per_mbps: NDArray[np.float64]
    service_offset_mbps: NDArray[np.float64]
    service_packets_per_mbps: float
    penalty_weight: float
    epsilon: float
    multiplier: NDArray[np.float64]
    delay_exponent_per_mbps: float
    violation_share: float
    drift_weight: NDArray[np.float64]


@register_jitable(inline="always")
def slot_terms(
    constants: Any,
    backlog_packets: NDArray[np.float64],
    dexterity_index: NDArray[np.float64],
    multiplier: NDArray[np.float64],
    drift_weight: NDArray[np.float64],
    of_users: NDArray[np.float64],
) -> UserTerms:
    """Return the terms of a slot's Lagrangian, in Python and in kernels.

    `constants` are `simulator.SlotConstants`; backlogs (U,) at the start of the slot, dexterity and
    multipliers (R,) in force, weights of the drift (U,). `of_users` (2, U), zeros beyond R, holds
    what is made of dexterity and multipliers.
    """
    for robot in range(constants.num_urllc):
        of_users[0, robot] = constants.service_coefficient_mbps * dexterity_index[robot]
        of_users[1, robot] = multiplier[robot]
    return UserTerms(
        backlog_packets,
        constants.offered_mbps,
        constants.rate_sensitivity,
        constants.arrival_packets_per_mbps,
        of_users[0],
        constants.service_packets_per_mbps,
        constants.penalty_weight,
        constants.epsilon,
        of_users[1],
        constants.delay_exponent_per_mbps,
        constants.violation_share,
        drift_weight,
    )


@njit(inline="always")
def mean_arrivals(
    rate_mbps: float, offered_mbps: float, rate_sensitivity: float, packets_per_mbps: float
) -> float:
    """Mean arrivals of a slot in packets: max(0, lambda_0 - alpha r) times packets per Mbit/s."""
    return max(0.0, offered_mbps - rate_sensitivity * rate_mbps) * packets_per_mbps


@njit(inline="always")
def offered_service(rate_mbps: float, offset_mbps: float, packets_per_mbps: float) -> float:
    """Service of a slot in packets: mu = max(0, r - beta DI) times packets per Mbit/s."""
    return max(0.0, rate_mbps - offset_mbps) * packets_per_mbps


@njit(inline="always")
def rate_penalty(rate_mbps: float, epsilon: float) -> float:
    """1 / (r^2 + epsilon), r in Mbit/s."""
    return 1.0 / (rate_mbps * rate_mbps + epsilon)


@njit(inline="always")
def delay_surrogate(rate_mbps: float, exponent_per_mbps: float, violation_share: float) -> float:
    """Y = (1 - chi) - exp(-alpha_1 r D_max); negative where the constraint is violated.

    Exponents below -700 count as -700, where the exponential is below 1e-303.
    """
    return violation_share - exp_f64(max(-700.0, -exponent_per_mbps * rate_mbps))


@njit(inline="always")
def user_lagrangian(terms: UserTerms, user: int, rate_mbps: float) -> float:
    """One user's share of the slot's Lagrangian with the arrivals at their mean."""
    backlog, multiplier = terms.backlog_packets[user], terms.multiplier[user]
    arrivals = mean_arrivals(
        rate_mbps,
        terms.offered_mbps[user],
        terms.rate_sensitivity[user],
        terms.arrival_packets_per_mbps[user],
    )
    offset, per_mbps = terms.service_offset_mbps[user], terms.service_packets_per_mbps
    after = max(0.0, backlog + arrivals - offered_service(rate_mbps, offset, per_mbps))
    penalty = terms.penalty_weight * rate_penalty(rate_mbps, terms.epsilon)
    drift = 0.5 * (after * after - backlog * backlog)
    value = terms.drift_weight[user] * drift + penalty
    if multiplier > 0.0:
        value -= multiplier * delay_surrogate(
            rate_mbps, terms.delay_exponent_per_mbps, terms.violation_share
        )
    return float(value)
