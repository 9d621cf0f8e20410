"""The sweeps of the gain study, from their logs to data frames, and what happens in a violation."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from hiersched.control import GainSchedule
from hiersched.log import LogReader
from hiersched.runs import paths
from hiersched.runs.gain_points import GainPoint, gain_points
from hiersched.runs.variants import STUDY_GAINS, STUDY_PLANTS, baseline_method
from hiersched.scenario import Scenario
from hiersched.scenario.schema import delay_steps
from hiersched.study.collect import attached_schedule
from hiersched.study.fifo import FloatArray
from hiersched.study.metrics import OFF_TRACK_CM, slots_per_window, tracking_error_by_window_cm

WINDOWS_AFTER = 2
"""Windows of a trace behind the violated one, in which the loop recovers."""


class Robots(NamedTuple):
    """What the robots of one log did, by window: each of shape (windows, R)."""

    error_cm: FloatArray
    saturated: FloatArray
    """Share of the slots in which a control was at its limit."""


def read_robots(path: Path, scenario: Scenario) -> Robots:
    """Read the robots of a log of the gain study.

    Raises
    ------
    FileNotFoundError
        If there is no such log.
    LogError
        If the log is damaged.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such log")
    with LogReader(path, verify="chunks") as log:
        fields = log.read("/robots", ["tracking_error_m", "control_saturated"])
    window = slots_per_window(scenario)
    error_cm = tracking_error_by_window_cm(fields["tracking_error_m"], window)
    saturated = fields["control_saturated"][: len(error_cm) * window].astype(np.float64)
    return Robots(error_cm, saturated.reshape(len(error_cm), window, -1).mean(axis=1))


def robot_measures(robots: Robots, windows: slice | list[int]) -> dict[str, float]:
    """Return the mean error of some windows, and the shares of robots that got into trouble there.

    ``off_track``: robots with more than `OFF_TRACK_CM` in one of the windows; ``saturated``: robots
    with a control at its limit in more than half of the slots of one. None is left out of the mean.
    """
    error_cm, saturated = robots.error_cm[windows], robots.saturated[windows]
    return {
        "error_cm": float(error_cm.mean()),
        "off_track": float((error_cm > OFF_TRACK_CM).any(axis=0).mean()),
        "saturated": float((saturated > 0.5).any(axis=0).mean()),
    }


def delay_range(scenario: Scenario, bounds_s: tuple[float, float]) -> range:
    """Return the delays in samples between two bounds, capped at T_max as in the loop."""
    low, high = (
        min(delay_steps(bound, scenario.control.sampling_s), scenario.max_delay_steps)
        for bound in bounds_s
    )
    return range(low, high + 1)


def schedule_state(schedule: GainSchedule, delays: range) -> dict[str, Any]:
    """Say which gains are in force at some delays, and which of them are certified."""
    states = dict.fromkeys(schedule.status[delay] for delay in delays)
    certified = sum(bool(schedule.certified[delay]) for delay in delays)
    last = f"–{delays[-1]}" if len(delays) > 1 else ""
    return {
        "delay_steps": f"{delays[0]}{last}",
        "status": ", ".join(states),
        "certified": f"{certified} of {len(delays)}",
    }


def gain_sweep_frame(results: Path, scenario: Scenario, axis: str) -> pd.DataFrame:
    """Measure a sweep of the gain study in its violated windows.

    Returns
    -------
    DataFrame
        Columns axis, value, those of `point_columns`, gain, seed and those of `robot_measures`.

    Raises
    ------
    FileNotFoundError
        If a log is missing.
    """
    rows = []
    for point in gain_points(scenario, axis):
        columns = point_columns(results, scenario, axis, point)
        for gain in STUDY_GAINS:
            for seed in scenario.gain_study.seeds:
                path = results / paths.gain_sweep_log(axis, point.value, gain, seed)
                measures = robot_measures(read_robots(path, point.scenario), slice(1, None))
                rows.append({**columns, "gain": gain, "seed": seed, **measures})
    return pd.DataFrame(rows)


def point_columns(results: Path, scenario: Scenario, axis: str, point: GainPoint) -> dict[str, Any]:
    """Describe a point: its values, the delays in violated windows, the gains in force there."""
    first = scenario.gain_study.seeds[0]
    path = results / paths.gain_sweep_log(axis, point.value, "adjusted", first)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such log")
    schedule = attached_schedule(path)
    delays = delay_range(point.scenario, point.violation_delay_s)
    control, robot = point.scenario.control, point.scenario.robot
    changed = any((schedule.gains[T] != schedule.nominal).any() for T in delays)
    predicts = any(schedule.input_gains[T].any() for T in delays)
    return {
        "axis": axis,
        "value": point.value,
        "weight": control.weight,
        "sampling_s": control.sampling_s,
        "noise_position_m": robot.noise_position_m,
        "noise_heading_rad": robot.noise_heading_rad,
        "delay_lo_s": point.violation_delay_s[0],
        "delay_hi_s": point.violation_delay_s[1],
        **schedule_state(schedule, delays),
        "same_gain": not (changed or predicts),
    }


def trace_frame(results: Path, scenario: Scenario) -> pd.DataFrame:
    """Read the tracking error slot by slot around the first violation of the gain study.

    Returns
    -------
    DataFrame
        Columns method (``nominal`` for the nominal gain), plant, seed, slot (0 = the first of the
        violated window), error_cm: root mean square over the robots, from the window before the
        violation to `WINDOWS_AFTER` behind it.
    """
    study, window = scenario.gain_study, slots_per_window(scenario)
    begin = (min(study.violation_windows) - 1) * window
    span = slice(max(0, begin - window), begin + (1 + WINDOWS_AFTER) * window)
    frames = []
    for method in study.methods:
        for gain in STUDY_GAINS:
            if gain == "nominal" and method != baseline_method(scenario, method):
                continue
            for seed in study.seeds:
                path = results / paths.gain_study_log(method, gain, seed)
                with LogReader(path, verify="chunks") as log:
                    error_m = log.read("/robots", ["tracking_error_m"])["tracking_error_m"][span]
                rms_cm = 100.0 * np.sqrt((error_m**2).mean(axis=1))
                columns = {
                    "method": "nominal" if gain == "nominal" else method,
                    "plant": STUDY_PLANTS[method],
                    "seed": seed,
                    "slot": np.arange(len(rms_cm)) + span.start - begin,
                    "error_cm": rms_cm,
                }
                frames.append(pd.DataFrame(columns))
    return pd.concat(frames, ignore_index=True)


def stability_frame(results: Path) -> pd.DataFrame:
    """Read the stability regions: a row an axis, value, plant and criterion, see `runs.stability`.

    ``delay_steps`` is NaN where a criterion does not even hold without delay; ``delay_s`` is that
    many samples; ``at_least`` says that no longer delay was looked at.
    """
    path = results / paths.STABILITY
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    frame = pd.DataFrame(json.loads(path.read_text(encoding="utf-8")))
    frame["delay_steps"] = frame["delay_steps"].astype(np.float64)
    frame["delay_s"] = frame["delay_steps"] * frame["sampling_s"]
    frame["at_least"] = frame["delay_steps"] == frame["max_delay_steps"]
    return frame
