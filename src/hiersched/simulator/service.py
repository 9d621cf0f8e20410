"""What an allocation does in a slot: service, averages, the parts of the Lagrangian, rewards."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from hiersched.allocation.objective import delay_surrogate, offered_service, rate_penalty
from hiersched.core.compiled import inner_kernel
from hiersched.core.seam import call_plug


@inner_kernel(forceinline=True)
def serve(plugs: Any, constants: Any, state: Any, scratch: Any, slot: Any, env: int) -> None:
    """Serve a world's slot by the owners that stand in `slot`, which is filled."""
    call_plug(plugs.deliver, constants, state, slot, env)
    call_plug(plugs.arrivals, constants, state, slot, env)
    per_mbps = constants.service_packets_per_mbps
    for user in range(slot.rate_mbps.shape[0]):
        offset = scratch.terms.service_offset_mbps[user]
        slot.service_packets[user] = offered_service(slot.rate_mbps[user], offset, per_mbps)
    call_plug(plugs.queue, constants, state, slot, env)
    forgetting = constants.average_forgetting
    for user in range(slot.rate_mbps.shape[0]):
        rate, average = slot.rate_mbps[user], state.average_rate_mbps[env, user]
        state.rate_mbps[env, user] = rate
        state.average_rate_mbps[env, user] = average + forgetting * (rate - average)
    _weigh(constants, state, slot, env)


@njit(inline="always")
def _surplus(constants: Any, slot: Any, user: int) -> float:
    """Constraint y of a URLLC user, negative where it is violated."""
    if constants.measured_constraint:
        due, late = np.float64(slot.due_packets[user]), np.float64(slot.late_packets[user])
        excess = constants.violation_share * due - late
        return float(excess / constants.mean_due_packets[user])
    return float(
        delay_surrogate(
            slot.rate_mbps[user], constants.delay_exponent_per_mbps, constants.violation_share
        )
    )


@inner_kernel(forceinline=True)
def _weigh(constants: Any, state: Any, slot: Any, env: int) -> None:
    """Drift, penalty and constraint summed over the users of each slice; the rewards."""
    num_urllc, num_users = constants.num_urllc, slot.rate_mbps.shape[0]
    drift_urllc = drift_embb = penalty_urllc = penalty_embb = priced = 0.0
    for user in range(num_users):
        before, after = slot.backlog_packets[user], state.backlog_packets[env, user]
        drift = 0.5 * (after * after - before * before)
        penalty = rate_penalty(slot.rate_mbps[user], constants.epsilon)
        if user < num_urllc:
            drift_urllc += drift
            penalty_urllc += penalty
            surplus = _surplus(constants, slot, user)
            priced += state.multiplier[env, user] * surplus
            slot.constraint[user] = surplus
            slot.network_delay_s[user] = slot.delay_s[user] + constants.loop.core_latency_s
        else:
            drift_embb += drift
            penalty_embb += penalty
    slot.drift_urllc[()] = drift_urllc
    slot.drift_embb[()] = drift_embb
    slot.penalty_urllc[()] = penalty_urllc
    slot.penalty_embb[()] = penalty_embb
    weight, scale = constants.penalty_weight, constants.reward_scale
    slot.reward_urllc[()] = -(drift_urllc + weight * penalty_urllc - priced) / (num_urllc * scale)
    slot.reward_embb[()] = -(drift_embb + weight * penalty_embb) / ((num_users - num_urllc) * scale)
