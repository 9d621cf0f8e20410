"""Figure 8: late packets and delays."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hiersched.scenario import Scenario
from hiersched.study.collect import BASELINE
from hiersched.study.distributions import tail_policies
from hiersched.study.style import (
    GREY,
    PANEL_HEIGHT_IN,
    caption,
    log_axis_with_zero,
    new_figure,
    note_at,
    policy_look,
    shared_legend,
    zero_floor,
)


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
        f"Large marks: means; dots: single runs, of learned policies each in every world; bars: "
        f"95 % intervals over {seeds} worlds and over policies; bands: over worlds, world i under "
        "the learned policy of training seed i; cut at the axis where they include 0. "
        f"Left of the dotted line in (a): 0, which has no place on a logarithmic axis."
        f"{_open_marks(policies)} "
        f"Corner in (b): 1 − χ = {_percent(1.0 - traffic.reliability)} at the deadline of "
        f"{1e3 * traffic.deadline_s:g} ms.",
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
    floor = zero_floor([*runs[late], *policies[f"{late}_hi"]])
    learned = scenario.learning.algorithm
    for row, line in enumerate(table.to_dict("records")):
        look = policy_look(str(line["policy"]), scenario)
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
    names = [policy_look(policy, scenario).label for policy in table["policy"]]
    panel.set_yticks(range(len(table) + 1), [*names, "allowed at χ [%] ="])
    panel.tick_params(axis="y", length=0)
    panel.set_ylim(-0.6, len(table) + 0.5)
    panel.grid(visible=False, axis="y")
    drawn = table[[late, f"{late}_hi"]].to_numpy(dtype=np.float64)
    allowed = 1.0 - scenario.traffic.reliability
    log_axis_with_zero(panel, floor, [*np.minimum(drawn, 1.0).ravel(), allowed], which="x")
    _draw_levels(panel, scenario, len(table))
    shares = policies.set_index("policy")[late]
    looks = {p: policy_look(p, scenario) for p in (learned, BASELINE)}
    named = [(p, look) for p, look in looks.items() if p in shares.index]
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
        note_at(panel, f"{100.0 * level:g}", 1.0 - level, row, ha="center", va="center")


def _draw_tails(panel: Axes, tails: pd.DataFrame, scenario: Scenario) -> None:
    bottom = 1e-5
    for policy in tail_policies(scenario):
        curve = tails[tails["policy"] == policy]
        look = policy_look(policy, scenario)
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
