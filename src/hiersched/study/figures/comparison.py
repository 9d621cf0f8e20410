"""Where policies stand: late packets and delays, along the load, against the exact optimum."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hiersched.experiments.points import BASELINE
from hiersched.policies.registry import Look
from hiersched.scenario import Scenario
from hiersched.study.claims.conditions import learners
from hiersched.study.figures import style
from hiersched.study.registry import axis_of, figure, has_bound, has_cells, learners_among, varies
from hiersched.study.study import Study
from hiersched.study.tables.policies import (
    BACKLOG,
    LOAD,
    along_axes,
    bound_table,
    generalisation_table,
    policy_rows,
)

LATE = "urllc_late_share"
LATE_BOUNDS = [LATE, f"{LATE}_hi"]
"""Columns of late shares that have to fit an axis."""

LOAD_PANELS = (
    (LATE, "late URLLC packets", "share of due packets [1]"),
    ("tracking_error_cm", "robots: RMS position error", "tracking error [cm]"),
    (BACKLOG, "mean square backlog", "mean of ½ΣF² over slots [packets²]"),
    ("embb_rate_mbps", "eMBB data rate", "rate per user [Mbit/s]"),
)
BESIDE = (BASELINE, "drift_plus_penalty")
"""Schedulers that are shown beside the learners."""


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
    table = _with_one_learner(along_axes(study, str(axis_of(scenario, LOAD))), scenario)
    figure, axes, arrows = _draw_load_panels(table, scenario, list(dict.fromkeys(table["policy"])))
    style.shared_legend(figure, axes[0], columns=6)
    style.caption(
        figure,
        f"Mean and 95 % interval over {len(scenario.sweeps.seeds)} worlds, of the learned policy "
        "also over training seeds; bars leave logarithmic axes, or end at 0 in (a), where they "
        "include 0. Grey line in (a): the share 1 − χ that is allowed; below the dotted line: "
        f"0.{_open_marks(table)}{arrows} The axes of (b) and (d) do not start at 0.",
    )
    return figure


@figure(
    "figX_learners",
    title="Every learner over the offered load, beside two schedulers; not in the paper.",
    reads=("runs",),
    when=varies(LOAD, learners_among),
)
def draw_learners(study: Study) -> Figure:
    """Draw every learner along the load, beside PF and drift-plus-penalty.

    They are set apart at each load: learners often lie on each other.
    """
    scenario = study.scenario
    table = along_axes(study, str(axis_of(scenario, LOAD)))
    there = set(table["policy"])
    policies = [name for name in (*learners(scenario), *BESIDE) if name in there]
    table = table[table["policy"].isin(policies)]
    figure, axes, arrows = _draw_load_panels(table, scenario, policies, apart=0.09)
    style.shared_legend(figure, axes[0], columns=4)
    style.caption(
        figure,
        f"Mean and 95 % interval over {len(scenario.sweeps.seeds)} worlds, of learned policies "
        "also over training seeds. Grey line in (a): the share 1 − χ that is allowed; below the "
        f"dotted line: 0.{arrows} The axes of (b) and (d) do not start at 0.",
    )
    return figure


def _draw_load_panels(
    table: pd.DataFrame, scenario: Scenario, policies: list[str], *, apart: float = 0.0
) -> tuple[Figure, list[Axes], str]:
    """Draw the measures of `LOAD_PANELS` of policies along the load, joined or set apart.

    Returns figure, panels and, for the caption, what an arrow is.
    """
    figure, axes = style.new_figure(2, rows=2, height_in=2.15 * style.PANEL_HEIGHT_IN)
    loads = list(scenario.sweeps.axes[str(axis_of(scenario, LOAD))].vary[LOAD])
    allowed = 1.0 - scenario.traffic.reliability
    for panel, (measure, title, label), letter in zip(axes, LOAD_PANELS, "abcd", strict=True):
        floor = style.zero_floor(table[LATE_BOUNDS]) if measure == LATE else None
        for number, policy in enumerate(policies):
            own, look = table[table["policy"] == policy], style.policy_look(policy, scenario)
            x: Any = own["value"].astype(float)
            if apart:
                look = look._replace(dashes="none")
                x = np.arange(len(loads)) + apart * (number - 0.5 * (len(policies) - 1))
            style.draw_series(panel, x, own, measure, look, floor=floor)
        if floor is not None:
            fits = np.append(table[LATE_BOUNDS], [] if apart else allowed)
            style.log_axis_with_zero(panel, floor, fits)
            panel.axhline(allowed, color=style.GREY, linewidth=0.9)
        elif _spans_decades(table, measure):
            panel.set_yscale("log")
        if apart:
            panel.set_xticks(range(len(loads)), [f"{load:g}" for load in loads])
        else:
            panel.set_xticks(loads)
        xlabel = "offered load, relative to the nominal loads [1]"
        panel.set(title=f"({letter}) {title}", ylabel=label, xlabel=xlabel)
    bounds = table[[f"{measure}_hi" for measure, *_ in LOAD_PANELS]]
    return figure, axes, style.arrows_text(bounds)


def _spans_decades(table: pd.DataFrame, measure: str) -> bool:
    """Whether a positive measure or its finite bounds span more than a factor of ten."""
    drawn = table[[measure, f"{measure}_lo", f"{measure}_hi"]].to_numpy(dtype=np.float64)
    finite = drawn[np.isfinite(drawn)]
    return bool((drawn > 0.0).all() and finite.max() > 10.0 * finite.min())


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

    Of the learners the first, the scenario's own where it runs: the others would hide it. It ends
    where packets are too few to show.
    """
    scenario, bottom = study.scenario, 1e-4
    tails = _with_one_learner(delay_tails(study), scenario)
    figure, axes = style.new_figure(height_in=1.15 * style.PANEL_HEIGHT_IN, sharey=True)
    every = list(dict.fromkeys(tails["policy"]))
    chosen = [name for name in every if name in shown_policies(scenario)]
    _draw_tails(axes[0], tails, chosen, scenario, bottom)
    _draw_tails(axes[1], tails, every, scenario, bottom, alpha=0.0)
    for panel, title in zip(axes, ("(a) compared", "(b) all policies"), strict=True):
        panel.axvline(1e3 * scenario.traffic.deadline_s, color="black", linewidth=0.9, zorder=1)
        panel.axhline(1.0 - scenario.traffic.reliability, color=style.GREY, linewidth=0.9, zorder=1)
        panel.set_title(f"{title}: delay of delivered URLLC packets")
    axes[0].set_ylabel("share of packets that took longer [1]")
    style.shared_legend(figure, axes[1], columns=6)
    style.caption(
        figure,
        f"Mean over {len(scenario.evaluate.seeds)} worlds, world i under the learned policy of "
        "training seed i; bands in (a): Student t 95 % interval. "
        f"Black: deadline; grey: 1 − χ. Packets that still wait at the end do not count. A curve "
        f"that ends has no slower packet; shares below {bottom:g} are not shown.",
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
    scenario, policies = study.scenario, policy_rows(study)
    figure, axes = style.new_figure(height_in=1.15 * style.PANEL_HEIGHT_IN)
    rate, floor = "embb_rate_mbps", style.zero_floor(policies[LATE_BOUNDS])
    floors = {LATE: floor, "tracking_error_cm": -np.inf}
    for row in policies.to_dict("records"):
        look = style.policy_look(str(row["policy"]), scenario)
        up_and_down = [[row[rate] - row[f"{rate}_lo"]], [row[f"{rate}_hi"] - row[rate]]]
        drawn = {"yerr": up_and_down, "linestyle": "none", "elinewidth": 0.9, "label": look.label}
        for panel, (measure, low) in zip(axes, floors.items(), strict=True):
            hollow = not row[measure] > 0.0
            style.draw_mark(panel, row, measure, row[rate], look, floor=low, hollow=hollow, **drawn)
    for panel, (measure, low) in zip(axes, floors.items(), strict=True):
        front = pareto_front(policies, measure, rate)
        x = front[measure].astype(float).clip(lower=max(low, 0.0))
        panel.step(x, front[rate], where="post", color=style.GREY, linewidth=0.8, zorder=1)
        panel.set_ylabel("eMBB rate per user [Mbit/s]")
    style.log_axis_with_zero(axes[0], floor, policies[LATE_BOUNDS], which="x")
    axes[0].set_title("(a) eMBB rate against URLLC violations")
    axes[0].set_xlabel("late share of due URLLC packets [1]")
    axes[1].set_title("(b) eMBB rate against tracking error")
    axes[1].set_xlabel("tracking error of the robots [cm]")
    style.shared_legend(figure, axes[0], columns=5)
    style.caption(
        figure,
        f"Means and 95 % intervals over {len(scenario.evaluate.seeds)} worlds, of learned policies "
        "also over training seeds. Up and "
        "left is better. Grey steps: the policies that no other beats in both means. Left of the "
        f"dotted line in (a): 0.{_open_marks(policies)}"
        f"{style.arrows_text(policies['tracking_error_cm_hi'])} Other axes do not start at 0.",
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
    figure, axes = style.new_figure(height_in=1.25 * style.PANEL_HEIGHT_IN, sharey=True)
    by_decider = bound.set_index(["states_of", "decider"], drop=False)
    own = bound[bound["decider"] == bound["states_of"]].sort_values("gap", ascending=False)
    looks = [style.policy_look(name, scenario) for name in own["states_of"]]
    greedy, greedy_look = "drift_plus_penalty", Look("", style.GREY, "none", "D")
    floor = style.zero_floor(bound["gap"])

    def mark(panel: Axes, asked: tuple[str, str], y: float, look: Look, hollow: bool) -> None:
        if asked in by_decider.index:
            row, size = by_decider.loc[asked], 3.0 if hollow else 5.0
            drawn: dict[str, Any] = {"markersize": size, "elinewidth": 0.9}
            style.draw_mark(panel, row, "gap", y, look, floor=floor, hollow=hollow, **drawn)

    for row, (name, look) in enumerate(zip(own["states_of"], looks, strict=True)):
        mark(axes[0], (name, name), row, look, hollow=False)
        if name != greedy:
            mark(axes[0], (name, greedy), row - 0.3, greedy_look, hollow=True)
        mark(axes[1], (greedy, name), row, look, hollow=False)
    for panel in axes:
        style.log_axis_with_zero(panel, floor, bound[["gap", "gap_hi"]], which="x")
        panel.set_xlabel("Lagrangian above the exact optimum [packets²]")
        panel.grid(visible=False, axis="y")
    axes[0].set_yticks(range(len(looks)), [look.label for look in looks])
    axes[0].set_title("(a) in the states a policy gets into")
    axes[1].set_title("(b) all in the states of drift-plus-penalty")
    style.caption(
        figure,
        f"Mean over {scenario.bound.slots_per_log} slots of each of {len(scenario.evaluate.seeds)} "
        "worlds; bars: Student t 95 % intervals over worlds, world i under the learned policy of "
        "training seed i, cut where they include 0. Small grey diamonds in (a): what the greedy "
        "rule would have lost in the same states. The optimum is a mixed-integer programme; what "
        f"its bound leaves open is at most {bound['uncertified'].max():.2g}.",
    )
    return figure


def shown_policies(scenario: Scenario) -> list[str]:
    """Return the evaluated policies that the sweeps compare, and EDF as the reference."""
    shown = [p for p in scenario.sweeps.policies if p in scenario.evaluate.policies]
    return shown + [p for p in scenario.evaluate.policies if p == "edf" and p not in shown]


def delay_tails(study: Study) -> pd.DataFrame:
    """Return the share of delivered URLLC packets that took longer than a time, by policy.

    Columns are policy, delay_s and share (_lo, _hi) over worlds; of a learned policy each world is
    under another of its policies.
    """
    delays = study.measures("delays")
    frames = []
    for policy in study.scenario.evaluate.policies:
        own = delays[delays["policy"] == policy]
        shares = own.pivot(index="delay_s", columns="seed", values="share").sort_index()
        intervals = style.share_intervals(shares.to_numpy())
        frames.append(intervals.assign(policy=policy, delay_s=shares.index))
    return pd.concat(frames, ignore_index=True)


@figure(
    "figX_generalise",
    title="Policies in cells of other sizes: the learned ones run unchanged.",
    reads=("runs", "growth"),
    when=has_cells,
)
def draw_generalise(study: Study) -> Figure:
    """Draw late share and backlog of policies in cells of other sizes, beside the schedulers."""
    scenario, table = study.scenario, generalisation_table(study)
    cells = table[table["axis"] == "cell"]
    figure, axes = style.new_figure(height_in=1.1 * style.PANEL_HEIGHT_IN)
    values = list(dict.fromkeys(cells["value"]))
    policies = list(dict.fromkeys(cells["policy"]))
    floor = style.zero_floor(cells[LATE_BOUNDS])
    for number, policy in enumerate(policies):
        own = cells[cells["policy"] == policy].set_index("value").loc[values]
        x = np.arange(len(values)) + 0.11 * (number - 0.5 * (len(policies) - 1))
        look = style.policy_look(policy, scenario)._replace(dashes="none")
        style.draw_series(axes[0], x, own, LATE, look, floor=floor)
        style.draw_series(axes[1], x, own, BACKLOG, look)
    style.log_axis_with_zero(axes[0], floor, cells[LATE_BOUNDS])
    if (cells[BACKLOG] > 0.0).all():
        axes[1].set_yscale("log")
    for panel in axes:
        panel.set_xticks(range(len(values)), [_cell_label(value) for value in values])
        panel.set_xlabel("URLLC + eMBB users, PRBs")
    axes[0].set(title="(a) late URLLC packets", ylabel="share of due packets [1]")
    axes[1].set(title="(b) mean square backlog", ylabel="mean of ½ΣF² over slots [packets²]")
    style.shared_legend(figure, axes[0])
    users = scenario.users
    style.caption(
        figure,
        f"Mean and 95 % interval over {len(scenario.generalise.seeds)} worlds, of learned policies "
        f"also over training seeds. The learned policies were trained on {users.num_urllc} + "
        f"{users.num_embb} users and {scenario.radio.num_prb} PRBs and run unchanged. Below the "
        f"dotted line in (a): 0.{_open_marks(cells)}{style.arrows_text(cells[f'{BACKLOG}_hi'])}",
    )
    return figure


def _cell_label(value: str) -> str:
    urllc, embb, prb = (part[1:] for part in value.split("_"))
    return f"{urllc} + {embb}\n{prb} PRBs"


def _open_marks(table: pd.DataFrame) -> str:
    """Say what an open mark is, where there is one."""
    return " Open mark at 0: no late packet." if (table[LATE] == 0.0).any() else ""


@figure(
    "fig8_violations",
    title="Fig. 8: violations of the delay constraint, learned policy and schedulers.",
    reads=("runs", "delays"),
)
def draw_violations(study: Study) -> Figure:
    """Draw the late share of URLLC packets by policy, and the tail of their delays."""
    scenario, policies, tails = study.scenario, policy_rows(study), delay_tails(study)
    figure, (left, right) = style.new_figure(
        height_in=1.3 * style.PANEL_HEIGHT_IN, width_ratios=[1.15, 1.0]
    )
    _draw_shares(left, policies, study.evaluation, scenario)
    bottom = 1e-5
    _draw_tails(right, tails, shown_policies(scenario), scenario, bottom)
    traffic, seeds = scenario.traffic, len(scenario.evaluate.seeds)
    deadline_ms, allowed = 1e3 * traffic.deadline_s, 1.0 - traffic.reliability
    # A curve that meets deadline and allowed share passes below the corner.
    corner = [0.0, deadline_ms, deadline_ms], [allowed, allowed, bottom]
    right.plot(*corner, color="black", linewidth=1.0, zorder=1.5)
    right.set_title("(b) delay of delivered URLLC packets")
    right.set_ylabel("share of packets that took longer [1]")
    style.shared_legend(figure, right, side="right")
    style.caption(
        figure,
        "Large marks: means; dots: single runs, of learned policies each in every world; bars: 95 "
        f"% intervals over {seeds} worlds and over policies; bands: over worlds, world i under the "
        "learned policy of training seed i; cut at the axis where they include 0. Left of the "
        f"dotted line in (a): 0, which has no place on a logarithmic axis.{_open_marks(policies)} "
        f"Corner in (b): 1 − χ = {_percent(allowed)} at the deadline of {deadline_ms:g} ms.",
    )
    return figure


def _draw_shares(
    panel: Axes, policies: pd.DataFrame, runs: pd.DataFrame, scenario: Scenario
) -> None:
    """One row a policy, the most late packets at the bottom."""
    table = policies.sort_values(LATE, ascending=False, kind="stable")
    floor = style.zero_floor(np.append(runs[LATE], policies[f"{LATE}_hi"]))
    looks = {name: style.policy_look(name, scenario) for name in table["policy"]}
    for y, row in enumerate(table.to_dict("records")):
        hollow = not row[LATE] > 0.0
        drawn = {"markersize": 5.5, "zorder": 3}
        style.draw_mark(
            panel, row, LATE, y, looks[row["policy"]], floor=floor, hollow=hollow, **drawn
        )
        own = runs.loc[runs["policy"] == row["policy"], LATE].to_numpy()
        dots: dict[str, Any] = {"linestyle": "none", "marker": ".", "markersize": 3.0, "zorder": 2}
        panel.plot(np.maximum(own, floor), np.full(len(own), y) + 0.36, color=style.GREY, **dots)
    names = [look.label for look in looks.values()]
    panel.set_yticks(range(len(table) + 1), [*names, "allowed at χ [%] ="])
    panel.tick_params(axis="y", length=0)
    panel.set_ylim(-0.6, len(table) + 0.5)
    panel.grid(visible=False, axis="y")
    fits = np.append(table[LATE_BOUNDS], 1.0 - scenario.traffic.reliability)
    style.log_axis_with_zero(panel, floor, fits, which="x")
    _draw_levels(panel, scenario, len(table))
    shares = policies.set_index("policy")[LATE]
    named = [name for name in (scenario.learning.algorithm, BASELINE) if name in looks]
    seen = ", ".join(f"{looks[name].label.split()[0]} {_percent(shares[name])}" for name in named)
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
            color="black" if own else style.GREY,
            linewidth=1.0 if own else 0.6,
            linestyle="-" if own else (0, (5, 3)),
            zorder=1,
        )
        white = {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 0.8}
        at: dict[str, Any] = {"ha": "center", "va": "center", "zorder": 5, "bbox": white}
        panel.annotate(f"{100.0 * level:g}", (1.0 - level, row), fontsize=7, **at)


def _draw_tails(
    panel: Axes,
    tails: pd.DataFrame,
    policies: Iterable[str],
    scenario: Scenario,
    bottom: float,
    **band: float,
) -> None:
    """Draw distributions of delay, from `bottom` to all packets, of some policies."""
    for policy in policies:
        own = tails[tails["policy"] == policy]
        curve = own.assign(share=own["share"].where(own["share"] > 0.0))
        look, cut = style.policy_look(policy, scenario), (bottom / 10, np.inf)
        style.draw_curve(panel, 1e3 * curve["delay_s"], curve, "share", look, cut=cut, **band)
    panel.set(yscale="log", ylim=(bottom, 1.3), xlabel="delay [ms]")
    panel.set_xlim(0.0, float(1e3 * tails["delay_s"].max()))


def _percent(share: float) -> str:
    return f"{float(f'{100.0 * share:.2g}') if share < 0.5 else 100.0 * share:g} %"
