"""The classical schedulers as weights, utilities or orders of the one allocator.

Every rule reads what a base station knows at the start of a slot: backlog, head-of-line delay W,
moving average rate and the channel, never the slot's arrivals. Sources: Kelly 1998 (pf), Jalali et
al. 2000 (pf_average), Tassiulas and Ephremides 1992 (max_weight), Andrews et al. 2001 (m_lwdf),
Rhee et al. 2003 (exp_pf), Sadiq et al. 2009 (log_rule), Neely 2010 (drift_plus_penalty).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.compiled import kernel
from hiersched.network.allocation import (
    UTILITY_LAGRANGIAN,
    UTILITY_LINEAR,
    UTILITY_LOG,
    AllocationScratch,
    allocate_by_utility,
)
from hiersched.network.in_order import allocate_by_urgency, allocate_in_turn
from hiersched.network.lyapunov import UserTerms

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


_UTILITY_OF = np.full(len(CLASSICAL), UTILITY_LINEAR)
_UTILITY_OF[WEIGHTED_PF] = UTILITY_LOG
_UTILITY_OF[DRIFT_PLUS_PENALTY] = UTILITY_LAGRANGIAN


class SchedulerConstants(NamedTuple):
    """Deadline in s and admitted late share of each user (U,), and the log rule's c and a D."""

    deadline_s: NDArray[np.float64]
    late_share: NDArray[np.float64]
    num_urllc: int
    log_rule_offset: float
    log_rule_gain: float


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


@kernel(forceinline=True)
def schedule_slot(
    scheduler: int,
    slot: int,
    rate: NDArray[np.float32],
    given_weight: NDArray[np.float64],
    hol_delay_s: NDArray[np.float64],
    average_rate_mbps: NDArray[np.float64],
    terms: UserTerms,
    constants: SchedulerConstants,
    weight: NDArray[np.float64],
    scratch: AllocationScratch,
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
    hol_delay_s, average_rate_mbps
        Shape (U,).
    terms, constants
        Lagrangian and rule constants; `terms.backlog_packets` is the backlog.
    weight
        Scratch, shape (U,).
    scratch
        From `allocation_scratch`.
    owner
        Result: user of each PRB, shape (K,).
    """
    if scheduler == ROUND_ROBIN:
        allocate_in_turn(slot, rate.shape[0], rate.shape[1], owner)
    elif scheduler == EDF:
        need = scratch.assignment.row_price
        for user in range(rate.shape[0]):
            weight[user] = hol_delay_s[user] - constants.deadline_s[user]
            backlog = terms.backlog_packets[user]
            need[user] = backlog / terms.service_packets_per_mbps
            if backlog > 0.0:
                need[user] += terms.service_offset_mbps[user]
        allocate_by_urgency(rate, weight, need, scratch, owner)
    else:
        if scheduler == WEIGHTED_PF or scheduler == DRIFT_PLUS_PENALTY:
            for user in range(rate.shape[0]):
                weight[user] = given_weight[user]
        else:
            index_weights(
                scheduler, terms.backlog_packets, hol_delay_s, average_rate_mbps, constants, weight
            )
            for user in range(rate.shape[0]):
                weight[user] *= given_weight[user]
        # Looked up, not branched on: the compiler would otherwise build the allocator once for each
        # constant.
        allocate_by_utility(_UTILITY_OF[scheduler], rate, weight, terms, scratch, owner)
