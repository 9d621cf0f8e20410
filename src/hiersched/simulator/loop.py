"""The slot loop: the only place where network and robots meet."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.core.compiled import kernel
from hiersched.core.numerics import F32
from hiersched.core.randomness import (
    STREAM_ARRIVAL,
    draw_exponentials,
    draw_normals,
    draw_uniforms,
)
from hiersched.models.channel.link_budget import prb_rates
from hiersched.models.plant.dexterity import window_index
from hiersched.models.plant.unicycle import (
    CONTROL,
    LANES,
    NORMALS,
    NUM_PATH,
    SLOT_SQUARE,
    STATE,
    WINDOW_SUMS,
    RobotConstants,
    close_loop,
    gather_path,
    hold_entry,
    move_lanes,
    start_slot,
    steps_of_delay,
)
from hiersched.policies.rules import schedule_slot
from hiersched.simulator.linear_robots import drive_linear
from hiersched.simulator.prefetch import prefetch_third
from hiersched.simulator.record import SlotFields
from hiersched.simulator.service import serve
from hiersched.simulator.setup import SlotConstants, SlotScratch, SlotState

GIVEN = -1
"""Scheduler code where the owners of the PRBs are given."""


@kernel(forceinline=True)
def draw_channel(
    constants: SlotConstants,
    state: SlotState,
    scratch: SlotScratch,
    env: int,
    fading_power: NDArray[np.float32],
) -> None:
    """Draw environment `env`'s coming slot: its fading into (U, K), its rates into the state."""
    power = fading_power.reshape(-1)
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
        draw_channel(constants, state, scratch, env, state.fading_power[env])
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
    owners: NDArray[np.uint32],
    rows: NDArray[np.uint64],
) -> None:
    """Run all environments for as many slots as `rows` has.

    Parameters
    ----------
    constants, state, scratch
        From `simulator.setup`; `state` moves on.
    scheduler
        Code of the scheduler, or GIVEN.
    weights
        Weights of the weighted PF rule, shape (E, U).
    multipliers
        Multiplier of each URLLC user's delay constraint, shape (E, R).
    owners
        For GIVEN, the owner of each PRB, shape (E, T, K); not read otherwise.
    rows
        Is filled: the rows of a record, shape (E, T, words).
    """
    record = scratch.slot
    for env in range(state.key.shape[0]):
        _copy(state.fading_power[env].reshape(-1), record.fading_power.reshape(-1))
        for index in range(rows.shape[1]):
            row = rows[env, index]
            prefetch_third(row, 0)
            _observe(constants, state, scratch, multipliers[env], record, env)
            prefetch_third(row, 1)
            for user in range(weights.shape[1]):
                record.weight[user] = np.float32(weights[env, user])
            if scheduler == GIVEN:
                for prb in range(constants.num_prb):
                    record.prb_owner[prb] = owners[env, index, prb]
            else:
                schedule_slot(
                    scheduler,
                    state.slot[env],
                    state.prb_rate_mbps[env],
                    weights[env],
                    state.hol_delay_s[env],
                    state.average_rate_mbps[env],
                    state.rate_mbps[env],
                    scratch.terms,
                    constants.rules,
                    scratch.scheduler,
                    record.prb_owner,
                )
            prefetch_third(row, 2)
            serve(constants, state, scratch, record, env)
            _move_robots(constants, state, scratch, record, env)
            # What this slot delivers is known when it has ended: the next slot's samples use it.
            _copy(record.network_delay_s, state.robots.delay_s[env])
            state.slot[env] += 1
            _copy(scratch.row, row)
            # The next slot's channel goes where it will be needed, after the last slot the state.
            is_last = index == rows.shape[1] - 1
            power = state.fading_power[env] if is_last else record.fading_power
            draw_channel(constants, state, scratch, env, power)


@kernel()
def run_robots(
    constants: SlotConstants,
    state: SlotState,
    scratch: SlotScratch,
    network_delay_s: NDArray[np.float64],
    rows: NDArray[np.uint64],
) -> None:
    """Run the robots alone with network delays of shape (E, T, R); `rows` is filled.

    A delay is in force in its own slot.
    """
    record = scratch.slot
    scratch.row[:] = 0  # what belongs to the network
    for env in range(state.key.shape[0]):
        for index in range(rows.shape[1]):
            _draw_robots(constants, state, scratch, record, env)
            for robot in range(constants.num_urllc):
                record.dexterity_index[robot] = state.robots.dexterity_index[env, robot]
                record.network_delay_s[robot] = network_delay_s[env, index, robot]
                state.robots.delay_s[env, robot] = network_delay_s[env, index, robot]
            _move_robots(constants, state, scratch, record, env)
            state.slot[env] += 1
            _copy(scratch.row, rows[env, index])


@njit(inline="always")
def _copy(values: NDArray[Any], out: NDArray[Any]) -> None:
    for i in range(values.shape[0]):
        out[i] = values[i]


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
    record: SlotFields,
    env: int,
) -> None:
    """Draw the slot's world and note what the scheduler sees."""
    num_users = state.backlog_packets.shape[1]
    key = state.key[env]
    slot = state.slot[env]
    draw_uniforms(key, STREAM_ARRIVAL, slot, 0, record.arrival_uniform)
    _draw_robots(constants, state, scratch, record, env)
    terms = scratch.terms
    for user in range(num_users):
        record.mean_fading_power[user] = _row_mean(record.fading_power[user])
        backlog = state.backlog_packets[env, user]
        terms.backlog_packets[user] = backlog
        record.backlog_packets[user] = backlog
        record.hol_delay_s[user] = state.hol_delay_s[env, user]
        record.average_rate_mbps[user] = state.average_rate_mbps[env, user]
    for robot in range(constants.num_urllc):
        dexterity = state.robots.dexterity_index[env, robot]
        terms.service_offset_mbps[robot] = constants.service_coefficient_mbps * dexterity
        terms.multiplier[robot] = multiplier[robot]
        record.dexterity_index[robot] = dexterity
        record.multiplier[robot] = multiplier[robot]


@kernel(forceinline=True)
def _draw_robots(
    constants: SlotConstants, state: SlotState, scratch: SlotScratch, record: SlotFields, env: int
) -> None:
    """Draw the robots' standard normals of the slot."""
    if constants.is_linear:
        rows = scratch.linear_normals
        draw_normals(state.key[env], state.slot[env], scratch.normals, rows)
        normals = record.robot_normal.reshape(-1)
        _copy(rows.reshape(-1)[: normals.shape[0]], normals)
    else:
        draw_normals(state.key[env], state.slot[env], scratch.normals, record.robot_normal)


@kernel(forceinline=True)
def _move_robots(
    constants: SlotConstants, state: SlotState, scratch: SlotScratch, record: SlotFields, env: int
) -> None:
    """Move all robots through the slot with the network delays in force."""
    robots = constants.robots
    for robot in range(record.network_delay_s.shape[0]):
        steps = steps_of_delay(state.robots.delay_s[env, robot], robots.sampling_s)
        record.delay_steps[robot] = steps
        record.delay_capped[robot] = 1 if steps > robots.max_delay_steps else 0
        record.control_saturated[robot] = 0
    if constants.is_linear:
        drive_linear(robots, constants.linear, state, record, env)
    else:
        _drive_robots(robots, state, scratch.path, record, env)


@kernel(forceinline=True)
def _drive_robots(
    robots: RobotConstants,
    state: SlotState,
    path: NDArray[np.float64],
    record: SlotFields,
    env: int,
) -> None:
    """Move all unicycles through the slot."""
    delay_steps = record.delay_steps
    saturated = record.control_saturated
    num_robots = delay_steps.shape[0]
    first = state.slot[env] * robots.steps_per_slot
    last = first + robots.steps_per_slot
    for block in range(state.robots.lanes.shape[1]):
        lanes = state.robots.lanes[env, block]
        begin = block * LANES
        count = min(LANES, num_robots - begin)
        for lane in range(count):
            normals = record.robot_normal[begin + lane]
            for j in range(5):
                lanes[NORMALS + j * LANES + lane] = np.float64(normals[j])
            place = robots.offset[begin + lane] + first
            gather_path(robots.path, place, robots.steps_per_slot, lane, path)
        start_slot(robots, lanes)
        for step in range(first, last):
            if step % robots.steps_per_sample == 0:
                sample = step // robots.steps_per_sample
                for lane in range(count):
                    robot = begin + lane
                    step_delay = int(delay_steps[robot])
                    entry = min(step_delay, robots.max_delay_steps)
                    if robots.hold_samples > 0:
                        held = state.robots.held[env, robot]
                        entry = hold_entry(entry, robots.hold_samples, held)
                    saturated[robot] += close_loop(
                        robots,
                        sample,
                        step_delay,
                        entry,
                        lane,
                        lanes,
                        state.robots.history[env, robot],
                        state.robots.commands[env, robot],
                    )
                    adjusted = robots.adjusted_delay_steps[entry]
                    state.robots.gain_delay_steps[env, robot] = adjusted
            of_step = (step - first) * NUM_PATH * LANES
            move_lanes(
                robots.step_s,
                robots.lag_mean,
                robots.lag_decay,
                path[of_step : of_step + NUM_PATH * LANES],
                lanes,
            )
            if (step + 1) % robots.steps_per_window == 0:
                _end_window(robots, lanes, state.robots.dexterity_index[env, begin:])
        for lane in range(count):
            _record_robot(robots, state, lanes, lane, last, record, env, begin + lane)


@kernel()
def _end_window(
    robots: RobotConstants, lanes: NDArray[np.float64], dexterity_index: NDArray[np.float64]
) -> None:
    """Dexterity index of a block of robots, shape (robots from the block on,), and new sums."""
    for lane in range(min(LANES, dexterity_index.shape[0])):
        dexterity_index[lane] = window_index(
            lanes[WINDOW_SUMS + lane],
            lanes[WINDOW_SUMS + LANES + lane],
            lanes[WINDOW_SUMS + 2 * LANES + lane],
            robots.steps_per_window,
        )
    for place in range(WINDOW_SUMS, WINDOW_SUMS + 3 * LANES):
        lanes[place] = 0.0


@kernel(forceinline=True)
def _record_robot(
    robots: RobotConstants,
    state: SlotState,
    lanes: NDArray[np.float64],
    lane: int,
    last: int,
    record: SlotFields,
    env: int,
    robot: int,
) -> None:
    """Note where one robot stands after the slot's last step."""
    record.gain_delay_steps[robot] = state.robots.gain_delay_steps[env, robot]
    record.tracking_error_m[robot] = math.sqrt(lanes[SLOT_SQUARE + lane] / robots.steps_per_slot)
    body = record.state[robot]
    for j in range(5):
        body[j] = lanes[STATE + j * LANES + lane]
    place = robots.offset[robot] + last
    reference = record.reference[robot]
    pose = robots.pose[place]
    for j in range(3):
        reference[j] = pose[j]
    reference[3] = robots.path[place - 1, 4]
    reference[4] = robots.path[place - 1, 0]
    control = record.control[robot]
    control[0] = lanes[CONTROL + lane]
    control[1] = lanes[CONTROL + LANES + lane]
