"""The slot loop: the only place where network and robots meet."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hiersched.compiled import kernel
from hiersched.network.lyapunov import (
    delay_surrogate,
    mean_arrivals,
    offered_service,
    rate_penalty,
)
from hiersched.network.queues import serve_slot
from hiersched.network.schedulers import schedule_slot
from hiersched.network.traffic import poisson_quantiles
from hiersched.numerics import F32
from hiersched.radio.channel import prb_rates
from hiersched.randomness import (
    STREAM_ARRIVAL,
    draw_exponentials,
    draw_normals,
    draw_uniforms,
)
from hiersched.robot.dexterity import window_index
from hiersched.robot.dynamics import RobotConstants, close_loop, move_step, steps_of_delay
from hiersched.simulator.records import SlotRecord
from hiersched.simulator.setup import SlotConstants, SlotScratch, SlotState


@kernel(forceinline=True)
def draw_channel(
    constants: SlotConstants, state: SlotState, scratch: SlotScratch, env: int
) -> None:
    """Draw the fading and the rates of environment `env`'s coming slot."""
    power = state.fading_power[env].reshape(-1)
    draw_exponentials(state.key[env], state.slot[env], constants.fading_scale, scratch.words, power)
    prb_rates(
        power,
        state.snr[env],
        constants.prb_bandwidth_mhz,
        state.prb_rate_mbps[env].reshape(-1),
    )


@kernel()
def draw_channels(constants: SlotConstants, state: SlotState, scratch: SlotScratch) -> None:
    """Draw every environment's first slot; the average rate starts at that of one PRB."""
    num_users, num_prb = state.prb_rate_mbps.shape[1:]
    for env in range(state.key.shape[0]):
        draw_channel(constants, state, scratch, env)
        for user in range(num_users):
            total = 0.0
            for prb in range(num_prb):
                total += state.prb_rate_mbps[env, user, prb]
            state.average_rate_mbps[env, user] = total / num_prb


@kernel()
def run_slots(
    constants: SlotConstants,
    state: SlotState,
    scratch: SlotScratch,
    scheduler: int,
    weights: NDArray[np.float64],
    multipliers: NDArray[np.float64],
    record: SlotRecord,
) -> None:
    """Run all environments for as many slots as `record` has.

    Parameters
    ----------
    constants, state, scratch
        From `simulator.setup`; `state` moves on.
    scheduler
        Code of the scheduler.
    weights
        Weights of the weighted PF rule, shape (E, U).
    multipliers
        Multiplier of each URLLC user's delay constraint, shape (E, R).
    record
        Is filled.
    """
    num_slots = record.prb_owner.shape[1]
    for env in range(state.key.shape[0]):
        for index in range(num_slots):
            _observe(constants, state, scratch, multipliers[env], record, env, index)
            for user in range(weights.shape[1]):
                record.weight[env, index, user] = np.float32(weights[env, user])
            schedule_slot(
                scheduler,
                state.slot[env],
                state.prb_rate_mbps[env],
                weights[env],
                state.hol_delay_s[env],
                state.average_rate_mbps[env],
                scratch.terms,
                constants.rules,
                scratch.weight,
                scratch.allocation,
                record.prb_owner[env, index],
            )
            _serve(constants, state, scratch, record, env, index)
            for robot in range(constants.num_urllc):
                _drive_robot(constants.robots, state, record, env, index, robot)
            state.slot[env] += 1
            draw_channel(constants, state, scratch, env)


@kernel()
def run_robots(
    constants: SlotConstants, state: SlotState, scratch: SlotScratch, record: SlotRecord
) -> None:
    """Run the robots alone with the network delays that stand in `record.network_delay_s`."""
    for env in range(state.key.shape[0]):
        for index in range(record.network_delay_s.shape[1]):
            normals = record.robot_normal[env, index]
            draw_normals(
                state.key[env], state.slot[env], scratch.normal_words, scratch.normals, normals
            )
            for robot in range(constants.num_urllc):
                dexterity = state.robots.dexterity_index[env, robot]
                record.dexterity_index[env, index, robot] = dexterity
                _drive_robot(constants.robots, state, record, env, index, robot)
            state.slot[env] += 1


@kernel()
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


@kernel(forceinline=True)
def _observe(
    constants: SlotConstants,
    state: SlotState,
    scratch: SlotScratch,
    multiplier: NDArray[np.float64],
    record: SlotRecord,
    env: int,
    index: int,
) -> None:
    """Draw the slot's world and note what the scheduler sees."""
    num_users = state.backlog_packets.shape[1]
    key = state.key[env]
    slot = state.slot[env]
    draw_uniforms(key, STREAM_ARRIVAL, slot, 0, record.arrival_uniform[env, index])
    draw_normals(key, slot, scratch.normal_words, scratch.normals, record.robot_normal[env, index])
    terms = scratch.terms
    drawn = state.fading_power[env]
    power = record.fading_power[env, index].reshape(-1)
    flat = drawn.reshape(-1)
    for i in range(power.shape[0]):
        power[i] = flat[i]
    for user in range(num_users):
        record.mean_fading_power[env, index, user] = _row_mean(drawn[user])
        backlog = state.backlog_packets[env, user]
        terms.backlog_packets[user] = backlog
        record.backlog_packets[env, index, user] = backlog
        record.hol_delay_s[env, index, user] = state.hol_delay_s[env, user]
        record.average_rate_mbps[env, index, user] = state.average_rate_mbps[env, user]
    for robot in range(constants.num_urllc):
        dexterity = state.robots.dexterity_index[env, robot]
        terms.service_offset_mbps[robot] = constants.service_coefficient_mbps * dexterity
        terms.multiplier[robot] = multiplier[robot]
        record.dexterity_index[env, index, robot] = dexterity
        record.multiplier[env, index, robot] = multiplier[robot]


@kernel(forceinline=True)
def _serve(
    constants: SlotConstants,
    state: SlotState,
    scratch: SlotScratch,
    record: SlotRecord,
    env: int,
    index: int,
) -> None:
    """Rates of the allocation, arrivals, queues, delays and the parts of the Lagrangian."""
    num_users = state.backlog_packets.shape[1]
    terms = scratch.terms
    owner = record.prb_owner[env, index]
    rate = record.rate_mbps[env, index]
    count = record.num_prb[env, index]
    for user in range(num_users):
        rate[user] = 0.0
        count[user] = 0
    for prb in range(owner.shape[0]):
        user_of_prb = np.int64(owner[prb])
        rate[user_of_prb] += np.float64(state.prb_rate_mbps[env, user_of_prb, prb])
        count[user_of_prb] += 1
    for user in range(num_users):
        wanted = constants.offered_mbps[user] - constants.rate_sensitivity[user] * rate[user]
        record.arrival_clamped[env, index, user] = 1 if wanted < 0.0 else 0
        mean = mean_arrivals(
            rate[user],
            constants.offered_mbps[user],
            constants.rate_sensitivity[user],
            constants.arrival_packets_per_mbps[user],
        )
        scratch.mean_batches[user] = mean / constants.batch_packets
    poisson_quantiles(
        record.arrival_uniform[env, index],
        scratch.mean_batches,
        scratch.poisson,
        scratch.batches,
    )
    slot = state.slot[env]
    drift_urllc = 0.0
    drift_embb = 0.0
    penalty_urllc = 0.0
    penalty_embb = 0.0
    priced = 0.0
    for user in range(num_users):
        r = rate[user]
        arrivals = scratch.batches[user] * constants.batch_packets
        service = offered_service(
            r, terms.service_offset_mbps[user], constants.service_packets_per_mbps
        )
        backlog = state.backlog_packets[env, user]
        after, head, sojourn, hol, due, late = serve_slot(
            slot,
            backlog,
            arrivals,
            service,
            constants.deadline_slots[user],
            state.arrived[env, :, user],
            state.head[env, user],
        )
        record.arrivals_packets[env, index, user] = arrivals
        record.service_packets[env, index, user] = service
        record.delay_s[env, index, user] = sojourn * constants.slot_s
        record.due_packets[env, index, user] = due
        record.late_packets[env, index, user] = late
        state.backlog_packets[env, user] = after
        state.head[env, user] = head
        state.hol_delay_s[env, user] = hol * constants.slot_s
        state.rate_mbps[env, user] = r
        state.average_rate_mbps[env, user] += constants.average_forgetting * (
            r - state.average_rate_mbps[env, user]
        )
        drift = 0.5 * (after * after - backlog * backlog)
        penalty = rate_penalty(r, constants.epsilon)
        if user < constants.num_urllc:
            drift_urllc += drift
            penalty_urllc += penalty
            if constants.measured_constraint:
                y = (constants.violation_share * due - late) / constants.mean_due_packets[user]
            else:
                y = delay_surrogate(r, constants.delay_exponent_per_mbps, constants.violation_share)
            record.constraint[env, index, user] = y
            record.network_delay_s[env, index, user] = (
                record.delay_s[env, index, user] + constants.robots.core_latency_s
            )
            priced += terms.multiplier[user] * y
        else:
            drift_embb += drift
            penalty_embb += penalty
    record.drift_urllc[env, index] = drift_urllc
    record.drift_embb[env, index] = drift_embb
    record.penalty_urllc[env, index] = penalty_urllc
    record.penalty_embb[env, index] = penalty_embb
    record.reward_urllc[env, index] = -(
        drift_urllc + constants.penalty_weight * penalty_urllc - priced
    ) / (constants.num_urllc * constants.reward_scale)
    record.reward_embb[env, index] = -(drift_embb + constants.penalty_weight * penalty_embb) / (
        (num_users - constants.num_urllc) * constants.reward_scale
    )


@kernel(forceinline=True)
def _drive_robot(
    robots: RobotConstants,
    state: SlotState,
    record: SlotRecord,
    env: int,
    index: int,
    robot: int,
) -> None:
    """Move one robot through the slot with the network delay that stands in the record."""
    body = state.robots.state[env, robot]
    slip = state.robots.slip[env, robot]
    control = state.robots.control[env, robot]
    history = state.robots.history[env, robot]
    sums = state.robots.window_sums[env, robot]
    normals = record.robot_normal[env, index, robot]
    wanted = steps_of_delay(record.network_delay_s[env, index, robot], robots.sampling_s)
    steps = min(wanted, robots.max_delay_steps)
    slip[0] = robots.slip_decay * slip[0] + robots.slip_gain_mps * normals[0]
    slip[1] = robots.slip_decay * slip[1] + robots.slip_gain_radps * normals[1]
    saturated = 0
    square_error = 0.0
    offset = robots.offset[robot]
    first = state.slot[env] * robots.steps_per_slot
    last = first + robots.steps_per_slot
    for step in range(first, last):
        if step % robots.steps_per_sample == 0:
            sample = step // robots.steps_per_sample
            saturated += close_loop(robots, sample, steps, normals, body, history, control)
            state.robots.gain_delay_steps[env, robot] = robots.adjusted_delay_steps[steps]
        square_error += move_step(robots, offset + step, slip, control, body, sums)
        if (step + 1) % robots.steps_per_window == 0:
            state.robots.dexterity_index[env, robot] = window_index(
                sums[0], sums[1], sums[2], robots.steps_per_window
            )
            sums[:] = 0.0
    record.delay_steps[env, index, robot] = steps
    record.delay_capped[env, index, robot] = 1 if wanted > steps else 0
    record.gain_delay_steps[env, index, robot] = state.robots.gain_delay_steps[env, robot]
    record.control_saturated[env, index, robot] = saturated
    record.tracking_error_m[env, index, robot] = math.sqrt(square_error / robots.steps_per_slot)
    body_record = record.state[env, index, robot]
    for j in range(5):
        body_record[j] = body[j]
    reference = record.reference[env, index, robot]
    pose = robots.pose[offset + last]
    for j in range(3):
        reference[j] = pose[j]
    reference[3] = robots.speed_mps
    reference[4] = robots.turn_rate[offset + last - 1]
    record.control[env, index, robot, 0] = control[0]
    record.control[env, index, robot, 1] = control[1]
