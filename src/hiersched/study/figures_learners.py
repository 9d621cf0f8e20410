"""The learners side by side: their learning curves, and what they reach along the load."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hiersched.policies.registry import Look
from hiersched.scenario import Scenario
from hiersched.study.collect import BASELINE
from hiersched.study.figures_comparison import LOAD_BOUNDS, LOAD_PANELS, spans_decades
from hiersched.study.figures_training import checkpoint_curve, training_curve
from hiersched.study.sensitivities import controls, learners
from hiersched.study.style import (
    CONTROL,
    GREY,
    PANEL_HEIGHT_IN,
    arrows_text,
    caption,
    draw_series,
    log_axis_with_zero,
    policy_look,
    shared_legend,
    zero_floor,
)

_CURVES = (
    ("urllc_late_share", "late URLLC packets", "share of due packets [1]"),
    ("urllc_backlog_packets", "URLLC queue", "backlog per user [packets]"),
    ("embb_backlog_packets", "eMBB queue", "backlog per user [packets]"),
)
BESIDE = (BASELINE, "drift_plus_penalty")
"""Schedulers that are shown beside the learners."""


def draw_learning(
    training: Mapping[str, pd.DataFrame],
    checkpoints: Mapping[str, pd.DataFrame],
    scenario: Scenario,
) -> Figure:
    """Draw late share and queues of every learner over its training, with and without noise.

    Parameters
    ----------
    training, checkpoints
        Learner -> frame of `collect.training_frame` and of `collect.checkpoint_frame`.
    scenario
        Its learners; those that learn nothing are drawn alike.
    """
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


def draw_learners(sweeps: pd.DataFrame, scenario: Scenario) -> Figure:
    """Draw every learner along the load, beside PF and drift-plus-penalty.

    Parameters
    ----------
    sweeps
        From `summary.sweep_table`.
    scenario
        Its learners.
    """
    shown = [*learners(scenario), *BESIDE]
    table = sweeps[(sweeps["axis"] == "load") & sweeps["policy"].isin(shown)]
    policies = [policy for policy in shown if policy in set(table["policy"])]
    figure = Figure(figsize=(7.2, 2.15 * PANEL_HEIGHT_IN), layout="constrained")
    axes = [axis for row in figure.subplots(2, 2, squeeze=False) for axis in row]
    loads = np.arange(len(scenario.sweeps.load))
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
        panel.set_xticks(loads, [f"{load:g}" for load in scenario.sweeps.load])
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
