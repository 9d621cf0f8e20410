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
from hiersched.study.figures.style import (
    PAPER_COLOR,
    SLICES,
    arrows_text,
    caption,
    draw_series,
    log_ticks,
    new_figure,
    policy_look,
    share_intervals,
    shared_legend,
)
from hiersched.study.paper import TABLE3
from hiersched.study.registry import (
    axis_of,
    compares_rates,
    figure,
    own_and_baseline,
    varies,
)
from hiersched.study.study import Study
from hiersched.study.tables.policies import SCALE, along_axes

LAST_SHARE = 0.999
"""The axes of rates end where this share of them is covered."""
SPAN_SHARE = 0.15
"""Least half height of a rate axis that does not start at 0, as a share of its middle."""

FLAT_SHARE = 0.002
"""A rate that varies by a smaller share of its mean is flat."""
COINCIDENT_SHARE = 0.01
"""Curves that are nowhere further apart than this share lie on each other in the figure."""

_AND_POLICIES = ", of the learned policy also over training seeds"

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
    figure, axes = new_figure(sharey=True)
    window = f"{scenario.robot.window_s:g} s"
    titles = {"slot": "(a) rate of a user in a slot", "window": f"(b) rate of a user over {window}"}
    for panel, (span, title) in zip(axes, titles.items(), strict=True):
        for (policy, name), curve in rates[rates["span"] == span].groupby(
            ["policy", "slice"], sort=False
        ):
            look = _pair_look(str(policy), str(name), scenario)
            x = curve["rate_mbps"]
            panel.fill_between(
                x,
                curve["share_lo"].clip(0.0, 1.0),
                curve["share_hi"].clip(0.0, 1.0),
                color=look.color,
                alpha=0.15,
                linewidth=0,
            )
            panel.plot(x, curve["share"], color=look.color, linestyle=look.dashes, label=look.label)
        panel.set_title(title)
        panel.set_xlabel("data rate [Mbit/s]")
        panel.set_ylim(0.0, 1.02)
        own = rates[rates["span"] == span]
        drawn = own[(own["share"] > 0.0) & (own["share"] < LAST_SHARE)]["rate_mbps"]
        panel.set_xlim(0.93 * float(drawn.min()), 1.02 * float(drawn.max()))
    axes[0].set_ylabel("share of rates at or below")
    shared_legend(figure, axes[0])
    caption(
        figure,
        f"Mean and {_over_seeds(scenario.evaluate.seeds)}, world i under the learned policy of "
        "training seed i; users of a slice pooled; bands end "
        "at 0 and 1. Steps in (a): 1, 2, 3 … PRBs. The rate axes do not start at 0 and end at the "
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
    figure, axes = new_figure()
    scenario = study.scenario
    values, table = _along(study, SCALE)
    for policy in own_and_baseline(scenario, table["policy"]):
        own = table[table["policy"] == policy]
        for name in SLICES:
            look = _pair_look(policy, name, scenario)
            _draw(axes[0], values, own, f"{name}_rate_mbps", look)
            _draw(axes[1], values, own, f"{name}_backlog_packets", look)
    for panel in axes:
        log_ticks(panel, values)
        panel.set_xlabel("Rayleigh scale σ of the fading amplitude [1]")
    _mark_paper_rates(axes[0])
    axes[0].set_title("(a) mean data rate per user")
    axes[0].set_ylabel("data rate [Mbit/s]")
    axes[1].set_title("(b) mean queue length per user")
    axes[1].set_ylabel("backlog [packets]")
    axes[1].set_yscale("log")
    shared_legend(figure, axes[0], columns=3)
    caption(
        figure,
        f"Mean and {_over_seeds(scenario.sweeps.seeds)}{_AND_POLICIES}. The rate axis does not "
        "start at 0; bars leave the logarithmic axis where they include 0. Stars "
        "at σ\u00a0=\u00a01: "
        f"mean of the three slots of the paper's Table III.{_coincidence(table, scenario)}"
        f"{arrows_text(table[[f'{name}_backlog_packets_hi' for name in SLICES]])}",
    )
    return figure


@figure(
    "fig6_sampling",
    title="Fig. 6: data rates over the sampling interval of the control loop.",
    reads=("runs",),
    when=varies("control.sampling_s", own_and_baseline),
)
def draw_sampling(study: Study) -> Figure:
    """Draw data rates against the control sampling interval."""
    figure, axes = new_figure()
    scenario = study.scenario
    values, table = _along(study, "control.sampling_s")
    values = [1e3 * value for value in values]
    for panel, name, letter in zip(axes, ("embb", "urllc"), "ab", strict=True):
        for policy in own_and_baseline(scenario, table["policy"]):
            own = table[table["policy"] == policy]
            look = policy_look(policy, scenario)
            _draw(panel, values, own, f"{name}_rate_mbps", look)
        log_ticks(panel, values)
        panel.set_xlabel("sampling interval h [ms]")
        change = _change_text(table, f"{name}_rate_mbps", scenario)
        panel.set_title(f"({letter}) {SLICES[name].label} data rate{change}")
        panel.set_ylabel("data rate per user [Mbit/s]")
        _widen(panel)
    shared_legend(figure, axes[0])
    caption(
        figure,
        f"Mean and {_over_seeds(scenario.sweeps.seeds)}{_AND_POLICIES}. The rate axes do not start "
        "at 0.",
    )
    return figure


@figure(
    "fig7_dexterity",
    title="Fig. 7: data rates on references of low, moderate and high dexterity index.",
    reads=("runs",),
    when=varies("robot.reference", own_and_baseline),
)
def draw_dexterity(study: Study) -> Figure:
    """Draw data rates against the dexterity index that the references give."""
    figure, axes = new_figure()
    scenario = study.scenario
    _, table = _along(study, "robot.reference")
    for panel, name, letter in zip(axes, ("embb", "urllc"), "ab", strict=True):
        for policy in own_and_baseline(scenario, table["policy"]):
            own = table[table["policy"] == policy].sort_values("dexterity_index")
            look = policy_look(policy, scenario)
            index = own["dexterity_index"].to_numpy()
            _draw(panel, index, own, f"{name}_rate_mbps", look)
            sideways = [
                index - own["dexterity_index_lo"].to_numpy(),
                own["dexterity_index_hi"].to_numpy() - index,
            ]
            rate = own[f"{name}_rate_mbps"].to_numpy()
            panel.errorbar(
                index, rate, xerr=sideways, fmt="none", ecolor=look.color, elinewidth=0.9
            )
        panel.set_xlabel("measured dexterity index [1]")
        trend = _trend_text(table, f"{name}_rate_mbps", scenario)
        panel.set_title(f"({letter}) {SLICES[name].label} rate{trend}")
        panel.set_ylabel("data rate per user [Mbit/s]")
        panel.margins(x=0.14)
        _widen(panel)
        _name_references(panel, table)
    shared_legend(figure, axes[0])
    caption(
        figure,
        f"Mean and {_over_seeds(scenario.sweeps.seeds)}{_AND_POLICIES}. The rate axes do not start "
        "at 0. DI: dexterity index; titles: change of the mean from the lowest index to the "
        "highest. The paper has the data rate fall as the index grows.",
    )
    return figure


def _along(study: Study, key: str) -> tuple[list[Any], pd.DataFrame]:
    """Return the values of an axis that varies a key, and the rows of learned policy and PF."""
    scenario, name = study.scenario, str(axis_of(study.scenario, key))
    table = along_axes(study, name)
    own = table["policy"].isin(own_and_baseline(scenario, table["policy"]))
    return list(scenario.sweeps.axes[name].vary[key]), table[own]


def rate_distributions(study: Study) -> pd.DataFrame:
    """Return the distribution of data rates: learned policy and PF, by slot and by window.

    Returns
    -------
    DataFrame
        Columns span (slot, window), policy, slice, rate_mbps and the share of rates at or below
        it: mean over worlds as share, share_lo, share_hi; of a learned policy from its logs, each
        world under another of its policies.
    """
    rates = study.measures("rates")
    frames = []
    for policy in own_and_baseline(study.scenario, rates["policy"]):
        own = rates[rates["policy"] == policy]
        for (span, name), rows in own.groupby(["span", "slice"], sort=False):
            shares = rows.pivot(index="rate_mbps", columns="seed", values="share").sort_index()
            # Below what a world's rows begin with its share is 0, above their end 1.
            shares = shares.where(shares.notna() | (shares.ffill().fillna(0.0) < 1.0), 1.0)
            labels = {"span": span, "policy": policy, "slice": name, "rate_mbps": shares.index}
            intervals = share_intervals(shares.fillna(0.0).to_numpy())
            frames.append(pd.DataFrame({**labels, **intervals}))
    return pd.concat(frames, ignore_index=True).sort_values(
        ["span"], key=lambda span: span != "slot", kind="stable"
    )


def _pair_look(policy: str, name: str, scenario: Scenario) -> Look:
    """Colour says which slice; dashes and markers say both, for readers in grey."""
    own = policy_look(policy, scenario)
    part = SLICES[name]
    dashes, marker = _PAIRS[name, policy == scenario.learning.algorithm]
    return Look(f"{part.label}, {own.label}", part.color, dashes, marker)


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
            name = policy_look(policy, scenario).label
            names.append(f" In (a) eMBB and URLLC under {name} coincide (within {apart:.1%}).")
    return "".join(names).replace("%", " %")


def _draw(
    panel: Axes, x: Sequence[float] | np.ndarray, table: pd.DataFrame, measure: str, look: Look
) -> None:
    draw_series(panel, x, table[measure], table[f"{measure}_lo"], table[f"{measure}_hi"], look)


def _mark_paper_rates(panel: Axes) -> None:
    """Mark the URLLC rates of Table III, mean over its three slots, at the paper's scale 1."""
    for name, rates, face in (
        ("DRL", [row.drl_mbps for row in TABLE3.values()], PAPER_COLOR),
        ("PF", [row.pf_mbps for row in TABLE3.values()], "white"),
    ):
        panel.plot(
            [1.0],
            [float(np.mean(rates))],
            linestyle="none",
            marker="*",
            markersize=7,
            markerfacecolor=face,
            markeredgecolor=PAPER_COLOR,
            zorder=5,
            label=f"paper, URLLC, {name}",
        )


def _widen(panel: Axes) -> None:
    """Keep a narrow range of rates from filling the whole height: small changes stay small."""
    low, high = panel.get_ylim()
    middle = 0.5 * (low + high)
    half = max(0.5 * (high - low), SPAN_SHARE * middle)
    panel.set_ylim(middle - half, middle + half)


def _name_references(panel: Axes, table: pd.DataFrame) -> None:
    """Write each reference above its points."""
    for reference, group in table.groupby("value", sort=False):
        panel.annotate(
            str(reference).replace("_", "-"),
            (float(group["dexterity_index"].mean()), 0.98),
            xycoords=panel.get_xaxis_transform(),
            ha="center",
            va="top",
            fontsize=7,
        )


def _over_seeds(seeds: Sequence[int]) -> str:
    return f"95 % interval over {len(seeds)} worlds"
