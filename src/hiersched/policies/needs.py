"""What a user can use of a slot, for rules that are capped there."""

from __future__ import annotations

from typing import Any

from numba import njit

from hiersched.allocation.objective import mean_arrivals

NEED_NONE = 0
NEED_BACKLOG = 1
NEED_BACKLOG_AND_ARRIVALS = 2

NEEDS = {
    "none": NEED_NONE,
    "backlog": NEED_BACKLOG,
    "backlog_and_arrivals": NEED_BACKLOG_AND_ARRIVALS,
}
"""Code of what caps a rule's rates, by its name in a scenario."""


@njit(inline="always")
def expected_packets(constants: Any, state: Any, env: int, user: int, need: int) -> float:
    """Backlog; with mean arrivals in the need, what the queue will hold by the end of the slot."""
    packets = state.backlog_packets[env, user]
    if need == NEED_BACKLOG_AND_ARRIVALS:
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
    if need == NEED_BACKLOG_AND_ARRIVALS:
        wait += constants.slot_s
    return float(wait)


@njit(inline="always")
def need_mbps(constants: Any, state: Any, env: int, user: int, packets: float) -> float:
    """Rate that serves so many packets in this slot, 0 for none."""
    need = packets / constants.service_packets_per_mbps
    if packets > 0.0 and user < constants.num_urllc:
        need += constants.service_coefficient_mbps * state.dexterity_index[env, user]
    return float(need)
