"""Who gets which PRB: every PRB one owner, every user one PRB or more (paper, 3b-3d).

The first PRB of every user is an assignment problem and solved exactly (shortest augmenting paths);
the K - U others are given out one by one where the utility rises most.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.allocation import ALLOCATE, check_needs, check_weights
from hiersched.allocation.assignment import (
    FAR,
    INDEX_BITS,
    LARGEST_KEY,
    VALUE_BITS,
    assign_one_each,
    least_key,
)
from hiersched.allocation.objective import UserTerms, slot_terms, user_lagrangian
from hiersched.core.compiled import inner_kernel
from hiersched.core.numerics import F32, from_ordered_f32, ln_f32, ordered_f32, ordered_f64

LOG = 0
LINEAR = 1
LAGRANGIAN = 2
CAPPED = 3

TIE_SHARE = 2.0**-20
"""Of a slot's greatest worth: first PRBs whose worths w min(r, need) differ by less go by PF.

Small enough that log r decides little but ties: it overrides only differences of about a millionth
of the greatest worth. Large enough that it decides those ties: the assignment takes costs within
2^-42 of each other as equal, so differences of log r count down to 2^-22. Free PRBs need no such
share: those that raise no worth are given out afterwards, by log r alone.
"""

_ROW_LANES = 32
_USER_LANES = 8


class MarginalWords(NamedTuple):
    """What the users' utilities are, and work arrays.

    Rows over K PRBs are padded to K' columns and those over U users to U' lanes: whole vectors, no
    scalar rest. Free PRBs are at most K - U.
    """

    utility: int  # LOG, LINEAR, LAGRANGIAN or CAPPED
    cost: NDArray[np.float64]  # (U, K') of the assignment, FAR in the padding
    nearest: NDArray[np.int64]  # (U,) cheapest PRB
    user_of_prb: NDArray[np.int64]  # (K',)
    prb_of_user: NDArray[np.int64]  # (U,)
    row_price: NDArray[np.float64]  # (U,)
    column_price: NDArray[np.float64]  # (K',)
    open_price: NDArray[np.float64]  # (K',)
    distance_bits: NDArray[np.int64]  # (K',)
    free_user: NDArray[np.int64]  # (U,)
    base: NDArray[np.float64]  # (U + 1,)
    settled: NDArray[np.int64]  # (U + 1,)
    settled_distance: NDArray[np.float64]  # (U + 1,)
    reached: NDArray[np.int64]  # (U + 1,)
    worth: NDArray[np.float32]  # (U, K)
    of_users: NDArray[np.float64]  # (2, U) of `slot_terms`
    have: NDArray[np.float64]  # (U,) rates so far
    share: NDArray[np.float32]  # (U,) 1 / rate so far
    ones: NDArray[np.float64]  # (U,) weights of plain PF
    free_prb: NDArray[np.int64]  # (K,)
    gain: NDArray[np.float64]  # (K, U')
    ratio: NDArray[np.float32]  # (K, U')
    best: NDArray[np.int64]  # (K,) user to whom a free PRB is worth most


def marginal_words(utility: int, num_users: int, num_prb: int) -> MarginalWords:
    """Work arrays of a utility for U users and K PRBs.

    ValueError if there are more users than PRBs, or more PRBs than the assignment packs into its
    keys.
    """
    if not 1 <= num_users <= num_prb:
        raise ValueError(f"num_users = {num_users}: must be 1 to num_prb = {num_prb}")
    if num_prb > INDEX_BITS:
        raise ValueError(f"num_prb = {num_prb}: at most {INDEX_BITS}")
    columns = -(-num_prb // _ROW_LANES) * _ROW_LANES
    lanes = -(-num_users // _USER_LANES) * _USER_LANES
    return MarginalWords(
        utility=utility,
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
        worth=np.zeros((num_users, num_prb), np.float32),
        of_users=np.zeros((2, num_users)),
        have=np.zeros(num_users),
        share=np.zeros(num_users, np.float32),
        ones=np.ones(num_users),
        free_prb=np.zeros(num_prb, np.int64),
        gain=np.zeros((num_prb, lanes)),
        ratio=np.ones((num_prb, lanes), np.float32),
        best=np.zeros(num_prb, np.int64),
    )


class Aim(NamedTuple):
    """What a slot's allocation raises: the sum of utilities, which depend on these."""

    utility: Any
    rate: NDArray[np.float32]  # (U, K)
    weight: NDArray[np.float64]  # (U,)
    need: NDArray[np.float64]  # (U,)
    terms: UserTerms


@inner_kernel()
def _settle(me: MarginalWords, aim: Aim, least: float) -> None:
    """Bring the costs to 0 and above, and find every user's cheapest PRB."""
    for user in range(aim.rate.shape[0]):
        key = LARGEST_KEY
        for k in range(aim.rate.shape[1]):
            me.cost[user, k] -= least
            key = least_key(key, me.cost[user, k], k)
        me.nearest[user] = key & INDEX_BITS


@inner_kernel()
def _lagrangian_costs(me: MarginalWords, aim: Aim) -> None:
    """Costs of drift plus penalty."""
    least = FAR
    for user in range(aim.rate.shape[0]):
        for k in range(aim.rate.shape[1]):
            value = user_lagrangian(aim.terms, user, np.float64(aim.rate[user, k]))
            me.cost[user, k] = aim.weight[user] * value
            least = min(least, me.cost[user, k])
    _settle(me, aim, least)


@inner_kernel()
def _capped_costs(me: MarginalWords, aim: Aim) -> None:
    """Costs of w min(r, need); between equal worths the rate decides.

    A user whose need any PRB meets is indifferent. So that such ties go by PF, as the free PRBs do,
    log r comes on top, scaled to a share of the slot's greatest worth: weights may be of any size.
    """
    greatest = 0.0
    for user in range(aim.rate.shape[0]):
        for k in range(aim.rate.shape[1]):
            worth = aim.weight[user] * min(np.float64(aim.rate[user, k]), aim.need[user])
            me.cost[user, k] = -worth
            greatest = max(greatest, worth)
    tie = TIE_SHARE * greatest if greatest > 0.0 else 1.0
    least = FAR
    for user in range(aim.rate.shape[0]):
        for k in range(aim.rate.shape[1]):
            me.cost[user, k] -= tie * np.float64(ln_f32(aim.rate[user, k]))
            least = min(least, me.cost[user, k])
    _settle(me, aim, least)


@inner_kernel(forceinline=True)
def _worth_costs(me: MarginalWords, aim: Aim) -> None:
    """Costs w (largest - log r) or w (largest - r)."""
    flat, worth = aim.rate.reshape(-1), me.worth.reshape(-1)
    # One flat loop: rows are too short for full vectors. The maximum by way of integers: the
    # compiler vectorises no maximum of floats.
    largest = np.int32(-0x80000000)
    for i in range(flat.shape[0]):
        worth[i] = ln_f32(flat[i]) if aim.utility == LOG else flat[i]
        largest = max(largest, ordered_f32(worth[i]))
    most = np.float64(from_ordered_f32(largest))
    for user in range(me.worth.shape[0]):
        key = LARGEST_KEY
        for k in range(me.worth.shape[1]):
            value = aim.weight[user] * (most - np.float64(me.worth[user, k]))
            me.cost[user, k] = value
            key = least_key(key, value, k)
        me.nearest[user] = key & INDEX_BITS


@njit(inline="always")
def _log_gain(aim: Aim, user: int, prb: int, have: float) -> float:
    ratio = F32(1.0) + aim.rate[user, prb] * (F32(1.0) / F32(have))
    return aim.weight[user] * np.float64(ln_f32(ratio))


@njit(inline="always")
def _marginal(aim: Aim, user: int, prb: int, have: float) -> float:
    """Gain in a user's utility by one more PRB."""
    rate, weight = np.float64(aim.rate[user, prb]), aim.weight[user]
    if aim.utility == LINEAR:
        return weight * rate
    if aim.utility == CAPPED:
        return weight * max(0.0, min(rate, aim.need[user] - have))
    after = user_lagrangian(aim.terms, user, have + rate)
    return weight * (user_lagrangian(aim.terms, user, have) - after)


@inner_kernel(forceinline=True)
def _greatest(gain: NDArray[np.float64]) -> int:
    """Place of the greatest; the first of equal ones, values within 2^-42 counting as equal.

    By way of integers, as in `_worth_costs`; the place rides in the last bits, as in `least_key`.
    """
    key = -LARGEST_KEY
    for i in range(gain.shape[0]):
        key = max(key, (ordered_f64(gain[i]) & VALUE_BITS) | (INDEX_BITS - i))
    return int(INDEX_BITS - (key & INDEX_BITS))


@inner_kernel(forceinline=True)
def _first_log_gains(me: MarginalWords, aim: Aim, num_free: int) -> None:
    """Gains w log(1 + r / R); the logarithms are one flat loop, as in `_worth_costs`."""
    num_users = aim.rate.shape[0]
    for user in range(num_users):
        me.share[user] = F32(1.0) / F32(me.have[user])
    for i in range(num_free):
        k = me.free_prb[i]
        for user in range(num_users):
            me.ratio[i, user] = F32(1.0) + aim.rate[user, k] * me.share[user]
    ratio, gain = me.ratio[:num_free].reshape(-1), me.gain[:num_free].reshape(-1)
    for place in range(ratio.shape[0]):
        gain[place] = np.float64(ln_f32(ratio[place]))
    for i in range(num_free):
        for user in range(num_users):
            me.gain[i, user] *= aim.weight[user]


@inner_kernel(forceinline=True)
def _first_gains(me: MarginalWords, aim: Aim, num_free: int) -> None:
    """Gain of every user by every free PRB, and the user to whom each is worth most."""
    num_users, lanes = aim.rate.shape[0], me.gain.shape[1]
    if aim.utility == LOG:
        _first_log_gains(me, aim, num_free)
    else:
        for i in range(num_free):
            for user in range(num_users):
                me.gain[i, user] = _marginal(aim, user, me.free_prb[i], me.have[user])
    for i in range(num_free):
        for lane in range(num_users, lanes):
            me.gain[i, lane] = -FAR
        me.best[i] = _greatest(me.gain[i])


@inner_kernel(forceinline=True)
def _give_out(me: MarginalWords, aim: Aim, num_free: int, owner: NDArray[np.uint32]) -> int:
    """Give out the free PRBs one by one where the utility rises most.

    Returns how many are left: those that nobody needs, the first of `free_prb`.
    """
    have, gain, best, free_prb = me.have, me.gain, me.best, me.free_prb
    for left in range(num_free - 1, -1, -1):
        place = _best_place(me, aim, left)
        user, k = best[place], free_prb[place]
        if aim.utility == CAPPED and gain[place, user] <= 0.0:
            return left + 1
        owner[k] = user
        have[user] += np.float64(aim.rate[user, k])
        # The last free PRB takes the place of the one just given.
        free_prb[place] = free_prb[left]
        best[place] = best[left]
        if place != left:
            for other in range(gain.shape[1]):
                gain[place, other] = gain[left, other]
        for i in range(left):
            if aim.utility == LAGRANGIAN or aim.utility == CAPPED:
                gain[i, user] = _marginal(aim, user, free_prb[i], have[user])
                best[i] = _greatest(gain[i])
            elif aim.utility == LOG and best[i] == user:
                best[i] = _still_greatest(aim, gain[i], user, free_prb[i], have)
    return 0


@njit(inline="always")
def _best_place(me: MarginalWords, aim: Aim, last: int) -> int:
    """Place, up to `last`, of the free PRB that is worth most to the user that wants it most."""
    gain, best, free_prb, rate = me.gain, me.best, me.free_prb, aim.rate
    place = 0
    for i in range(1, last + 1):
        here, there = gain[i, best[i]], gain[place, best[place]]
        if here > there:
            place = i
        elif aim.utility == CAPPED and here == there:
            # What is left of a need fits into any of several PRBs: the one of most rate.
            if rate[best[i], free_prb[i]] > rate[best[place], free_prb[place]]:
                place = i
    return place


@inner_kernel(forceinline=True)
def _still_greatest(
    aim: Aim, gain: NDArray[np.float64], user: int, prb: int, have: NDArray[np.float64]
) -> int:
    """User to whom a PRB is worth most, when gains may have fallen since they were computed.

    Only gains that come out on top are computed anew: the others are upper bounds, since the
    logarithm is concave.
    """
    while True:
        now = _log_gain(aim, user, prb, have[user])
        if now == gain[user]:
            return user
        gain[user] = now
        user = _greatest(gain)


@ALLOCATE.kernel(MarginalWords)
def allocate_by_utility(me: MarginalWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Allocate all PRBs of a world's slot to raise the sum of the users' utilities of a rate R.

    LOG: w log R, PF when all w are equal. LINEAR: w R. LAGRANGIAN: minus w times the user's
    drift-plus-penalty Lagrangian, its drift times `state.drift_weight`. CAPPED: w min(R, need);
    PRBs that nobody needs go by PF, without weights. w is the weight of the policy times that of
    the rule, and the product stays in `state.index_weight`.
    """
    rate, need = state.reported_rate_mbps[env], state.need_mbps[env]
    weight = state.index_weight[env]
    if me.utility == CAPPED:
        check_needs(need)
    for user in range(rate.shape[0]):
        weight[user] *= state.weight[env, user]
    check_weights(weight, 0.0)
    if me.utility == LAGRANGIAN:
        check_weights(state.drift_weight[env], 0.0)
    terms = slot_terms(
        constants,
        state.backlog_packets[env],
        state.dexterity_index[env],
        state.multiplier[env],
        state.drift_weight[env],
        me.of_users,
    )
    aim = Aim(me.utility, rate, weight, need, terms)
    # Cost of each PRB as a user's only one, 0 and above, and every user's cheapest PRB.
    if me.utility == LAGRANGIAN:
        _lagrangian_costs(me, aim)
    elif me.utility == CAPPED:
        _capped_costs(me, aim)
    else:
        _worth_costs(me, aim)
    assign_one_each(me)
    for user in range(rate.shape[0]):
        me.have[user] = rate[user, me.prb_of_user[user]]
    num_free = np.int64(0)
    for k in range(rate.shape[1]):
        first_owner = me.user_of_prb[k]
        slot.prb_owner[k] = first_owner
        me.free_prb[num_free] = k
        num_free += 1 if first_owner < 0 else 0
    _first_gains(me, aim, num_free)
    left = _give_out(me, aim, num_free, slot.prb_owner)
    if left > 0:
        plain = Aim(np.int64(LOG), rate, me.ones, need, terms)
        _first_gains(me, plain, left)
        _give_out(me, plain, left, slot.prb_owner)
