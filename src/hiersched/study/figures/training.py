"""Figures 2 and 3, and learners side by side: learning curves, what they reach along the load."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hiersched.experiments.points import BASELINE
from hiersched.policies.registry import Look
from hiersched.study.claims.conditions import control_of, controls, first_trained, learners
from hiersched.study.figures.comparison import LOAD_BOUNDS, LOAD_PANELS, spans_decades
from hiersched.study.figures.style import (
    CONTROL,
    GREY,
    PANEL_HEIGHT_IN,
    SLICES,
    arrows_text,
    caption,
    draw_series,
    log_axis_with_zero,
    new_figure,
    policy_look,
    shared_legend,
    zero_floor,
)
from hiersched.study.registry import axis_of, figure, has_learners, learners_among, varies
from hiersched.study.statistics import mean_interval
from hiersched.study.study import Study
from hiersched.study.tables.policies import LOAD, along_axes

LOG_RANGE = 30.0
"""Queues that span a larger factor are drawn on a logarithmic axis."""


def training_curve(training: pd.DataFrame, measure: str, block: int) -> pd.DataFrame:
    """Return the mean over seeds, and its interval, of a measure over blocks of episodes.

    Parameters
    ----------
    training
        From `Study.training`.
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
    figure, axes = new_figure()
    axis_note = ""
    for panel, name, letter in zip(axes, ("embb", "urllc"), "ab", strict=True):
        curve = _draw_training(panel, study, f"{name}_reward", name)
        panel.set_title(f"({letter}) {SLICES[name].label} reward")
        panel.set_ylabel("reward of the slice per slot [1]")
        if _stretch(panel, curve):
            axis_note = " Axes: linear near 0 (shaded), logarithmic beyond."
    _legend(figure, axes)
    caption(figure, _note(study) + axis_note)
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


@figure(
    "fig3_queues",
    title="Fig. 3: backlogs of both slices over training episodes, mean over seeds.",
    reads=("episodes",),
    when=has_learners,
)
def draw_queues(study: Study) -> Figure:
    """Draw each slice's backlog per user over training, as `draw_rewards` its reward."""
    figure, axes = new_figure()
    for panel, name, letter in zip(axes, ("embb", "urllc"), "ab", strict=True):
        measure = f"{name}_backlog_packets"
        _draw_training(panel, study, measure, name)
        panel.set_title(f"({letter}) {SLICES[name].label} queue length")
        panel.set_ylabel("backlog per user [packets]")
        drawn = [np.asarray(line.get_ydata(), np.float64) for line in panel.get_lines()]
        values = np.concatenate([y[np.isfinite(y)] for y in drawn])
        if values.min() > 0.0 and values.max() > LOG_RANGE * values.min():
            panel.set_yscale("log")
        else:
            panel.set_ylim(bottom=0.0)
    _legend(figure, axes)
    caption(figure, _note(study))
    return figure


def _draw_training(panel: Axes, study: Study, measure: str, name: str) -> pd.DataFrame:
    """Draw one measure of the first learner and its control; returns the learner's curve."""
    scenario = study.scenario
    own = first_trained(scenario)
    control = control_of(scenario, own)
    shown = [(own, SLICES[name])] + ([(control, CONTROL)] if control is not None else [])
    curves = []
    for learner, look in shown:
        learning = scenario.learned[learner]
        curve = training_curve(study.training[learner], measure, learning.num_envs)
        done = curve["episode"] / learning.episodes
        who = "learner" if learner == own else CONTROL.label
        panel.fill_between(
            done, curve["lo"], curve["hi"], color=look.color, alpha=0.2, linewidth=0.0
        )
        dashes = "-" if learner == own else look.dashes
        panel.plot(done, curve["mean"], color=look.color, linestyle=dashes, label=f"{who}, noise")
        points = checkpoint_curve(study.checkpoints[learner], measure)
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


def _note(study: Study) -> str:
    own = first_trained(study.scenario)
    learning, seeds = study.scenario.learned[own], study.training[own]["seed"].nunique()
    return (
        f"Lines: mean over {seeds} seeds and the {learning.num_envs} episodes that run side by "
        f"side, {learning.slots_per_episode} slots each from empty queues, with exploration noise "
        f"on the actions. Marks: the same policies without noise in {learning.checkpoint_worlds} "
        "fixed worlds. Grey: actors that stay as they start, under the same noise. Bands and bars: "
        "Student t 95 % intervals over seeds."
    )


_CURVES = (
    ("urllc_late_share", "late URLLC packets", "share of due packets [1]"),
    ("urllc_backlog_packets", "URLLC queue", "backlog per user [packets]"),
    ("embb_backlog_packets", "eMBB queue", "backlog per user [packets]"),
)
BESIDE = (BASELINE, "drift_plus_penalty")
"""Schedulers that are shown beside the learners."""


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
    figure = Figure(figsize=(7.2, 2.1 * PANEL_HEIGHT_IN), layout="constrained")
    rows = figure.subplots(2, len(_CURVES), squeeze=False, sharex=True, sharey="col")
    late = pd.concat(
        [f["urllc_late_share"] for frames in (training, checkpoints) for f in frames.values()]
    )
    floor = zero_floor(late)
    kinds = (("with noise", training), ("without noise", checkpoints))
    named = {*learners(scenario), *controls(scenario)[:1]}  # one control names all
    limits: dict[str, list[float]] = {}
    for axes, (kind, frames), letters in zip(rows, kinds, ("abc", "def"), strict=True):
        for panel, (measure, title, label), letter in zip(axes, _CURVES, letters, strict=True):
            for learner, frame in frames.items():
                learning = scenario.learned[learner]
                look = CONTROL if learning.frozen else policy_look(learner, scenario)
                look = look._replace(label=look.label if learner in named else "_")
                if frames is training:
                    curve = training_curve(frame, measure, learning.num_envs)
                    look = look._replace(marker="none")
                else:
                    curve = checkpoint_curve(frame, measure)
                # Bands leave the logarithmic axes where they include 0.
                least = floor if measure == "urllc_late_share" else 0.1 * curve["mean"].min()
                _draw_curve(panel, curve, learning.episodes, look, least)
            panel.set_title(f"({letter}) {title}, {kind}", fontsize="medium")
            panel.set_ylabel(label)
            panel.set_xlim(-0.02, 1.02)
            if measure != "urllc_late_share":
                lines = np.concatenate([line.get_ydata() for line in panel.get_lines()])
                if lines.min() > 0.0:
                    panel.set_yscale("log")
                    bounds = [*limits.get(measure, ()), 0.5 * lines.min(), 2.0 * lines.max()]
                    limits[measure] = bounds
                    panel.set_ylim(min(bounds), max(bounds))  # both rows share the axis
        if frames is checkpoints:
            for panel in axes:
                panel.set_xlabel("share of the training [1]")
    for axes in rows:
        log_axis_with_zero(axes[0], floor, np.minimum(late.to_numpy(np.float64), 1.0))
    shared_legend(figure, rows[1][0], columns=4)
    caption(
        figure,
        f"Mean over {len(scenario.learning.seeds)} seeds; bands: Student t 95 % interval over "
        "seeds. Grey: actors that stay as they start, one for each kind of noise and start. "
        "Without noise: the policies as they are at that share of their training, in the same "
        "worlds for all. Episodes begin with empty queues.",
    )
    return figure


def _draw_curve(panel: Axes, curve: pd.DataFrame, episodes: int, look: Look, least: float) -> None:
    """Draw a mean and its band, cut at the least value, over the share of the training."""
    done = curve["episode"] / episodes
    low, mean, high = (curve[end].clip(lower=least) for end in ("lo", "mean", "hi"))
    panel.fill_between(done, low, high, color=look.color, alpha=0.12, linewidth=0.0)
    panel.plot(
        done,
        mean,
        color=look.color,
        linestyle=look.dashes,
        marker=look.marker,
        markersize=3.0,
        label=look.label,
    )


@figure(
    "figX_learners",
    title="Every learner over the offered load, beside two schedulers; not in the paper.",
    reads=("runs",),
    when=varies(LOAD, learners_among),
)
def draw_learners(study: Study) -> Figure:
    """Draw every learner along the load, beside PF and drift-plus-penalty."""
    scenario = study.scenario
    name = str(axis_of(scenario, LOAD))
    sweeps = along_axes(study, name)
    swept = scenario.sweeps.axes[name].vary[LOAD]
    shown = [*learners(scenario), *BESIDE]
    table = sweeps[sweeps["policy"].isin(shown)]
    policies = [policy for policy in shown if policy in set(table["policy"])]
    figure = Figure(figsize=(7.2, 2.15 * PANEL_HEIGHT_IN), layout="constrained")
    axes = [axis for row in figure.subplots(2, 2, squeeze=False) for axis in row]
    loads = np.arange(len(swept))
    for panel, (measure, title, label), letter in zip(axes, LOAD_PANELS, "abcd", strict=True):
        floor = (
            zero_floor(table[[measure, f"{measure}_hi"]]) if measure == "urllc_late_share" else None
        )
        for number, policy in enumerate(policies):
            own = table[table["policy"] == policy]
            bounds = own[f"{measure}_lo"], own[f"{measure}_hi"]
            # Side by side at each load: learners often lie on each other.
            x = loads + 0.09 * (number - 0.5 * (len(policies) - 1))
            look = policy_look(policy, scenario)._replace(dashes="none")
            draw_series(panel, x, own[measure], *bounds, look, floor=floor)
        if floor is not None:
            drawn = table[[measure, f"{measure}_hi"]].to_numpy(dtype=np.float64)
            log_axis_with_zero(panel, floor, np.minimum(drawn, 1.0).ravel())
            panel.axhline(1.0 - scenario.traffic.reliability, color=GREY, linewidth=0.9)
        elif spans_decades(table, measure):
            panel.set_yscale("log")
        panel.set_title(f"({letter}) {title}")
        panel.set_ylabel(label)
        panel.set_xlabel("offered load, relative to the nominal loads [1]")
        panel.set_xticks(loads, [f"{load:g}" for load in swept])
    shared_legend(figure, axes[0], columns=4)
    caption(
        figure,
        f"Mean and 95 % interval over {len(scenario.sweeps.seeds)} worlds, of "
        "learned policies also over training seeds. Grey line in (a): the share 1 − χ that is "
        "allowed; below the "
        f"dotted line: 0.{arrows_text(table[LOAD_BOUNDS])} The axes of (b) and (d) do not start "
        "at 0.",
    )
    return figure
