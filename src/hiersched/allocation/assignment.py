"""Exactly one PRB for every user at least total cost: the first part of every allocation."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.core.compiled import inner_kernel, kernel

FAR = 1e300
"""Cost of a PRB that does not exist."""

INDEX_BITS = np.int64(1023)
VALUE_BITS = ~INDEX_BITS
LARGEST_KEY = np.int64(0x7FFFFFFFFFFFFFFF)
"""Key of nothing yet."""
_FAR_BITS = np.float64(10.0 * FAR).view(np.int64)


@njit(inline="always")
def _bits_of(value: float) -> np.int64:
    """Bits of a double as an integer."""
    return np.float64(value).view(np.int64)


@njit(inline="always")
def least_key(key: np.int64, value: float, index: int) -> np.int64:
    """Key of the lesser of what `key` stands for and a non-negative double at `index`.

    Non-negative doubles order like their bits; the index rides in the last ten, so that minimum and
    place come from one vectorised reduction. Values closer than 2^-42 relative count as equal.
    """
    return min(key, (_bits_of(value) & VALUE_BITS) | np.int64(index))


@inner_kernel(forceinline=True)
def _reach_first(
    row: NDArray[np.float64],
    base: float,
    price: NDArray[np.float64],
    open_price: NDArray[np.float64],
    distance_bits: NDArray[np.int64],
) -> int:
    """Distances from the user who starts; returns the nearest column."""
    key = LARGEST_KEY
    for k in range(distance_bits.shape[0]):
        open_price[k] = price[k]
        shortest = _bits_of(base + row[k] - price[k])
        distance_bits[k] = shortest
        key = min(key, (shortest & VALUE_BITS) | k)
    return int(key & INDEX_BITS)


@inner_kernel(forceinline=True)
def _reach(
    row: NDArray[np.float64],
    base: float,
    closed: int,
    open_price: NDArray[np.float64],
    distance_bits: NDArray[np.int64],
) -> int:
    """Close a column, shorten the distances by the way over its user; returns the nearest column.

    A closed column is out of reach from then on: neither the least nor ever improved. It is closed
    within the loop, since a vector load would wait for a scalar store.
    """
    key = LARGEST_KEY
    for k in range(distance_bits.shape[0]):
        price = -1e5 * FAR if k == closed else open_price[k]
        open_price[k] = price
        known = _FAR_BITS if k == closed else distance_bits[k]
        shortest = min(known, _bits_of(base + row[k] - price))
        distance_bits[k] = shortest
        key = min(key, (shortest & VALUE_BITS) | k)
    return int(key & INDEX_BITS)


@kernel(forceinline=True)
def assign_one_each(me: Any) -> None:
    """Give every user exactly one PRB at least total cost.

    Shortest augmenting paths with dual prices (Jonker and Volgenant, Computing 1987; Crouse, IEEE
    TAES 2016), for non-negative costs.

    `me` are the arrays of `marginal.MarginalWords`: `cost`, FAR in the padding, and `nearest`, the
    cheapest PRB of each user, are read; `prb_of_user` and `user_of_prb`, where -1 is a free PRB,
    are the result.
    """
    cost, price, row_price, open_price = me.cost, me.column_price, me.row_price, me.open_price
    distance_bits, base, reached = me.distance_bits, me.base, me.reached
    settled, settled_distance = me.settled, me.settled_distance
    user_of_prb, prb_of_user = me.user_of_prb, me.prb_of_user
    num_users, columns = cost.shape
    for k in range(columns):
        user_of_prb[k] = -1
        price[k] = 0.0
    num_free = 0
    for user in range(num_users):
        k = me.nearest[user]
        row_price[user] = cost[user, k]
        taken = user_of_prb[k]
        is_free = taken >= 0
        user_of_prb[k] = taken if is_free else user
        prb_of_user[user] = k
        me.free_user[num_free] = user
        num_free += 1 if is_free else 0
    for index in range(num_free):
        start = me.free_user[index]
        steps = 0
        reached[0] = start
        base[0] = -row_price[start]
        k = _reach_first(cost[start], base[0], price, open_price, distance_bits)
        shortest = np.int64(distance_bits[k]).view(np.float64)
        settled[0] = k
        user = user_of_prb[k]
        while user >= 0:
            settled_distance[steps] = shortest
            steps += 1
            reached[steps] = user
            base[steps] = shortest - row_price[user]
            k = _reach(cost[user], base[steps], k, open_price, distance_bits)
            shortest = np.int64(distance_bits[k]).view(np.float64)
            settled[steps] = k
            user = user_of_prb[k]
        last = steps
        while last >= 0:
            k = settled[last]
            parent = 0
            least = base[0] + cost[start, k] - price[k]
            for i in range(1, last + 1):
                through = base[i] + cost[reached[i], k] - price[k]
                parent = i if through < least else parent
                least = min(least, through)
            user_of_prb[k] = reached[parent]
            prb_of_user[reached[parent]] = k
            last = parent - 1
        for i in range(steps):
            slack = shortest - settled_distance[i]
            price[settled[i]] -= slack
            row_price[reached[i + 1]] += slack
        row_price[start] += shortest
