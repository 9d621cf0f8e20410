"""Exactly one PRB for every user at least total cost: the first part of every allocation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.core.compiled import inner_kernel, kernel

ROW_LANES = 32
"""Rows of the cost matrix are padded to a multiple of this: whole vectors, no scalar rest."""

FAR = 1e300
"""Cost of a PRB that does not exist."""

INDEX_BITS = np.int64(1023)
VALUE_BITS = ~INDEX_BITS
LARGEST_KEY = np.int64(0x7FFFFFFFFFFFFFFF)
"""Key of nothing yet."""
_FAR_BITS = np.float64(10.0 * FAR).view(np.int64)


class AssignmentScratch(NamedTuple):
    """Work arrays of one assignment of U users to K PRBs; rows are padded to K' columns.

    `cost` (U, K') and `nearest` (U,) are the input; `user_of_prb` (K',), where -1 is a free PRB,
    and `prb_of_user` (U,) the result.
    """

    cost: NDArray[np.float64]
    nearest: NDArray[np.int64]
    user_of_prb: NDArray[np.int64]
    prb_of_user: NDArray[np.int64]
    row_price: NDArray[np.float64]
    column_price: NDArray[np.float64]
    open_price: NDArray[np.float64]
    distance_bits: NDArray[np.int64]
    free_user: NDArray[np.int64]
    base: NDArray[np.float64]
    settled: NDArray[np.int64]
    settled_distance: NDArray[np.float64]
    reached: NDArray[np.int64]


def assignment_scratch(num_users: int, num_prb: int) -> AssignmentScratch:
    """Work arrays for `num_users` users and `num_prb` PRBs.

    Raises
    ------
    ValueError
        If there are more users than PRBs, or more PRBs than the search packs into its keys.
    """
    if not 1 <= num_users <= num_prb:
        raise ValueError(f"num_users = {num_users}: must be 1 to num_prb = {num_prb}")
    if num_prb > INDEX_BITS:
        raise ValueError(f"num_prb = {num_prb}: at most {INDEX_BITS}")
    columns = -(-num_prb // ROW_LANES) * ROW_LANES
    return AssignmentScratch(
        cost=np.full((num_users, columns), FAR),
        nearest=np.zeros(num_users, np.int64),
        user_of_prb=np.zeros(columns, np.int64),
        prb_of_user=np.zeros(num_users, np.int64),
        row_price=np.zeros(num_users),
        column_price=np.zeros(columns),
        open_price=np.zeros(columns),
        distance_bits=np.zeros(columns, np.int64),
        free_user=np.zeros(num_users, np.int64),
        base=np.zeros(num_users + 1),
        settled=np.zeros(num_users + 1, np.int64),
        settled_distance=np.zeros(num_users + 1),
        reached=np.zeros(num_users + 1, np.int64),
    )


@njit(inline="always")
def bits_of(value: float) -> np.int64:
    """Bits of a double as an integer."""
    return np.float64(value).view(np.int64)


@njit(inline="always")
def least_key(key: np.int64, value: float, index: int) -> np.int64:
    """Key of the lesser of what `key` stands for and a non-negative double at `index`.

    Non-negative doubles order like their bits; the index rides in the last ten, so that minimum and
    place come from one vectorised reduction. Values closer than 2^-42 relative count as equal.
    """
    return min(key, (bits_of(value) & VALUE_BITS) | np.int64(index))


@njit(inline="always")
def index_of(key: np.int64) -> int:
    """Index of the key."""
    return int(key & INDEX_BITS)


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
        shortest = bits_of(base + row[k] - price[k])
        distance_bits[k] = shortest
        key = min(key, (shortest & VALUE_BITS) | k)
    return index_of(key)


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
        shortest = min(known, bits_of(base + row[k] - price))
        distance_bits[k] = shortest
        key = min(key, (shortest & VALUE_BITS) | k)
    return index_of(key)


@kernel(forceinline=True)
def assign_one_each(scratch: AssignmentScratch) -> None:
    """Give every user exactly one PRB at least total cost.

    Shortest augmenting paths with dual prices (Jonker and Volgenant, Computing 1987; Crouse, IEEE
    TAES 2016), for non-negative costs.

    Parameters
    ----------
    scratch
        `cost`, FAR in the padding, and `nearest`, the cheapest PRB of each user, are read;
        `prb_of_user` and `user_of_prb` are the result.
    """
    cost = scratch.cost
    price = scratch.column_price
    row_price = scratch.row_price
    distance_bits = scratch.distance_bits
    base = scratch.base
    settled = scratch.settled
    settled_distance = scratch.settled_distance
    reached = scratch.reached
    free_user = scratch.free_user
    user_of_prb = scratch.user_of_prb
    prb_of_user = scratch.prb_of_user
    num_users, columns = cost.shape
    for k in range(columns):
        user_of_prb[k] = -1
        price[k] = 0.0
    num_free = 0
    for user in range(num_users):
        k = scratch.nearest[user]
        row_price[user] = cost[user, k]
        taken = user_of_prb[k]
        is_free = taken >= 0
        user_of_prb[k] = taken if is_free else user
        prb_of_user[user] = k
        free_user[num_free] = user
        num_free += 1 if is_free else 0
    for index in range(num_free):
        start = free_user[index]
        reached[0] = start
        base[0] = -row_price[start]
        k = _reach_first(cost[start], base[0], price, scratch.open_price, distance_bits)
        shortest = np.int64(distance_bits[k]).view(np.float64)
        settled[0] = k
        steps = 0
        user = user_of_prb[k]
        while user >= 0:
            settled_distance[steps] = shortest
            steps += 1
            reached[steps] = user
            base[steps] = shortest - row_price[user]
            k = _reach(cost[user], base[steps], k, scratch.open_price, distance_bits)
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
