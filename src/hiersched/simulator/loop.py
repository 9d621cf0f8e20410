"""The slot loop: the only place where network and robots meet."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.allocation.marginal import UTILITY_CAPPED
from hiersched.core.compiled import inner_kernel, kernel
from hiersched.core.numerics import F32
from hiersched.core.randomness import STREAM_ARRIVAL, draw_uniforms
from hiersched.core.seam import UNUSED, Plug, call_at, call_plug
from hiersched.models.plant.feedback import steps_of_delay
from hiersched.simulator.prefetch import prefetch_third
from hiersched.simulator.service import serve

GIVEN = 0
"""How to decide: the owners of the PRBs are given."""
OWN = 1
"""How to decide: a rule's kernel names the owners itself."""
BY_UTILITY = 2
"""How to decide: an allocation to the largest sum of weighted utilities."""
IN_ORDER = 3
"""How to decide: an allocation that goes through the users in an order."""


class Plugs(NamedTuple):
    """What is plugged into the seams (`models.seams`, `policies.seams`), and the allocation.

    `how` is GIVEN, OWN, BY_UTILITY or IN_ORDER; the two last have an allocation, whose kernel takes
    `code`.
    """

    path_loss: Plug
    fading: Plug
    link: Plug
    report: Plug
    deliver: Plug
    arrivals: Plug
    queue: Plug
    plant: Plug
    how: int = GIVEN
    allocation: Plug = UNUSED
    code: int = 0
    rule: Plug = UNUSED
    weigh: Plug = UNUSED
    allocate: Plug = UNUSED


@inner_kernel()
def draw_channel(plugs: Any, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Draw a world's coming slot: fading, rates, and what is reported of them."""
    if plugs.path_loss.kernel != 0:
        call_plug(plugs.path_loss, constants, state, slot, env)
    call_plug(plugs.fading, constants, state, slot, env)
    _rate_channel(plugs, constants, state, slot, env)


@inner_kernel()
def _rate_channel(plugs: Any, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Rates of a world's coming slot, and what is reported of them."""
    call_plug(plugs.link, constants, state, slot, env)
    if plugs.report.kernel != 0:
        call_plug(plugs.report, constants, state, slot, env)


@kernel()
def rate_channels(plugs: Any, constants: Any, state: Any, slot: Any) -> None:
    """Rates of every world's coming slot, whose fading is there."""
    for env in range(state.key.shape[0]):
        _rate_channel(plugs, constants, state, slot, env)


@kernel()
def draw_channels(plugs: Any, constants: Any, state: Any, slot: Any) -> None:
    """Draw every world's first slot; the average rate starts at that of one PRB."""
    num_users, num_prb = state.reported_rate_mbps.shape[1:]
    for env in range(state.key.shape[0]):
        draw_channel(plugs, constants, state, slot, env)
        for user in range(num_users):
            total = 0.0
            for prb in range(num_prb):
                total += state.reported_rate_mbps[env, user, prb]
            state.average_rate_mbps[env, user] = total / num_prb


@kernel()
def run_slots(
    plugs: Any,
    constants: Any,
    state: Any,
    scratch: Any,
    one: Any,
    owners: NDArray[np.uint32],
    rows: NDArray[np.uint64],
) -> None:
    """Run all worlds for as many slots as `rows` has.

    Parameters
    ----------
    plugs, constants, state, scratch
        Pointers to these; `state` moves on.
    one
        Pointer to the slot in work, `record.OneSlot`.
    owners
        For GIVEN, the owner of each PRB, shape (E, T, K); not read otherwise.
    rows
        Is filled: the rows of a record, shape (E, T, words).
    """
    slot = one.fields
    for env in range(state.key.shape[0]):
        for index in range(rows.shape[1]):
            row = rows[env, index]
            prefetch_third(row, 0)
            _observe(constants, state, scratch, slot, env)
            prefetch_third(row, 1)
            if plugs.how == GIVEN:
                _copy(owners[env, index], slot.prb_owner)
            else:
                _decide(plugs, constants, state, scratch, slot, env)
            for user in range(slot.weight.shape[0]):
                slot.weight[user] = np.float32(state.weight[env, user])
            prefetch_third(row, 2)
            serve(plugs, constants, state, scratch, slot, env)
            _move_robots(plugs, constants, state, slot, env)
            # What this slot delivers is known when it has ended: the next slot's samples use it.
            _copy(slot.network_delay_s, state.delay_s[env])
            state.slot[env] += 1
            _move(state.model_values[env], slot.model_values)
            _copy(one.words, row)
            draw_channel(plugs, constants, state, slot, env)
        _check_robots(state.robot_state[env])


@kernel()
def decide_slots(
    plugs: Any, constants: Any, state: Any, scratch: Any, one: Any, owners: NDArray[np.uint32]
) -> None:
    """Let a policy decide the coming slot of all worlds, which does not come: owners (E, K)."""
    for env in range(state.key.shape[0]):
        _observe(constants, state, scratch, one.fields, env)
        _decide(plugs, constants, state, scratch, one.fields, env)
        _copy(one.fields.prb_owner, owners[env])


@kernel()
def run_robots(
    plugs: Any,
    constants: Any,
    state: Any,
    one: Any,
    network_delay_s: NDArray[np.float64],
    rows: NDArray[np.uint64],
) -> None:
    """Run the robots alone with network delays of shape (E, T, R); `rows` is filled.

    A delay is in force in its own slot.
    """
    slot = one.fields
    for word in range(one.words.shape[0]):
        one.words[word] = 0  # what belongs to the network
    for env in range(state.key.shape[0]):
        _move(state.model_values[env], slot.model_values)  # what belongs to the channel
        for index in range(rows.shape[1]):
            for robot in range(constants.num_urllc):
                slot.dexterity_index[robot] = state.dexterity_index[env, robot]
                slot.network_delay_s[robot] = network_delay_s[env, index, robot]
                state.delay_s[env, robot] = network_delay_s[env, index, robot]
            _move_robots(plugs, constants, state, slot, env)
            state.slot[env] += 1
            _move(state.model_values[env], slot.model_values)
            _copy(one.words, rows[env, index])
        _check_robots(state.robot_state[env])


@njit(inline="always")
def _copy(values: NDArray[Any], out: NDArray[Any]) -> None:
    for i in range(values.shape[0]):
        out[i] = values[i]


@njit(inline="always")
def _move(values: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Copy values and leave zeros."""
    for i in range(values.shape[0]):
        out[i] = values[i]
        values[i] = 0.0


@inner_kernel()
def _row_mean(values: NDArray[np.float32]) -> np.float32:
    """Mean in a fixed order of eight interleaved sums: fast, and the same bits on every machine."""
    count = values.shape[0]
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = F32(0.0)
    whole = count - count % 8
    for i in range(0, whole, 8):
        s0 += values[i]
        s1 += values[i + 1]
        s2 += values[i + 2]
        s3 += values[i + 3]
        s4 += values[i + 4]
        s5 += values[i + 5]
        s6 += values[i + 6]
        s7 += values[i + 7]
    for i in range(whole, count):
        s0 += values[i]
    return (((s0 + s1) + (s2 + s3)) + ((s4 + s5) + (s6 + s7))) / F32(count)


@inner_kernel(forceinline=True)
def _observe(constants: Any, state: Any, scratch: Any, slot: Any, env: int) -> None:
    """Note what a policy sees of the slot, and the world's uniforms of its arrivals."""
    draw_uniforms(state.key[env], STREAM_ARRIVAL, state.slot[env], 0, slot.arrival_uniform)
    _copy(state.fading_power[env].reshape(-1), slot.fading_power.reshape(-1))
    terms = scratch.terms
    for user in range(slot.rate_mbps.shape[0]):
        slot.mean_fading_power[user] = _row_mean(slot.fading_power[user])
        backlog = state.backlog_packets[env, user]
        terms.backlog_packets[user] = backlog
        slot.backlog_packets[user] = backlog
        slot.hol_delay_s[user] = state.hol_delay_s[env, user]
        slot.average_rate_mbps[user] = state.average_rate_mbps[env, user]
    for robot in range(constants.num_urllc):
        dexterity, multiplier = state.dexterity_index[env, robot], state.multiplier[env, robot]
        terms.service_offset_mbps[robot] = constants.service_coefficient_mbps * dexterity
        terms.multiplier[robot] = multiplier
        slot.dexterity_index[robot] = dexterity
        slot.multiplier[robot] = multiplier


@inner_kernel()
def _decide(plugs: Any, constants: Any, state: Any, scratch: Any, slot: Any, env: int) -> None:
    """Let policy and rule decide who gets which PRB."""
    if plugs.weigh.kernel != 0:
        call_plug(plugs.weigh, constants, state, slot, env)
    if plugs.how == OWN:
        call_plug(plugs.allocate, constants, state, slot, env)
        _check_owners(slot.prb_owner, slot.num_prb)
        return
    if plugs.rule.kernel == 0:
        _copy(state.weight[env], state.index_weight[env])
    else:
        for user in range(slot.rate_mbps.shape[0]):  # what the kernel does not write is found
            state.index_weight[env, user] = state.need_mbps[env, user] = np.nan
        call_plug(plugs.rule, constants, state, slot, env)
        if plugs.how == IN_ORDER or plugs.code == UTILITY_CAPPED:
            _check_needs(state.need_mbps[env])
        if plugs.how == BY_UTILITY:  # an urgency is no utility: weights leave it alone
            for user in range(slot.rate_mbps.shape[0]):
                state.index_weight[env, user] *= state.weight[env, user]
    _check_weights(plugs.how, state.index_weight[env])
    call_at(
        plugs.allocation.kernel,
        plugs.code,
        state.slot[env],
        state.reported_rate_mbps[env],
        state.index_weight[env],
        state.need_mbps[env],
        scratch.terms,
        plugs.allocation.words,
        slot.prb_owner,
    )


@inner_kernel()
def _check_weights(how: int, weight: NDArray[np.float64]) -> None:
    """Refuse what no allocation takes: factors that are negative, what is not finite."""
    least = 0.0 if how == BY_UTILITY else -np.inf
    wrong = 0
    for user in range(weight.shape[0]):
        if not (least <= weight[user] < np.inf):
            wrong += 1
    if wrong > 0:
        raise ValueError("a policy gave a user a weight that is negative or not finite")


@inner_kernel()
def _check_needs(need: NDArray[np.float64]) -> None:
    """Refuse needs that are negative or not there."""
    wrong = 0
    for user in range(need.shape[0]):
        if not need[user] >= 0.0:
            wrong += 1
    if wrong > 0:
        raise ValueError("a rule gave a user a need that is negative or not a number, or none")


@inner_kernel()
def _check_robots(robot_state: NDArray[np.float64]) -> None:
    """Refuse a plant that has gone beyond all numbers; what is not finite stays so."""
    wrong = 0
    for robot in range(robot_state.shape[0]):
        for i in range(robot_state.shape[1]):
            if not abs(robot_state[robot, i]) < np.inf:
                wrong += 1
    if wrong > 0:
        raise ValueError("the state of a robot is not finite")


@inner_kernel()
def _check_owners(owner: NDArray[np.uint32], count: NDArray[np.uint32]) -> None:
    """Every PRB has an owner that is there, and every user a PRB or more; `count` is scratch."""
    for user in range(count.shape[0]):
        count[user] = 0
    for prb in range(owner.shape[0]):
        if owner[prb] >= count.shape[0]:
            raise ValueError("a rule gave a PRB to a user that is not there")
        count[owner[prb]] += 1
    for user in range(count.shape[0]):
        if count[user] == 0:
            raise ValueError("a rule left a user without a PRB")


@inner_kernel(forceinline=True)
def _move_robots(plugs: Any, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Move all robots through the slot with the network delays in force."""
    loop = constants.loop
    for robot in range(slot.delay_steps.shape[0]):
        steps = steps_of_delay(state.delay_s[env, robot], loop.sampling_s)
        slot.delay_steps[robot] = steps
        slot.delay_capped[robot] = 1 if steps > loop.max_delay_steps else 0
        slot.control_saturated[robot] = 0
    call_plug(plugs.plant, constants, state, slot, env)
