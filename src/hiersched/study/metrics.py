"""What a log says about its run: one record of measures a log."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.log import LogError, LogReader
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
    """Measures of one log; NaN where a run is too short or has no such user.

    Late shares are late packets over packets whose deadline fell into the run. Delay quantiles are
    of the packets that were delivered: those that still wait at the end do not count, so at
    overload the late share is the fairer measure.
    """

    policy: str
    seed: int
    stage: str
    axis: str
    value: str
    num_slots: int
    urllc_late_share: float
    embb_late_share: float
    late_share_by_user: tuple[float, ...]
    urllc_users_violating: tuple[float, ...]
    """Share of URLLC users whose late share exceeds 1 - chi, for each reliability level."""
    urllc_rate_mbps: float
    embb_rate_mbps: float
    urllc_backlog_packets: float
    embb_backlog_packets: float
    urllc_delay_p50_s: float
    urllc_delay_p95_s: float
    urllc_delay_p99_s: float
    urllc_delay_p999_s: float
    embb_delay_p50_s: float
    embb_delay_p95_s: float
    embb_delay_p99_s: float
    embb_delay_p999_s: float
    tracking_error_cm: float
    off_track_share: float
    dexterity_index: float
    delay_steps: float
    delay_capped_share: float
    arrival_clamped_share: float
    control_saturations_per_s: float
    drift_plus_penalty_cost: float
    drift_cost: float
    """Its first part: over a run it adds up to half the squares of the last backlogs."""
    penalty_cost: float
    """Its second part, V h."""


def run_metrics(path: str | os.PathLike[str], scenario: Scenario) -> RunMetrics:
    """Measure one run from its log.

    Parameters
    ----------
    path
        Log of an evaluation or a sweep, from the first slot on.
    scenario
        Gives deadlines, reliability levels and window; what a sweep varies is not used.

    Raises
    ------
    LogError
        If the log is damaged, or its backlogs or late packets are not those that follow from its
        arrivals and service.
    """
    with LogReader(path, verify="chunks") as log:
        queue = log.read("/queue", ["backlog_packets", "arrivals_packets", "service_packets"])
        rate = log.read("/allocation", ["rate_mbps"])["rate_mbps"]
        delay = log.read("/delay")
        robots = log.read("/robots")
        urllc = log.dims.num_urllc
        metadata, slot_s, num_slots = log.metadata, log.slot_ns * 1e-9, log.num_slots
    sojourn_s = _checked_sojourns(path, queue, delay, scenario, urllc, slot_s)
    due, late = delay["due_packets"], delay["late_packets"]
    shares = _share(late.sum(axis=0, dtype=np.int64), due.sum(axis=0, dtype=np.int64))
    levels = scenario.traffic.reliability_levels
    return RunMetrics(
        policy=metadata["policy"],
        seed=int(metadata["seed"]),
        stage=metadata.get("stage", ""),
        axis=metadata.get("axis", ""),
        value=metadata.get("value", ""),
        num_slots=num_slots,
        urllc_late_share=_late_share(late[:, :urllc], due[:, :urllc]),
        embb_late_share=_late_share(late[:, urllc:], due[:, urllc:]),
        late_share_by_user=tuple(float(share) for share in shares),
        urllc_users_violating=tuple(
            _mean(shares[:urllc] > _allowed_late_share(level)) for level in levels
        ),
        urllc_rate_mbps=_mean(rate[:, :urllc]),
        embb_rate_mbps=_mean(rate[:, urllc:]),
        urllc_backlog_packets=_mean(queue["backlog_packets"][:, :urllc]),
        embb_backlog_packets=_mean(queue["backlog_packets"][:, urllc:]),
        **_delay_quantiles("urllc", sojourn_s[:urllc]),
        **_delay_quantiles("embb", sojourn_s[urllc:]),
        **_robot_measures(robots, scenario, slot_s),
        arrival_clamped_share=_mean(delay["arrival_clamped"][:, :urllc]),
        **_costs(delay, scenario),
    )


def read_sojourns(path: str | os.PathLike[str], scenario: Scenario) -> list[FloatArray]:
    """Read the sojourn times [s] of delivered packets, one array a user, checked as ever."""
    with LogReader(path, verify="chunks") as log:
        queue = log.read("/queue", ["backlog_packets", "arrivals_packets", "service_packets"])
        delay = log.read("/delay", ["due_packets", "late_packets"])
        urllc, slot_s = log.dims.num_urllc, log.slot_ns * 1e-9
    return _checked_sojourns(path, queue, delay, scenario, urllc, slot_s)


def tracking_error_by_window_cm(tracking_error_m: FloatArray, slots_per_window: int) -> FloatArray:
    """Return the root mean square tracking error of whole windows.

    Parameters
    ----------
    tracking_error_m
        Root mean square over each slot [m], shape (T, R).
    slots_per_window
        Slots of a window; the slots behind the last whole window are left out.

    Returns
    -------
    ndarray
        Centimetres, shape (T // slots_per_window, R).
    """
    windows = len(tracking_error_m) // slots_per_window
    square = tracking_error_m[: windows * slots_per_window] ** 2
    blocks = square.reshape(windows, slots_per_window, tracking_error_m.shape[1])
    result: FloatArray = 100.0 * np.sqrt(blocks.mean(axis=1))
    return result


def slots_per_window(scenario: Scenario) -> int:
    """Return the number of slots in a window of the dexterity index."""
    return round(scenario.robot.window_s / scenario.radio.slot_s)


def _checked_sojourns(
    path: str | os.PathLike[str],
    queue: dict[str, NDArray[Any]],
    delay: dict[str, NDArray[Any]],
    scenario: Scenario,
    num_urllc: int,
    slot_s: float,
) -> list[FloatArray]:
    """Return the sojourn times [s] by user, after a check that the log agrees with them."""
    arrivals, service = queue["arrivals_packets"], queue["service_packets"]
    backlog = backlog_path(arrivals, service)
    if not np.array_equal(backlog[:-1], queue["backlog_packets"]):
        raise LogError(path, 0, "its backlogs do not follow from its arrivals and service")
    result = []
    for user in range(arrivals.shape[1]):
        traffic = scenario.traffic
        deadline_s = traffic.deadline_s if user < num_urllc else traffic.embb_deadline_s
        own = arrivals[:, user], service[:, user], backlog[:, user]
        due, late = late_packets(*own, deadline_in_slots(deadline_s, slot_s))
        for name, counted in (("due_packets", due), ("late_packets", late)):
            logged = delay[name][:, user]
            if not np.array_equal(counted, logged):
                slot = int(np.flatnonzero(counted != logged)[0])
                raise LogError(
                    path,
                    0,
                    f"{name} of user {user} in slot {slot} is {logged[slot]}, but its arrivals "
                    f"and service give {counted[slot]} at a deadline of {deadline_s:g} s",
                )
        result.append(sojourn_slots(*own) * slot_s)
    return result


def _allowed_late_share(reliability: float) -> float:
    """Return 1 - chi, rounded: 1 late packet in 10 is not more than 1 - 0.9 = 0.0999…."""
    return round(1.0 - reliability, 12)


def _share(part: NDArray[np.int64], whole: NDArray[np.int64]) -> FloatArray:
    share: FloatArray = np.divide(part, whole, out=np.full(part.shape, np.nan), where=whole > 0)
    return share


def _late_share(late: NDArray[np.uint32], due: NDArray[np.uint32]) -> float:
    total = int(due.sum(dtype=np.int64))
    return int(late.sum(dtype=np.int64)) / total if total else float("nan")


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if values.size else float("nan")


def _delay_quantiles(slice_name: str, sojourn_s: list[FloatArray]) -> dict[str, float]:
    """Return quantiles over the delivered packets of a slice; each is the delay of a packet."""
    pooled = np.concatenate(sojourn_s) if sojourn_s else np.empty(0)
    levels = list(DELAY_QUANTILES.values())
    values = (
        np.quantile(pooled, levels, method="inverted_cdf")
        if pooled.size
        else np.full(len(levels), np.nan)
    )
    return {
        f"{slice_name}_delay_{name}_s": float(value)
        for name, value in zip(DELAY_QUANTILES, values, strict=True)
    }


def _robot_measures(
    robots: dict[str, NDArray[Any]], scenario: Scenario, slot_s: float
) -> dict[str, float]:
    window = slots_per_window(scenario)
    error_cm = tracking_error_by_window_cm(robots["tracking_error_m"], window)
    # A window's index is in force from the first slot behind it; that of the last is not logged.
    finished = robots["dexterity_index"][window::window]
    robot_s = robots["control_saturated"].size * slot_s
    return {
        "tracking_error_cm": _mean(error_cm),
        "off_track_share": _mean(error_cm > OFF_TRACK_CM),
        "dexterity_index": _mean(finished),
        "delay_steps": _mean(robots["delay_steps"]),
        "delay_capped_share": _mean(robots["delay_capped"]),
        "control_saturations_per_s": (
            float(robots["control_saturated"].sum(dtype=np.int64)) / robot_s
            if robot_s
            else float("nan")
        ),
    }


def _costs(delay: dict[str, NDArray[Any]], scenario: Scenario) -> dict[str, float]:
    """Return the means over slots of drift + V penalty, and of both parts, of both slices.

    Without the priced constraint: multipliers differ between policies, so with it a policy would
    be credited with its own.
    """
    drift = delay["drift_urllc"] + delay["drift_embb"]
    penalty = delay["penalty_urllc"] + delay["penalty_embb"]
    penalty = scenario.objective.penalty_weight * penalty
    return {
        "drift_plus_penalty_cost": _mean(drift + penalty),
        "drift_cost": _mean(drift),
        "penalty_cost": _mean(penalty),
    }
