"""Who gets which PRB: every PRB one owner, every user one PRB or more (paper, 3b-3d).

The first PRB of every user is an assignment problem and solved exactly (shortest augmenting paths);
the K - U others are given out one by one where the utility rises most.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.allocation.assignment import (
    FAR,
    INDEX_BITS,
    LARGEST_KEY,
    VALUE_BITS,
    AssignmentScratch,
    assign_one_each,
    assignment_scratch,
    index_of,
    least_key,
)
from hiersched.allocation.objective import UserTerms, user_lagrangian
from hiersched.core.compiled import inner_kernel, kernel
from hiersched.core.numerics import F32, from_ordered_f32, ln_f32, ordered_f32, ordered_f64

UTILITY_LOG = 0
UTILITY_LINEAR = 1
UTILITY_LAGRANGIAN = 2
UTILITY_CAPPED = 3

TIE_SHARE = 2.0**-20
"""Of a slot's greatest worth: first PRBs whose worths w min(r, need) differ by less go by PF.

Small enough that log r decides little but ties: it overrides only differences of about a millionth
of the greatest worth. Large enough that it decides those ties: the assignment takes costs within
2^-42 of each other as equal, so differences of log r count down to 2^-22. Free PRBs need no such
share: those that raise no worth are given out afterwards, by log r alone.
"""

_USER_LANES = 8


class AllocationScratch(NamedTuple):
    """Work arrays of one allocation; users are padded to U' lanes, free PRBs are at most K - U."""

    assignment: AssignmentScratch
    worth: NDArray[np.float32]  # (U K + K',)
    user_rate: NDArray[np.float64]  # (U,)
    ones: NDArray[np.float64]  # (U,) weights of plain PF
    share: NDArray[np.float32]  # (U',)
    free_prb: NDArray[np.int64]  # (K,)
    gain: NDArray[np.float64]  # (K, U')
    ratio: NDArray[np.float32]  # (K, U')
    best: NDArray[np.int64]  # (K,)


def allocation_scratch(num_users: int, num_prb: int) -> AllocationScratch:
    """Work arrays for `num_users` users and `num_prb` PRBs.

    Raises
    ------
    ValueError
        If there are more users than PRBs, or more PRBs than the assignment can take.
    """
    assignment = assignment_scratch(num_users, num_prb)
    lanes = -(-num_users // _USER_LANES) * _USER_LANES
    return AllocationScratch(
        assignment=assignment,
        worth=np.zeros(num_users * num_prb + assignment.cost.shape[1], np.float32),
        user_rate=np.zeros(num_users),
        ones=np.ones(num_users),
        share=np.zeros(lanes, np.float32),
        free_prb=np.zeros(num_prb, np.int64),
        gain=np.zeros((num_prb, lanes)),
        ratio=np.ones((num_prb, lanes), np.float32),
        best=np.zeros(num_prb, np.int64),
    )


@kernel()
def _largest(values: NDArray[np.float32]) -> float:
    """Maximum, by way of integers: the compiler vectorises no maximum of floats."""
    largest = np.int32(-0x80000000)
    for i in range(values.shape[0]):
        largest = max(largest, ordered_f32(values[i]))
    return float(from_ordered_f32(largest))


@inner_kernel(forceinline=True)
def _row_costs(
    worth: NDArray[np.float32],
    first: int,
    num_prb: int,
    weight: float,
    largest: float,
    cost: NDArray[np.float64],
) -> int:
    """Costs w (largest - worth) of one user, in place; returns the cheapest PRB."""
    key = LARGEST_KEY
    row = worth[first : first + cost.shape[0]]
    for k in range(cost.shape[0]):
        value = weight * (largest - float(row[k])) if k < num_prb else FAR
        cost[k] = value
        key = least_key(key, value, k)
    return index_of(key)


@kernel()
def _lagrangian_costs(
    rate: NDArray[np.float32],
    weight: NDArray[np.float64],
    terms: UserTerms,
    scratch: AssignmentScratch,
) -> None:
    """Costs of drift plus penalty, brought to 0 and above."""
    cost = scratch.cost
    num_users, num_prb = rate.shape
    least = FAR
    for user in range(num_users):
        for k in range(num_prb):
            cost[user, k] = weight[user] * user_lagrangian(terms, user, np.float64(rate[user, k]))
            least = min(least, cost[user, k])
    for user in range(num_users):
        key = LARGEST_KEY
        for k in range(num_prb):
            cost[user, k] -= least
            key = least_key(key, cost[user, k], k)
        scratch.nearest[user] = index_of(key)


@kernel()
def _capped_costs(
    rate: NDArray[np.float32],
    weight: NDArray[np.float64],
    need: NDArray[np.float64],
    scratch: AllocationScratch,
) -> None:
    """Costs of w min(r, need), brought to 0 and above; between equal worths the rate decides.

    A user whose need any PRB meets is indifferent. So that such ties go by PF, as the free PRBs do,
    log r comes on top, scaled to a share of the slot's greatest worth: weights may be of any size.
    """
    cost = scratch.assignment.cost
    num_users, num_prb = rate.shape
    greatest = 0.0
    for user in range(num_users):
        for k in range(num_prb):
            worth = weight[user] * min(np.float64(rate[user, k]), need[user])
            cost[user, k] = -worth
            greatest = max(greatest, worth)
    tie = TIE_SHARE * greatest if greatest > 0.0 else 1.0
    least = FAR
    for user in range(num_users):
        for k in range(num_prb):
            cost[user, k] -= tie * np.float64(ln_f32(rate[user, k]))
            least = min(least, cost[user, k])
    for user in range(num_users):
        key = LARGEST_KEY
        for k in range(num_prb):
            cost[user, k] -= least
            key = least_key(key, cost[user, k], k)
        scratch.assignment.nearest[user] = index_of(key)


@inner_kernel(forceinline=True)
def _first_costs(
    utility: int,
    rate: NDArray[np.float32],
    weight: NDArray[np.float64],
    need: NDArray[np.float64],
    terms: UserTerms,
    scratch: AllocationScratch,
) -> None:
    """Cost of each PRB as a user's only one: the utility lost against the greatest of all."""
    assignment = scratch.assignment
    if utility == UTILITY_LAGRANGIAN:
        _lagrangian_costs(rate, weight, terms, assignment)
        return
    num_users, num_prb = rate.shape
    flat = rate.reshape(-1)
    worth = scratch.worth[: flat.shape[0]]
    if utility == UTILITY_CAPPED:
        _capped_costs(rate, weight, need, scratch)
        return
    if utility == UTILITY_LOG:
        # One flat loop: rows are too short for full vectors.
        for i in range(flat.shape[0]):
            worth[i] = ln_f32(flat[i])
    else:
        for i in range(flat.shape[0]):
            worth[i] = flat[i]
    largest = _largest(worth)
    for user in range(num_users):
        assignment.nearest[user] = _row_costs(
            scratch.worth, user * num_prb, num_prb, weight[user], largest, assignment.cost[user]
        )


@njit(inline="always")
def _log_gain(rate: np.float32, have: float, weight: float) -> float:
    return weight * np.float64(ln_f32(F32(1.0) + rate * (F32(1.0) / F32(have))))


@njit(inline="always")
def _marginal(
    utility: int,
    user: int,
    rate: np.float32,
    have: float,
    weight: float,
    need: float,
    terms: UserTerms,
) -> float:
    """Gain in a user's utility by one more PRB of the given rate."""
    if utility == UTILITY_LOG:
        return _log_gain(rate, have, weight)
    if utility == UTILITY_LINEAR:
        return weight * np.float64(rate)
    if utility == UTILITY_CAPPED:
        return weight * max(0.0, min(np.float64(rate), need - have))
    after = user_lagrangian(terms, user, have + np.float64(rate))
    return weight * (user_lagrangian(terms, user, have) - after)


@inner_kernel(forceinline=True)
def _greatest(gain: NDArray[np.float64]) -> int:
    """Place of the greatest; the first of equal ones, values within 2^-42 counting as equal.

    By way of integers, as in `_largest`; the place rides in the last bits, as in `least_key`.
    """
    key = -LARGEST_KEY
    for i in range(gain.shape[0]):
        key = max(key, (ordered_f64(gain[i]) & VALUE_BITS) | (INDEX_BITS - i))
    return int(INDEX_BITS - (key & INDEX_BITS))


@inner_kernel(forceinline=True)
def _first_log_gains(
    rate: NDArray[np.float32],
    weight: NDArray[np.float64],
    scratch: AllocationScratch,
    num_free: int,
) -> None:
    """Gains w log(1 + r / R) of every user by every free PRB.

    The logarithms are one flat loop: rows of users are too short for full vectors.
    """
    num_users = rate.shape[0]
    gain, share = scratch.gain, scratch.share
    lanes = share.shape[0]
    for user in range(num_users):
        share[user] = F32(1.0) / F32(scratch.user_rate[user])
    flat = scratch.ratio.reshape(-1)[: num_free * lanes]
    for i in range(num_free):
        k = scratch.free_prb[i]
        for user in range(num_users):
            flat[i * lanes + user] = F32(1.0) + rate[user, k] * share[user]
    flat_gain = gain.reshape(-1)
    for place in range(flat.shape[0]):
        flat_gain[place] = np.float64(ln_f32(flat[place]))
    for i in range(num_free):
        for user in range(num_users):
            gain[i, user] *= weight[user]


@inner_kernel(forceinline=True)
def _first_gains(
    utility: int,
    rate: NDArray[np.float32],
    weight: NDArray[np.float64],
    need: NDArray[np.float64],
    terms: UserTerms,
    scratch: AllocationScratch,
    num_free: int,
) -> None:
    """Gain of every user by every free PRB, and the user to whom each is worth most."""
    num_users = rate.shape[0]
    have = scratch.user_rate
    gain = scratch.gain
    lanes = scratch.share.shape[0]
    if utility == UTILITY_LOG:
        _first_log_gains(rate, weight, scratch, num_free)
    else:
        for i in range(num_free):
            k = scratch.free_prb[i]
            for user in range(num_users):
                gain[i, user] = _marginal(
                    utility,
                    user,
                    rate[user, k],
                    have[user],
                    weight[user],
                    need[user],
                    terms,
                )
    for i in range(num_free):
        for lane in range(num_users, lanes):
            gain[i, lane] = -FAR
        scratch.best[i] = _greatest(gain[i])


@inner_kernel(forceinline=True)
def _give_out(
    utility: int,
    rate: NDArray[np.float32],
    weight: NDArray[np.float64],
    need: NDArray[np.float64],
    terms: UserTerms,
    scratch: AllocationScratch,
    num_free: int,
    owner: NDArray[np.uint32],
) -> int:
    """Give out the free PRBs one by one where the utility rises most.

    Returns how many are left: those that nobody needs, the first of `free_prb`.
    """
    have = scratch.user_rate
    gain = scratch.gain
    best = scratch.best
    free_prb = scratch.free_prb
    for left in range(num_free - 1, -1, -1):
        place = _best_place(utility, rate, scratch, left)
        user = best[place]
        if utility == UTILITY_CAPPED and gain[place, user] <= 0.0:
            return left + 1
        k = free_prb[place]
        owner[k] = user
        have[user] += np.float64(rate[user, k])
        # The last free PRB takes the place of the one just given.
        free_prb[place] = free_prb[left]
        best[place] = best[left]
        if place != left:
            for other in range(gain.shape[1]):
                gain[place, other] = gain[left, other]
        for i in range(left):
            if utility == UTILITY_LAGRANGIAN or utility == UTILITY_CAPPED:
                k = free_prb[i]
                gain[i, user] = _marginal(
                    utility, user, rate[user, k], have[user], weight[user], need[user], terms
                )
                best[i] = _greatest(gain[i])
            elif utility == UTILITY_LOG and best[i] == user:
                best[i] = _still_greatest(gain[i], user, free_prb[i], rate, have, weight)
    return 0


@njit(inline="always")
def _best_place(
    utility: int, rate: NDArray[np.float32], scratch: AllocationScratch, last: int
) -> int:
    """Place, up to `last`, of the free PRB that is worth most to the user that wants it most."""
    gain, best, free_prb = scratch.gain, scratch.best, scratch.free_prb
    place = 0
    for i in range(1, last + 1):
        here, there = gain[i, best[i]], gain[place, best[place]]
        if here > there:
            place = i
        elif utility == UTILITY_CAPPED and here == there:
            # What is left of a need fits into any of several PRBs: the one of most rate.
            if rate[best[i], free_prb[i]] > rate[best[place], free_prb[place]]:
                place = i
    return place


@inner_kernel(forceinline=True)
def _still_greatest(
    gain: NDArray[np.float64],
    user: int,
    prb: int,
    rate: NDArray[np.float32],
    have: NDArray[np.float64],
    weight: NDArray[np.float64],
) -> int:
    """User to whom a PRB is worth most, when gains may have fallen since they were computed.

    Only gains that come out on top are computed anew: the others are upper bounds, since the
    logarithm is concave.
    """
    while True:
        now = _log_gain(rate[user, prb], have[user], weight[user])
        if now == gain[user]:
            return user
        gain[user] = now
        user = _greatest(gain)


@kernel()
def allocate_by_utility(
    utility: int,
    slot: int,
    rate: NDArray[np.float32],
    weight: NDArray[np.float64],
    need: NDArray[np.float64],
    terms: UserTerms,
    scratch: AllocationScratch,
    owner: NDArray[np.uint32],
) -> None:
    """Allocate all PRBs of one slot to raise the sum of the users' utilities.

    Parameters
    ----------
    utility
        UTILITY_LOG (w log R: PF when all w are equal), UTILITY_LINEAR (w R), UTILITY_LAGRANGIAN
        (minus w times the user's drift-plus-penalty Lagrangian of `terms`) or UTILITY_CAPPED (w
        min(R, need); PRBs that nobody needs go by PF, without weights).
    slot
        Unused.
    rate
        Rate of each user on each PRB, shape (U, K), Mbit/s.
    weight, need
        Weight of each user and the rate that it can use of this slot, shape (U,), Mbit/s; the need
        is unused but by UTILITY_CAPPED.
    terms
        What the Lagrangian needs; unused by the others.
    scratch
        From `allocation_scratch`.
    owner
        Result: user of each PRB, shape (K,).
    """
    num_users, num_prb = rate.shape
    # Not a literal, for which two of the functions below would be compiled apart.
    log = np.int64(UTILITY_LOG)
    _first_costs(utility, rate, weight, need, terms, scratch)
    assignment = scratch.assignment
    assign_one_each(assignment)
    for user in range(num_users):
        scratch.user_rate[user] = rate[user, assignment.prb_of_user[user]]
    num_free = np.int64(0)
    for k in range(num_prb):
        first_owner = assignment.user_of_prb[k]
        owner[k] = first_owner
        scratch.free_prb[num_free] = k
        num_free += 1 if first_owner < 0 else 0
    _first_gains(utility, rate, weight, need, terms, scratch, num_free)
    left = _give_out(utility, rate, weight, need, terms, scratch, num_free, owner)
    if left > 0:
        _first_gains(log, rate, scratch.ones, need, terms, scratch, left)
        _give_out(log, rate, scratch.ones, need, terms, scratch, left, owner)
