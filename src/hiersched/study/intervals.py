"""Which interval the mean of a measure has, and which comparison: it follows from what it is."""

from __future__ import annotations

import math

import pandas as pd

from hiersched.scenario import Scenario
from hiersched.study.metrics import slots_per_window
from hiersched.study.samples import counts, sample_of
from hiersched.study.statistics import Interval, mean_interval, skewed_interval, smallest_mean

SYMMETRIC = ("urllc_rate_mbps", "embb_rate_mbps", "dexterity_index", "delay_steps")
"""Measures whose values lie about evenly around their mean: Student's t. All others are 0 or above
and skewed: late shares, backlogs, delays, errors."""

INTERVAL_NOTE = (
    "Means over worlds, of learned policies over `training_seeds` policies, each in all worlds. In "
    "brackets their 95 % intervals, which take in what policies and what worlds differ by: Student "
    "t for rates, the dexterity index and the delay in samples; for all else, which is skewed, the "
    "generalised pivotal interval of a lognormal mean (Krishnamoorthy and Mathew 2003; with zeros, "
    "Tian 2005 and Hannig 2009; of policies and worlds, the product of both). Bounds of shares are "
    "cut at 1. Where a share is above 0 in a single world, its logarithm is taken to spread by "
    "1.6; where it is 0 in all worlds, `<` stands before the least mean that so many worlds, or "
    "policies where they are fewer, tell from 0."
)


def resolution(name: str, runs: pd.DataFrame, scenario: Scenario) -> float:
    """Return the least value above 0 that every one of these runs could show of a count, else 0.

    Shares are counts over what is counted; so are saturations per second. `name` is a measure of
    `RunMetrics`, `runs` are of one policy under one condition.
    """
    slots, robots = int(runs["num_slots"].min()), scenario.users.num_urllc
    if name.endswith("_late_share"):
        due = float(runs[name.replace("late_share", "due_packets")].min())
        return scenario.traffic.arrivals.packets_at_once() / due if due > 0.0 else 0.0
    if name.startswith("urllc_users_violating"):
        return 1.0 / robots
    if name == "off_track_share":
        return 1.0 / (robots * max(1, slots // slots_per_window(scenario)))
    if name.endswith("_share"):
        return 1.0 / (robots * slots)
    if name == "control_saturations_per_s":
        return 1.0 / (robots * slots * scenario.radio.slot_s)
    return 0.0


def measure_interval(name: str, runs: pd.DataFrame, scenario: Scenario) -> Interval:
    """Return the mean of a measure over the runs of a policy, and the interval that suits it.

    Of a learned policy it is the mean over policies and worlds, and the interval has both parts.
    """
    values = sample_of(runs, name)
    if name in SYMMETRIC:
        return mean_interval(values)
    is_share = name.endswith("_share") or name.startswith("urllc_users_violating")
    most = 1.0 if is_share else math.inf
    return skewed_interval(values, resolution=resolution(name, runs, scenario), most=most)


def smallest_late_share(runs: pd.DataFrame, scenario: Scenario) -> float:
    """Return the least share of late URLLC packets that these runs tell from 0."""
    worlds, trained = counts(runs).values()
    units = min(worlds, trained) if trained > 1 else worlds
    return smallest_mean(units, resolution("urllc_late_share", runs, scenario))
