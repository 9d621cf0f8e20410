"""What the figures need besides the tables: distributions of rates and delays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from hiersched.scenario import Scenario
from hiersched.study.collect import BASELINE, evaluation_log, read_evaluation
from hiersched.study.metrics import read_sojourns, slots_per_window
from hiersched.study.statistics import mean_interval

RATE_POINTS = 301
DELAY_POINTS = 201
DEADLINES_SHOWN = 5.0
"""The delay axis ends at this many deadlines."""


def shown_policies(scenario: Scenario) -> list[str]:
    """Return the evaluated policies that the sweeps compare."""
    return [p for p in scenario.sweeps.policies if p in scenario.evaluate.policies]


def tail_policies(scenario: Scenario) -> list[str]:
    """Return the policies whose delays are shown: those of the sweeps, and EDF as the reference."""
    shown = shown_policies(scenario)
    return shown + [p for p in scenario.evaluate.policies if p == "edf" and p not in shown]


def rate_distributions(results: Path, scenario: Scenario) -> pd.DataFrame:
    """Return the distribution of data rates: learned policy and PF, by slot and by window.

    Returns
    -------
    DataFrame
        Columns span (slot, window), policy, slice, rate_mbps and the share of rates at or below
        it: mean over worlds as share, share_lo, share_hi; of a learned policy from its logs, each
        world under another of its policies.
    """
    learned, urllc = scenario.learning.algorithm, scenario.users.num_urllc
    window = slots_per_window(scenario)
    users = {"embb": slice(urllc, None), "urllc": slice(0, urllc)}
    rates = {
        policy: [
            read_evaluation(results, policy, seed, ["rate_mbps"]).measured("rate_mbps")
            for seed in scenario.evaluate.seeds
        ]
        for policy in (learned, BASELINE)
        if policy in scenario.evaluate.policies
    }
    frames = []
    for span, length in (("slot", 1), ("window", window)):
        means = {policy: [_block_means(log, length) for log in rates[policy]] for policy in rates}
        everything = [block.ravel() for blocks in means.values() for block in blocks]
        pooled = np.concatenate(everything) if everything else np.empty(0)
        top = float(np.quantile(pooled, 0.999)) if pooled.size else 1.0
        grid = np.linspace(0.0, top, RATE_POINTS)
        for policy, blocks in means.items():
            for name, columns in users.items():
                samples = [block[:, columns].ravel() for block in blocks]
                shares = np.array([_share_at_most(sample, grid) for sample in samples])
                labels = {"span": span, "policy": policy, "slice": name, "rate_mbps": grid}
                frames.append(pd.DataFrame({**labels, **_columns(shares)}))
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame()


def delay_tails(results: Path, scenario: Scenario) -> pd.DataFrame:
    """Return the share of delivered URLLC packets that took longer than a time, by policy.

    Returns
    -------
    DataFrame
        Columns policy, delay_s and share, share_lo, share_hi over worlds, likewise.
    """
    grid = np.linspace(0.0, DEADLINES_SHOWN * scenario.traffic.deadline_s, DELAY_POINTS)
    frames = []
    for policy in scenario.evaluate.policies:
        shares = []
        for seed in scenario.evaluate.seeds:
            sojourns = read_sojourns(evaluation_log(results, policy, seed), scenario)
            pooled = np.concatenate(sojourns[: scenario.users.num_urllc])
            shares.append(1.0 - _share_at_most(pooled, grid))
        frames.append(
            pd.DataFrame({"policy": policy, "delay_s": grid, **_columns(np.array(shares))})
        )
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame()


def _block_means(
    values: np.ndarray[tuple[int, ...], np.dtype[np.float64]], length: int
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return the mean over whole blocks of slots, shape (T // length, U)."""
    blocks = len(values) // length
    return np.asarray(
        values[: blocks * length].reshape(blocks, length, values.shape[1]).mean(axis=1)
    )


def _share_at_most(
    sample: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
    grid: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    if not sample.size:
        return np.full(len(grid), np.nan)
    return np.searchsorted(np.sort(sample), grid, side="right") / sample.size


def _columns(
    shares: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
) -> dict[str, list[float]]:
    """Return the mean over seeds and its interval at every point; shares have shape (seeds, n)."""
    intervals = [mean_interval(column) for column in shares.T]
    return {
        "share": [interval.mean for interval in intervals],
        "share_lo": [interval.lo for interval in intervals],
        "share_hi": [interval.hi for interval in intervals],
    }
