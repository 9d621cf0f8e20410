"""The gain study around Table II: sampling interval, noise, stability regions, traces."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hiersched.policies.registry import Look
from hiersched.scenario import Scenario
from hiersched.study.statistics import mean_interval
from hiersched.study.style import (
    GAIN_METHODS,
    GREY,
    caption,
    draw_series,
    log_ticks,
    new_figure,
    shared_legend,
)

_CRITERIA = {
    "exact": Look("nominal gain, exact (constant delay)", "#000000", "-", "o"),
    "c3": Look("nominal gain, C3", "#0072B2", (0, (4, 1.5)), "s"),
    "c2": Look("nominal gain, C2", "#CC79A7", (0, (1, 1.2)), "D"),
    "c1": Look("nominal gain, C1", "#009E73", (0, (6, 1.5, 1, 1.5)), "^"),
    "adjusted": Look("adjusted gain, exact", "#D55E00", (0, (3, 1, 1, 1)), "v"),
}
_SHIFT = 0.009
"""Distance between the criteria's markers, as a share of the axis."""


def draw_gain_sweeps(sweeps: pd.DataFrame, scenario: Scenario) -> Figure:
    """Draw first unstable delay and ratio against the sampling interval, ratio against the noise.

    Parameters
    ----------
    sweeps
        From `gain_summary.sweeps_table`.
    scenario
        The scenario that was run.
    """
    figure, (left, middle, right) = new_figure(3)
    study = scenario.gain_study
    look = GAIN_METHODS[scenario.control.method]._replace(dashes=(0, (1, 2)))
    sampling, noise = (sweeps[sweeps["axis"] == axis] for axis in ("sampling_s", "noise"))
    h_ms = 1e3 * sampling["sampling_s"].to_numpy()
    low, high = (1e3 * bound for bound in study.violation_delay_s)
    left.axhspan(low, high, color="#dddddd", zorder=0, linewidth=0)
    _draw_unstable(left, h_ms, 1e3 * sampling["first_unstable_delay_s"].to_numpy(), high)
    top = float(sweeps["ratio_hi"].replace(np.inf, np.nan).max())
    for axes, rows, x in ((middle, sampling, h_ms), (right, noise, np.arange(len(noise)))):
        draw_series(axes, x, rows["ratio"], rows["ratio_lo"], rows["ratio_hi"], look)
        axes.axhline(1.0, color=GREY, linewidth=0.9)
        axes.set_ylim(0.0, 1.2 if np.isnan(top) else max(1.2, 1.05 * top))
        axes.set_ylabel("error, adjusted / nominal [1]")
    for axes in (left, middle):
        log_ticks(axes, h_ms.tolist())
        axes.set_xlabel("sampling interval h [ms]")
    pairs = zip(noise["noise_position_m"], noise["noise_heading_rad"], strict=True)
    labels = [f"{1e3 * p:g} mm\n{1e3 * a:g} mrad" for p, a in pairs]
    right.set_xticks(range(len(noise)), labels, fontsize=6.5)
    right.set_xlim(-0.4, len(noise) - 0.6)
    right.set_xlabel("measurement noise")
    left.set_title("(a) nominal loop")
    middle.set_title("(b) ratio against h")
    right.set_title("(c) ratio against noise")
    caption(
        figure,
        f"q = {scenario.control.weight:g}, {scenario.plant_name} plant, {look.label} gains. "
        f"Grey: the violated delays of (b) and (c), uniform in {low:g} to {high:g} ms. Means over "
        f"{study.sweep_robots} robots and {len(study.seeds)} seeds, 95 % "
        "intervals. (a): spectral radius of the lifted system, delays in whole samples.",
    )
    return figure


def draw_gain_stability(regions: pd.DataFrame, scenario: Scenario) -> Figure:
    """Draw the longest delay against the weight, by each criterion and plant.

    Parameters
    ----------
    regions
        From `gain_logs.stability_frame`.
    scenario
        The scenario that was run.
    """
    own = regions[regions["axis"] == "weight"]
    plants = list(dict.fromkeys(own["plant"]))
    figure, panels = new_figure(len(plants), sharey=True)
    longest_ms = 1e3 * float((own["max_delay_steps"] * own["sampling_s"]).max())
    step = _SHIFT * max(1.0, float(np.ptp(own["value"])))
    for axes, plant, name in zip(panels, plants, "abcdef", strict=False):
        for number, (criterion, look) in enumerate(_CRITERIA.items()):
            rows = own[(own["plant"] == plant) & (own["criterion"] == criterion)]
            if len(rows):
                _draw_region(axes, rows, look, step * (number - 2))
        axes.set_title(f"({name}) {plant} plant")
        axes.set_xticks(sorted(set(own["value"])))
        axes.set_xlabel("weight q [1]")
        axes.set_ylabel("longest delay [ms]")
        axes.set_ylim(-0.07 * longest_ms, 1.12 * longest_ms)
    fullest = max(panels, key=lambda axes: len(axes.get_legend_handles_labels()[0]))
    shared_legend(figure, fullest, columns=3)
    delay_ms = 1e3 * max(scenario.gain_study.fixed_delay_s)
    caption(
        figure,
        f"Delays in whole samples of {1e3 * scenario.control.sampling_s:g} ms; open markers: "
        f"{longest_ms:g} ms or more, no longer delay was tried. Markers are shifted sideways to "
        "show all. Exact: spectral radius of the lifted system below 1 at every constant delay up "
        "to this one. C1, C2, C3: certified for every sequence of delays up to this one; C1, where "
        "it holds, for any delay, and where it is missing, for none. Adjusted: the gain designed "
        f"for {delay_ms:g} ms. network: all feedback is delayed; split: "
        f"{100 * scenario.control.operator_share:g} % of the gain on the pose.",
    )
    return figure


def draw_gain_traces(traces: pd.DataFrame, scenario: Scenario) -> Figure:
    """Draw the tracking error slot by slot through a violation, nominal and every method.

    Parameters
    ----------
    traces
        From `gain_logs.trace_frame`.
    scenario
        The scenario that was run.
    """
    plants = list(dict.fromkeys(traces["plant"]))
    ratios = [1.6, *[1.0] * (len(plants) - 1)]
    figure, panels = new_figure(len(plants), sharey=True, width_ratios=ratios, height_in=3.1)
    study, slot_s = scenario.gain_study, scenario.radio.slot_s
    for axes, plant, name in zip(panels, plants, "abcdef", strict=False):
        own = traces[traces["plant"] == plant]
        axes.axvspan(0.0, scenario.robot.window_s, color="#dddddd", zorder=0, linewidth=0)
        for method, rows in own.groupby("method", sort=False):
            look = GAIN_METHODS[str(method)]
            by_slot = rows.pivot(index="slot", columns="seed", values="error_cm")
            intervals = np.array([mean_interval(row) for row in by_slot.to_numpy()])
            x = (by_slot.index.to_numpy() + 0.5) * slot_s
            axes.plot(x, intervals[:, 0], color=look.color, linestyle=look.dashes, label=look.label)
            axes.fill_between(
                x, intervals[:, 1], intervals[:, 2], color=look.color, alpha=0.15, linewidth=0
            )
        axes.set_title(f"({name}) {plant} plant")
        axes.set_xlabel("time since the violation began [s]")
        axes.set_ylabel("error, RMS over robots [cm]")
        axes.set_ylim(bottom=0.0)
        axes.margins(x=0.01)
    _legend_of_all(figure, panels)
    low, high = (1e3 * bound for bound in study.violation_delay_s)
    calm = [f"{1e3 * bound:g}" for bound in study.calm_delay_s]
    caption(
        figure,
        f"Window {min(study.violation_windows)} of the gain study, q = "
        f"{scenario.control.weight:g}. Grey: violated slots, {low:g} to {high:g} ms of delay; "
        f"elsewhere {calm[0]} to {calm[1]} ms. Mean over {len(study.seeds)} seeds of the root mean "
        f"square over {study.num_robots} robots; bands: 95 % intervals (Student t)."
        f"{_equal_traces(traces)}",
    )
    return figure


def _draw_unstable(
    axes: Axes, h_ms: NDArray[np.float64], unstable_ms: NDArray[np.float64], high_ms: float
) -> None:
    """Draw first unstable delays; where there is none up to T_max, no marker."""
    known = np.isfinite(unstable_ms)
    axes.plot(h_ms[known], unstable_ms[known], color="#000000", marker="o", linestyle=(0, (1, 2)))
    axes.set_ylim(0.0, 1.3 * max([high_ms, *unstable_ms[known].tolist()]))
    axes.set_ylabel("first unstable constant delay [ms]")


def _draw_region(axes: Axes, rows: pd.DataFrame, look: Look, shift: float) -> None:
    """Draw one criterion's longest delays; open markers where no longer delay was tried."""
    x, y = rows["value"] + shift, 1e3 * rows["delay_s"]
    axes.plot(x, y, color=look.color, linestyle=look.dashes, marker=look.marker, label=look.label)
    tried = rows["at_least"].to_numpy(bool)
    axes.plot(
        x[tried],
        y[tried],
        linestyle="none",
        marker=look.marker,
        markerfacecolor="white",
        markeredgecolor=look.color,
    )


def _equal_traces(traces: pd.DataFrame) -> str:
    """Say which methods have the very errors of the nominal gain, where any has."""
    equal = []
    for _, own in traces.groupby("plant", sort=False):
        errors = {name: rows["error_cm"].to_numpy() for name, rows in own.groupby("method")}
        equal += [
            GAIN_METHODS[str(name)].label
            for name, error in errors.items()
            if name != "nominal" and np.array_equal(error, errors["nominal"])
        ]
    return f" {', '.join(equal)}: the nominal gain, at all these delays." if equal else ""


def _legend_of_all(figure: Figure, panels: list[Axes]) -> None:
    """Put one legend above the panels with the entries of all of them, each once."""
    entries = {
        label: handle
        for axes in panels
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        list(entries.values()), list(entries), loc="outside upper left", ncols=6, columnspacing=1.4
    )
