"""Who gets which PRB: every PRB one owner, every user one PRB or more (paper, 3b-3d).

The first PRB of every user is an assignment problem and solved exactly (shortest augmenting paths);
the K - U others are given out one by one where the utility rises most.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.compiled import kernel
from hiersched.network.assignment import AllocationScratch, assign_one_each
from hiersched.network.lyapunov import UserTerms, user_lagrangian
from hiersched.numerics import F32, ln_f32

UTILITY_LOG = 0
UTILITY_LINEAR = 1
UTILITY_LAGRANGIAN = 2

_NO_NAN = {"nnan", "nsz"}
"""Lets the compiler vectorise minima and maxima; without NaN the bits do not change."""


@kernel(fastmath=_NO_NAN)
def _largest(values: NDArray[np.float32]) -> float:
    largest = values[0]
    for i in range(values.shape[0]):
        largest = max(largest, values[i])
    return float(largest)


@kernel(fastmath=_NO_NAN)
def _make_non_negative(cost: NDArray[np.float64]) -> None:
    least = cost[0]
    for i in range(cost.shape[0]):
        least = min(least, cost[i])
    for i in range(cost.shape[0]):
        cost[i] -= least


@kernel(forceinline=True)
def _first_costs(
    utility: int,
    rate: NDArray[np.float32],
    weight: NDArray[np.float64],
    terms: UserTerms,
    log_rate: NDArray[np.float32],
    cost: NDArray[np.float64],
) -> None:
    """Cost of each PRB as a user's only one: the utility lost against the greatest of all."""
    num_users, num_prb = rate.shape
    if utility == UTILITY_LAGRANGIAN:
        for user in range(num_users):
            for k in range(num_prb):
                cost[user, k] = user_lagrangian(terms, user, np.float64(rate[user, k]))
        _make_non_negative(cost.reshape(-1))
        return
    worth = rate
    if utility == UTILITY_LOG:
        # One flat loop: rows are too short for full vectors.
        worth = log_rate
        flat = rate.reshape(-1)
        flat_log = log_rate.reshape(-1)
        for i in range(flat.shape[0]):
            flat_log[i] = ln_f32(flat[i])
    largest = _largest(worth.reshape(-1))
    for user in range(num_users):
        w = weight[user]
        row = worth[user]
        for k in range(num_prb):
            cost[user, k] = w * (largest - np.float64(row[k]))


@njit(inline="always")
def _marginal(
    utility: int,
    user: int,
    rate: np.float32,
    have: float,
    weight: float,
    terms: UserTerms,
) -> float:
    """Gain in a user's utility by one more PRB of the given rate."""
    if utility == UTILITY_LOG:
        return weight * np.float64(ln_f32(F32(1.0) + rate * (F32(1.0) / F32(have))))
    if utility == UTILITY_LINEAR:
        return weight * np.float64(rate)
    after = user_lagrangian(terms, user, have + np.float64(rate))
    return user_lagrangian(terms, user, have) - after


@kernel(fastmath=_NO_NAN)
def _greatest(gain: NDArray[np.float64], count: int) -> int:
    """Place of the greatest of gain[:count]; the first of equal ones."""
    best = gain[0]
    for i in range(count):
        best = max(best, gain[i])
    place = count
    for i in range(count):
        place = min(place, i if gain[i] == best else count)
    return place


@kernel(forceinline=True)
def allocate_by_utility(
    utility: int,
    rate: NDArray[np.float32],
    weight: NDArray[np.float64],
    terms: UserTerms,
    scratch: AllocationScratch,
    owner: NDArray[np.uint32],
) -> None:
    """Allocate all PRBs of one slot to raise the sum of the users' utilities.

    Parameters
    ----------
    utility
        UTILITY_LOG (w log R: PF when all w are equal), UTILITY_LINEAR (w R) or UTILITY_LAGRANGIAN
        (minus the slot's drift-plus-penalty Lagrangian of `terms`).
    rate
        Rate of each user on each PRB, shape (U, K), Mbit/s.
    weight
        Weight of each user, shape (U,).
    terms
        What the Lagrangian needs; unused by the other two.
    scratch
        From `allocation_scratch`.
    owner
        Result: user of each PRB, shape (K,).
    """
    num_users, num_prb = rate.shape
    _first_costs(utility, rate, weight, terms, scratch.log_rate, scratch.cost)
    assign_one_each(scratch)
    have = scratch.user_rate
    for user in range(num_users):
        have[user] = rate[user, scratch.prb_of_user[user]]
    num_free = 0
    for k in range(num_prb):
        if scratch.user_of_prb[k] >= 0:
            owner[k] = scratch.user_of_prb[k]
        else:
            scratch.free_prb[num_free] = k
            num_free += 1
    gain = scratch.gain
    free_prb = scratch.free_prb
    if utility == UTILITY_LOG:
        ratio = scratch.ratio
        share = scratch.share
        for user in range(num_users):
            share[user] = F32(1.0) / F32(have[user])
        for i in range(num_free):
            k = free_prb[i]
            for user in range(num_users):
                ratio[i * num_users + user] = rate[user, k]
        for i in range(num_free):
            row = ratio[i * num_users : (i + 1) * num_users]
            for user in range(num_users):
                row[user] = F32(1.0) + row[user] * share[user]
        for i in range(num_free * num_users):
            gain[i] = np.float64(ln_f32(ratio[i]))
        for i in range(num_free):
            for user in range(num_users):
                gain[i * num_users + user] *= weight[user]
    else:
        for i in range(num_free):
            k = free_prb[i]
            for user in range(num_users):
                gain[i * num_users + user] = _marginal(
                    utility, user, rate[user, k], have[user], weight[user], terms
                )
    for left in range(num_free - 1, -1, -1):
        place = _greatest(gain, (left + 1) * num_users)
        i = place // num_users
        user = place - i * num_users
        k = free_prb[i]
        owner[k] = user
        have[user] += np.float64(rate[user, k])
        # The last free PRB takes the place of the one just given.
        free_prb[i] = free_prb[left]
        for other in range(num_users):
            gain[i * num_users + other] = gain[left * num_users + other]
        for j in range(left):
            gain[j * num_users + user] = _marginal(
                utility, user, rate[user, free_prb[j]], have[user], weight[user], terms
            )


@kernel()
def allocate_by_urgency(
    rate: NDArray[np.float32],
    urgency: NDArray[np.float64],
    need_mbps: NDArray[np.float64],
    scratch: AllocationScratch,
    owner: NDArray[np.uint32],
) -> None:
    """Serve users in the order of falling urgency: one PRB each, then PRBs until the need is met.

    Parameters
    ----------
    rate
        Rate of each user on each PRB, shape (U, K), Mbit/s.
    urgency
        Shape (U,); equal urgencies are served in the order of the users.
    need_mbps
        Rate that would empty the user's queue in this slot, shape (U,). PRBs that nobody needs are
        given out one by one in the same order.
    scratch
        From `allocation_scratch`.
    owner
        Result: user of each PRB, shape (K,).
    """
    num_users, num_prb = rate.shape
    order = scratch.order
    for user in range(num_users):
        place = user
        while place > 0 and urgency[order[place - 1]] < urgency[user]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = user
        scratch.user_rate[user] = 0.0
    for k in range(num_prb):
        scratch.user_of_prb[k] = -1
    left = num_prb
    for place in range(num_users):
        left -= _take_best(order[place], rate, scratch, owner)
    for place in range(num_users):
        user = order[place]
        while left > 0 and scratch.user_rate[user] < need_mbps[user]:
            left -= _take_best(user, rate, scratch, owner)
    place = 0
    while left > 0:
        left -= _take_best(order[place % num_users], rate, scratch, owner)
        place += 1


@kernel()
def _take_best(
    user: int,
    rate: NDArray[np.float32],
    scratch: AllocationScratch,
    owner: NDArray[np.uint32],
) -> int:
    """Give the user its best free PRB; returns 1, the number of PRBs taken."""
    best = -1
    for k in range(rate.shape[1]):
        if scratch.user_of_prb[k] < 0 and (best < 0 or rate[user, k] > rate[user, best]):
            best = k
    scratch.user_of_prb[best] = user
    scratch.user_rate[user] += rate[user, best]
    owner[best] = user
    return 1


@kernel()
def allocate_in_turn(slot: int, num_users: int, num_prb: int, owner: NDArray[np.uint32]) -> None:
    """Round robin: PRBs go around the users, and the next slot goes on where this one stopped."""
    for k in range(num_prb):
        owner[k] = (slot * num_prb + k) % num_users
