"""Table II as a figure: tracking error with nominal and adjusted gains under forced delays."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from hiersched.policies.registry import Look
from hiersched.scenario import Scenario
from hiersched.study.style import (
    GAIN_METHODS,
    PAPER_COLOR,
    caption,
    draw_series,
    new_figure,
    shared_legend,
)

_PAIR = (
    ("nominal_cm", GAIN_METHODS["nominal"]),
    ("adjusted_cm", Look("adjusted gain", "#0072B2", "-", "o")),
)
_SPREAD = 0.13
"""Distance between the methods' points at one slot."""


def draw_gain(gains: pd.DataFrame, scenario: Scenario) -> Figure:
    """Draw the tracking error of every window, and adjusted over nominal where delays violate.

    Parameters
    ----------
    gains
        From `summary.gain_table`.
    scenario
        The scenario that was run.
    """
    figure, (left, right) = new_figure(width_ratios=[1.5, 1.0])
    method, plant = str(gains["method"].iloc[0]), str(gains["plant"].iloc[0])
    own = gains[gains["method"] == method]
    for column, look in _PAIR:
        bounds = own[f"{column}_lo"], own[f"{column}_hi"]
        draw_series(left, own["slot"], own[column], *bounds, look)
    for slot in scenario.gain_study.violation_windows:
        left.axvspan(slot - 0.5, slot + 0.5, color="#dddddd", zorder=0, linewidth=0)
    left.set_ylim(bottom=0.0)
    left.set_xlim(0.3, scenario.gain_study.num_windows + 0.7)
    left.set_title(f"(a) tracking error, {plant} plant, {GAIN_METHODS[method].label} gains")
    left.set_xticks([1, *range(5, scenario.gain_study.num_windows + 1, 5)])
    left.set_xlabel(f"time slot (window of {scenario.robot.window_s:g} s)")
    left.set_ylabel("RMS over the window [cm]")
    shared_legend(figure, left)
    violated = gains[gains["violated"]]
    slots = sorted(violated["slot"].unique())
    groups = list(violated.groupby("method", sort=False))
    for number, (name, group) in enumerate(groups):
        look = GAIN_METHODS[str(name)]._replace(dashes="none")
        shift = _SPREAD * (number - 0.5 * (len(groups) - 1))
        x = [slots.index(slot) + shift for slot in group["slot"]]
        bounds = group["ratio_lo"], group["ratio_hi"]
        label = look.label if group["plant"].iloc[0] == plant else f"{look.label}, split plant"
        draw_series(right, x, group["ratio"], *bounds, look, label=label)
    paper = violated[violated["method"] == method]
    right.plot(
        [slots.index(slot) for slot in paper["slot"]],
        paper["paper_ratio"],
        linestyle="none",
        marker="*",
        markersize=9,
        color=PAPER_COLOR,
        label="paper",
        zorder=4,
    )
    right.axhline(1.0, color="#5f5f5f", linewidth=0.9)
    right.set_xticks(range(len(slots)), [str(slot) for slot in slots])
    right.set_xlim(-0.5, len(slots) - 0.5)
    top = float(violated["ratio_hi"].replace(np.inf, np.nan).max())
    right.set_ylim(0.0, 1.2 if np.isnan(top) else max(1.2, 1.05 * top))
    lowest, highest = paper["ratio"].min(), paper["ratio"].max()
    right.set_title(f"(b) all methods; {GAIN_METHODS[method].label}: {lowest:.2f} to {highest:.2f}")
    right.set_xlabel("time slot of violated delay")
    right.set_ylabel("error, adjusted / nominal [1]")
    right.legend(
        ncols=2,
        loc="lower left",
        fontsize=6.2,
        handletextpad=0.3,
        columnspacing=0.6,
        handlelength=1.6,
        borderaxespad=0.0,
    )
    caption(
        figure,
        f"Mean over robots and {len(scenario.gain_study.seeds)} seeds; bars: 95 % intervals, "
        "Student t, in (b) of the logarithm. Grey: violated delay. Each gain follows the delay. "
        f"Stars: the paper's Table II.{_missing_bars(violated)}",
    )
    return figure


def _missing_bars(violated: pd.DataFrame) -> str:
    """Say why points in (b) have no bar, where some have none."""
    bounded = np.isfinite(violated["ratio_lo"]) & np.isfinite(violated["ratio_hi"])
    width = violated["ratio_hi"] - violated["ratio_lo"]
    equal = bounded & (violated["ratio"] == 1.0) & (width < 1e-9)
    reasons = (
        ("both gains give the same errors", equal),
        ("the interval is unbounded", np.isinf(violated["ratio_lo"])),
    )
    return "".join(
        f" No bar ({', '.join(GAIN_METHODS[m].label for m in violated['method'][rows].unique())}): "
        f"{reason}."
        for reason, rows in reasons
        if rows.any()
    )
