"""The tables as data frames: means over seeds with their intervals, paired comparisons."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from hiersched.control import GainSchedule, spectral_radius_by_delay
from hiersched.runs.policies import world_slots
from hiersched.scenario import Scenario
from hiersched.simulator.loop_gains import plant_of
from hiersched.study.collect import BASELINE, read_evaluation
from hiersched.study.comparison import best_classical, standing
from hiersched.study.intervals import measure_interval, resolution, smallest_late_share
from hiersched.study.metrics import violation_column
from hiersched.study.paper import TABLE2, TABLE3
from hiersched.study.samples import counts, paired
from hiersched.study.statistics import (
    Interval,
    interval_columns,
    mean_interval,
    paired_difference,
    paired_log_ratio,
)

LEADING_MEASURES = (
    "urllc_late_share",
    "embb_late_share",
    "urllc_rate_mbps",
    "embb_rate_mbps",
    "urllc_backlog_packets",
    "embb_backlog_packets",
    "urllc_delay_p99_s",
    "tracking_error_cm",
    "dexterity_index",
    "urllc_delay_p50_s",
    "urllc_delay_p95_s",
    "urllc_delay_p999_s",
    "embb_delay_p50_s",
    "embb_delay_p95_s",
    "embb_delay_p99_s",
    "embb_delay_p999_s",
    "off_track_share",
    "mean_square_backlog",
)
TRAILING_MEASURES = (
    "delay_steps",
    "delay_capped_share",
    "arrival_clamped_share",
    "control_saturations_per_s",
    "penalty_cost",
)
COMPARED = (
    "urllc_late_share",
    "urllc_rate_mbps",
    "embb_rate_mbps",
    "embb_late_share",
    "urllc_backlog_packets",
    "embb_backlog_packets",
    "urllc_delay_p99_s",
    "tracking_error_cm",
    "off_track_share",
    "mean_square_backlog",
    "penalty_cost",
)


def measures(scenario: Scenario) -> list[str]:
    """List every measure of the tables of policies and sweeps, in their order."""
    violating = [violation_column(level) for level in scenario.traffic.reliability_levels]
    return [*LEADING_MEASURES, *violating, *TRAILING_MEASURES]


def summarise(
    runs: pd.DataFrame, by: Sequence[str], names: Sequence[str], scenario: Scenario
) -> pd.DataFrame:
    """Return the mean of each measure over a group's runs, and its interval as ``_lo``, ``_hi``.

    `seeds` are the worlds, `training_seeds` the policies of a learner, 0 of a rule: see `samples`.

    Parameters
    ----------
    runs
        One row a run.
    by
        Columns that make up a group; groups keep the order of the rows.
    names
        Measures.
    scenario
        Of the runs.
    """
    rows = []
    for key, group in runs.groupby(list(by), sort=False):
        row: dict[str, Any] = dict(zip(by, key, strict=True))
        row |= counts(group)
        for name in names:
            row |= interval_columns(name, measure_interval(name, group, scenario))
        rows.append(row)
    return pd.DataFrame(rows)


def policy_table(runs: pd.DataFrame, scenario: Scenario) -> pd.DataFrame:
    """Return one row a policy: all measures over the evaluation's worlds, medians beside means.

    Of a learned policy, over all its policies in all worlds.

    `urllc_late_share_smallest` is the least late share that these worlds tell from 0. How the
    policy stands against the best classical scheduler comes from `comparison`.
    """
    names = measures(scenario)
    table = summarise(runs, ["policy"], names, scenario)
    groups = [group for _, group in runs.groupby("policy", sort=False)]
    medians = {f"{name}_median": [float(g[name].median()) for g in groups] for name in names}
    smallest = [smallest_late_share(group, scenario) for group in groups]
    medians["urllc_late_share_smallest"] = smallest
    table = pd.concat([table, pd.DataFrame(medians)], axis=1)
    return table.merge(standing(runs), on="policy")


def sweep_table(runs: pd.DataFrame, scenario: Scenario) -> pd.DataFrame:
    """Return one row an axis, value and policy: all measures over the sweep's worlds."""
    return summarise(runs, ["axis", "value", "policy"], measures(scenario), scenario)


def comparison_table(runs: pd.DataFrame, scenario: Scenario) -> pd.DataFrame:
    """Compare every policy with PF, then with the best classical scheduler, in the same worlds.

    Typical ratios and mean differences; both intervals are Student's, that of the ratio on its
    logarithm. `seeds_below_baseline` counts worlds, of a learned policy its pairs of policy and
    world.
    """
    policies = list(dict.fromkeys(runs["policy"]))
    baselines = [name for name in (BASELINE, best_classical(runs)) if name in policies]
    rows = [
        row
        for baseline in dict.fromkeys(baselines)
        for policy in policies
        if policy != baseline
        for row in _compared(runs, str(policy), str(baseline), scenario)
    ]
    columns = ["policy", "baseline", "measure"]
    return pd.DataFrame(rows) if rows else pd.DataFrame(columns=columns)


def _compared(
    runs: pd.DataFrame, policy: str, baseline: str, scenario: Scenario
) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    own, other = (runs[runs["policy"] == name] for name in (policy, baseline))
    both = pd.concat([own, other])
    for name in COMPARED:
        a, b = paired(own, other, name)
        rows.append(
            {
                "policy": policy,
                "baseline": baseline,
                "measure": name,
                **counts(own),
                "mean": float(a.mean()),
                "baseline_mean": float(b.mean()),
                **interval_columns(
                    "ratio", paired_log_ratio(a, b, resolution=resolution(name, both, scenario))
                ),
                **interval_columns("difference", paired_difference(a, b)),
                "seeds_below_baseline": int((a < b).sum()),
            }
        )
    return rows


def gain_table(gains: pd.DataFrame) -> pd.DataFrame:
    """Return the tracking error of every method and window: nominal, adjusted, paired ratio.

    Slots that are in the paper's Table II have its numbers beside them.
    """
    rows = []
    for (method, plant, slot, violated), group in gains.groupby(
        ["method", "plant", "slot", "violated"], sort=False
    ):
        by_gain = group.pivot(index="seed", columns="gain", values="error_cm")
        nominal, adjusted = by_gain["nominal"].to_numpy(), by_gain["adjusted"].to_numpy()
        printed = TABLE2.get(int(str(slot))) if violated else None
        rows.append(
            {
                "slot": slot,
                "nominal_cm": float(nominal.mean()),
                "adjusted_cm": float(adjusted.mean()),
                **interval_columns("ratio", paired_log_ratio(adjusted, nominal)),
                **_bounds("nominal_cm", mean_interval(nominal)),
                **_bounds("adjusted_cm", mean_interval(adjusted)),
                "seeds": len(by_gain),
                "method": method,
                "plant": plant,
                "violated": bool(violated),
                "paper_nominal": printed.nominal if printed else math.nan,
                "paper_adjusted": printed.adjusted if printed else math.nan,
                "paper_ratio": printed.adjusted / printed.nominal if printed else math.nan,
            }
        )
    return pd.DataFrame(rows)


def rate_table(results_dir: Path, scenario: Scenario) -> pd.DataFrame:
    """Return Table III: mean URLLC rate of learned policy and PF at three slots and over all.

    The first slot is slot 1; all is what lies behind the warm-up. The channel gain is the mean of
    the squared fading amplitude over URLLC users and PRBs, the same for both policies.
    """
    learned, urllc = scenario.learning.algorithm, scenario.users.num_urllc
    seeds = scenario.evaluate.seeds
    present = [str(p) for p in (learned, BASELINE) if p in scenario.evaluate.policies]
    if not present:
        return pd.DataFrame(columns=["slot", "seeds"])

    _, warmup_slots = world_slots(scenario.evaluate, scenario.radio.slot_s)

    def by_slot(policy: str) -> np.ndarray[Any, Any]:
        """Return channel gain and rate, means over URLLC users, shape (2, seeds, T)."""
        names = ("mean_fading_power", "rate_mbps")
        logs = [read_evaluation(results_dir, policy, seed, names).fields for seed in seeds]
        return np.array(
            [[log[n][:, :urllc].mean(axis=1, dtype=np.float64) for log in logs] for n in names]
        )

    both = {policy: by_slot(policy) for policy in present}
    gain = both[present[0]][0]
    rates = {policy: rate for policy, (_, rate) in both.items()}
    rows = []
    slots: list[int | str] = [*TABLE3, "mean"]
    for slot in slots:
        at = slice(slot - 1, slot) if isinstance(slot, int) else slice(warmup_slots, None)
        if not gain[:, at].size:
            raise ValueError(f"slot {slot}: the runs have {gain.shape[1]} slots")
        printed = TABLE3.get(slot) if isinstance(slot, int) else None
        row: dict[str, Any] = {"slot": slot, "seeds": len(seeds)}
        row |= interval_columns("channel_gain", mean_interval(gain[:, at].mean(axis=1)))
        for name, policy in (("drl", learned), ("pf", BASELINE)):
            if policy in rates:
                row |= interval_columns(
                    f"{name}_mbps", mean_interval(rates[policy][:, at].mean(axis=1))
                )
        if len(rates) == 2:
            own, other = (rates[p][:, at].mean(axis=1) for p in (learned, BASELINE))
            row |= interval_columns("ratio", paired_log_ratio(own, other))
        for field in ("channel_gain", "drl_mbps", "pf_mbps"):
            row[f"paper_{field}"] = getattr(printed, field) if printed else math.nan
        rows.append(row)
    return pd.DataFrame(rows)


def schedule_table(schedules: dict[str, GainSchedule], scenario: Scenario) -> pd.DataFrame:
    """Return the gain in force at every delay: status, deviation, certificate, spectral radii."""
    rows = []
    for schedule in schedules.values():
        kind: Literal["network", "split"] = "split" if schedule.kind == "split" else "network"
        control = replace(scenario.control, loop=kind, sampling_s=schedule.sampling_s)
        plant = plant_of(replace(scenario, control=control))
        loop = plant.closed_loop(schedule.nominal)
        nominal_radii = spectral_radius_by_delay(*loop, schedule.max_delay_steps)
        for delay, certificate in enumerate(schedule.certificates):
            rows.append(
                {
                    "method": schedule.method,
                    "plant": schedule.kind,
                    "delay_steps": delay,
                    "delay_s": delay * schedule.sampling_s,
                    "status": schedule.status[delay],
                    "deviation": float(schedule.deviation[delay]),
                    "certified": bool(certificate.certified),
                    "criterion": certificate.criterion,
                    "spectral_radius": float(certificate.spectral_radii.max()),
                    "nominal_spectral_radius": float(nominal_radii[: delay + 1].max()),
                }
            )
    return pd.DataFrame(rows)


def _bounds(name: str, interval: Interval) -> dict[str, float]:
    return {f"{name}_lo": interval.lo, f"{name}_hi": interval.hi}
