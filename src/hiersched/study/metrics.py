"""What a run comes to: one record of measures, from its log or from its slots in memory."""

from __future__ import annotations

import math
import os
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.experiments.logged import RunSlots, read_slots
from hiersched.log import LogError
from hiersched.scenario import Scenario
from hiersched.study.fifo import (
    FloatArray,
    backlog_path,
    deadline_in_slots,
    late_packets,
    sojourn_slots,
)

DELAY_QUANTILES = {"p50": 0.5, "p95": 0.95, "p99": 0.99, "p999": 0.999}
OFF_TRACK_CM = 10.0
"""A window with a larger tracking error is off track: the dexterity index gives it no point."""


@dataclass(frozen=True, kw_only=True)
class RunMetrics:
    """Measures of one run after its warm-up; NaN where it is too short or has no such user.

    Packets that still wait at the end have no delay, so at overload the late share is the fairer
    measure. A text below is about all columns since the text before.
    """

    policy: str
    policy_seed: int | None
    """Name of the policy, and the training seed of a learned one."""
    seed: int
    """That of the world."""
    stage: str
    axis: str
    value: str
    """Stage of the experiment, what it varies, and name of the point."""
    num_slots: int
    """Slots that are measured."""
    urllc_due_packets: int
    embb_due_packets: int
    """Packets whose deadline fell behind the warm-up."""
    urllc_late_share: float
    embb_late_share: float
    """Share of these that were late."""
    late_share_by_user: tuple[float, ...]
    """The same of each user, in columns `late_share_user_0` and so on."""
    urllc_users_violating: tuple[float, ...]
    """Share of URLLC users whose late share exceeds 1 - chi, for each reliability level: columns
    `urllc_users_violating_0.95` and so on."""
    urllc_rate_mbps: float
    embb_rate_mbps: float
    """Mean rate of a user."""
    urllc_backlog_packets: float
    embb_backlog_packets: float
    """Mean backlog of a user."""
    urllc_delay_p50_s: float
    urllc_delay_p95_s: float
    urllc_delay_p99_s: float
    urllc_delay_p999_s: float
    embb_delay_p50_s: float
    embb_delay_p95_s: float
    embb_delay_p99_s: float
    embb_delay_p999_s: float
    """Quantiles of the delay of delivered packets that arrived behind the warm-up."""
    tracking_error_cm: float
    """Root mean square of a window, mean over robots and windows."""
    off_track_share: float
    """Share of robots and windows in which that is above `OFF_TRACK_CM`, 10 cm."""
    dexterity_index: float
    """Mean over robots and windows."""
    delay_steps: float
    """Mean delay in force, in control samples."""
    delay_capped_share: float
    """Share of slots in which that is beyond the longest that a gain is designed for."""
    arrival_clamped_share: float
    """Share of slots of URLLC users whose mean arrivals were cut to 0."""
    control_saturations_per_s: float
    """Commands at their limit, of a robot."""
    mean_square_backlog: float
    """Mean over slots of half the sum of F^2 over the users of both slices [packets^2]."""
    penalty_cost: float
    """Mean over slots of V h of both slices [packets^2]."""


MEASURED = (
    "backlog_packets",
    "arrivals_packets",
    "service_packets",
    "rate_mbps",
    "due_packets",
    "late_packets",
    "arrival_clamped",
    "penalty_urllc",
    "penalty_embb",
    "delay_steps",
    "delay_capped",
    "control_saturated",
    "tracking_error_m",
    "dexterity_index",
)


def run_metrics(path: str | os.PathLike[str], scenario: Scenario) -> RunMetrics:
    """Measure one run from its log.

    LogError if the log is damaged, or its backlogs or late packets are not those that follow from
    its arrivals and service.
    """
    return slot_metrics(read_slots(path, MEASURED), scenario)


def slot_metrics(
    run: RunSlots, scenario: Scenario, sojourn_s: list[FloatArray] | None = None
) -> RunMetrics:
    """Measure one run from its slots, see `run_metrics`; `sojourn_s`: from `checked_sojourns`."""
    metadata, policy_seed = run.metadata, run.metadata.get("policy_seed")
    if sojourn_s is None:
        sojourn_s = checked_sojourns(run, scenario)
    fields = {name: run.measured(name) for name in MEASURED}
    due, late = fields["due_packets"], fields["late_packets"]
    late_by_user, due_by_user = (counted.sum(axis=0, dtype=np.int64) for counted in (late, due))
    unknown = np.full(len(due_by_user), np.nan)
    shares = np.divide(late_by_user, due_by_user, out=unknown, where=due_by_user > 0)
    urllc = slice(0, run.num_urllc)
    measures: dict[str, Any] = _robot_measures(run, scenario)
    measures |= {name: metadata.get(name, "") for name in ("stage", "axis", "value")}
    for name, own in (("urllc", urllc), ("embb", slice(run.num_urllc, None))):
        packets = int(due[:, own].sum(dtype=np.int64))
        lost = int(late[:, own].sum(dtype=np.int64))
        measures |= {
            f"{name}_due_packets": packets,
            f"{name}_late_share": lost / packets if packets else math.nan,
            f"{name}_rate_mbps": _mean(fields["rate_mbps"][:, own]),
            f"{name}_backlog_packets": _mean(fields["backlog_packets"][:, own]),
            **_delay_quantiles(name, sojourn_s[own]),
        }
    return RunMetrics(
        policy=metadata["policy"],
        policy_seed=None if policy_seed is None else int(policy_seed),
        seed=int(metadata["seed"]),
        num_slots=len(due),
        **measures,
        late_share_by_user=tuple(shares.tolist()),
        urllc_users_violating=tuple(
            # Rounded: 1 late packet in 10 is not more than 1 - 0.9 = 0.0999…
            _mean(shares[urllc] > round(1.0 - level, 12))
            for level in scenario.traffic.reliability_levels
        ),
        arrival_clamped_share=_mean(fields["arrival_clamped"][:, urllc]),
        mean_square_backlog=_mean(0.5 * (fields["backlog_packets"] ** 2).sum(axis=1)),
        # Without the priced constraint: multipliers differ between policies, so with it a policy
        # would be credited with its own.
        penalty_cost=scenario.objective.penalty_weight
        * _mean(fields["penalty_urllc"] + fields["penalty_embb"]),
    )


def violation_column(level: float) -> str:
    """Return the column with the share of URLLC users that miss a reliability level."""
    return f"urllc_users_violating_{level:g}"


def metrics_row(metrics: RunMetrics, scenario: Scenario) -> dict[str, Any]:
    """Return measures as a row of a table, one number a column."""
    row = asdict(metrics)
    by_user, violating = row.pop("late_share_by_user"), row.pop("urllc_users_violating")
    levels = scenario.traffic.reliability_levels
    row |= {violation_column(level): x for level, x in zip(levels, violating, strict=True)}
    return row | {f"late_share_user_{user}": share for user, share in enumerate(by_user)}


def measured_row(run: RunSlots, scenario: Scenario) -> dict[str, Any]:
    """Measure a run that has no log: the row that its log would give."""
    return metrics_row(slot_metrics(run, scenario), scenario)


def tracking_error_by_window_cm(tracking_error_m: FloatArray, slots_per_window: int) -> FloatArray:
    """Return the root mean square tracking error of whole windows [cm], by robot.

    From that over each slot [m], shape (T, R), to shape (T // slots_per_window, R).
    """
    windows = len(tracking_error_m) // slots_per_window
    square = tracking_error_m[: windows * slots_per_window] ** 2
    blocks = square.reshape(windows, slots_per_window, tracking_error_m.shape[1])
    result: FloatArray = 100.0 * np.sqrt(blocks.mean(axis=1))
    return result


def slots_per_window(scenario: Scenario) -> int:
    """Return the number of slots in a window of the dexterity index."""
    return round(scenario.robot.window_s / scenario.radio.slot_s)


def checked_sojourns(run: RunSlots, scenario: Scenario) -> list[FloatArray]:
    """Return the sojourn times [s] of delivered packets that arrived behind the warm-up, by user.

    LogError if the run's backlogs or late packets do not follow from its arrivals and service.
    """
    arrivals, service = run.fields["arrivals_packets"], run.fields["service_packets"]
    backlog = backlog_path(arrivals, service)
    if not np.array_equal(backlog[:-1], run.fields["backlog_packets"]):
        raise LogError(run.source, 0, "its backlogs do not follow from its arrivals and service")
    result = []
    for user in range(arrivals.shape[1]):
        traffic = scenario.traffic
        deadline_s = traffic.deadline_s if user < run.num_urllc else traffic.embb_deadline_s
        own = arrivals[:, user], service[:, user], backlog[:, user]
        due, late = late_packets(*own, deadline_in_slots(deadline_s, run.slot_s))
        for name, counted in (("due_packets", due), ("late_packets", late)):
            logged = run.fields[name][:, user]
            if not np.array_equal(counted, logged):
                slot = int(np.flatnonzero(counted != logged)[0])
                said = (
                    f"{name} of user {user} in slot {slot} is {logged[slot]}, but its arrivals "
                    f"and service give {counted[slot]} at a deadline of {deadline_s:g} s"
                )
                raise LogError(run.source, 0, said)
        before = int(arrivals[: run.warmup_slots, user].sum(dtype=np.int64))
        result.append(sojourn_slots(*own)[before:] * run.slot_s)
    return result


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if values.size else math.nan


def _delay_quantiles(slice_name: str, sojourn_s: list[FloatArray]) -> dict[str, float]:
    """Return quantiles over the delivered packets of a slice; each is the delay of a packet."""
    pooled = np.concatenate(sojourn_s) if sojourn_s else np.empty(0)
    values = np.full(len(DELAY_QUANTILES), np.nan)
    if pooled.size:
        values = np.quantile(pooled, list(DELAY_QUANTILES.values()), method="inverted_cdf")
    names = (f"{slice_name}_delay_{name}_s" for name in DELAY_QUANTILES)
    return dict(zip(names, values.tolist(), strict=True))


def _robot_measures(run: RunSlots, scenario: Scenario) -> dict[str, Any]:
    window = slots_per_window(scenario)
    fields, warmup = run.fields, run.warmup_slots
    whole = tracking_error_by_window_cm(fields["tracking_error_m"], window)
    error_cm = whole[-(-warmup // window) :]  # windows that begin behind the warm-up
    # A window's index is in force from the first slot behind it; that of the last is not logged.
    finished = fields["dexterity_index"][window::window][-(-warmup // window) :]
    saturated = fields["control_saturated"][warmup:]
    robot_s = saturated.size * run.slot_s
    return {
        "tracking_error_cm": _mean(error_cm),
        "off_track_share": _mean(error_cm > OFF_TRACK_CM),
        "dexterity_index": _mean(finished),
        "delay_steps": _mean(fields["delay_steps"][warmup:]),
        "delay_capped_share": _mean(fields["delay_capped"][warmup:]),
        "control_saturations_per_s": (
            float(saturated.sum(dtype=np.int64)) / robot_s if robot_s else math.nan
        ),
    }
