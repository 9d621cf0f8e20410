"""The study of the task: curves over knobs, gains along the load, one world as traces."""

from __future__ import annotations

from itertools import cycle
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hiersched.experiments.points import REFERENCE, TASK, experiments
from hiersched.policies.registry import RULES, Look
from hiersched.scenario import Scenario
from hiersched.study.figures import style
from hiersched.study.registry import figure, has_pareto, has_task_learners, has_task_study
from hiersched.study.statistics import Interval
from hiersched.study.study import Study
from hiersched.study.tables.task import RATIOS, ratio_columns, task_learners, task_pareto
from hiersched.study.task import (
    RMS,
    best_blind,
    best_family,
    first_aware,
    keeps_limit,
    line_of,
    lines,
    load_of,
    mean_of,
    runs_of,
    task_learners_of,
)

MOVING_MPS = 0.05
"""Speed of a set-point above which its robot counts as moving."""
SMOOTHED_SLOTS = 20
LEAST_SHARE = 0.9
"""eMBB throughput over the reference's at which the panels of the curves end."""
_LINES = (
    Look("", "#000000", "-", "o"),
    Look("", "#0072B2", (0, (4, 1.5)), "s"),
    Look("", "#D55E00", (0, (1, 1.2)), "D"),
    Look("", "#009E73", (0, (6, 1.5, 1, 1.5)), "^"),
    Look("", "#CC79A7", (0, (3, 1, 1, 1)), "v"),
    Look("", "#A6761D", (0, (8, 2)), "P"),
    Look("", "#56B4E9", (0, (2, 1)), "X"),
)
_REFERENCE = Look("reference", "#000000", "none", "o")
_PANELS = (
    ("channel and traffic", ("radio", "traffic", "objective")),
    ("robots and operators", ("robot", "control")),
    ("superseding, video in time", ("robot.superseding", "bound_late")),
)
"""Titles of the panels of gains and the keys whose cells they show, the last that fits."""


def family_look(scenario: Scenario, policy: str) -> Look:
    """Return how a policy of a cell is drawn: a family as its rule."""
    families = scenario.task_study.families
    if policy not in families:
        return _REFERENCE if policy == REFERENCE else style.policy_look(policy, scenario)
    model = families[policy].policy.model
    look: Look = RULES[model].look  # type: ignore[attr-defined]
    first = next(name for name, family in families.items() if family.policy.model == model)
    return look if policy == first else look._replace(label=policy.replace("_", " "))


@figure(
    "figX_task_pareto",
    title="eMBB throughput against tracking error, one curve a family over its knob; not in the "
    "paper.",
    reads=("task", "tunings", "growth"),
    when=has_pareto,
)
def draw_pareto(study: Study) -> Figure:
    """Draw a panel a cell with curves: throughput over the reference's, error on a log axis.

    Tuned knobs are filled marks; what has no knob, and learners, are marks alone.
    """
    table, scenario = task_pareto(study), study.scenario
    cells = list(dict.fromkeys(table["cell"]))
    columns = min(3, len(cells))
    rows = -(-len(cells) // columns)
    figure, axes = style.new_figure(columns, rows=rows, height_in=0.9 + 2.6 * rows)
    limit = scenario.task_study.embb_share
    loads = {cell: load_of(scenario, cell) for cell in cells}
    is_by_load = len(set(loads.values())) == len(cells)
    for panel, cell in zip(axes, cells, strict=False):
        own = table[table["cell"] == cell]
        for policy in dict.fromkeys(own["policy"]):
            _draw_curve(panel, own[own["policy"] == policy], family_look(scenario, policy))
        panel.axvline(100.0 * limit, color=style.GREY, linewidth=0.9)
        panel.set_yscale("log")
        panel.set_title(f"load {loads[cell]:g}" if is_by_load else cell.replace("_", " "))
        panel.set_xlabel("eMBB throughput [% of reference]")
        shares = 100.0 * own["embb_share"]
        low = max(100.0 * LEAST_SHARE, float(shares.min()))
        panel.set_xlim(low - 0.4, float(shares.max()) + 0.4)
        shown = own[own["embb_share"] >= LEAST_SHARE][RMS]
        panel.set_ylim(0.9 * shown.min(), 1.15 * shown.max())
        _plain_log_ticks(panel)
    for panel in axes[len(cells) :]:
        panel.set_visible(False)
    for panel in axes[::columns]:
        panel.set_ylabel("RMS tracking error [cm]")
    style.shared_legend(figure, axes[0], columns=5)
    style.caption(
        figure,
        f"Means over {len(scenario.task_study.seeds)} held-out worlds. Reference: "
        "drift-plus-penalty with knob 1. Filled marks: knobs chosen in design worlds, at a limit "
        f"of {100.0 * limit:g} % (grey line) there. Points below "
        f"{100.0 * LEAST_SHARE:g} % are left out.",
    )
    return figure


def _draw_curve(panel: Axes, own: pd.DataFrame, look: Look) -> None:
    """Draw the rows of one policy in a cell."""
    over = own[~own["tuned"]].sort_values("knob")
    panel.plot(
        100.0 * over["embb_share"], over[RMS], color=look.color, linestyle=look.dashes, lw=1.0
    )
    panel.plot(
        100.0 * own[own["tuned"]]["embb_share"],
        own[own["tuned"]][RMS],
        color=look.color,
        linestyle=look.dashes if len(over) else "none",
        marker=look.marker,
        markersize=5.5,
        label=look.label,
    )


def _plain_log_ticks(panel: Axes) -> None:
    """Label a logarithmic axis of y at 1, 2, 3 and 5 times powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    panel.yaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.yaxis.set_minor_locator(NullLocator())


@figure(
    "figX_task_gain",
    title="What knowing the task changes along the load; not in the paper.",
    reads=("task", "tunings"),
    when=has_task_study,
)
def draw_gain(study: Study) -> Figure:
    """Draw the change of RMS and 99 % error by the first family that knows the task.

    Lines are cells that differ in their loads alone; the panels are by what sets them apart.
    """
    scenario = study.scenario
    panels = _panels(scenario)
    figure, axes = style.new_figure(len(panels), rows=2, height_in=5.6, sharey="row")
    for column, (title, own) in enumerate(panels):
        for row, short in enumerate(RATIOS):
            panel = axes[row * len(panels) + column]
            for look, (name, cells) in zip(cycle(_LINES), own.items(), strict=False):
                _draw_line(study, panel, cells, short, look._replace(label=name))
            panel.axhline(0.0, color=style.GREY, linewidth=0.9)
            if row == 0:
                panel.set_title(f"({'abc'[column]}) {title}")
                panel.legend(fontsize=6.5, loc="lower left")
            else:
                panel.set_xlabel("offered load [1]")
    axes[0].set_ylabel("RMS error, change [%]")
    axes[len(panels)].set_ylabel("99 % quantile of error, change [%]")
    first = (first_aware(scenario, cell) for cell in scenario.task_study.cells)
    aware = " or ".join(dict.fromkeys(name for name in first if name is not None))
    style.caption(
        figure,
        f"Change by {aware} against the best family that knows nothing of the task, both with "
        "knobs from design worlds at equal eMBB throughput: typical ratio, 95 % interval over "
        f"{len(scenario.task_study.seeds)} held-out worlds. The names are those of the cells.",
    )
    return figure


def _panels(scenario: Scenario) -> list[tuple[str, dict[str, list[str]]]]:
    """Return titles and lines of the panels that have any; the scenario's own line is in all."""
    plain: dict[str, list[str]] = {}
    found: list[dict[str, list[str]]] = [{} for _ in _PANELS]
    for name, cells in lines(scenario).items():
        is_bounded = scenario.task_study.cells[cells[0]].bound_late
        keys = [*line_of(scenario, cells[0]), *(["bound_late"] if is_bounded else [])]
        fits = [
            number
            for number, (_, parts) in enumerate(_PANELS)
            if any(key in parts or key.partition(".")[0] in parts for key in keys)
        ]
        if fits:
            found[fits[-1]][name.replace("_", " ")] = cells
        elif not keys:
            plain["as configured"] = cells
    shown = [
        (title, {**plain, **own}) for (title, _), own in zip(_PANELS, found, strict=True) if own
    ]
    return shown or [("load", plain)]


def _draw_line(study: Study, panel: Axes, cells: list[str], short: str, look: Look) -> None:
    """Draw the change of one measure over the loads of some cells, where it can be told."""
    rows = []
    for cell in cells:
        aware, blind = first_aware(study.scenario, cell), best_blind(study, cell)
        if aware is None or blind is None or not keeps_limit(study, cell, aware):
            continue
        columns = ratio_columns(study, cell, aware, blind, "blind")
        ratio = Interval(*(columns[f"{short}_over_blind{end}"] for end in ("", "_lo", "_hi")))
        change = Interval(*(100.0 * (value - 1.0) for value in ratio))
        rows.append({"load": load_of(study.scenario, cell), **change.columns("change")})
    if rows:
        frame = pd.DataFrame(rows)
        style.draw_series(panel, frame["load"], frame, "change", look)


@figure(
    "figX_task_learners",
    title="What learning adds to the best rule that knows the task; not in the paper.",
    reads=("task", "tunings", "growth"),
    when=has_task_learners,
)
def draw_learners(study: Study) -> Figure:
    """Draw every learner against the best rule that knows the task, a row a cell.

    Change of RMS and of 99 % error, and late video packets beside those of the rule.
    """
    table, scenario = task_learners(study), study.scenario
    cells, learners = list(scenario.task_study.cells), task_learners_of(scenario)
    figure, axes = style.new_figure(3, height_in=1.2 + 0.42 * len(cells), sharey=True)
    for place, learner in enumerate(learners):
        own = table[table["policy"] == learner].to_dict("records")
        look = style.policy_look(learner, scenario)
        for height, row in enumerate(own):
            y = height + 0.22 * (place - 0.5 * (len(learners) - 1))
            for panel, short in zip(axes, RATIOS, strict=False):
                ends = {end: row[f"{short}_over_aware{end}"] for end in ("", "_lo", "_hi")}
                change = {f"change{end}": 100.0 * (value - 1.0) for end, value in ends.items()}
                label = look.label if height == 0 else None
                style.draw_mark(panel, change, "change", y, look, markersize=4, label=label)
            axes[2].plot(
                100.0 * row["embb_late_share"], y, color=look.color, marker=look.marker, ms=4
            )
    for height, cell in enumerate(cells):
        rule = best_family(study, cell, ("control-aware",))
        if rule is not None:
            late = 100.0 * mean_of(runs_of(study, cell, rule), "embb_late_share")
            label = "best rule that knows the task" if height == 0 else None
            axes[2].plot(late, height, color="black", marker="|", ms=9, ls="none", label=label)
    for panel, text in zip(axes, ("RMS error", "99 % quantile of error"), strict=False):
        panel.axvline(0.0, color="black", linewidth=0.9)
        panel.set_xlabel(f"{text}, change [%]")
    axes[2].set_xlabel("late eMBB packets [%]")
    axes[0].set_yticks(range(len(cells)), [cell.replace("_", " ") for cell in cells])
    axes[0].set_ylim(len(cells) - 0.5, -0.5)
    axes[2].set_xlim(left=-0.5, right=max(10.0, axes[2].get_xlim()[1]))
    style.shared_legend(figure, axes[0], axes[2])
    counts = sorted({len(scenario.learned[name].seeds) for name in learners})
    style.caption(
        figure,
        f"Against the best rule that knows the task in each cell, at its tuned knob: typical "
        f"ratio, 95 % interval over {' or '.join(map(str, counts))} training seeds and "
        f"{len(scenario.task_study.seeds)} held-out worlds. Trained at load "
        f"{scenario.traffic.load:g}, run as they are everywhere.",
    )
    return figure


@figure(
    "figX_task_traces",
    title="One world under the best classical rule and the best rule that knows the task; not in "
    "the paper.",
    reads=("traces", "tunings"),
    when=has_pareto,
)
def draw_traces(study: Study) -> Figure:
    """Draw the robot that moves most and who has the PRBs, a column a rule."""
    scenario = study.scenario
    cell = [name for name, own in scenario.task_study.cells.items() if own.pareto][-1]
    traces = study.measures("traces")
    traces = traces[traces["cell"] == cell]
    policies = [best_family(study, cell, (kind,)) for kind in ("classical", "control-aware")]
    shown = [policy for policy in policies if policy is not None]
    point = experiments(scenario)[f"{TASK}_{cell}"].points[0].scenario
    figure, axes = style.new_figure(
        max(1, len(shown)), rows=4, height_in=6.4, sharex=True, sharey="row"
    )
    for column, policy in enumerate(shown):
        own = traces[traces["policy"] == policy]
        panels = axes[column :: len(shown)]
        _draw_trace(panels, own, point)
        panels[0].set_title(f"({'ab'[column]}) {family_look(scenario, policy).label}")
    labels = ("set-point\nspeed [m/s]", "wait [ms]", "error [cm]", "PRBs")
    for label, panel in zip(labels, axes[:: max(1, len(shown))], strict=True):
        panel.set_ylabel(label)
    style.shared_legend(figure, axes[-1])
    style.caption(
        figure,
        f"First held-out world of the cell {cell}. Speed, wait of the oldest packet and error of "
        "the robot whose set-point moves fastest on average; PRBs, means over "
        f"{SMOOTHED_SLOTS} slots, of robots that move (faster than {MOVING_MPS:g} m/s), of those "
        "at rest, and of eMBB users. The grey areas: that robot moves.",
    )
    return figure


def _draw_trace(panels: list[Axes], own: pd.DataFrame, scenario: Scenario) -> None:
    """Draw four panels of one rule: speed, wait, error, owners of the PRBs."""
    by_slot: dict[str, NDArray[Any]] = {
        name: own.pivot_table(index="slot", columns="robot", values=name).to_numpy(float)
        for name in ("speed_mps", "hol_delay_s", "tracking_error_m", "num_prb")
    }
    speed = np.abs(by_slot["speed_mps"])
    robot = int(np.argmax(speed.mean(axis=0)))
    time_s = np.arange(len(speed)) * scenario.radio.slot_s
    moves = speed > MOVING_MPS
    series = (speed, 1e3 * by_slot["hol_delay_s"], 100.0 * by_slot["tracking_error_m"])
    for panel, values in zip(panels, series, strict=False):
        panel.plot(time_s, values[:, robot], color="#000000", linewidth=0.9)
    prbs = by_slot["num_prb"]
    total = {
        "moving robots": (prbs * moves).sum(axis=1),
        "robots at rest": (prbs * ~moves).sum(axis=1),
    }
    total["eMBB"] = scenario.radio.num_prb - prbs.sum(axis=1)
    kernel = np.ones(SMOOTHED_SLOTS) / SMOOTHED_SLOTS
    looks = (_LINES[2], _LINES[1], style.SLICES["embb"])
    for (name, values), look in zip(total.items(), looks, strict=True):
        smooth = np.convolve(values, kernel, mode="valid")
        middle = time_s[: len(smooth)] + 0.5 * SMOOTHED_SLOTS * scenario.radio.slot_s
        panels[3].plot(
            middle, smooth, color=look.color, linestyle=look.dashes, linewidth=1.1, label=name
        )
    for panel in panels:
        panel.fill_between(
            time_s,
            0.0,
            1.0,
            where=moves[:, robot],
            transform=panel.get_xaxis_transform(),
            color="#e8e8e8",
            linewidth=0,
            zorder=0,
        )
    panels[3].set_xlabel("time behind the warm-up [s]")
    panels[3].set_xlim(0.0, time_s[-1])
