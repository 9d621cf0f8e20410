"""What a run of the study of the task comes to: errors, ages, packets on time, eMBB throughput."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.experiments.logged import RunSlots
from hiersched.scenario import Scenario
from hiersched.study.metrics import OFF_TRACK_CM

TASK_MEASURES = (
    "tracking_rms_cm",
    "tracking_p99_cm",
    "off_track_slots_share",
    "set_point_age_s",
    "set_point_age_p99_s",
    "urllc_late_share",
    "urllc_on_time_share",
    "superseded_share",
    "embb_mbps",
    "embb_late_share",
    "urllc_mbps",
    "horizon_s",
)
"""Columns of `task_row` that are measures."""

TASK_FIELDS = (
    "tracking_error_m",
    "set_point_age_s",
    "backlog_packets",
    "arrivals_packets",
    "superseded_packets",
    "service_packets",
    "due_packets",
    "late_packets",
)


def task_row(run: RunSlots, scenario: Scenario) -> dict[str, Any]:
    """Measure a run behind its warm-up: labels of the run, then `TASK_MEASURES`.

    Errors are root mean squares of a slot and robot: ``tracking_rms_cm`` over all of them,
    ``tracking_p99_cm`` their 99 % quantile, ``off_track_slots_share`` the share above 10 cm. Ages
    are those of the held set-points at the ends of slots; NaN where robots know their references.
    ``urllc_late_share`` is of the packets that fell due; a superseded one never does, so that the
    share of what was offered and came in time stands beside it, and the share superseded.
    Throughput is what left the queues of a slice [Mbit/s]. ``horizon_s`` is the time measured:
    above capacity queues grow, and all numbers with it.
    """
    fields = {name: run.measured(name) for name in TASK_FIELDS}
    error_cm = 100.0 * fields["tracking_error_m"]
    age_s = fields["set_point_age_s"] if scenario.tracks_age else np.full((1, 1), np.nan)
    urllc, embb = slice(0, run.num_urllc), slice(run.num_urllc, None)
    total = {
        name: values.sum(axis=0, dtype=np.float64)
        for name, values in {**fields, "served_packets": served_packets(fields)}.items()
        if name.endswith("_packets")
    }
    num_slots = len(error_cm)
    mbps = scenario.traffic.packet_bits * 1e-6 / (num_slots * run.slot_s)
    offered, due, late = (
        float(total[f"{name}_packets"][urllc].sum()) for name in ("arrivals", "due", "late")
    )
    embb_due = float(total["due_packets"][embb].sum())
    policy_seed = run.metadata.get("policy_seed")
    return {
        "policy": run.metadata["policy"],
        "policy_seed": None if policy_seed is None else int(policy_seed),
        "seed": int(run.metadata["seed"]),
        "tracking_rms_cm": math.sqrt(float(np.mean(error_cm**2))),
        "tracking_p99_cm": _p99(error_cm),
        "off_track_slots_share": float(np.mean(error_cm > OFF_TRACK_CM)),
        "set_point_age_s": float(age_s.mean()),
        "set_point_age_p99_s": _p99(age_s),
        "urllc_late_share": _share(late, due),
        "urllc_on_time_share": _share(due - late, offered),
        "superseded_share": _share(float(total["superseded_packets"][urllc].sum()), offered),
        "embb_mbps": mbps * float(total["served_packets"][embb].sum()),
        "embb_late_share": _share(float(total["late_packets"][embb].sum()), embb_due),
        "urllc_mbps": mbps * float(total["served_packets"][urllc].sum()),
        "horizon_s": num_slots * run.slot_s,
    }


def served_packets(fields: dict[str, NDArray[Any]]) -> NDArray[np.float64]:
    """Return what left the queues in each slot [packets], shape (T, U).

    Of what waits and arrives, superseded packets leave without service.
    """
    load = fields["backlog_packets"] + fields["arrivals_packets"] - fields["superseded_packets"]
    served: NDArray[np.float64] = np.minimum(fields["service_packets"], load)
    return served


def _p99(values: NDArray[np.float64]) -> float:
    return float(np.quantile(values, 0.99, method="inverted_cdf"))


def _share(part: float, whole: float) -> float:
    return part / whole if whole > 0.0 else math.nan
