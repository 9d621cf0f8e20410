"""What a user can use of a slot, for rules that are capped there."""

from __future__ import annotations

from typing import Any

from numba import njit

from hiersched.allocation.objective import mean_arrivals

NEEDS = {"none": 0, "backlog": 1, "backlog_and_arrivals": 2}
"""Code of what caps a rule's rates, by its name in a scenario."""
_WITH_ARRIVALS = NEEDS["backlog_and_arrivals"]


@njit(inline="always")
def expected_packets(constants: Any, state: Any, env: int, user: int, need: int) -> float:
    """Backlog; with mean arrivals in the need, what the queue will hold by the end of the slot."""
    packets = state.backlog_packets[env, user]
    if need == _WITH_ARRIVALS:
        packets += mean_arrivals(
            state.rate_mbps[env, user],
            constants.offered_mbps[user],
            constants.rate_sensitivity[user],
            constants.arrival_packets_per_mbps[user],
        )
    return float(packets)


@njit(inline="always")
def expected_wait_s(constants: Any, state: Any, env: int, user: int, need: int) -> float:
    """Head-of-line delay; with mean arrivals in the need, that by the end of the slot."""
    wait = state.hol_delay_s[env, user]
    return float(wait + constants.slot_s if need == _WITH_ARRIVALS else wait)


@njit(inline="always")
def need_mbps(constants: Any, state: Any, env: int, user: int, packets: float) -> float:
    """Rate that serves so many packets in this slot, 0 for none."""
    need = packets / constants.service_packets_per_mbps
    if packets > 0.0 and user < constants.num_urllc:
        need += constants.service_coefficient_mbps * state.dexterity_index[env, user]
    return float(need)


@njit(inline="always")
def order_by_deadline(constants: Any, state: Any, env: int, user: int, deadline_s: float) -> None:
    """Give a user EDF's urgency W - D and the rate that empties its queue."""
    packets = state.backlog_packets[env, user]
    state.need_mbps[env, user] = need_mbps(constants, state, env, user, packets)
    state.index_weight[env, user] = state.hol_delay_s[env, user] - deadline_s
