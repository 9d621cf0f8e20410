"""The seams of a decision: what a policy computes from what a base station may know.

Kernels are `kernel(me, constants, state, slot, env)`. They read `state` at the start of the slot
(reported rates, backlog, waits, averages, the robots' dexterity and task) and never the slot's
arrivals.
"""

from __future__ import annotations

from hiersched.allocation import ALLOCATE
from hiersched.core.seam import Seam

__all__ = ["ALLOCATE", "INDEX", "WEIGH"]

INDEX = Seam(
    "index of a rule",
    reads="state.reported_rate_mbps, backlog_packets, hol_delay_s, average_rate_mbps, rate_mbps "
    "(of the last slot), dexterity_index and what is known of the task (set_point_age_s, "
    "set_point_speed_mps, waiting_speed_mps, set_point_acceleration_mps2, set_point_gap_m, "
    "reported_error_m), of world env",
    writes="state.index_weight[env] (U,): weights of the utilities, or urgencies; "
    "state.need_mbps[env] (U,) where the rule is capped or goes by urgency; "
    "state.drift_weight[env] (U,), 1 unless written, where it is Lagrangian",
)
WEIGH = Seam(
    "weights of a policy",
    reads="as the index; state.multiplier[env] (R,)",
    writes="state.weight[env] (U,): factors of the base rule's utilities",
)
