"""Figures 2 and 3: rewards and queues over training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hiersched.scenario import Scenario
from hiersched.study.sensitivities import control_of
from hiersched.study.statistics import mean_interval
from hiersched.study.style import CONTROL, SLICES, caption, new_figure, shared_legend

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
    return _curve(training.groupby(number)["episode"].max().to_numpy(), by_seed)


def draw_rewards(
    training: Mapping[str, pd.DataFrame],
    checkpoints: Mapping[str, pd.DataFrame],
    scenario: Scenario,
) -> Figure:
    """Draw each slice's reward per slot over training: with noise, without, and without learning.

    Parameters
    ----------
    training, checkpoints
        Learner -> frame of `collect.training_frame` and of `collect.checkpoint_frame`.
    scenario
        Its own learner is drawn, and the control for it.
    """
    figure, axes = new_figure()
    axis_note = ""
    for panel, name, letter in zip(axes, ("embb", "urllc"), "ab", strict=True):
        curve = _draw_training(panel, training, checkpoints, f"{name}_reward", name, scenario)
        panel.set_title(f"({letter}) {SLICES[name].label} reward")
        panel.set_ylabel("reward of the slice per slot [1]")
        if _stretch(panel, curve):
            axis_note = " Axes: linear near 0 (shaded), logarithmic beyond."
    _legend(figure, axes)
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
    training: Mapping[str, pd.DataFrame],
    checkpoints: Mapping[str, pd.DataFrame],
    scenario: Scenario,
) -> Figure:
    """Draw each slice's backlog per user over training; parameters as for `draw_rewards`."""
    figure, axes = new_figure()
    for panel, name, letter in zip(axes, ("embb", "urllc"), "ab", strict=True):
        measure = f"{name}_backlog_packets"
        _draw_training(panel, training, checkpoints, measure, name, scenario)
        panel.set_title(f"({letter}) {SLICES[name].label} queue length")
        panel.set_ylabel("backlog per user [packets]")
        drawn = [np.asarray(line.get_ydata(), np.float64) for line in panel.get_lines()]
        values = np.concatenate([y[np.isfinite(y)] for y in drawn])
        if values.min() > 0.0 and values.max() > LOG_RANGE * values.min():
            panel.set_yscale("log")
        else:
            panel.set_ylim(bottom=0.0)
    _legend(figure, axes)
    caption(figure, _note(training, scenario))
    return figure


def _draw_training(
    panel: Axes,
    training: Mapping[str, pd.DataFrame],
    checkpoints: Mapping[str, pd.DataFrame],
    measure: str,
    name: str,
    scenario: Scenario,
) -> pd.DataFrame:
    """Draw one measure of the own learner and its control; returns the learner's curve."""
    own = scenario.learning.algorithm
    control = control_of(scenario, own)
    shown = [(own, SLICES[name])] + ([(control, CONTROL)] if control is not None else [])
    curves = []
    for learner, look in shown:
        learning = scenario.learned[learner]
        curve = training_curve(training[learner], measure, learning.num_envs)
        done = curve["episode"] / learning.episodes
        who = "learner" if learner == own else CONTROL.label
        panel.fill_between(
            done, curve["lo"], curve["hi"], color=look.color, alpha=0.2, linewidth=0.0
        )
        dashes = "-" if learner == own else look.dashes
        panel.plot(done, curve["mean"], color=look.color, linestyle=dashes, label=f"{who}, noise")
        points = checkpoint_curve(checkpoints[learner], measure)
        panel.errorbar(
            points["episode"] / learning.episodes,
            points["mean"],
            yerr=[points["mean"] - points["lo"], points["hi"] - points["mean"]],
            color=look.color,
            linestyle="none",
            marker="o" if learner == own else "D",
            markerfacecolor=look.color if learner == own else "white",
            elinewidth=0.9,
            zorder=3,
            label=f"{who}, without noise",
        )
        curves.append(curve)
    panel.set_xlabel("share of the training [1]")
    panel.set_xlim(-0.02, 1.02)
    return curves[0]


def checkpoint_curve(checkpoints: pd.DataFrame, measure: str) -> pd.DataFrame:
    """Return the mean over seeds of a measure at noise-free checkpoints: episode, mean, lo, hi."""
    by_seed = checkpoints.pivot(index="episode", columns="seed", values=measure)
    return _curve(by_seed.index.to_numpy(), by_seed)


def _curve(episode: NDArray[np.int64], by_seed: pd.DataFrame) -> pd.DataFrame:
    """Return episode, mean, lo, hi from one row of seeds an episode."""
    frame = pd.DataFrame(
        [mean_interval(row) for row in by_seed.to_numpy()], columns=["mean", "lo", "hi"]
    )
    frame.insert(0, "episode", episode)
    return frame


def _legend(figure: Figure, axes: Sequence[Axes]) -> None:
    """Name lines and marks below the panels: once for each slice's colour."""
    shared_legend(figure, axes[0], columns=4)


def _note(training: Mapping[str, pd.DataFrame], scenario: Scenario) -> str:
    learning = scenario.learning
    seeds = training[learning.algorithm]["seed"].nunique()
    return (
        f"Lines: mean over {seeds} seeds and the {learning.num_envs} episodes that run side by "
        f"side, {learning.slots_per_episode} slots each from empty queues, with exploration noise "
        f"on the actions. Marks: the same policies without noise in {learning.checkpoint_worlds} "
        "fixed worlds. Grey: actors that stay as they start, under the same noise. Bands and bars: "
        "Student t 95 % intervals over seeds."
    )
