"""What an allocation does in a slot: rates, arrivals, delays, the parts of the Lagrangian."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.allocation.objective import (
    delay_surrogate,
    mean_arrivals,
    offered_service,
    rate_penalty,
)
from hiersched.core.compiled import kernel
from hiersched.models.queue.fifo import (
    AFTER,
    ARRIVALS,
    BACKLOG,
    DUE,
    HOL_DELAY,
    LANES,
    LATE,
    SERVICE,
    SOJOURN,
    serve_users,
)
from hiersched.models.traffic.poisson import MEAN, QUANTILE, UNIFORM, poisson_quantiles
from hiersched.simulator.record import SlotFields
from hiersched.simulator.setup import SlotConstants, SlotScratch, SlotState
from hiersched.simulator.user_lanes import (
    AVERAGE,
    CLAMPED,
    DELAY,
    DRIFT,
    MEAN_DUE,
    OFFERED,
    OFFSET,
    PACKETS,
    PENALTY,
    RATE,
    SENSITIVITY,
    SURPLUS,
)


@kernel(forceinline=True)
def serve(
    constants: SlotConstants,
    state: SlotState,
    scratch: SlotScratch,
    record: SlotFields,
    env: int,
) -> None:
    """Serve one environment's slot by the owners that stand in the record; fills the record."""
    _rates(state.prb_rate_mbps[env], record)
    for block in range(scratch.users.shape[0]):
        begin = block * LANES
        count = min(LANES, record.rate_mbps.shape[0] - begin)
        users = scratch.users[block]
        arrivals = scratch.arrivals[block]
        queues = scratch.queues[block]
        _load_users(state, scratch, record, env, begin, count, users, arrivals, queues)
        _offer(constants, users, arrivals, queues)
        poisson_quantiles(arrivals)
        batch = np.float64(constants.batch_packets)
        for lane in range(LANES):
            queues[ARRIVALS + lane] = batch * arrivals[QUANTILE + lane]
        serve_users(
            state.slot[env],
            count,
            queues,
            state.arrived[env][:, begin:],
            state.head[env, begin:],
        )
        _weigh(constants, users, queues)
        _store_users(constants, state, record, env, begin, count, users, queues)
    _sum_up(constants, scratch, record)


@kernel(forceinline=True)
def _rates(prb_rate_mbps: NDArray[np.float32], record: SlotFields) -> None:
    rate = record.rate_mbps
    count = record.num_prb
    for user in range(rate.shape[0]):
        rate[user] = 0.0
        count[user] = 0
    for prb in range(record.prb_owner.shape[0]):
        owner = np.int64(record.prb_owner[prb])
        rate[owner] += np.float64(prb_rate_mbps[owner, prb])
        count[owner] += 1


@kernel(forceinline=True)
def _load_users(
    state: SlotState,
    scratch: SlotScratch,
    record: SlotFields,
    env: int,
    begin: int,
    count: int,
    users: NDArray[np.float64],
    arrivals: NDArray[np.float64],
    queues: NDArray[np.float64],
) -> None:
    for lane in range(count):
        users[RATE + lane] = record.rate_mbps[begin + lane]
    for lane in range(count):
        users[OFFSET + lane] = scratch.terms.service_offset_mbps[begin + lane]
    for lane in range(count):
        users[AVERAGE + lane] = state.average_rate_mbps[env, begin + lane]
    for lane in range(count):
        arrivals[UNIFORM + lane] = record.arrival_uniform[begin + lane]
    for lane in range(count):
        queues[BACKLOG + lane] = state.backlog_packets[env, begin + lane]


@kernel(forceinline=True)
def _offer(
    constants: SlotConstants,
    users: NDArray[np.float64],
    arrivals: NDArray[np.float64],
    queues: NDArray[np.float64],
) -> None:
    """Mean arrivals and offered service at the rates of a block of users."""
    batch = np.float64(constants.batch_packets)
    per_mbps = constants.service_packets_per_mbps
    for lane in range(LANES):
        rate = users[RATE + lane]
        offered = users[OFFERED + lane]
        sensitivity = users[SENSITIVITY + lane]
        mean = mean_arrivals(rate, offered, sensitivity, users[PACKETS + lane])
        users[CLAMPED + lane] = 1.0 if offered - sensitivity * rate < 0.0 else 0.0
        arrivals[MEAN + lane] = mean / batch
        queues[SERVICE + lane] = offered_service(rate, users[OFFSET + lane], per_mbps)


@kernel(forceinline=True)
def _weigh(
    constants: SlotConstants, users: NDArray[np.float64], queues: NDArray[np.float64]
) -> None:
    """Delays, averages and the parts of the Lagrangian of a block of users."""
    for lane in range(LANES):
        rate = users[RATE + lane]
        before = queues[BACKLOG + lane]
        after = queues[AFTER + lane]
        users[DRIFT + lane] = 0.5 * (after * after - before * before)
        users[PENALTY + lane] = rate_penalty(rate, constants.epsilon)
        users[DELAY + lane] = queues[SOJOURN + lane] * constants.slot_s
        users[AVERAGE + lane] += constants.average_forgetting * (rate - users[AVERAGE + lane])
    if constants.measured_constraint:
        for lane in range(LANES):
            excess = constants.violation_share * queues[DUE + lane] - queues[LATE + lane]
            users[SURPLUS + lane] = excess / users[MEAN_DUE + lane]
    else:
        for lane in range(LANES):
            users[SURPLUS + lane] = delay_surrogate(
                users[RATE + lane], constants.delay_exponent_per_mbps, constants.violation_share
            )


@kernel(forceinline=True)
def _store_users(
    constants: SlotConstants,
    state: SlotState,
    record: SlotFields,
    env: int,
    begin: int,
    count: int,
    users: NDArray[np.float64],
    queues: NDArray[np.float64],
) -> None:
    for lane in range(count):
        record.arrival_clamped[begin + lane] = np.uint32(users[CLAMPED + lane])
    for lane in range(count):
        record.arrivals_packets[begin + lane] = np.uint32(queues[ARRIVALS + lane])
    for lane in range(count):
        record.due_packets[begin + lane] = np.uint32(queues[DUE + lane])
    for lane in range(count):
        record.late_packets[begin + lane] = np.uint32(queues[LATE + lane])
    for lane in range(count):
        record.service_packets[begin + lane] = queues[SERVICE + lane]
    for lane in range(count):
        record.delay_s[begin + lane] = users[DELAY + lane]
    for lane in range(count):
        state.backlog_packets[env, begin + lane] = queues[AFTER + lane]
    for lane in range(count):
        state.hol_delay_s[env, begin + lane] = queues[HOL_DELAY + lane] * constants.slot_s
    for lane in range(count):
        state.rate_mbps[env, begin + lane] = users[RATE + lane]
    for lane in range(count):
        state.average_rate_mbps[env, begin + lane] = users[AVERAGE + lane]


@njit(inline="always")
def _lane(users: NDArray[np.float64], field: int, user: int) -> float:
    return float(users[user // LANES, field + user % LANES])


@kernel(forceinline=True)
def _sum_up(constants: SlotConstants, scratch: SlotScratch, record: SlotFields) -> None:
    """Add up over the users of each slice, in their order; the rewards."""
    users = scratch.users
    num_users = record.rate_mbps.shape[0]
    drift_urllc = drift_embb = penalty_urllc = penalty_embb = priced = 0.0
    for user in range(constants.num_urllc):
        drift_urllc += _lane(users, DRIFT, user)
        penalty_urllc += _lane(users, PENALTY, user)
        surplus = _lane(users, SURPLUS, user)
        priced += scratch.terms.multiplier[user] * surplus
        record.constraint[user] = surplus
        record.network_delay_s[user] = record.delay_s[user] + constants.robots.core_latency_s
    for user in range(constants.num_urllc, num_users):
        drift_embb += _lane(users, DRIFT, user)
        penalty_embb += _lane(users, PENALTY, user)
    record.drift_urllc[()] = drift_urllc
    record.drift_embb[()] = drift_embb
    record.penalty_urllc[()] = penalty_urllc
    record.penalty_embb[()] = penalty_embb
    record.reward_urllc[()] = -(drift_urllc + constants.penalty_weight * penalty_urllc - priced) / (
        constants.num_urllc * constants.reward_scale
    )
    record.reward_embb[()] = -(drift_embb + constants.penalty_weight * penalty_embb) / (
        (num_users - constants.num_urllc) * constants.reward_scale
    )
