"""Who gets which PRB: every PRB one owner, every user one PRB or more (paper, 3b-3d).

The first PRB of every user is an assignment problem and solved exactly (shortest augmenting paths);
the K - U others are given out one by one where the utility rises most.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.compiled import kernel
from hiersched.network.lyapunov import UserTerms, user_lagrangian
from hiersched.numerics import F32, ln_f32

UTILITY_LOG = 0
UTILITY_LINEAR = 1
UTILITY_LAGRANGIAN = 2

_INDEX_BITS = np.int64(1023)
_VALUE_BITS = ~_INDEX_BITS
_FAR = 1e300
_NO_NAN = {"nnan", "nsz"}
"""Lets the compiler vectorise minima and maxima; without NaN the bits do not change."""


class AllocationScratch(NamedTuple):
    """Work arrays of one allocation; a `_bits` array shares the memory of its namesake."""

    cost: NDArray[np.float64]
    cost_bits: NDArray[np.int64]
    distance: NDArray[np.float64]
    distance_bits: NDArray[np.int64]
    column_price: NDArray[np.float64]
    open_price: NDArray[np.float64]
    row_price: NDArray[np.float64]
    settled_distance: NDArray[np.float64]
    settled: NDArray[np.int64]
    path: NDArray[np.int64]
    user_of_prb: NDArray[np.int64]
    prb_of_user: NDArray[np.int64]
    user_rate: NDArray[np.float64]
    free_prb: NDArray[np.int64]
    order: NDArray[np.int64]
    gain: NDArray[np.float64]
    ratio: NDArray[np.float32]
    share: NDArray[np.float32]
    log_rate: NDArray[np.float32]


def allocation_scratch(num_users: int, num_prb: int) -> AllocationScratch:
    """Work arrays for `num_users` users and `num_prb` PRBs.

    Raises
    ------
    ValueError
        If there are more users than PRBs, or more PRBs than the search packs into its keys.
    """
    if not 1 <= num_users <= num_prb:
        raise ValueError(f"num_users = {num_users}: must be 1 to num_prb = {num_prb}")
    if num_prb > _INDEX_BITS:
        raise ValueError(f"num_prb = {num_prb}: at most {_INDEX_BITS}")
    cost = np.zeros((num_users, num_prb))
    distance = np.zeros(num_prb)
    return AllocationScratch(
        cost=cost,
        cost_bits=cost.view(np.int64),
        distance=distance,
        distance_bits=distance.view(np.int64),
        column_price=np.zeros(num_prb),
        open_price=np.zeros(num_prb),
        row_price=np.zeros(num_users),
        settled_distance=np.zeros(num_prb),
        settled=np.zeros(num_prb, np.int64),
        path=np.zeros(num_prb, np.int64),
        user_of_prb=np.zeros(num_prb, np.int64),
        prb_of_user=np.zeros(num_users, np.int64),
        user_rate=np.zeros(num_users),
        free_prb=np.zeros(num_prb, np.int64),
        order=np.zeros(num_users, np.int64),
        gain=np.zeros(num_users * num_prb),
        ratio=np.zeros(num_users * num_prb, np.float32),
        share=np.zeros(num_users, np.float32),
        log_rate=np.zeros((num_users, num_prb), np.float32),
    )


@njit(inline="always")
def _least(bits: NDArray[np.int64], count: int) -> int:
    """Index of the least of `count` non-negative doubles, given as their bits.

    Non-negative doubles order like their bits; the index rides in the last ten, so that minimum and
    place come from one vectorised reduction. Values closer than 2^-42 relative count as equal.
    """
    key = np.int64(0x7FFFFFFFFFFFFFFF)
    for k in range(count):
        key = min(key, (bits[k] & _VALUE_BITS) | k)
    return int(key & _INDEX_BITS)


@kernel(forceinline=True)
def assign_one_each(scratch: AllocationScratch) -> None:
    """Give every user exactly one PRB at least total cost.

    The result stands in `prb_of_user` and in `user_of_prb`, where -1 is a free PRB.

    Shortest augmenting paths with dual prices (Jonker and Volgenant, Computing 1987; Crouse, IEEE
    TAES 2016), for non-negative costs `scratch.cost`, shape (U, K), whose least entry in every row
    is 0.
    """
    cost = scratch.cost
    price = scratch.column_price
    open_price = scratch.open_price
    row_price = scratch.row_price
    distance = scratch.distance
    user_of_prb = scratch.user_of_prb
    prb_of_user = scratch.prb_of_user
    path = scratch.path
    num_users, num_prb = cost.shape
    for k in range(num_prb):
        user_of_prb[k] = -1
        price[k] = 0.0
    for user in range(num_users):
        k = _least(scratch.cost_bits[user], num_prb)
        row_price[user] = cost[user, k]
        prb_of_user[user] = -1
        if user_of_prb[k] < 0:
            user_of_prb[k] = user
            prb_of_user[user] = k
    for start in range(num_users):
        if prb_of_user[start] >= 0:
            continue
        for k in range(num_prb):
            distance[k] = _FAR
            open_price[k] = price[k]
        user = start
        base = -row_price[user]
        num_settled = 0
        while True:
            row = cost[user]
            for k in range(num_prb):
                through = base + row[k] - open_price[k]
                nearer = through < distance[k]
                distance[k] = through if nearer else distance[k]
                path[k] = user if nearer else path[k]
            k = _least(scratch.distance_bits, num_prb)
            shortest = distance[k]
            if user_of_prb[k] < 0:
                break
            scratch.settled[num_settled] = k
            scratch.settled_distance[num_settled] = shortest
            num_settled += 1
            # Out of reach from now on: neither the least nor ever improved.
            distance[k] = 10.0 * _FAR
            open_price[k] = -1e5 * _FAR
            user = user_of_prb[k]
            base = shortest - row_price[user]
        for i in range(num_settled):
            slack = shortest - scratch.settled_distance[i]
            price[scratch.settled[i]] -= slack
            row_price[user_of_prb[scratch.settled[i]]] += slack
        row_price[start] += shortest
        while True:
            user = path[k]
            user_of_prb[k] = user
            k, prb_of_user[user] = prb_of_user[user], k
            if user == start:
                break


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
