"""Figure 8 and the load sweep: late packets, delays, tracking."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hiersched.scenario import Scenario
from hiersched.study.collect import BASELINE
from hiersched.study.samples import tail_policies
from hiersched.study.style import (
    GREY,
    PANEL_HEIGHT_IN,
    caption,
    draw_series,
    log_axis_with_zero,
    new_figure,
    note_at,
    policy_look,
    shared_legend,
    zero_floor,
)

DODGE = 0.012
"""Distance between the policies' points at one load, as a share of the axis."""


def draw_violations(
    policies: pd.DataFrame, runs: pd.DataFrame, tails: pd.DataFrame, scenario: Scenario
) -> Figure:
    """Draw the late share of URLLC packets by policy, and the tail of their delays."""
    figure, axes = new_figure(height_in=1.3 * PANEL_HEIGHT_IN, width_ratios=[1.15, 1.0])
    _draw_shares(axes[0], policies, runs, scenario)
    _draw_tails(axes[1], tails, scenario)
    shared_legend(figure, axes[1], side="right")
    traffic, seeds = scenario.traffic, len(scenario.evaluate.seeds)
    caption(
        figure,
        f"Large marks: means; dots: single seeds; bars and bands: Student t 95 % intervals over "
        f"{seeds} seeds, cut at the axis where they include 0. Left of the dotted line in (a): 0, "
        f"which has no place on a logarithmic axis.{_open_marks(policies)} "
        f"Corner in (b): 1 − χ = {_percent(1.0 - traffic.reliability)} at the deadline of "
        f"{1e3 * traffic.deadline_s:g} ms.",
    )
    return figure


def draw_load(sweeps: pd.DataFrame, scenario: Scenario) -> Figure:
    """Draw late share and tracking error against the load, all policies of the sweeps."""
    table = sweeps[sweeps["axis"] == "load"]
    figure, axes = new_figure()
    loads = [float(load) for load in scenario.sweeps.load]
    shift = DODGE * (max(loads) - min(loads))
    late = "urllc_late_share"
    floor = zero_floor(table[late])
    for number, policy in enumerate(scenario.sweeps.policies):
        own = table[table["policy"] == policy]
        place = number - 0.5 * (len(scenario.sweeps.policies) - 1)
        load = own["value"].astype(float).to_numpy() + place * shift
        look = policy_look(policy, scenario.learning.algorithm)
        bounds = own[f"{late}_lo"], own[f"{late}_hi"]
        draw_series(axes[0], load, own[late], *bounds, look, floor=floor)
        error = "tracking_error_cm"
        draw_series(axes[1], load, own[error], own[f"{error}_lo"], own[f"{error}_hi"], look)
    allowed = 1.0 - scenario.traffic.reliability
    drawn = table[[late, f"{late}_hi"]].to_numpy(dtype=np.float64)
    log_axis_with_zero(axes[0], floor, [*drawn.ravel(), allowed])
    axes[0].axhline(allowed, color=GREY, linewidth=0.9)
    note_at(
        axes[0],
        f"1 − χ = {_percent(allowed)}",
        0.99,
        allowed,
        xycoords=axes[0].get_yaxis_transform(),
        xytext=(0, -3),
        textcoords="offset points",
        ha="right",
        va="top",
    )
    deadline = f"{1e3 * scenario.traffic.deadline_s:g} ms"
    axes[0].set_title(f"(a) URLLC packets later than {deadline}")
    axes[0].set_ylabel("late share of due packets [1]")
    window = f"{scenario.robot.window_s:g} s"
    axes[1].set_title(f"(b) robots: RMS position error over {window}")
    axes[1].set_ylabel("tracking error [cm]")
    for panel in axes:
        panel.set_xlabel("offered load, relative to the nominal loads [1]")
        panel.set_xticks(loads)
    shared_legend(figure, axes[0])
    caption(
        figure,
        f"Mean and Student t 95 % interval over {len(scenario.sweeps.seeds)} seeds; bars in (a) "
        "end at 0 where they include it. Below the dotted line in (a): 0, which has no place on a "
        f"logarithmic axis.{_open_marks(table)} The axis of (b) does not start at 0. Points at one "
        "load are set apart.",
    )
    return figure


def _open_marks(table: pd.DataFrame) -> str:
    """Say what an open mark is, where there is one."""
    return " Open mark at 0: no late packet." if (table["urllc_late_share"] == 0.0).any() else ""


def _draw_shares(
    panel: Axes, policies: pd.DataFrame, runs: pd.DataFrame, scenario: Scenario
) -> None:
    """One row a policy, the most late packets at the bottom."""
    late = "urllc_late_share"
    table = policies.sort_values(late, ascending=False, kind="stable").reset_index(drop=True)
    floor = zero_floor(runs[late])
    learned = scenario.learning.algorithm
    for row, line in enumerate(table.to_dict("records")):
        look = policy_look(str(line["policy"]), learned)
        own = runs.loc[runs["policy"] == line["policy"], late].to_numpy()
        mean = max(float(line[late]), floor)
        low, high = (max(float(line[f"{late}_{end}"]), floor) for end in ("lo", "hi"))
        panel.errorbar(
            [mean],
            [row],
            xerr=[[mean - low], [high - mean]],
            color=look.color,
            marker=look.marker,
            markersize=5.5,
            markerfacecolor=look.color if line[late] > 0.0 else "white",
            zorder=3,
        )
        panel.plot(
            np.maximum(own, floor),
            np.full(len(own), row) + 0.36,
            linestyle="none",
            marker=".",
            markersize=3.0,
            color=GREY,
            zorder=2,
        )
    names = [policy_look(policy, learned).label for policy in table["policy"]]
    panel.set_yticks(range(len(table) + 1), [*names, "allowed at χ ="])
    panel.tick_params(axis="y", length=0)
    panel.set_ylim(-0.6, len(table) + 0.5)
    panel.grid(visible=False, axis="y")
    drawn = table[[late, f"{late}_hi"]].to_numpy(dtype=np.float64)
    allowed = 1.0 - scenario.traffic.reliability
    log_axis_with_zero(panel, floor, [*np.minimum(drawn, 1.0).ravel(), allowed], which="x")
    _draw_levels(panel, scenario, len(table))
    shares = policies.set_index("policy")[late]
    named = [(p, policy_look(p, learned)) for p in (learned, BASELINE) if p in shares.index]
    seen = ", ".join(f"{look.label.split()[0]} {_percent(shares[p])}" for p, look in named)
    deadline = f"{1e3 * scenario.traffic.deadline_s:g} ms"
    panel.set_title(f"(a) URLLC later than {deadline}: {seen}")
    panel.set_xlabel("late share of due packets [1]")


def _draw_levels(panel: Axes, scenario: Scenario, row: float) -> None:
    """Mark the late share 1 - chi that each reliability level allows."""
    bottom, top = panel.get_ylim()
    for level in scenario.traffic.reliability_levels:
        own = level == scenario.traffic.reliability
        panel.axvline(
            1.0 - level,
            ymax=(row - 0.45 - bottom) / (top - bottom),  # ends below its label
            color="black" if own else GREY,
            linewidth=1.0 if own else 0.6,
            linestyle="-" if own else (0, (5, 3)),
            zorder=1,
        )
        note_at(panel, _percent(level), 1.0 - level, row, ha="center", va="center")


def _draw_tails(panel: Axes, tails: pd.DataFrame, scenario: Scenario) -> None:
    bottom = 1e-5
    for policy in tail_policies(scenario):
        curve = tails[tails["policy"] == policy]
        look = policy_look(policy, scenario.learning.algorithm)
        delay_ms = 1e3 * curve["delay_s"]
        low, high = (np.maximum(curve[f"share_{end}"], bottom / 10) for end in ("lo", "hi"))
        panel.fill_between(delay_ms, low, high, color=look.color, alpha=0.15, linewidth=0)
        share = curve["share"].where(curve["share"] > 0.0)
        panel.plot(delay_ms, share, color=look.color, linestyle=look.dashes, label=look.label)
    panel.set_yscale("log")
    panel.set_ylim(bottom, 1.3)
    panel.set_xlim(0.0, float(1e3 * tails["delay_s"].max()))
    _draw_target(panel, scenario, bottom)
    panel.set_title("(b) delay of delivered URLLC packets")
    panel.set_xlabel("delay [ms]")
    panel.set_ylabel("share of packets that took longer [1]")


def _draw_target(panel: Axes, scenario: Scenario, bottom: float) -> None:
    """Mark deadline and allowed share: a curve that meets both passes below the corner."""
    deadline_ms = 1e3 * scenario.traffic.deadline_s
    allowed = 1.0 - scenario.traffic.reliability
    panel.plot(
        [0.0, deadline_ms, deadline_ms],
        [allowed, allowed, bottom],
        color="black",
        linewidth=1.0,
        zorder=1.5,
    )


def _percent(share: float) -> str:
    return f"{float(f'{100.0 * share:.2g}') if share < 0.5 else 100.0 * share:g} %"
