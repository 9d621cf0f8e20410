"""From a scenario and a gain schedule to the constants and the initial state of the slot loop."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.allocation.objective import UserTerms
from hiersched.core.randomness import NormalScratch, normal_scratch
from hiersched.models.channel.link_budget import snr_per_fading_power
from hiersched.models.channel.rayleigh import Rayleigh
from hiersched.models.plant.linear import Linear, LinearConstants, LinearState, linear_state
from hiersched.models.plant.unicycle import RobotConstants, RobotState, path_scratch, robot_state
from hiersched.models.queue.fifo import LANES, NUM_QUEUE_LANES, set_deadline
from hiersched.models.traffic.poisson import MAX_MEAN, NUM_ARRIVAL_LANES, Poisson
from hiersched.policies.rules import (
    CAPPED,
    SchedulerConstants,
    SchedulerScratch,
    need_codes,
    scheduler_scratch,
)
from hiersched.scenario.schema import Scenario
from hiersched.simulator.record import SlotFields, SlotLayout
from hiersched.simulator.robot_setup import Gains, linear_constants, robot_constants
from hiersched.simulator.user_lanes import (
    MEAN_DUE,
    NUM_USER_LANES,
    OFFERED,
    PACKETS,
    SENSITIVITY,
)


class SlotConstants(NamedTuple):
    """What does not change during a run. Arrays have shape (U,), URLLC users first."""

    num_urllc: int
    num_prb: int
    slot_s: float
    prb_bandwidth_mhz: float
    fading_scale: np.float32
    offered_mbps: NDArray[np.float64]
    rate_sensitivity: NDArray[np.float64]
    arrival_packets_per_mbps: NDArray[np.float64]
    service_packets_per_mbps: float
    service_coefficient_mbps: float
    batch_packets: int
    deadline_slots: NDArray[np.float64]
    mean_due_packets: NDArray[np.float64]
    penalty_weight: float
    epsilon: float
    delay_exponent_per_mbps: float
    violation_share: float
    measured_constraint: bool
    average_forgetting: float
    reward_scale: float
    rules: SchedulerConstants
    robots: RobotConstants
    is_linear: bool  # robots that are linear plants, not unicycles
    linear: LinearConstants


class SlotState(NamedTuple):
    """What evolves, one row an environment; the channel is that of the coming slot."""

    key: NDArray[np.uint64]  # (E,)
    slot: NDArray[np.int64]  # (E,)
    snr: NDArray[np.float64]  # (E, U*K)
    fading_power: NDArray[np.float32]  # (E, U, K)
    prb_rate_mbps: NDArray[np.float32]  # (E, U, K)
    backlog_packets: NDArray[np.float64]  # (E, U)
    hol_delay_s: NDArray[np.float64]  # (E, U)
    average_rate_mbps: NDArray[np.float64]  # (E, U)
    rate_mbps: NDArray[np.float64]  # (E, U) of the last slot
    arrived: NDArray[np.float64]  # (E, T + 1, U): a slot's users side by side in memory
    head: NDArray[np.int64]  # (E, U)
    robots: RobotState
    linear: LinearState


class SlotScratch(NamedTuple):
    """Work arrays of the slot loop."""

    words: NDArray[np.uint32]
    normals: NormalScratch
    scheduler: SchedulerScratch
    users: NDArray[np.float64]  # (blocks, fields of LANES users)
    arrivals: NDArray[np.float64]  # likewise
    queues: NDArray[np.float64]  # likewise
    terms: UserTerms
    path: NDArray[np.float64]
    linear_normals: NDArray[np.float32]  # of all linear plants, in rows of 5
    slot: SlotFields
    row: NDArray[np.uint64]  # in which `slot` lies


def slot_constants(scenario: Scenario, gains: Gains, num_slots: int) -> SlotConstants:
    """Constants of a run of `num_slots` slots.

    Parameters
    ----------
    scenario
        The validated scenario.
    gains
        Gains for every delay up to `scenario.max_delay_steps`.
    num_slots
        Horizon of the run.

    Raises
    ------
    ValueError
        If the gains do not cover the scenario's delays, or a user's mean arrivals are beyond the
        Poisson quantile.
    """
    radio, traffic, objective = scenario.radio, scenario.traffic, scenario.objective
    num_urllc, num_embb = scenario.users.num_urllc, scenario.users.num_embb
    packet_mbit = traffic.packet_bits * 1e-6
    arrivals, fading = traffic.arrivals, radio.fading
    assert isinstance(arrivals, Poisson)  # the loop knows no others yet
    assert isinstance(fading, Rayleigh)
    belief = arrivals.belief(scenario)
    worst = belief.offered_mbps * belief.packets_per_mbps / arrivals.batch_packets
    if worst.max() > MAX_MEAN:
        user = int(worst.argmax())
        raise ValueError(
            f"user {user}: up to {worst[user]:.6g} batches a slot on average; at most {MAX_MEAN:g} "
            "(lower traffic.load or the offered rate, or raise traffic.packet_bits or "
            "traffic.arrivals.batch_packets)"
        )
    deadline_s = np.repeat([traffic.deadline_s, traffic.embb_deadline_s], [num_urllc, num_embb])
    rules = SchedulerConstants(
        deadline_s=deadline_s,
        late_share=1.0
        - np.repeat([traffic.reliability, traffic.embb_reliability], [num_urllc, num_embb]),
        num_urllc=num_urllc,
        log_rule_offset=scenario.schedulers.log_rule_offset,
        log_rule_gain=scenario.schedulers.log_rule_gain,
        need=need_codes({name: getattr(scenario.schedulers, f"{name}_need") for name in CAPPED}),
        slot_s=radio.slot_s,
    )
    return SlotConstants(
        num_urllc=num_urllc,
        num_prb=radio.num_prb,
        slot_s=radio.slot_s,
        prb_bandwidth_mhz=radio.bandwidth_hz / radio.num_prb * 1e-6,
        fading_scale=np.float32(2.0 * fading.scale**2),
        offered_mbps=belief.offered_mbps,
        rate_sensitivity=belief.rate_sensitivity,
        arrival_packets_per_mbps=belief.packets_per_mbps,
        service_packets_per_mbps=radio.slot_s / packet_mbit,
        service_coefficient_mbps=traffic.service_coefficient_mbps,
        batch_packets=arrivals.batch_packets,
        deadline_slots=_near_integer(deadline_s / radio.slot_s),
        mean_due_packets=belief.mean_due_packets,
        penalty_weight=objective.penalty_weight,
        epsilon=objective.epsilon,
        delay_exponent_per_mbps=objective.delay_exponent * traffic.deadline_s,
        violation_share=1.0 - traffic.reliability,
        measured_constraint=objective.constraint == "measured",
        average_forgetting=1.0 / scenario.schedulers.average_window_slots,
        reward_scale=scenario.learning.reward_scale,
        rules=rules,
        robots=robot_constants(scenario, gains, num_slots, num_urllc),
        is_linear=isinstance(scenario.plant, Linear),
        linear=linear_constants(scenario),
    )


def _near_integer(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round quotients within 1e-9 of an integer: 0.02 s / 0.01 s must be 2 slots."""
    rounded = np.round(values)
    return np.where(np.abs(values - rounded) < 1e-9 * np.maximum(1.0, rounded), rounded, values)


def initial_state(scenario: Scenario, keys: NDArray[np.uint64], num_slots: int) -> SlotState:
    """Empty queues, and robots on their reference, in the worlds `keys` (E,).

    The channel of slot 0 is not drawn yet: `Simulator` does that.
    """
    num_envs, num_users, num_prb = len(keys), scenario.num_users, scenario.radio.num_prb
    radio, (n, m, _) = scenario.radio, scenario.robot_sizes
    num_samples = math.ceil(num_slots * radio.slot_s / scenario.control.sampling_s - 1e-9)
    snr = np.full((num_envs, num_users), snr_per_fading_power(radio.tx_power_dbm, radio.noise_dbm))
    for env, key in enumerate(keys):
        snr[env] *= radio.path_loss.gain(int(key), num_users)
    return SlotState(
        key=np.asarray(keys, dtype=np.uint64).copy(),
        slot=np.zeros(num_envs, np.int64),
        snr=np.repeat(snr, num_prb, axis=1),
        fading_power=np.zeros((num_envs, num_users, num_prb), np.float32),
        prb_rate_mbps=np.zeros((num_envs, num_users, num_prb), np.float32),
        backlog_packets=np.zeros((num_envs, num_users)),
        hol_delay_s=np.zeros((num_envs, num_users)),
        average_rate_mbps=np.zeros((num_envs, num_users)),
        rate_mbps=np.zeros((num_envs, num_users)),
        arrived=np.zeros((num_envs, num_slots + 1, num_users)),
        head=np.zeros((num_envs, num_users), np.int64),
        robots=robot_state(
            num_envs,
            scenario.users.num_urllc,
            scenario.max_delay_steps,
            num_samples,
            scenario.robot.initial_dexterity_index,
            scenario.robot.core_latency_s,
            n,
            m,
        ),
        linear=linear_state(num_envs, scenario.users.num_urllc, num_samples, n, m),
    )


def _user_lanes(constants: SlotConstants) -> NDArray[np.float64]:
    num_users = len(constants.offered_mbps)
    lanes = np.zeros((-(-num_users // LANES), NUM_USER_LANES))
    lanes[:, MEAN_DUE : MEAN_DUE + LANES] = 1.0
    for field, values in (
        (OFFERED, constants.offered_mbps),
        (SENSITIVITY, constants.rate_sensitivity),
        (PACKETS, constants.arrival_packets_per_mbps),
        (MEAN_DUE, constants.mean_due_packets),
    ):
        for user, value in enumerate(values):
            lanes[user // LANES, field + user % LANES] = value
    return lanes


def _queue_lanes(constants: SlotConstants) -> NDArray[np.float64]:
    lanes = np.zeros((-(-len(constants.deadline_slots) // LANES), NUM_QUEUE_LANES))
    for user, deadline_slots in enumerate(constants.deadline_slots):
        set_deadline(lanes[user // LANES], user % LANES, deadline_slots)
    return lanes


def user_terms(constants: SlotConstants) -> UserTerms:
    """Terms of a slot's Lagrangian; backlogs, service offsets and multipliers are still 0."""
    num_users = len(constants.offered_mbps)
    return UserTerms(
        backlog_packets=np.zeros(num_users),
        offered_mbps=constants.offered_mbps,
        rate_sensitivity=constants.rate_sensitivity,
        arrival_packets_per_mbps=constants.arrival_packets_per_mbps,
        service_offset_mbps=np.zeros(num_users),
        service_packets_per_mbps=constants.service_packets_per_mbps,
        penalty_weight=constants.penalty_weight,
        epsilon=constants.epsilon,
        multiplier=np.zeros(num_users),
        delay_exponent_per_mbps=constants.delay_exponent_per_mbps,
        violation_share=constants.violation_share,
    )


def slot_scratch(constants: SlotConstants, robot_sizes: tuple[int, int, int]) -> SlotScratch:
    """Work arrays for one caller of the slot loop; sizes from `Scenario.robot_sizes`."""
    num_users = len(constants.offered_mbps)
    num_prb = constants.num_prb
    blocks = -(-num_users // LANES)
    slot, row = SlotLayout(num_users, constants.num_urllc, num_prb, robot_sizes).slot()
    normal_rows = -(-constants.num_urllc * robot_sizes[2] // 5)
    return SlotScratch(
        words=np.zeros((4, (num_users * num_prb + 3) // 4), np.uint32),
        normals=normal_scratch(normal_rows),
        scheduler=scheduler_scratch(num_users, num_prb),
        users=_user_lanes(constants),
        arrivals=np.zeros((blocks, NUM_ARRIVAL_LANES)),
        queues=_queue_lanes(constants),
        terms=user_terms(constants),
        path=path_scratch(constants.robots.steps_per_slot),
        linear_normals=np.zeros((normal_rows if constants.is_linear else 0, 5), np.float32),
        slot=slot,
        row=row,
    )
