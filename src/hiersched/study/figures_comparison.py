"""Where policies stand: along the load, in delay, against each other, against the optimum."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hiersched.policies.registry import Look
from hiersched.scenario import Scenario
from hiersched.study.comparison import BACKLOG
from hiersched.study.distributions import tail_policies
from hiersched.study.style import (
    GREY,
    PANEL_HEIGHT_IN,
    arrows_text,
    caption,
    draw_series,
    log_axis_with_zero,
    new_figure,
    policy_look,
    shared_legend,
    unbounded_bar,
    zero_floor,
)

TAIL_END = 1e-4
"""The complementary distribution of delay ends here: rarer packets are too few to show."""

LOAD_PANELS = (
    ("urllc_late_share", "late URLLC packets", "share of due packets [1]"),
    ("tracking_error_cm", "robots: RMS position error", "tracking error [cm]"),
    (BACKLOG, "mean square backlog", "mean of ½ΣF² over slots [packets²]"),
    ("embb_rate_mbps", "eMBB data rate", "rate per user [Mbit/s]"),
)
LOAD_BOUNDS = [f"{measure}_hi" for measure, *_ in LOAD_PANELS]


def spans_decades(table: pd.DataFrame, measure: str) -> bool:
    """Whether a positive measure or its finite bounds span more than a factor of ten."""
    drawn = table[[measure, f"{measure}_lo", f"{measure}_hi"]].to_numpy(dtype=np.float64)
    finite = drawn[np.isfinite(drawn)]
    return bool((drawn > 0.0).all() and finite.max() > 10.0 * finite.min())


def draw_load(sweeps: pd.DataFrame, scenario: Scenario) -> Figure:
    """Draw late share, tracking error, backlog and eMBB rate of policies against the load.

    Of the learners the scenario's own; `figures_learners` has the others.
    """
    table = sweeps[(sweeps["axis"] == "load") & ~sweeps["policy"].isin(list(scenario.learners))]
    figure = Figure(figsize=(7.2, 2.15 * PANEL_HEIGHT_IN), layout="constrained")
    axes = [axis for row in figure.subplots(2, 2, squeeze=False) for axis in row]
    policies = [str(policy) for policy in dict.fromkeys(table["policy"])]
    loads = [float(load) for load in scenario.sweeps.load]
    for panel, (measure, title, label), letter in zip(axes, LOAD_PANELS, "abcd", strict=True):
        floor = (
            zero_floor(table[[measure, f"{measure}_hi"]]) if measure == "urllc_late_share" else None
        )
        for policy in policies:
            own = table[table["policy"] == policy]
            bounds = own[f"{measure}_lo"], own[f"{measure}_hi"]
            x = own["value"].astype(float)
            draw_series(panel, x, own[measure], *bounds, _look(policy, scenario), floor=floor)
        if floor is not None:
            allowed = 1.0 - scenario.traffic.reliability
            drawn = table[[measure, f"{measure}_hi"]].to_numpy(dtype=np.float64)
            log_axis_with_zero(panel, floor, [*drawn.ravel(), allowed])
            panel.axhline(allowed, color=GREY, linewidth=0.9)
        elif spans_decades(table, measure):
            panel.set_yscale("log")
        panel.set_title(f"({letter}) {title}")
        panel.set_ylabel(label)
        panel.set_xlabel("offered load, relative to the nominal loads [1]")
        panel.set_xticks(loads)
    shared_legend(figure, axes[0], columns=6)
    caption(
        figure,
        f"Mean and 95 % interval over {len(scenario.sweeps.seeds)} worlds, of the learned policy "
        "also over training seeds; bars leave "
        "logarithmic axes, or end at 0 in (a), where they include 0. Grey line in (a): the share "
        f"1 − χ that is allowed; below the dotted line: 0.{_open_marks(table)}"
        f"{arrows_text(table[LOAD_BOUNDS])} The axes of (b) and (d) do not start at 0.",
    )
    return figure


def draw_delay(tails: pd.DataFrame, scenario: Scenario) -> Figure:
    """Draw the complementary distribution of URLLC delays: main policies left, all right.

    Of the learners the scenario's own: the others would hide it.
    """
    tails = tails[~tails["policy"].isin(list(scenario.learners))]
    figure, axes = new_figure(height_in=1.15 * PANEL_HEIGHT_IN, sharey=True)
    chosen = tail_policies(scenario)
    panels = (
        (axes[0], [p for p in dict.fromkeys(tails["policy"]) if p in chosen], "(a) compared"),
        (axes[1], list(dict.fromkeys(tails["policy"])), "(b) all policies"),
    )
    for panel, policies, title in panels:
        for policy in policies:
            curve = tails[tails["policy"] == policy]
            look = _look(str(policy), scenario)
            delay_ms = 1e3 * curve["delay_s"]
            if panel is axes[0]:
                low, high = (np.maximum(curve[f"share_{e}"], TAIL_END / 10) for e in ("lo", "hi"))
                panel.fill_between(delay_ms, low, high, color=look.color, alpha=0.15, linewidth=0)
            share = curve["share"].where(curve["share"] > 0.0)
            panel.plot(delay_ms, share, color=look.color, linestyle=look.dashes, label=look.label)
        panel.axvline(1e3 * scenario.traffic.deadline_s, color="black", linewidth=0.9, zorder=1)
        panel.axhline(1.0 - scenario.traffic.reliability, color=GREY, linewidth=0.9, zorder=1)
        panel.set_yscale("log")
        panel.set_ylim(TAIL_END, 1.3)
        panel.set_xlim(0.0, float(1e3 * tails["delay_s"].max()))
        panel.set_title(f"{title}: delay of delivered URLLC packets")
        panel.set_xlabel("delay [ms]")
    axes[0].set_ylabel("share of packets that took longer [1]")
    shared_legend(figure, axes[1], columns=6)
    caption(
        figure,
        f"Mean over {len(scenario.evaluate.seeds)} worlds, world i under the learned policy of "
        "training seed i; bands in (a): Student t 95 % interval. "
        f"Black: deadline; grey: 1 − χ. Packets that still wait at the end do not count. A curve "
        f"that ends has no slower packet; shares below {TAIL_END:g} are not shown.",
    )
    return figure


def draw_pareto(policies: pd.DataFrame, scenario: Scenario) -> Figure:
    """Draw every policy by its eMBB rate and its URLLC violations, and its tracking error."""
    figure, axes = new_figure(height_in=1.15 * PANEL_HEIGHT_IN)
    late, rate = "urllc_late_share", "embb_rate_mbps"
    floor = zero_floor(policies[[late, f"{late}_hi"]])
    for line in policies.to_dict("records"):
        look = _look(str(line["policy"]), scenario)
        for panel, measure in zip(axes, (late, "tracking_error_cm"), strict=True):
            low = floor if measure == late else -np.inf
            at, down, up = (max(float(line[f"{measure}{e}"]), low) for e in ("", "_lo", "_hi"))
            if up == np.inf:
                unbounded_bar(panel, at, float(line[rate]), look, which="x")
                up = at
            panel.errorbar(
                [at],
                [line[rate]],
                xerr=[[at - down], [up - at]],
                yerr=[[line[rate] - line[f"{rate}_lo"]], [line[f"{rate}_hi"] - line[rate]]],
                color=look.color,
                marker=look.marker,
                linestyle="none",
                elinewidth=0.9,
                markerfacecolor=look.color if line[measure] > 0.0 else "white",
                label=look.label,
            )
    for panel, measure in zip(axes, (late, "tracking_error_cm"), strict=True):
        front = pareto_front(policies, measure, rate)
        x = np.maximum(front[measure].to_numpy(np.float64), floor if measure == late else 0.0)
        panel.step(x, front[rate], where="post", color=GREY, linewidth=0.8, zorder=1)
        panel.set_ylabel("eMBB rate per user [Mbit/s]")
    drawn = policies[[late, f"{late}_hi"]].to_numpy(dtype=np.float64)
    log_axis_with_zero(axes[0], floor, np.minimum(drawn, 1.0), which="x")
    axes[0].set_title("(a) eMBB rate against URLLC violations")
    axes[0].set_xlabel("late share of due URLLC packets [1]")
    axes[1].set_title("(b) eMBB rate against tracking error")
    axes[1].set_xlabel("tracking error of the robots [cm]")
    shared_legend(figure, axes[0], columns=5)
    caption(
        figure,
        f"Means and 95 % intervals over {len(scenario.evaluate.seeds)} worlds, of learned policies "
        "also over training seeds. Up and "
        "left is better. Grey steps: the policies that no other beats in both means. Left of the "
        f"dotted line in (a): 0.{_open_marks(policies)}"
        f"{arrows_text(policies['tracking_error_cm_hi'])} Other axes do not start at 0.",
    )
    return figure


def pareto_front(policies: pd.DataFrame, less: str, more: str) -> pd.DataFrame:
    """Return the rows that no other beats: less of one measure is better, more of the other.

    Sorted by the first measure; of equal rows, the first.
    """
    ordered = policies.sort_values([less, more], ascending=[True, False], kind="stable")
    best = ordered[more].astype(float).cummax().shift(fill_value=-np.inf)
    return ordered[ordered[more] > best]


def draw_bound(bound: pd.DataFrame, scenario: Scenario) -> Figure:
    """Draw the distance of decisions from the exact optimum of their slots."""
    figure, axes = new_figure(height_in=1.25 * PANEL_HEIGHT_IN, sharey=True)
    own = bound[bound["decider"] == bound["states_of"]].sort_values("gap", ascending=False)
    names = list(own["states_of"])
    greedy = bound[bound["decider"] == "drift_plus_penalty"].set_index("states_of")
    shared = bound[bound["states_of"] == "drift_plus_penalty"].set_index("decider")
    floor = zero_floor(bound["gap"])
    looks = [_look(name, scenario) for name in names]
    greedy_look = Look("greedy drift-plus-penalty, asked in the same states", GREY, "none", "D")
    for row, (name, look) in enumerate(zip(names, looks, strict=True)):
        _draw_gap(axes[0], row, own.set_index("states_of").loc[name], look, floor)
        if name in greedy.index and name != "drift_plus_penalty":
            _draw_gap(axes[0], row - 0.3, greedy.loc[name], greedy_look, floor, hollow=True)
        if name in shared.index:
            _draw_gap(axes[1], row, shared.loc[name], look, floor)
    drawn = bound[["gap", "gap_hi"]].to_numpy(dtype=np.float64)
    for panel in axes:
        log_axis_with_zero(panel, floor, drawn, which="x")
        panel.set_xlabel("Lagrangian above the exact optimum [packets²]")
        panel.grid(visible=False, axis="y")
    axes[0].set_yticks(range(len(names)), [look.label for look in looks])
    axes[0].set_title("(a) in the states a policy gets into")
    axes[1].set_title("(b) all in the states of drift-plus-penalty")
    slots = scenario.bound.slots_per_log
    caption(
        figure,
        f"Mean over {slots} slots of each of {len(scenario.evaluate.seeds)} worlds; bars: Student "
        "t 95 % intervals over worlds, world i under the learned policy of training seed i, "
        "cut where they include 0. Small grey diamonds in (a): what "
        "the greedy rule would have lost in the same states. The optimum is a mixed-integer "
        f"programme; what its bound leaves open is at most {bound['uncertified'].max():.2g}.",
    )
    return figure


def _draw_gap(
    panel: Axes, row: float, line: Any, look: Look, floor: float, *, hollow: bool = False
) -> None:
    gap, low, high = (max(float(line[f"gap{end}"]), floor) for end in ("", "_lo", "_hi"))
    panel.errorbar(
        [gap],
        [row],
        xerr=[[gap - low], [high - gap]],
        color=look.color,
        marker=look.marker,
        markersize=3.0 if hollow else 5.0,
        markerfacecolor="white" if hollow else look.color,
        elinewidth=0.9,
    )


def draw_generalise(table: pd.DataFrame, scenario: Scenario) -> Figure:
    """Draw late share and backlog of policies in cells of other sizes, beside the schedulers."""
    cells = table[table["axis"] == "cell"]
    figure, axes = new_figure(height_in=1.1 * PANEL_HEIGHT_IN)
    values = list(dict.fromkeys(cells["value"]))
    policies = [str(policy) for policy in dict.fromkeys(cells["policy"])]
    late = "urllc_late_share"
    floor = zero_floor(cells[[late, f"{late}_hi"]])
    for number, policy in enumerate(policies):
        own = cells[cells["policy"] == policy].set_index("value").loc[values]
        x = np.arange(len(values)) + 0.11 * (number - 0.5 * (len(policies) - 1))
        look = _look(policy, scenario)._replace(dashes="none")
        for panel, measure, low in ((axes[0], late, floor), (axes[1], BACKLOG, None)):
            bounds = own[f"{measure}_lo"], own[f"{measure}_hi"]
            draw_series(panel, x, own[measure], *bounds, look, floor=low)
    drawn = cells[[late, f"{late}_hi"]].to_numpy(dtype=np.float64)
    log_axis_with_zero(axes[0], floor, np.minimum(drawn, 1.0))
    if (cells[BACKLOG] > 0.0).all():
        axes[1].set_yscale("log")
    for panel in axes:
        panel.set_xticks(range(len(values)), [_cell_label(value) for value in values])
        panel.set_xlabel("URLLC + eMBB users, PRBs")
    axes[0].set_title("(a) late URLLC packets")
    axes[0].set_ylabel("share of due packets [1]")
    axes[1].set_title("(b) mean square backlog")
    axes[1].set_ylabel("mean of ½ΣF² over slots [packets²]")
    shared_legend(figure, axes[0])
    users = scenario.users
    caption(
        figure,
        f"Mean and 95 % interval over {len(scenario.generalise.seeds)} worlds, of learned policies "
        "also over training seeds. The "
        f"learned policies were trained on {users.num_urllc} + {users.num_embb} users and "
        f"{scenario.radio.num_prb} PRBs and run unchanged. Below the dotted line in (a): "
        f"0.{_open_marks(cells)}{arrows_text(cells[f'{BACKLOG}_hi'])}",
    )
    return figure


def _cell_label(value: str) -> str:
    urllc, embb, prb = (part[1:] for part in value.split("_"))
    return f"{urllc} + {embb}\n{prb} PRBs"


def _look(policy: str, scenario: Scenario) -> Look:
    return policy_look(policy, scenario)


def _open_marks(table: pd.DataFrame) -> str:
    """Say what an open mark is, where there is one."""
    return " Open mark at 0: no late packet." if (table["urllc_late_share"] == 0.0).any() else ""
