"""The slot loop: the only place where network and robots meet."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.allocation.objective import delay_surrogate, offered_service, rate_penalty
from hiersched.core.compiled import inner_kernel, kernel
from hiersched.core.numerics import F32, copy
from hiersched.core.randomness import STREAM_ARRIVAL, draw_uniforms
from hiersched.core.seam import UNUSED, Plug, call_plug
from hiersched.models.plant.feedback import steps_of_delay
from hiersched.simulator.prefetch import prefetch_third


class Plugs(NamedTuple):
    """What is plugged into the seams (`models.seams`, `policies.seams`).

    Without an allocation the owners are given; without a rule's index all users are alike.
    """

    path_loss: Plug
    fading: Plug
    link: Plug
    report: Plug
    deliver: Plug
    arrivals: Plug
    queue: Plug
    plant: Plug
    weigh: Plug = UNUSED
    rule: Plug = UNUSED
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
    one: Any,
    owners: NDArray[np.uint32],
    rows: NDArray[np.uint64],
) -> None:
    """Run all worlds for as many slots as `rows` (E, T, words), those of a record, has.

    The others are pointers, `one` to the slot in work, `record.OneSlot`; `state` moves on. `owners`
    (E, T, K) is read only where there is no allocation.
    """
    slot = one.fields
    for env in range(state.key.shape[0]):
        for index in range(rows.shape[1]):
            row = rows[env, index]
            prefetch_third(row, 0)
            _observe(state, slot, env)
            prefetch_third(row, 1)
            if plugs.allocate.kernel == 0:
                copy(owners[env, index], slot.prb_owner)
            else:
                _decide(plugs, constants, state, slot, env)
            copy(state.weight[env], slot.weight)
            prefetch_third(row, 2)
            call_plug(plugs.deliver, constants, state, slot, env)
            call_plug(plugs.arrivals, constants, state, slot, env)
            _offer_service(constants, state, slot, env)
            if constants.tracks_age:
                state.held_step[env] = -1  # what the queue does not write is found
            call_plug(plugs.queue, constants, state, slot, env)
            _account(constants, state, slot, env)
            _move_robots(plugs, constants, state, slot, env)
            # What this slot delivers is known when it has ended: the next slot's samples use it.
            copy(slot.network_delay_s, state.delay_s[env])
            _end_slot(state, one, env, row)
            draw_channel(plugs, constants, state, slot, env)
        _check_robots(state.robot_state[env])


@kernel()
def decide_slots(
    plugs: Any, constants: Any, state: Any, one: Any, owners: NDArray[np.uint32]
) -> None:
    """Let a policy decide the coming slot of all worlds, which does not come: owners (E, K)."""
    for env in range(state.key.shape[0]):
        _observe(state, one.fields, env)
        _decide(plugs, constants, state, one.fields, env)
        copy(one.fields.prb_owner, owners[env])


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
            copy(state.dexterity_index[env], slot.dexterity_index)
            copy(network_delay_s[env, index], slot.network_delay_s)
            copy(network_delay_s[env, index], state.delay_s[env])
            _force_ages(constants, state, env)
            _move_robots(plugs, constants, state, slot, env)
            _end_slot(state, one, env, rows[env, index])
        _check_robots(state.robot_state[env])


@njit(inline="always")
def _move(values: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Copy values and leave zeros."""
    for i in range(values.shape[0]):
        out[i] = values[i]
        values[i] = 0.0


@njit(inline="always")
def _end_slot(state: Any, one: Any, env: int, row: NDArray[np.uint64]) -> None:
    """Write the slot in work into its row; the next slot comes."""
    state.slot[env] += 1
    _move(state.model_values[env], one.fields.model_values)
    copy(one.words, row)


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
def _observe(state: Any, slot: Any, env: int) -> None:
    """Note what a policy sees of the slot, and the world's uniforms of its arrivals."""
    draw_uniforms(state.key[env], STREAM_ARRIVAL, state.slot[env], 0, slot.arrival_uniform)
    copy(state.fading_power[env].reshape(-1), slot.fading_power.reshape(-1))
    for user in range(slot.rate_mbps.shape[0]):
        slot.mean_fading_power[user] = _row_mean(slot.fading_power[user])
    copy(state.backlog_packets[env], slot.backlog_packets)
    copy(state.hol_delay_s[env], slot.hol_delay_s)
    copy(state.average_rate_mbps[env], slot.average_rate_mbps)
    copy(state.dexterity_index[env], slot.dexterity_index)
    copy(state.multiplier[env], slot.multiplier)


@inner_kernel()
def _decide(plugs: Any, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Let policy and rule decide who gets which PRB."""
    if plugs.weigh.kernel != 0:
        call_plug(plugs.weigh, constants, state, slot, env)
    known = plugs.rule.kernel == 0
    for user in range(slot.rate_mbps.shape[0]):  # what the kernel does not write is found
        state.index_weight[env, user] = 1.0 if known else np.nan
        state.need_mbps[env, user] = np.nan
        state.drift_weight[env, user] = 1.0
    if not known:
        call_plug(plugs.rule, constants, state, slot, env)
    call_plug(plugs.allocate, constants, state, slot, env)
    _check_owners(slot.prb_owner, slot.num_prb)


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
def _offer_service(constants: Any, state: Any, slot: Any, env: int) -> None:
    """Turn the rates of the slot into the service that the queues are offered, and average them."""
    forgetting, per_mbps = constants.average_forgetting, constants.service_packets_per_mbps
    for user in range(slot.rate_mbps.shape[0]):
        rate, average, offset = slot.rate_mbps[user], state.average_rate_mbps[env, user], 0.0
        if user < constants.num_urllc:
            offset = constants.service_coefficient_mbps * slot.dexterity_index[user]
        slot.service_packets[user] = offered_service(rate, offset, per_mbps)
        state.rate_mbps[env, user] = rate
        state.average_rate_mbps[env, user] = average + forgetting * (rate - average)


@inner_kernel(forceinline=True)
def _account(constants: Any, state: Any, slot: Any, env: int) -> None:
    """Drift, penalty and constraint summed over the users of each slice; the rewards."""
    num_urllc, num_users = constants.num_urllc, slot.rate_mbps.shape[0]
    drift_urllc = drift_embb = penalty_urllc = penalty_embb = priced = 0.0
    for user in range(num_users):
        rate, before = slot.rate_mbps[user], slot.backlog_packets[user]
        after = state.backlog_packets[env, user]
        drift = 0.5 * (after * after - before * before)
        penalty = rate_penalty(rate, constants.epsilon)
        if user >= num_urllc:
            drift_embb += drift
            penalty_embb += penalty
            continue
        drift_urllc += drift
        penalty_urllc += penalty
        if constants.measured_constraint:
            due, late = np.float64(slot.due_packets[user]), np.float64(slot.late_packets[user])
            surplus = (constants.violation_share * due - late) / constants.mean_due_packets[user]
        else:
            exponent = constants.delay_exponent_per_mbps
            surplus = delay_surrogate(rate, exponent, constants.violation_share)
        priced += state.multiplier[env, user] * surplus
        slot.constraint[user] = surplus
        slot.network_delay_s[user] = slot.delay_s[user] + constants.loop.core_latency_s
    slot.drift_urllc[()] = drift_urllc
    slot.drift_embb[()] = drift_embb
    slot.penalty_urllc[()] = penalty_urllc
    slot.penalty_embb[()] = penalty_embb
    weight, scale = constants.penalty_weight, constants.reward_scale
    slot.reward_urllc[()] = -(drift_urllc + weight * penalty_urllc - priced) / (num_urllc * scale)
    slot.reward_embb[()] = -(drift_embb + weight * penalty_embb) / ((num_users - num_urllc) * scale)


@inner_kernel()
def _force_ages(constants: Any, state: Any, env: int) -> None:
    """Let set-points be as old as the delays in force."""
    steps = state.held_step.shape[2]
    first = state.slot[env] * steps
    for robot in range(state.held_step.shape[1]):
        age = np.int64(np.rint(state.delay_s[env, robot] / constants.slot_s * steps))
        for step in range(steps):
            state.held_step[env, robot, step] = max(0, first + step - age)


@inner_kernel()
def _note_ages(constants: Any, state: Any, slot: Any, env: int) -> None:
    """Note how old the set-points in force are; a delay that is an age is that at the slot's start.

    At the end of the slot all are a step older than at the start of its last step.
    """
    steps = state.held_step.shape[2]
    first = state.slot[env] * steps
    step_s = constants.slot_s / steps
    for robot in range(state.held_step.shape[1]):
        for step in range(steps):
            if not 0 <= state.held_step[env, robot, step] <= first + step:
                raise ValueError(
                    "a queue left state.held_step[env] without the set-points in force"
                )
        if constants.loop.by_age:
            state.delay_s[env, robot] = (first - state.held_step[env, robot, 0]) * step_s
        age = (first + steps - state.held_step[env, robot, steps - 1]) * step_s
        slot.set_point_age_s[robot] = age
        state.set_point_age_s[env, robot] = age


@inner_kernel(forceinline=True)
def _move_robots(plugs: Any, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Move all robots through the slot with the network delays in force."""
    loop = constants.loop
    if constants.tracks_age:
        _note_ages(constants, state, slot, env)
    for robot in range(slot.delay_steps.shape[0]):
        if loop.is_local:
            state.delay_s[env, robot] = 0.0
        steps = steps_of_delay(state.delay_s[env, robot], loop.sampling_s)
        slot.delay_steps[robot] = steps
        capped = steps > loop.max_delay_steps and not loop.filter.is_on
        slot.delay_capped[robot] = 1 if capped else 0
        slot.control_saturated[robot] = 0
    call_plug(plugs.plant, constants, state, slot, env)
    copy(state.gain_delay_steps[env], slot.gain_delay_steps)
    copy(slot.state.reshape(-1), state.robot_state[env].reshape(-1))
