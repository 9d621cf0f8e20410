"""Allocations that go through the users in an order: by urgency, and in turn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hiersched.allocation.marginal import AllocationScratch
from hiersched.core.compiled import kernel


@kernel()
def allocate_by_urgency(
    rate: NDArray[np.float32],
    urgency: NDArray[np.float64],
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
    scratch
        From `allocation_scratch`, with `need`: the rate that would empty the user's queue in this
        slot. PRBs that nobody needs are given out one by one in the same order.
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
        scratch.assignment.user_of_prb[k] = -1
    left = num_prb
    for place in range(num_users):
        left -= _take_best(order[place], rate, scratch, owner)
    for place in range(num_users):
        user = order[place]
        while left > 0 and scratch.user_rate[user] < scratch.need[user]:
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
        if scratch.assignment.user_of_prb[k] < 0 and (best < 0 or rate[user, k] > rate[user, best]):
            best = k
    scratch.assignment.user_of_prb[best] = user
    scratch.user_rate[user] += rate[user, best]
    owner[best] = user
    return 1


@kernel()
def allocate_in_turn(slot: int, num_users: int, num_prb: int, owner: NDArray[np.uint32]) -> None:
    """Round robin: PRBs go around the users, and the next slot goes on where this one stopped."""
    for k in range(num_prb):
        owner[k] = (slot * num_prb + k) % num_users
