"""Figures 2 and 3: rewards and queues over training."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hiersched.scenario import Scenario
from hiersched.study.statistics import Interval, mean_interval
from hiersched.study.style import SLICES, Look, caption, new_figure, note_at, policy_look

LOG_RANGE = 30.0
"""Queues that span a larger factor are drawn on a logarithmic axis."""


def training_curve(training: pd.DataFrame, measure: str, block: int) -> pd.DataFrame:
    """Return the mean over seeds, and its interval, of a measure over blocks of episodes.

    Parameters
    ----------
    training
        From `collect.training_frame`.
    measure
        Column.
    block
        Episodes that ran side by side, with the same agents: one point.

    Returns
    -------
    DataFrame
        Columns episode (last of the block), mean, lo, hi.
    """
    number = (training["episode"] - 1) // block
    by_seed = training.groupby([number.rename("block"), "seed"])[measure].mean().unstack("seed")
    last = training.groupby(number)["episode"].max()
    intervals = [mean_interval(row) for row in by_seed.to_numpy()]
    frame = pd.DataFrame(intervals, columns=["mean", "lo", "hi"])
    frame.insert(0, "episode", last.to_numpy())
    return frame


def draw_rewards(training: pd.DataFrame, scenario: Scenario) -> Figure:
    """Draw each slice's reward per slot over the episodes of training."""
    figure, axes = new_figure()
    axis_note = ""
    for panel, name, letter in zip(axes, ("embb", "urllc"), "ab", strict=True):
        curve = _draw_curve(panel, training, f"{name}_reward", SLICES[name], scenario)
        panel.set_title(f"({letter}) {SLICES[name].label} reward")
        panel.set_ylabel("reward of the slice per slot [1]")
        if _stretch(panel, curve):
            axis_note = " Axes: linear near 0 (shaded), logarithmic beyond."
    caption(figure, _note(training, scenario) + axis_note)
    return figure


def _stretch(panel: Axes, curve: pd.DataFrame) -> bool:
    """Take a symmetric logarithmic axis where the first episodes would hide all later ones."""
    sizes = curve["mean"].abs()
    late = float(sizes.iloc[len(sizes) // 2 :].median())
    if late == 0.0 or sizes.max() < LOG_RANGE * late:
        return False
    threshold = 10.0 ** np.floor(np.log10(late))
    panel.set_yscale("symlog", linthresh=threshold)
    panel.axhspan(-threshold, threshold, color="0.93", zorder=0)
    return True


def draw_queues(
    training: pd.DataFrame, reference: Mapping[str, Interval], scenario: Scenario
) -> Figure:
    """Draw each slice's backlog per user over the episodes of training, and PF's for comparison."""
    figure, axes = new_figure()
    for panel, name, letter in zip(axes, ("embb", "urllc"), "ab", strict=True):
        measure = f"{name}_backlog_packets"
        curve = _draw_curve(panel, training, measure, SLICES[name], scenario)
        values = curve["mean"].to_list()
        if name in reference:
            values.append(reference[name].mean)
            look = policy_look("pf")
            panel.axhline(
                reference[name].mean,
                color=look.color,
                linestyle=look.dashes,
            )
            at = {"xycoords": panel.get_yaxis_transform(), "textcoords": "offset points"}
            note_at(panel, "PF", 0.995, reference[name].mean, xytext=(0, 3), ha="right", **at)
        panel.set_title(f"({letter}) {SLICES[name].label} queue length")
        panel.set_ylabel("backlog per user [packets]")
        if min(values) > 0.0 and max(values) > LOG_RANGE * min(values):
            panel.set_yscale("log")
        else:
            panel.set_ylim(bottom=0.0)
    pf = " PF: in the evaluation worlds, over as many slots from empty queues." if reference else ""
    caption(figure, _note(training, scenario) + pf)
    return figure


def _draw_curve(
    panel: Axes, training: pd.DataFrame, measure: str, look: Look, scenario: Scenario
) -> pd.DataFrame:
    curve = training_curve(training, measure, scenario.learning.num_envs)
    episode = curve["episode"].to_numpy()
    panel.fill_between(
        episode, curve["lo"], curve["hi"], color=look.color, alpha=0.22, linewidth=0.0
    )
    panel.plot(
        episode,
        curve["mean"],
        color=look.color,
        marker=look.marker,
        markersize=3.0,
    )
    panel.set_xlabel("training episode")
    panel.set_xlim(0, float(training["episode"].max()) * 1.02)
    return curve


def _note(training: pd.DataFrame, scenario: Scenario) -> str:
    learning = scenario.learning
    seeds = training["seed"].nunique()
    return (
        f"Point: mean over {seeds} seeds and the {learning.num_envs} episodes that run side by "
        f"side, {learning.slots_per_episode} slots each. Band: Student t 95 % interval over seeds."
    )
