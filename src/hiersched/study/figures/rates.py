"""Figures 4 to 7: data rates, their distribution and what they depend on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hiersched.policies.registry import Look
from hiersched.scenario import Scenario
from hiersched.study.figures import style
from hiersched.study.paper import TABLE3
from hiersched.study.registry import axis_of, compares_rates, figure, own_and_baseline, varies
from hiersched.study.study import Study
from hiersched.study.tables.policies import SCALE, along_axes

SAMPLING, REFERENCE = "control.sampling_s", "robot.reference"
LAST_SHARE = 0.999
"""The axes of rates end where this share of them is covered."""
SPAN_SHARE = 0.15
"""Least half height of a rate axis that does not start at 0, as a share of its middle."""

FLAT_SHARE = 0.002
"""A rate that varies by a smaller share of its mean is flat."""
COINCIDENT_SHARE = 0.01
"""Curves that are nowhere further apart than this share lie on each other in the figure."""

_PAIRS: dict[tuple[str, bool], tuple[Any, str]] = {
    ("urllc", True): ("-", "o"),
    ("urllc", False): ((0, (4, 1.5)), "D"),
    ("embb", True): ((0, (6, 1.5, 1, 1.5)), "s"),
    ("embb", False): ((0, (1, 1.2)), "^"),
}
"""Dashes and marker of a slice under the learned policy (True) or PF."""


@figure(
    "fig4_rate_cdf",
    title="Fig. 4: distribution of the data rates of URLLC and eMBB users.",
    reads=("rates",),
    when=compares_rates,
)
def draw_rate_cdf(study: Study) -> Figure:
    """Draw the distribution of the data rates of both slices, learned policy and PF."""
    scenario = study.scenario
    rates = rate_distributions(study)
    figure, axes = style.new_figure(sharey=True)
    window = f"{scenario.robot.window_s:g} s"
    titles = {"slot": "(a) rate of a user in a slot", "window": f"(b) rate of a user over {window}"}
    for panel, (span, title) in zip(axes, titles.items(), strict=True):
        own = rates[rates["span"] == span]
        for (policy, name), curve in own.groupby(["policy", "slice"], sort=False):
            look = _pair_look(str(policy), str(name), scenario)
            style.draw_curve(panel, curve["rate_mbps"], curve, "share", look, cut=(0.0, 1.0))
        drawn = own[(own["share"] > 0.0) & (own["share"] < LAST_SHARE)]["rate_mbps"]
        panel.set(title=title, xlabel="data rate [Mbit/s]", ylim=(0.0, 1.02))
        if len(drawn):
            panel.set_xlim(0.93 * float(drawn.min()), 1.02 * float(drawn.max()))
        else:
            panel.text(0.5, 0.5, "the runs are shorter", ha="center", transform=panel.transAxes)
    axes[0].set_ylabel("share of rates at or below")
    style.shared_legend(figure, axes[0])
    style.caption(
        figure,
        f"Mean and 95 % interval over {len(scenario.evaluate.seeds)} worlds, world i under the "
        "learned policy of training seed i; users of a slice pooled; bands end at 0 and 1. Steps "
        "in (a): 1, 2, 3 … PRBs. The rate axes do not start at 0 and end at the "
        f"{100.0 * LAST_SHARE:g} % quantiles.",
    )
    return figure


@figure(
    "fig5_rayleigh",
    title="Fig. 5: data rates and backlogs over the scale of the Rayleigh fading.",
    reads=("runs",),
    when=varies(SCALE, own_and_baseline),
)
def draw_rayleigh(study: Study) -> Figure:
    """Draw data rates and queue lengths against the Rayleigh scale."""
    figure, (rates, queues) = style.new_figure()
    scenario = study.scenario
    values, table = _along(study, SCALE)
    for policy in own_and_baseline(scenario, table["policy"]):
        own = table[table["policy"] == policy]
        for name in style.SLICES:
            look = _pair_look(policy, name, scenario)
            style.draw_series(rates, values, own, f"{name}_rate_mbps", look)
            style.draw_series(queues, values, own, f"{name}_backlog_packets", look)
    for panel in (rates, queues):
        style.log_ticks(panel, values)
        panel.set_xlabel("Rayleigh scale σ of the fading amplitude [1]")
    _mark_paper_rates(rates)
    rates.set(title="(a) mean data rate per user", ylabel="data rate [Mbit/s]")
    queues.set(title="(b) mean queue length per user", ylabel="backlog [packets]", yscale="log")
    style.shared_legend(figure, rates, columns=3)
    style.caption(
        figure,
        f"{_means(scenario)} The rate axis does not start at 0; bars leave the logarithmic axis "
        "where they include 0. Stars at σ\u00a0=\u00a01: mean of the three slots of the paper's "
        f"Table III.{_coincidence(table, scenario)}"
        f"{style.arrows_text(table[[f'{name}_backlog_packets_hi' for name in style.SLICES]])}",
    )
    return figure


@figure(
    "fig6_sampling",
    title="Fig. 6: data rates over the sampling interval of the control loop.",
    reads=("runs",),
    when=varies(SAMPLING, own_and_baseline),
)
def draw_sampling(study: Study) -> Figure:
    """Draw data rates against the control sampling interval."""
    scenario = study.scenario
    values, table = _along(study, SAMPLING)
    values_ms = [1e3 * value for value in values]
    figure, axes = _draw_rates(table, scenario, values_ms)
    for panel, name, letter in zip(axes, style.SLICES, "ab", strict=True):
        style.log_ticks(panel, values_ms)
        panel.set_xlabel("sampling interval h [ms]")
        change = _change_text(table, f"{name}_rate_mbps", scenario)
        panel.set_title(f"({letter}) {style.SLICES[name].label} data rate{change}")
    style.caption(figure, f"{_means(scenario)} The rate axes do not start at 0.")
    return figure


@figure(
    "fig7_dexterity",
    title="Fig. 7: data rates on references of low, moderate and high dexterity index.",
    reads=("runs",),
    when=varies(REFERENCE, own_and_baseline),
)
def draw_dexterity(study: Study) -> Figure:
    """Draw data rates against the dexterity index that the references give."""
    scenario = study.scenario
    _, table = _along(study, REFERENCE)
    figure, axes = _draw_rates(table, scenario)
    for panel, name, letter in zip(axes, style.SLICES, "ab", strict=True):
        panel.set_xlabel("measured dexterity index [1]")
        trend = _trend_text(table, f"{name}_rate_mbps", scenario)
        panel.set_title(f"({letter}) {style.SLICES[name].label} rate{trend}")
        panel.margins(x=0.14)
        _name_references(panel, table)
    style.caption(
        figure,
        f"{_means(scenario)} The rate axes do not start at 0. DI: dexterity index; titles: change "
        "of the mean from the lowest index to the highest. The paper has the data rate fall as the "
        "index grows.",
    )
    return figure


def _draw_rates(
    table: pd.DataFrame, scenario: Scenario, values: Sequence[float] | None = None
) -> tuple[Figure, list[Axes]]:
    """Draw rates of both slices over values of an axis or, without, the measured dexterity index.

    Narrow ranges of rates do not fill the whole height: small changes stay small.
    """
    figure, axes = style.new_figure()
    for panel, name in zip(axes, style.SLICES, strict=True):
        for policy in own_and_baseline(scenario, table["policy"]):
            own, look = table[table["policy"] == policy], style.policy_look(policy, scenario)
            if values is not None:
                style.draw_series(panel, values, own, f"{name}_rate_mbps", look)
                continue
            own = own.sort_values("dexterity_index")
            index, rate = own["dexterity_index"], own[f"{name}_rate_mbps"]
            style.draw_series(panel, index, own, f"{name}_rate_mbps", look)
            ends = [index - own["dexterity_index_lo"], own["dexterity_index_hi"] - index]
            panel.errorbar(index, rate, xerr=ends, fmt="none", ecolor=look.color, elinewidth=0.9)
        low, high = panel.get_ylim()
        middle = 0.5 * (low + high)
        half = max(0.5 * (high - low), SPAN_SHARE * middle)
        panel.set_ylim(middle - half, middle + half)
        panel.set_ylabel("data rate per user [Mbit/s]")
    style.shared_legend(figure, axes[0])
    return figure, axes


def _along(study: Study, key: str) -> tuple[list[Any], pd.DataFrame]:
    """Return the values of an axis that varies a key, and the rows of learned policy and PF."""
    scenario, name = study.scenario, str(axis_of(study.scenario, key))
    table = along_axes(study, name)
    own = table["policy"].isin(own_and_baseline(scenario, table["policy"]))
    return list(scenario.sweeps.axes[name].vary[key]), table[own]


def rate_distributions(study: Study) -> pd.DataFrame:
    """Return the distribution of data rates: learned policy and PF, by slot and by window.

    Columns are span (slot, window), policy, slice, rate_mbps and, over worlds, the share (_lo, _hi)
    of rates at or below it; of a learned policy each world is under another of its policies.
    """
    rates = study.measures("rates")
    frames = []
    for policy in own_and_baseline(study.scenario, rates["policy"]):
        own = rates[rates["policy"] == policy]
        for (span, name), rows in own.groupby(["span", "slice"], sort=False):
            shares = rows.pivot(index="rate_mbps", columns="seed", values="share").sort_index()
            # Below what a world's rows begin with its share is 0, above their end 1.
            shares = shares.where(shares.notna() | (shares.ffill().fillna(0.0) < 1.0), 1.0)
            intervals = style.share_intervals(shares.fillna(0.0).to_numpy())
            labels: dict[str, Any] = {"span": span, "policy": policy, "slice": name}
            frames.append(intervals.assign(**labels, rate_mbps=shares.index))
    return pd.concat(frames, ignore_index=True)


def _pair_look(policy: str, name: str, scenario: Scenario) -> Look:
    """Colour says which slice; dashes and markers say both, for readers in grey."""
    own, part = style.policy_look(policy, scenario), style.SLICES[name]
    pair = _PAIRS[name, policy == scenario.learning.algorithm]
    return Look(f"{part.label}, {own.label}", part.color, *pair)


def _change_text(table: pd.DataFrame, measure: str, scenario: Scenario) -> str:
    """Say how far the learned policy's mean varies along a sweep, for a title."""
    own = table.loc[table["policy"] == scenario.learning.algorithm, measure]
    if own.empty:
        return ""
    return f": DRL varies by {100.0 * (own.max() - own.min()) / own.mean():.2g} %"


def _trend_text(table: pd.DataFrame, measure: str, scenario: Scenario) -> str:
    """Say which way the learned policy's mean goes with the dexterity index, for a title."""
    own = table[table["policy"] == scenario.learning.algorithm].sort_values("dexterity_index")
    if len(own) < 2:
        return ""
    mean = own[measure].to_numpy()
    change = float((mean[-1] - mean[0]) / mean.mean())
    steps = np.sign(change) * np.diff(mean)
    if np.ptp(mean) < FLAT_SHARE * mean.mean():
        return ": DRL flat over DI"
    if (steps < 0.0).any():
        return f": DRL not monotone in DI ({100.0 * np.ptp(mean) / mean.mean():.2g} %)"
    way = "rises" if change > 0.0 else "falls"
    return f": DRL {way} by {100.0 * abs(change):.2g} % with DI"


def _coincidence(table: pd.DataFrame, scenario: Scenario) -> str:
    """Name the policies under which the rates of both slices lie on each other."""
    names = []
    for policy in own_and_baseline(scenario, table["policy"]):
        own = table[table["policy"] == policy]
        apart = (own["embb_rate_mbps"] / own["urllc_rate_mbps"] - 1.0).abs().max()
        if apart < COINCIDENT_SHARE:
            name = style.policy_look(policy, scenario).label
            names.append(f" In (a) eMBB and URLLC under {name} coincide (within {apart:.1%}).")
    return "".join(names).replace("%", " %")


def _mark_paper_rates(panel: Axes) -> None:
    """Mark the URLLC rates of Table III, mean over its three slots, at the paper's scale 1."""
    star: dict[str, Any] = {"linestyle": "none", "marker": "*", "markersize": 7, "zorder": 5}
    for name, column, face in (("DRL", "drl_mbps", style.PAPER_COLOR), ("PF", "pf_mbps", "white")):
        rate = float(np.mean([getattr(row, column) for row in TABLE3.values()]))
        color: dict[str, Any] = {"markerfacecolor": face, "markeredgecolor": style.PAPER_COLOR}
        panel.plot([1.0], [rate], label=f"paper, URLLC, {name}", **star, **color)


def _name_references(panel: Axes, table: pd.DataFrame) -> None:
    """Write each reference above its points."""
    for reference, group in table.groupby("value", sort=False):
        name, x = str(reference).replace("_", "-"), float(group["dexterity_index"].mean())
        over = panel.get_xaxis_transform()
        panel.annotate(name, (x, 0.98), xycoords=over, ha="center", va="top", fontsize=7)


def _means(scenario: Scenario) -> str:
    over = f"over {len(scenario.sweeps.seeds)} worlds, of the learned policy also over training"
    return f"Mean and 95 % interval {over} seeds."
