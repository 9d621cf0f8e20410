"""The slot loop: the only place where network and robots meet."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.network.lyapunov import (
    delay_surrogate,
    offered_service,
    rate_penalty,
)
from hiersched.network.queues import serve_slot
from hiersched.network.schedulers import schedule_slot
from hiersched.network.traffic import poisson_quantile
from hiersched.radio.channel import prb_rates
from hiersched.randomness import (
    STREAM_ARRIVAL,
    draw_exponentials,
    draw_normals,
    draw_uniforms,
)
from hiersched.robot.dexterity import window_index
from hiersched.robot.dynamics import close_loop, move_step, steps_of_delay
from hiersched.simulator.records import SlotRecord
from hiersched.simulator.setup import SlotConstants, SlotScratch, SlotState


@njit(error_model="numpy")
def draw_channel(
    constants: SlotConstants, state: SlotState, scratch: SlotScratch, env: int
) -> None:
    """Draw the fading and the rates of environment `env`'s coming slot."""
    power = state.fading_power[env].reshape(-1)
    draw_exponentials(
        state.key[env], state.slot[env], constants.fading_scale, scratch.words, power
    )
    prb_rates(
        power,
        state.snr[env],
        constants.prb_bandwidth_mhz,
        state.prb_rate_mbps[env].reshape(-1),
    )


@njit(error_model="numpy")
def draw_channels(constants: SlotConstants, state: SlotState, scratch: SlotScratch) -> None:
    """Draw every environment's first slot; the moving average starts at the mean rate of one PRB."""
    num_users, num_prb = state.prb_rate_mbps.shape[1:]
    for env in range(state.key.shape[0]):
        draw_channel(constants, state, scratch, env)
        for user in range(num_users):
            total = 0.0
            for prb in range(num_prb):
                total += state.prb_rate_mbps[env, user, prb]
            state.average_rate_mbps[env, user] = total / num_prb


@njit(error_model="numpy")
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
            _drive(constants, state, scratch, record, env, index)
            state.slot[env] += 1
            draw_channel(constants, state, scratch, env)


@njit(error_model="numpy")
def run_robots(
    constants: SlotConstants, state: SlotState, scratch: SlotScratch, record: SlotRecord
) -> None:
    """Run the robots alone with the network delays that stand in `record.network_delay_s`."""
    for env in range(state.key.shape[0]):
        for index in range(record.network_delay_s.shape[1]):
            normals = record.robot_normal[env, index]
            draw_normals(state.key[env], state.slot[env], scratch.normal_words, normals)
            for robot in range(constants.num_urllc):
                dexterity = state.robots.dexterity_index[env, robot]
                record.dexterity_index[env, index, robot] = dexterity
            drive_robots(constants, state, scratch, record, env, index)
            state.slot[env] += 1


@njit(error_model="numpy")
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
    num_users, num_prb = state.prb_rate_mbps.shape[1:]
    key = state.key[env]
    slot = state.slot[env]
    draw_uniforms(key, STREAM_ARRIVAL, slot, 0, record.arrival_uniform[env, index])
    draw_normals(key, slot, scratch.normal_words, record.robot_normal[env, index])
    terms = scratch.terms
    power = record.fading_power[env, index]
    drawn = state.fading_power[env]
    for user in range(num_users):
        total = np.float32(0.0)
        for prb in range(num_prb):
            power[user, prb] = drawn[user, prb]
            total += drawn[user, prb]
        record.mean_fading_power[env, index, user] = total / np.float32(num_prb)
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


@njit(error_model="numpy")
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
        user = np.int64(owner[prb])
        rate[user] += np.float64(state.prb_rate_mbps[env, user, prb])
        count[user] += 1
    slot = state.slot[env]
    drift_urllc = 0.0
    drift_embb = 0.0
    penalty_urllc = 0.0
    penalty_embb = 0.0
    priced = 0.0
    for user in range(num_users):
        r = rate[user]
        wanted = constants.offered_mbps[user] - constants.rate_sensitivity[user] * r
        record.arrival_clamped[env, index, user] = 1 if wanted < 0.0 else 0
        mean = max(0.0, wanted) * constants.arrival_packets_per_mbps[user]
        batches = poisson_quantile(
            record.arrival_uniform[env, index, user], mean / constants.batch_packets
        )
        arrivals = batches * constants.batch_packets
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
            state.arrived[env, user],
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
                y = (
                    constants.violation_share * due - late
                ) / constants.mean_due_packets[user]
            else:
                y = delay_surrogate(
                    r, constants.delay_exponent_per_mbps, constants.violation_share
                )
            record.constraint[env, index, user] = y
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
    record.reward_embb[env, index] = -(
        drift_embb + constants.penalty_weight * penalty_embb
    ) / ((num_users - constants.num_urllc) * constants.reward_scale)


@njit(error_model="numpy")
def _drive(
    constants: SlotConstants,
    state: SlotState,
    scratch: SlotScratch,
    record: SlotRecord,
    env: int,
    index: int,
) -> None:
    """Move the robots through the slot with the delay that their commands meet in it."""
    delay_s = record.network_delay_s[env, index]
    for robot in range(constants.num_urllc):
        delay_s[robot] = record.delay_s[env, index, robot] + constants.robots.core_latency_s
    drive_robots(constants, state, scratch, record, env, index)


@njit(error_model="numpy")
def drive_robots(
    constants: SlotConstants,
    state: SlotState,
    scratch: SlotScratch,
    record: SlotRecord,
    env: int,
    index: int,
) -> None:
    """Move the robots of `env` through a slot whose network delays stand in the record."""
    robots = constants.robots
    num_robots = constants.num_urllc
    body = state.robots.state[env]
    slip = state.robots.slip[env]
    control = state.robots.control[env]
    sums = state.robots.window_sums[env]
    normals = record.robot_normal[env, index]
    steps = record.delay_steps[env, index]
    saturated = record.control_saturated[env, index]
    square_error = scratch.square_error
    for robot in range(num_robots):
        wanted = steps_of_delay(record.network_delay_s[env, index, robot], robots.sampling_s)
        capped = wanted > robots.max_delay_steps
        steps[robot] = robots.max_delay_steps if capped else wanted
        record.delay_capped[env, index, robot] = 1 if capped else 0
        record.gain_delay_steps[env, index, robot] = steps[robot]
        slip[0, robot] = robots.slip_decay * slip[0, robot] + robots.slip_gain_mps * normals[robot, 0]
        slip[1, robot] = (
            robots.slip_decay * slip[1, robot] + robots.slip_gain_radps * normals[robot, 1]
        )
        square_error[robot] = 0.0
        saturated[robot] = 0
    first = state.slot[env] * robots.steps_per_slot
    for step in range(first, first + robots.steps_per_slot):
        if step % robots.steps_per_sample == 0:
            close_loop(
                robots,
                step // robots.steps_per_sample,
                steps,
                normals,
                body,
                state.robots.history[env],
                control,
                saturated,
            )
        move_step(robots, step, slip, control, body, sums, square_error)
        if (step + 1) % robots.steps_per_window == 0:
            for robot in range(num_robots):
                state.robots.dexterity_index[env, robot] = window_index(
                    sums[0, robot], sums[1, robot], sums[2, robot], robots.steps_per_window
                )
                sums[0, robot] = 0.0
                sums[1, robot] = 0.0
                sums[2, robot] = 0.0
    last = first + robots.steps_per_slot
    for robot in range(num_robots):
        place = robots.offset[robot] + last
        for j in range(5):
            record.state[env, index, robot, j] = body[j, robot]
        for j in range(3):
            record.reference[env, index, robot, j] = robots.pose[place, j]
        record.reference[env, index, robot, 3] = robots.speed_mps
        record.reference[env, index, robot, 4] = robots.turn_rate[place - 1]
        record.control[env, index, robot, 0] = control[0, robot]
        record.control[env, index, robot, 1] = control[1, robot]
        record.tracking_error_m[env, index, robot] = math.sqrt(
            square_error[robot] / robots.steps_per_slot
        )
