"""From runs of a policy to a sample of a measure, and its mean with the interval that suits it.

A sample is one value a world or, of a learned policy, policies crossed with worlds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hiersched.scenario import Scenario
from hiersched.study.metrics import slots_per_window
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


def sample_of(
    runs: pd.DataFrame, name: str, worlds: Sequence[int] | None = None
) -> NDArray[np.float64]:
    """Return a measure of one policy under one condition.

    Runs are one a row; without a column `policy_seed`, and where that is empty, they are of a rule.
    The sample of a rule has shape (W,), of a learned policy (P, W): training seeds in the order of
    the rows, and so `worlds` unless their order is given. ValueError if not every policy ran once
    in every world.
    """
    worlds = list(dict.fromkeys(runs["seed"])) if worlds is None else worlds
    learned = is_learned(runs)
    trained = runs["policy_seed"].tolist() if learned else [0] * len(runs)
    policies = list(dict.fromkeys(trained))
    pairs = dict(zip(zip(trained, runs["seed"], strict=True), runs[name], strict=True))
    wanted = list(product(policies, worlds))
    if len(runs) != len(wanted) or set(pairs) != set(wanted):
        raise ValueError(
            f"{len(runs)} runs of {len(policies)} policies in {len(worlds)} worlds: must be each "
            "policy once in each world"
        )
    values = np.array([pairs[pair] for pair in wanted], dtype=np.float64)
    return values.reshape(len(policies), len(worlds)) if learned else values


def is_learned(runs: pd.DataFrame) -> bool:
    """Whether runs of one policy are of trained ones."""
    return "policy_seed" in runs and bool(runs["policy_seed"].notna().all()) and len(runs) > 0


def counts(runs: pd.DataFrame) -> dict[str, int]:
    """Return columns of a table: worlds, and training seeds, 0 of a rule."""
    trained = runs["policy_seed"].nunique() if is_learned(runs) else 0
    return {"seeds": runs["seed"].nunique(), "training_seeds": int(trained)}


def paired(
    own: pd.DataFrame, other: pd.DataFrame, name: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return samples of two policies in the same worlds, by world and training seed.

    Of two learned policies the k-th training seeds are paired, as many as both have. ValueError if
    they did not run in the same worlds.
    """
    worlds = list(dict.fromkeys(own["seed"]))
    if set(worlds) != set(other["seed"]):
        raise ValueError(
            f"{own['policy'].iloc[0]} and {other['policy'].iloc[0]} did not run in the same worlds"
        )
    a, b = (sample_of(runs, name, worlds) for runs in (own, other))
    if a.ndim == b.ndim == 2:
        common = min(len(a), len(b))
        a, b = a[:common], b[:common]
    return a, b


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
