"""Exactly one PRB for every user at least total cost: the first part of every allocation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.compiled import kernel

_INDEX_BITS = np.int64(1023)
_VALUE_BITS = ~_INDEX_BITS
_FAR = 1e300


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
