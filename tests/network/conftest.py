from __future__ import annotations

import numpy as np
import pytest

from hiersched.network.lyapunov import UserTerms
from hiersched.network.schedulers import (
    CLASSICAL,
    NEEDS,
    SchedulerConstants,
    schedule_slot,
    scheduler_scratch,
)


def per_user(value, num_users):
    return np.broadcast_to(np.asarray(value, np.float64), (num_users,)).copy()


@pytest.fixture(scope="session")
def make_terms():
    """Terms of the Lagrangian for U users; no arrivals, no multiplier unless given."""

    def make(num_users, **given):
        arrays = {
            "backlog_packets": 0.0,
            "offered_mbps": 0.0,
            "rate_sensitivity": 0.0,
            "arrival_packets_per_mbps": 1.0,
            "service_offset_mbps": 0.0,
            "multiplier": 0.0,
        }
        scalars = {
            "service_packets_per_mbps": 1.0,
            "penalty_weight": 0.0,
            "epsilon": 0.01,
            "delay_exponent_per_mbps": 0.16,
            "violation_share": 0.05,
        }
        assert given.keys() <= arrays.keys() | scalars.keys()
        filled = {name: per_user(given.get(name, arrays[name]), num_users) for name in arrays}
        return UserTerms(**filled, **{name: given.get(name, scalars[name]) for name in scalars})

    return make


@pytest.fixture(scope="session")
def schedule(make_terms):
    """Run one scheduler for one slot; returns the owner of each PRB as a list."""

    def run(
        name,
        rate,
        *,
        slot=0,
        weight=1.0,
        hol_delay_s=0.0,
        average_rate_mbps=10.0,
        last_rate_mbps=0.0,
        deadline_s=0.02,
        late_share=0.05,
        num_urllc=None,
        need="none",
        **terms,
    ):
        rate = np.ascontiguousarray(rate, np.float32)
        num_users, num_prb = rate.shape
        rules = SchedulerConstants(
            deadline_s=per_user(deadline_s, num_users),
            late_share=per_user(late_share, num_users),
            num_urllc=num_users if num_urllc is None else num_urllc,
            log_rule_offset=1.1,
            log_rule_gain=5.0,
            need=np.full(len(CLASSICAL), NEEDS[need]),
            slot_s=0.01,
        )
        owner = np.full(num_prb, 10**6, np.uint32)
        schedule_slot(
            CLASSICAL[name],
            slot,
            rate,
            per_user(weight, num_users),
            per_user(hol_delay_s, num_users),
            per_user(average_rate_mbps, num_users),
            per_user(last_rate_mbps, num_users),
            make_terms(num_users, **terms),
            rules,
            scheduler_scratch(num_users, num_prb),
            owner,
        )
        return owner.tolist()

    return run
