"""Tables of the gain study: every method, the grid of weight and delay, the sweeps, the regions."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pandas as pd

from hiersched.runs import paths
from hiersched.runs.variants import STUDY_PLANTS, baseline_method
from hiersched.scenario import Scenario
from hiersched.study.collect import attached_schedule
from hiersched.study.gain_logs import (
    Robots,
    delay_range,
    gain_sweep_frame,
    read_robots,
    robot_measures,
    schedule_state,
    stability_frame,
)
from hiersched.study.statistics import Interval, interval_columns, mean_interval, paired_log_ratio


def methods_table(results: Path, scenario: Scenario) -> pd.DataFrame:
    """Return the tracking error of every method of the gain study, in the same worlds.

    A row for each violated slot, one for all of them and one for the calm slots: a method whose
    gain differs from the nominal one at short delays too pays, or gains, there.
    """
    study = scenario.gain_study
    violated = sorted(study.violation_windows)
    calm = [slot for slot in range(1, study.num_windows + 1) if slot not in violated]
    spans: dict[str, list[int]] = {str(slot): [slot - 1] for slot in violated}
    spans["violated"] = [slot - 1 for slot in violated]
    if calm:
        spans["calm"] = [slot - 1 for slot in calm]
    rows = []
    for method in study.methods:
        logs = {
            "nominal": _robots(results, scenario, baseline_method(scenario, method), "nominal"),
            "adjusted": _robots(results, scenario, method, "adjusted"),
        }
        first = results / paths.gain_study_log(method, "adjusted", study.seeds[0])
        schedule = attached_schedule(first)
        for slot, windows in spans.items():
            bounds = study.calm_delay_s if slot == "calm" else study.violation_delay_s
            runs = pd.DataFrame(
                [
                    {"gain": gain, **robot_measures(robots, windows)}
                    for gain, seeds in logs.items()
                    for robots in seeds
                ]
            )
            labels = {"method": method, "plant": STUDY_PLANTS[method], "slot": slot}
            state = schedule_state(schedule, delay_range(scenario, bounds))
            rows.append({**labels, **compared(runs), **state})
    return pd.DataFrame(rows)


def sweep_points_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Compare both gains at every point of a sweep of the gain study.

    Parameters
    ----------
    runs
        From `gain_logs.gain_sweep_frame`.

    Returns
    -------
    DataFrame
        One row a point: its columns, errors, ratio, shares of robots in trouble, and ``effect``:
        ``same gain``, ``helps`` or ``hurts`` where the ratio's interval excludes 1, else
        ``no difference``.
    """
    measured = ["gain", "seed", "error_cm", "off_track", "saturated"]
    labels = [name for name in runs.columns if name not in measured]
    rows = []
    for _, group in runs.groupby("value", sort=False):
        row: dict[str, Any] = {name: group[name].iloc[0] for name in labels}
        row |= compared(group)
        same, ratio = row.pop("same_gain"), (row["ratio"], row["ratio_lo"], row["ratio_hi"])
        row["effect"] = "same gain" if same else effect_of(Interval(*ratio))
        rows.append(row)
    return pd.DataFrame(rows)


def effect_of(ratio: Interval) -> str:
    """Return what a ratio of errors, adjusted over nominal, says at the level of its interval."""
    if ratio.hi < 1.0:
        return "helps"
    return "hurts" if ratio.lo > 1.0 else "no difference"


def compared(runs: pd.DataFrame) -> dict[str, Any]:
    """Compare adjusted and nominal gain over the same seeds, which are in the same order."""
    by_gain = {gain: runs[runs["gain"] == gain] for gain in ("nominal", "adjusted")}
    row: dict[str, Any] = {}
    for gain, group in by_gain.items():
        row |= interval_columns(f"{gain}_cm", mean_interval(group["error_cm"]))
    nominal, adjusted = (by_gain[gain]["error_cm"].to_numpy() for gain in ("nominal", "adjusted"))
    row |= interval_columns("ratio", paired_log_ratio(adjusted, nominal))
    row["seeds"] = len(nominal)
    for name in ("off_track", "saturated"):
        for gain, group in by_gain.items():
            row[f"{gain}_{name}_share"] = float(group[name].mean())
    return row


def grid_table(results: Path, scenario: Scenario) -> pd.DataFrame:
    """Return the grid of weight and delay: a row of `sweep_points_table` each."""
    points = sweep_points_table(gain_sweep_frame(results, scenario, "grid"))
    unused = ["axis", "value", "sampling_s", "noise_position_m", "noise_heading_rad", "delay_hi_s"]
    return points.rename(columns={"delay_lo_s": "delay_s"}).drop(columns=unused)


def sweeps_table(results: Path, scenario: Scenario) -> pd.DataFrame:
    """Return the sweeps of sampling interval and noise, with the first unstable constant delay.

    That delay is of the nominal gain; there is none where the loop is stable up to T_max.
    """
    axes = ("sampling_s", "noise")
    runs = [gain_sweep_frame(results, scenario, axis) for axis in axes]
    points = pd.concat([sweep_points_table(frame) for frame in runs], ignore_index=True)
    regions = stability_frame(results)
    exact = regions[regions["axis"] == "sampling_s"].set_index("value")
    unstable_s = []
    for axis, sampling_s in zip(points["axis"], points["sampling_s"], strict=True):
        if axis != "sampling_s" or exact.loc[sampling_s, "at_least"]:
            unstable_s.append(math.nan)
        else:
            unstable_s.append((exact.loc[sampling_s, "delay_steps"] + 1.0) * sampling_s)
    place = list(points.columns).index("sampling_s") + 1
    points.insert(place, "first_unstable_delay_s", unstable_s)
    return points.drop(columns=["value", "weight"])


def stability_table(results: Path) -> pd.DataFrame:
    """Return the stability regions, with what the file names in words."""
    return stability_frame(results).drop(columns="max_delay_steps")


def _robots(results: Path, scenario: Scenario, method: str, gain: str) -> list[Robots]:
    return [
        read_robots(results / paths.gain_study_log(method, gain, seed), scenario)
        for seed in scenario.gain_study.seeds
    ]
