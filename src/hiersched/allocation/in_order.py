"""Allocations that go through the users in an order: by urgency, and in turn."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.allocation.objective import UserTerms
from hiersched.core.compiled import kernel


class OrderScratch(NamedTuple):
    """Work arrays: users in their order (U,), rates so far (U,), which PRBs are taken (K,)."""

    order: NDArray[np.int64]
    user_rate: NDArray[np.float64]
    taken: NDArray[np.bool_]


def order_scratch(num_users: int, num_prb: int) -> OrderScratch:
    """Work arrays for `num_users` users and `num_prb` PRBs."""
    return OrderScratch(
        order=np.zeros(num_users, np.int64),
        user_rate=np.zeros(num_users),
        taken=np.zeros(num_prb, np.bool_),
    )


@kernel()
def allocate_by_urgency(
    code: int,
    slot: int,
    rate: NDArray[np.float32],
    urgency: NDArray[np.float64],
    need: NDArray[np.float64],
    terms: UserTerms,
    scratch: OrderScratch,
    owner: NDArray[np.uint32],
) -> None:
    """Serve users in the order of falling urgency: one PRB each, then PRBs until the need is met.

    Parameters
    ----------
    code, slot, terms
        Unused: all allocations have one form.
    rate
        Rate of each user on each PRB, shape (U, K), Mbit/s.
    urgency
        Shape (U,); equal urgencies are served in the order of the users.
    need
        The rate that would empty the user's queue in this slot, shape (U,), Mbit/s. PRBs that
        nobody needs are given out one by one in the same order.
    scratch
        From `order_scratch`.
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
        scratch.taken[k] = False
    left = num_prb
    for place in range(num_users):
        left -= _take_best(order[place], rate, scratch, owner)
    for place in range(num_users):
        user = order[place]
        while left > 0 and scratch.user_rate[user] < need[user]:
            left -= _take_best(user, rate, scratch, owner)
    place = 0
    while left > 0:
        left -= _take_best(order[place % num_users], rate, scratch, owner)
        place += 1


@kernel()
def _take_best(
    user: int,
    rate: NDArray[np.float32],
    scratch: OrderScratch,
    owner: NDArray[np.uint32],
) -> int:
    """Give the user its best free PRB; returns 1, the number of PRBs taken."""
    best = -1
    for k in range(rate.shape[1]):
        if not scratch.taken[k] and (best < 0 or rate[user, k] > rate[user, best]):
            best = k
    scratch.taken[best] = True
    scratch.user_rate[user] += rate[user, best]
    owner[best] = user
    return 1


@kernel()
def allocate_in_turn(
    code: int,
    slot: int,
    rate: NDArray[np.float32],
    weight: NDArray[np.float64],
    need: NDArray[np.float64],
    terms: UserTerms,
    scratch: OrderScratch,
    owner: NDArray[np.uint32],
) -> None:
    """Round robin: PRBs go around the users, and the next slot goes on where this one stopped.

    Parameters are those of `allocate_by_urgency`; only the slot and the shape of `rate` are used.
    """
    num_users, num_prb = rate.shape
    for k in range(num_prb):
        owner[k] = (slot * num_prb + k) % num_users
