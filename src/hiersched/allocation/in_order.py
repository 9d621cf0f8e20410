"""Allocations that go through the users in an order: by urgency, and in turn."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.allocation import ALLOCATE, check_needs, check_weights
from hiersched.core.compiled import inner_kernel


class UrgencyWords(NamedTuple):
    """Work arrays: users in their order (U,), rates so far (U,), which PRBs are taken (K,)."""

    order: NDArray[np.int64]
    user_rate: NDArray[np.float64]
    taken: NDArray[np.bool_]


def urgency_words(num_users: int, num_prb: int) -> UrgencyWords:
    """Work arrays for U users and K PRBs."""
    return UrgencyWords(
        np.zeros(num_users, np.int64), np.zeros(num_users), np.zeros(num_prb, np.bool_)
    )


@ALLOCATE.kernel(UrgencyWords)
def allocate_by_urgency(me: UrgencyWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Serve users in the order of falling urgency: one PRB each, then PRBs until the need is met.

    The urgency is `state.index_weight`; equal ones are served in the order of the users. PRBs that
    nobody needs are given out one by one in the same order.
    """
    rate, need = state.reported_rate_mbps[env], state.need_mbps[env]
    urgency = state.index_weight[env]
    check_needs(need)
    check_weights(urgency, -np.inf)
    num_users, left = rate.shape
    order = me.order
    for user in range(num_users):
        place = user
        while place > 0 and urgency[order[place - 1]] < urgency[user]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = user
        me.user_rate[user] = 0.0
    for k in range(left):
        me.taken[k] = False
    for place in range(num_users):
        left -= _take_best(me, order[place], rate, slot.prb_owner)
    for place in range(num_users):
        user = order[place]
        while left > 0 and me.user_rate[user] < need[user]:
            left -= _take_best(me, user, rate, slot.prb_owner)
    place = 0
    while left > 0:
        left -= _take_best(me, order[place % num_users], rate, slot.prb_owner)
        place += 1


@inner_kernel()
def _take_best(
    me: UrgencyWords, user: int, rate: NDArray[np.float32], owner: NDArray[np.uint32]
) -> int:
    """Give the user its best free PRB; returns 1, the number of PRBs taken."""
    best = -1
    for k in range(rate.shape[1]):
        if not me.taken[k] and (best < 0 or rate[user, k] > rate[user, best]):
            best = k
    me.taken[best] = True
    me.user_rate[user] += rate[user, best]
    owner[best] = user
    return 1


class TurnWords(NamedTuple):
    """No parameters."""

    none: int = 0


@ALLOCATE.kernel(TurnWords)
def allocate_in_turn(me: TurnWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Round robin: PRBs go around the users, and the next slot goes on where this one stopped."""
    _, num_users, num_prb = state.reported_rate_mbps.shape
    for k in range(num_prb):
        slot.prb_owner[k] = (state.slot[env] * num_prb + k) % num_users
