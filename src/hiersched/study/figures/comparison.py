"""Where policies stand: late packets and delays, along the load, against the exact optimum."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hiersched.experiments.points import BASELINE
from hiersched.policies.registry import Look
from hiersched.scenario import Scenario
from hiersched.study.figures.style import (
    GREY,
    PANEL_HEIGHT_IN,
    arrows_text,
    caption,
    draw_series,
    log_axis_with_zero,
    new_figure,
    note_at,
    policy_look,
    share_intervals,
    shared_legend,
    unbounded_bar,
    zero_floor,
)
from hiersched.study.registry import axis_of, figure, has_bound, has_cells, varies
from hiersched.study.study import Study
from hiersched.study.tables.policies import (
    BACKLOG,
    LOAD,
    along_axes,
    bound_table,
    generalisation_table,
    policy_table,
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


@figure(
    "figX_load",
    title="Violations and tracking error over the offered load; not in the paper.",
    reads=("runs",),
    when=varies(LOAD),
)
def draw_load(study: Study) -> Figure:
    """Draw late share, tracking error, backlog and eMBB rate of policies against the load.

    Of the learners the first, the scenario's own where it runs; `draw_learners` has the others.
    """
    scenario = study.scenario
    name = str(axis_of(scenario, LOAD))
    table = _with_one_learner(along_axes(study, name), scenario)
    figure = Figure(figsize=(7.2, 2.15 * PANEL_HEIGHT_IN), layout="constrained")
    axes = [axis for row in figure.subplots(2, 2, squeeze=False) for axis in row]
    policies = [str(policy) for policy in dict.fromkeys(table["policy"])]
    loads = list(scenario.sweeps.axes[name].vary[LOAD])
    for panel, (measure, title, label), letter in zip(axes, LOAD_PANELS, "abcd", strict=True):
        floor = (
            zero_floor(table[[measure, f"{measure}_hi"]]) if measure == "urllc_late_share" else None
        )
        for policy in policies:
            own = table[table["policy"] == policy]
            bounds = own[f"{measure}_lo"], own[f"{measure}_hi"]
            x = own["value"].astype(float)
            draw_series(panel, x, own[measure], *bounds, policy_look(policy, scenario), floor=floor)
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


def _with_one_learner(table: pd.DataFrame, scenario: Scenario) -> pd.DataFrame:
    """Return the rows of all policies but the learners behind the first of them."""
    there = set(table["policy"])
    found = [name for name in scenario.learned if name in there]
    return table[~table["policy"].isin(found[1:])]


@figure(
    "figX_delay",
    title="Complementary distribution of the delay of delivered URLLC packets, all policies.",
    reads=("delays",),
)
def draw_delay(study: Study) -> Figure:
    """Draw the complementary distribution of URLLC delays: main policies left, all right.

    Of the learners the first, the scenario's own where it runs: the others would hide it.
    """
    scenario = study.scenario
    tails = _with_one_learner(delay_tails(study), scenario)
    figure, axes = new_figure(height_in=1.15 * PANEL_HEIGHT_IN, sharey=True)
    chosen = shown_policies(scenario)
    panels = (
        (axes[0], [p for p in dict.fromkeys(tails["policy"]) if p in chosen], "(a) compared"),
        (axes[1], list(dict.fromkeys(tails["policy"])), "(b) all policies"),
    )
    for panel, policies, title in panels:
        for policy in policies:
            curve = tails[tails["policy"] == policy]
            look = policy_look(str(policy), scenario)
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


@figure(
    "figX_pareto",
    title="eMBB rate against URLLC violations, and against the tracking error of the robots: "
    "every policy, and those that no other beats in both.",
    reads=("runs",),
)
def draw_pareto(study: Study) -> Figure:
    """Draw every policy by its eMBB rate and its URLLC violations, and its tracking error."""
    scenario, policies = study.scenario, policy_table(study)
    figure, axes = new_figure(height_in=1.15 * PANEL_HEIGHT_IN)
    late, rate = "urllc_late_share", "embb_rate_mbps"
    floor = zero_floor(policies[[late, f"{late}_hi"]])
    for line in policies.to_dict("records"):
        look = policy_look(str(line["policy"]), scenario)
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


@figure(
    "figX_bound",
    title="Distance of decisions from the exact optimum of the drift-plus-penalty Lagrangian in "
    "sampled slots.",
    reads=("bound",),
    when=has_bound,
)
def draw_bound(study: Study) -> Figure:
    """Draw the distance of decisions from the exact optimum of their slots."""
    scenario, bound = study.scenario, bound_table(study)
    figure, axes = new_figure(height_in=1.25 * PANEL_HEIGHT_IN, sharey=True)
    own = bound[bound["decider"] == bound["states_of"]].sort_values("gap", ascending=False)
    names = list(own["states_of"])
    greedy = bound[bound["decider"] == "drift_plus_penalty"].set_index("states_of")
    shared = bound[bound["states_of"] == "drift_plus_penalty"].set_index("decider")
    floor = zero_floor(bound["gap"])
    looks = [policy_look(name, scenario) for name in names]
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


def shown_policies(scenario: Scenario) -> list[str]:
    """Return the evaluated policies that the sweeps compare, and EDF as the reference."""
    shown = [p for p in scenario.sweeps.policies if p in scenario.evaluate.policies]
    return shown + [p for p in scenario.evaluate.policies if p == "edf" and p not in shown]


def delay_tails(study: Study) -> pd.DataFrame:
    """Return the share of delivered URLLC packets that took longer than a time, by policy.

    Returns
    -------
    DataFrame
        Columns policy, delay_s and share, share_lo, share_hi over worlds; of a learned policy each
        world under another of its policies.
    """
    delays = study.measures("delays")
    frames = []
    for policy in study.scenario.evaluate.policies:
        own = delays[delays["policy"] == policy]
        shares = own.pivot(index="delay_s", columns="seed", values="share").sort_index()
        labels = {"policy": policy, "delay_s": shares.index}
        frames.append(pd.DataFrame({**labels, **share_intervals(shares.to_numpy())}))
    return pd.concat(frames, ignore_index=True)


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


@figure(
    "figX_generalise",
    title="Policies in cells of other sizes: the learned ones run unchanged.",
    reads=("runs",),
    when=has_cells,
)
def draw_generalise(study: Study) -> Figure:
    """Draw late share and backlog of policies in cells of other sizes, beside the schedulers."""
    scenario, table = study.scenario, generalisation_table(study)
    cells = table[table["axis"] == "cell"]
    figure, axes = new_figure(height_in=1.1 * PANEL_HEIGHT_IN)
    values = list(dict.fromkeys(cells["value"]))
    policies = [str(policy) for policy in dict.fromkeys(cells["policy"])]
    late = "urllc_late_share"
    floor = zero_floor(cells[[late, f"{late}_hi"]])
    for number, policy in enumerate(policies):
        own = cells[cells["policy"] == policy].set_index("value").loc[values]
        x = np.arange(len(values)) + 0.11 * (number - 0.5 * (len(policies) - 1))
        look = policy_look(policy, scenario)._replace(dashes="none")
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


def _open_marks(table: pd.DataFrame) -> str:
    """Say what an open mark is, where there is one."""
    return " Open mark at 0: no late packet." if (table["urllc_late_share"] == 0.0).any() else ""


@figure(
    "fig8_violations",
    title="Fig. 8: violations of the delay constraint, learned policy and schedulers.",
    reads=("runs", "delays"),
)
def draw_violations(study: Study) -> Figure:
    """Draw the late share of URLLC packets by policy, and the tail of their delays."""
    scenario, policies, tails = study.scenario, policy_table(study), delay_tails(study)
    runs = study.evaluation
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
    for policy in shown_policies(scenario):
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
