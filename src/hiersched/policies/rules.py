"""The classical schedulers as weights, utilities or orders of the one allocator.

Every rule reads what a base station knows at the start of a slot: backlog, head-of-line delay W,
moving average rate and the channel, never the slot's arrivals. Sources: Kelly 1998 (pf), Jalali et
al. 2000 (pf_average), Tassiulas and Ephremides 1992 (max_weight), Andrews et al. 2001 (m_lwdf),
Rhee et al. 2003 (exp_pf), Sadiq et al. 2009 (log_rule), Neely 2010 (drift_plus_penalty).

MaxWeight, M-LWDF, EXP/PF and LOG maximise the sum of w min(r, need): a user can use no more of a
slot than its queue holds, and without the cap a rule that gives out many PRBs a slot goes on
feeding queues that are empty already (Andrews and Zhang, IEEE/ACM Trans. Networking 19(2), 2011).

EXP/PF gives URLLC users exp((a W - m) / (1 + sqrt m)) / R, m the mean a W of all URLLC users, those
without a packet (W = 0) among them, and eMBB users 1 / R, as LTE-Sim does (Piro et al. 2011).
LTE-Sim takes the mean over the users that have packets and cuts exponents below 0 to 0. Rhee et al.
multiply the eMBB users' weight by an adaptive w(t) / M(t), M the mean number of waiting real-time
packets, and w lowered by a step while a real-time packet waits too long, raised by a fraction of it
otherwise. LOG is LTE-Sim's, ln(1.1 + 5 W / deadline) / R, for the users of both slices; Sadiq et
al. have a factor b instead of 1 / R. docs/paper_notes.md (5a) says how much of this matters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.allocation.in_order import allocate_by_urgency, allocate_in_turn
from hiersched.allocation.marginal import (
    UTILITY_CAPPED,
    UTILITY_LAGRANGIAN,
    UTILITY_LINEAR,
    UTILITY_LOG,
    AllocationScratch,
    allocate_by_utility,
    allocation_scratch,
)
from hiersched.allocation.objective import UserTerms, mean_arrivals
from hiersched.core.compiled import kernel

WEIGHTED_PF = 0
PF_AVERAGE = 1
ROUND_ROBIN = 2
MAX_RATE = 3
MAX_WEIGHT = 4
M_LWDF = 5
EXP_PF = 6
LOG_RULE = 7
EDF = 8
DRIFT_PLUS_PENALTY = 9

CLASSICAL = {
    "pf": WEIGHTED_PF,
    "pf_average": PF_AVERAGE,
    "round_robin": ROUND_ROBIN,
    "max_rate": MAX_RATE,
    "max_weight": MAX_WEIGHT,
    "m_lwdf": M_LWDF,
    "exp_pf": EXP_PF,
    "log_rule": LOG_RULE,
    "edf": EDF,
    "drift_plus_penalty": DRIFT_PLUS_PENALTY,
}
"""Code of every classical scheduler by its name; `pf` is the weighted PF with weights 1."""


NEED_NONE = 0
NEED_BACKLOG = 1
NEED_BACKLOG_AND_ARRIVALS = 2

NEEDS = {
    "none": NEED_NONE,
    "backlog": NEED_BACKLOG,
    "backlog_and_arrivals": NEED_BACKLOG_AND_ARRIVALS,
}
"""Code of what caps the rates of the rules `CAPPED`, by its name in a scenario."""

CAPPED = ("max_weight", "m_lwdf", "exp_pf", "log_rule")
"""Rules that maximise a sum of weighted rates of which a user can use only so much."""

# Utility by need and scheduler.
_UTILITY_OF = np.full((len(NEEDS), len(CLASSICAL)), UTILITY_LINEAR)
_UTILITY_OF[:, WEIGHTED_PF] = UTILITY_LOG
_UTILITY_OF[:, DRIFT_PLUS_PENALTY] = UTILITY_LAGRANGIAN
_UTILITY_OF[NEED_BACKLOG:, [CLASSICAL[name] for name in CAPPED]] = UTILITY_CAPPED


class SchedulerConstants(NamedTuple):
    """What the rules know of users and slots.

    Deadline in s and admitted late share of each user (U,), the log rule's c and a D, one of
    `NEEDS` for each code in `CLASSICAL`, and the length of a slot in s.
    """

    deadline_s: NDArray[np.float64]
    late_share: NDArray[np.float64]
    num_urllc: int
    log_rule_offset: float
    log_rule_gain: float
    need: NDArray[np.int64]
    slot_s: float


class SchedulerScratch(NamedTuple):
    """Work arrays of one scheduled slot."""

    weight: NDArray[np.float64]  # (U,)
    expected_packets: NDArray[np.float64]  # (U,)
    wait_s: NDArray[np.float64]  # (U,)
    allocation: AllocationScratch


def scheduler_scratch(num_users: int, num_prb: int) -> SchedulerScratch:
    """Work arrays for `num_users` users and `num_prb` PRBs; errors as `allocation_scratch`."""
    return SchedulerScratch(
        weight=np.zeros(num_users),
        expected_packets=np.zeros(num_users),
        wait_s=np.zeros(num_users),
        allocation=allocation_scratch(num_users, num_prb),
    )


@kernel()
def index_weights(
    scheduler: int,
    backlog_packets: NDArray[np.float64],
    hol_delay_s: NDArray[np.float64],
    average_rate_mbps: NDArray[np.float64],
    constants: SchedulerConstants,
    weight: NDArray[np.float64],
) -> None:
    """Weights w of the rules that maximise the sum of w r, in place, shape (U,)."""
    num_users = weight.shape[0]
    if scheduler == EXP_PF:
        _exp_pf_weights(hol_delay_s, average_rate_mbps, constants, weight)
        return
    for user in range(num_users):
        average = average_rate_mbps[user]
        wait = hol_delay_s[user]
        deadline = constants.deadline_s[user]
        if scheduler == MAX_RATE:
            weight[user] = 1.0
        elif scheduler == PF_AVERAGE:
            weight[user] = 1.0 / average
        elif scheduler == MAX_WEIGHT:
            weight[user] = backlog_packets[user]
        elif scheduler == M_LWDF:
            weight[user] = -math.log10(constants.late_share[user]) / deadline * wait / average
        else:
            weight[user] = (
                math.log(constants.log_rule_offset + constants.log_rule_gain * wait / deadline)
                / average
            )


@kernel()
def _exp_pf_weights(
    hol_delay_s: NDArray[np.float64],
    average_rate_mbps: NDArray[np.float64],
    constants: SchedulerConstants,
    weight: NDArray[np.float64],
) -> None:
    """EXP/PF: exp((a W - m) / (1 + sqrt m)) / R for URLLC, m the mean a W; 1 / R for eMBB."""
    num_urllc = constants.num_urllc
    mean = 0.0
    for user in range(num_urllc):
        a = -math.log10(constants.late_share[user]) / constants.deadline_s[user]
        weight[user] = a * hol_delay_s[user]
        mean += weight[user] / num_urllc
    largest = 0.0
    for user in range(num_urllc):
        weight[user] = (weight[user] - mean) / (1.0 + math.sqrt(mean))
        largest = max(largest, weight[user])
    # The rule does not change when all weights are scaled: the largest exponent is taken out, so
    # none overflows.
    for user in range(weight.shape[0]):
        exponent = weight[user] if user < num_urllc else 0.0
        weight[user] = math.exp(exponent - largest) / average_rate_mbps[user]


def need_codes(by_rule: Mapping[str, str]) -> NDArray[np.int64]:
    """Codes of `NEEDS` by scheduler, from names of needs by names of rules; none for others."""
    codes = np.full(len(CLASSICAL), NEED_NONE)
    for name, need in by_rule.items():
        codes[CLASSICAL[name]] = NEEDS[need]
    return codes


@kernel()
def needs(
    terms: UserTerms, expected_packets: NDArray[np.float64], need_mbps: NDArray[np.float64]
) -> None:
    """Rate that serves the expected packets in this slot, 0 for none, in place, shape (U,)."""
    for user in range(need_mbps.shape[0]):
        packets = expected_packets[user]
        need_mbps[user] = packets / terms.service_packets_per_mbps
        if packets > 0.0:
            need_mbps[user] += terms.service_offset_mbps[user]


@kernel()
def _expect(
    terms: UserTerms, last_rate_mbps: NDArray[np.float64], expected_packets: NDArray[np.float64]
) -> None:
    """Backlog and mean arrivals at the last slot's rate, in place, shape (U,)."""
    for user in range(expected_packets.shape[0]):
        expected_packets[user] = terms.backlog_packets[user] + mean_arrivals(
            last_rate_mbps[user],
            terms.offered_mbps[user],
            terms.rate_sensitivity[user],
            terms.arrival_packets_per_mbps[user],
        )


@kernel(forceinline=True)
def schedule_slot(
    scheduler: int,
    slot: int,
    rate: NDArray[np.float32],
    given_weight: NDArray[np.float64],
    hol_delay_s: NDArray[np.float64],
    average_rate_mbps: NDArray[np.float64],
    last_rate_mbps: NDArray[np.float64],
    terms: UserTerms,
    constants: SchedulerConstants,
    scratch: SchedulerScratch,
    owner: NDArray[np.uint32],
) -> None:
    """Allocate one slot by one scheduler.

    Parameters
    ----------
    scheduler
        One of the codes in `CLASSICAL`.
    slot
        Index of the slot (round robin only).
    rate
        Rate of each user on each PRB, shape (U, K), Mbit/s.
    given_weight
        Factors of the users' utilities, shape (U,), 1 for the plain rule; not for round robin and
        EDF, which have no utility.
    hol_delay_s, average_rate_mbps, last_rate_mbps
        Shape (U,); the last is that of the slot before.
    terms, constants
        Lagrangian and rule constants; `terms.backlog_packets` is the backlog.
    scratch
        From `scheduler_scratch`.
    owner
        Result: user of each PRB, shape (K,).
    """
    weight, allocation = scratch.weight, scratch.allocation
    if scheduler == ROUND_ROBIN:
        allocate_in_turn(slot, rate.shape[0], rate.shape[1], owner)
    elif scheduler == EDF:
        for user in range(rate.shape[0]):
            weight[user] = hol_delay_s[user] - constants.deadline_s[user]
        needs(terms, terms.backlog_packets, allocation.need)
        allocate_by_urgency(rate, weight, allocation, owner)
    else:
        if scheduler == WEIGHTED_PF or scheduler == DRIFT_PLUS_PENALTY:
            for user in range(rate.shape[0]):
                weight[user] = given_weight[user]
        else:
            _index_rule(
                scheduler, hol_delay_s, average_rate_mbps, last_rate_mbps, terms, constants, scratch
            )
            for user in range(rate.shape[0]):
                weight[user] *= given_weight[user]
        # Looked up, not branched on: the compiler would otherwise build the allocator once for each
        # constant.
        utility = _UTILITY_OF[constants.need[scheduler], scheduler]
        allocate_by_utility(utility, rate, weight, terms, allocation, owner)


@kernel()
def _index_rule(
    scheduler: int,
    hol_delay_s: NDArray[np.float64],
    average_rate_mbps: NDArray[np.float64],
    last_rate_mbps: NDArray[np.float64],
    terms: UserTerms,
    constants: SchedulerConstants,
    scratch: SchedulerScratch,
) -> None:
    """Weights of a rule that maximises a sum of weighted rates, and the needs that cap them.

    With mean arrivals in the need, the rule weighs what a queue will hold and how old its first
    packet will be by the end of the slot.
    """
    expected, wait = scratch.expected_packets, scratch.wait_s
    for user in range(expected.shape[0]):
        expected[user] = terms.backlog_packets[user]
        wait[user] = hol_delay_s[user]
    if constants.need[scheduler] == NEED_BACKLOG_AND_ARRIVALS:
        _expect(terms, last_rate_mbps, expected)
        for user in range(expected.shape[0]):
            wait[user] += constants.slot_s
    needs(terms, expected, scratch.allocation.need)
    index_weights(scheduler, expected, wait, average_rate_mbps, constants, scratch.weight)
