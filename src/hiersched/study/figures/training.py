"""Figures 2 and 3, and learning curves of all learners side by side."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hiersched.study.claims.conditions import control_of, controls, first_trained, learners
from hiersched.study.figures import style
from hiersched.study.registry import figure, has_learners
from hiersched.study.statistics import mean_interval
from hiersched.study.study import Study

LOG_RANGE = 30.0
"""Queues that span a larger factor are drawn on a logarithmic axis."""


def training_curve(training: pd.DataFrame, measure: str, block: int) -> pd.DataFrame:
    """Return the mean over seeds, and its interval, of a measure over blocks of episodes.

    A block are the episodes that ran side by side, with the same agents: one row, with the columns
    episode (last of the block), mean, mean_lo and mean_hi.
    """
    number = (training["episode"] - 1) // block
    by_seed = training.groupby([number.rename("block"), "seed"])[measure].mean().unstack("seed")
    return _curve(training.groupby(number)["episode"].max().to_numpy(), by_seed)


@figure(
    "fig2_rewards",
    title="Fig. 2: rewards of both agents over training episodes, mean over seeds.",
    reads=("episodes",),
    when=has_learners,
)
def draw_rewards(study: Study) -> Figure:
    """Draw each slice's reward per slot over training: with noise, without, and without learning.

    The scenario's own learner is drawn, if it is trained, else the first that is, and the control
    for it.
    """
    return _draw_slices(study, "reward", "reward", "reward of the slice per slot [1]", _stretch)


def _stretch(panel: Axes, curve: pd.DataFrame) -> str:
    """Take a symmetric logarithmic axis where the first episodes would hide all later ones."""
    sizes = curve["mean"].abs()
    late = float(sizes.iloc[len(sizes) // 2 :].median())
    if late == 0.0 or sizes.max() < LOG_RANGE * late:
        return ""
    threshold = 10.0 ** np.floor(np.log10(late))
    panel.set_yscale("symlog", linthresh=threshold)
    panel.axhspan(-threshold, threshold, color="0.93", zorder=0)
    return " Axes: linear near 0 (shaded), logarithmic beyond."


@figure(
    "fig3_queues",
    title="Fig. 3: backlogs of both slices over training episodes, mean over seeds.",
    reads=("episodes",),
    when=has_learners,
)
def draw_queues(study: Study) -> Figure:
    """Draw each slice's backlog per user over training, as `draw_rewards` its reward."""
    label = "backlog per user [packets]"
    return _draw_slices(study, "backlog_packets", "queue length", label, _show_all)


def _show_all(panel: Axes, curve: pd.DataFrame) -> str:
    """Take a logarithmic axis where queues span too much for one that begins at 0."""
    drawn = [np.asarray(line.get_ydata(), np.float64) for line in panel.get_lines()]
    values = np.concatenate([y[np.isfinite(y)] for y in drawn])
    if values.min() > 0.0 and values.max() > LOG_RANGE * values.min():
        panel.set_yscale("log")
    else:
        panel.set_ylim(bottom=0.0)
    return ""


def _draw_slices(
    study: Study, measure: str, title: str, label: str, scale: Callable[[Axes, pd.DataFrame], str]
) -> Figure:
    """Draw a measure of both slices over training; `scale` chooses an axis and says so."""
    figure, axes = style.new_figure()
    said = ""
    for panel, name, letter in zip(axes, style.SLICES, "ab", strict=True):
        curve = _draw_training(panel, study, f"{name}_{measure}", name)
        panel.set(title=f"({letter}) {style.SLICES[name].label} {title}", ylabel=label)
        said = scale(panel, curve) or said
    style.shared_legend(figure, axes[0], columns=4)
    own = first_trained(study.scenario)
    learning, seeds = study.scenario.learned[own], study.training[own]["seed"].nunique()
    style.caption(
        figure,
        f"Lines: mean over {seeds} seeds and the {learning.num_envs} episodes that run side by "
        f"side, {learning.slots_per_episode} slots each from empty queues, with exploration noise "
        f"on the actions. Marks: the same policies without noise in {learning.checkpoint_worlds} "
        "fixed worlds. Grey: actors that stay as they start, under the same noise. Bands and bars: "
        f"Student t 95 % intervals over seeds.{said}",
    )
    return figure


def _draw_training(panel: Axes, study: Study, measure: str, name: str) -> pd.DataFrame:
    """Draw one measure of the first learner and its control; returns the learner's curve."""
    scenario = study.scenario
    own = first_trained(scenario)
    control = control_of(scenario, own)
    curves = []
    looks = {own: style.SLICES[name]._replace(label="learner", dashes="-", marker="o")}
    if control is not None:
        looks[control] = style.CONTROL._replace(marker="D")
    for learner, look in looks.items():
        learning = scenario.learned[learner]
        curve = training_curve(study.training[learner], measure, learning.num_envs)
        curves.append(curve)
        done, label = curve["episode"] / learning.episodes, f"{look.label}, noise"
        style.draw_curve(panel, done, curve, "mean", look, alpha=0.2, label=label)
        points = checkpoint_curve(study.checkpoints[learner], measure)
        panel.errorbar(
            points["episode"] / learning.episodes,
            points["mean"],
            yerr=[points["mean"] - points["mean_lo"], points["mean_hi"] - points["mean"]],
            color=look.color,
            linestyle="none",
            marker=look.marker,
            markerfacecolor=look.color if learner == own else "white",
            elinewidth=0.9,
            zorder=3,
            label=f"{look.label}, without noise",
        )
    panel.set(xlabel="share of the training [1]", xlim=(-0.02, 1.02))
    return curves[0]


def checkpoint_curve(checkpoints: pd.DataFrame, measure: str) -> pd.DataFrame:
    """Return the same columns of a measure at noise-free checkpoints."""
    by_seed = checkpoints.pivot(index="episode", columns="seed", values=measure)
    return _curve(by_seed.index.to_numpy(), by_seed)


def _curve(episode: NDArray[np.int64], by_seed: pd.DataFrame) -> pd.DataFrame:
    frame = pd.DataFrame([mean_interval(row).columns("mean") for row in by_seed.to_numpy()])
    return frame.assign(episode=episode)


_CURVES = (
    ("urllc_late_share", "late URLLC packets", "share of due packets [1]"),
    ("urllc_backlog_packets", "URLLC queue", "backlog per user [packets]"),
    ("embb_backlog_packets", "eMBB queue", "backlog per user [packets]"),
)


@figure(
    "figX_learning",
    title="Late packets and queues of every learner over its training; not in the paper.",
    reads=("episodes",),
    when=has_learners,
)
def draw_learning(study: Study) -> Figure:
    """Draw late share and queues of every learner over its training, with and without noise.

    Those that learn nothing are drawn alike.
    """
    scenario, training, checkpoints = study.scenario, study.training, study.checkpoints
    figure, panels = style.new_figure(
        *(len(_CURVES), 2), height_in=2.1 * style.PANEL_HEIGHT_IN, sharex=True, sharey="col"
    )
    late = pd.concat(
        [f["urllc_late_share"] for frames in (training, checkpoints) for f in frames.values()]
    )
    floor = style.zero_floor(late)
    kinds = (("with noise", training), ("without noise", checkpoints))
    named = {*learners(scenario), *controls(scenario)[:1]}  # one control names all
    limits: dict[str, list[float]] = {}
    for panel, letter, ((kind, frames), (measure, title, label)) in zip(
        panels, "abcdef", product(kinds, _CURVES), strict=True
    ):
        for learner, frame in frames.items():
            learning = scenario.learned[learner]
            look = style.CONTROL if learning.frozen else style.policy_look(learner, scenario)
            look = look._replace(label=look.label if learner in named else "_")
            if frames is training:
                curve = training_curve(frame, measure, learning.num_envs)
                look = look._replace(marker="none")
            else:
                curve = checkpoint_curve(frame, measure)
            # Bands leave the logarithmic axes where they include 0.
            least = floor if measure == "urllc_late_share" else 0.1 * curve["mean"].min()
            curve["mean"] = curve["mean"].clip(lower=least)
            done, cut = curve["episode"] / learning.episodes, (least, np.inf)
            marker: dict[str, Any] = {"marker": look.marker, "markersize": 3.0}
            style.draw_curve(panel, done, curve, "mean", look, cut=cut, alpha=0.12, **marker)
        panel.set_title(f"({letter}) {title}, {kind}", fontsize="medium")
        panel.set(ylabel=label, xlim=(-0.02, 1.02))
        if measure != "urllc_late_share":
            lines = np.concatenate([line.get_ydata() for line in panel.get_lines()])
            if lines.min() > 0.0:
                panel.set_yscale("log")
                bounds = [*limits.get(measure, ()), 0.5 * lines.min(), 2.0 * lines.max()]
                limits[measure] = bounds
                panel.set_ylim(min(bounds), max(bounds))  # both rows share the axis
        if frames is checkpoints:
            panel.set_xlabel("share of the training [1]")
    below = panels[len(_CURVES)]
    for panel in (panels[0], below):
        style.log_axis_with_zero(panel, floor, late)
    style.shared_legend(figure, below, columns=4)
    counts = sorted({len(scenario.learned[name].seeds) for name in study.training})
    seeds = " or ".join(map(str, counts))
    style.caption(
        figure,
        f"Mean over {seeds} seeds; bands: Student t 95 % interval over "
        "seeds. Grey: actors that stay as they start, one for each kind of noise and start. "
        "Without noise: the policies as they are at that share of their training, in the same "
        "worlds for all. Episodes begin with empty queues.",
    )
    return figure
