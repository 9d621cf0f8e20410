"""The gain study: Table II as a figure, the grid of weight and delay, sweeps, regions, traces."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from hiersched.experiments.points import STUDY_PLANTS
from hiersched.policies.registry import Look
from hiersched.study.figures import style
from hiersched.study.metrics import OFF_TRACK_CM
from hiersched.study.registry import figure, has_gain_study
from hiersched.study.statistics import mean_interval
from hiersched.study.study import Study
from hiersched.study.tables.gains import (
    gain_table,
    grid_table,
    has_gain_grid,
    has_gain_sweeps,
    stability_frame,
    sweeps_table,
)

_ADJUSTED = Look("adjusted gain", "#0072B2", "-", "o")
_SPREAD = 0.13
"""Distance between the methods' points at one slot."""
_VIOLATED: dict[str, Any] = {"color": "#dddddd", "zorder": 0, "linewidth": 0}
"""How spans of violated delay are shaded."""


@figure(
    "figX_gain",
    title="Table II as a figure: tracking error in the windows of violated delay, nominal against "
    "adjusted gain, mean and 95 % interval over seeds, with the paper's ratios as stars.",
    reads=("windows", "growth"),
    when=has_gain_study,
)
def draw_gain(study: Study) -> Figure:
    """Draw the tracking error of every window, and adjusted over nominal where delays violate."""
    scenario, gains = study.scenario, gain_table(study)
    figure, (left, right) = style.new_figure(width_ratios=[1.5, 1.0])
    method, plant = str(gains["method"].iloc[0]), str(gains["plant"].iloc[0])
    own = gains[gains["method"] == method]
    style.draw_series(left, own["slot"], own, "nominal_cm", style.GAIN_METHODS["nominal"])
    style.draw_series(left, own["slot"], own, "adjusted_cm", _ADJUSTED)
    gain_study, seeds = scenario.gain_study, len(scenario.gain_study.seeds)
    for slot in gain_study.violation_windows:
        left.axvspan(slot - 0.5, slot + 0.5, **_VIOLATED)
    left.set_ylim(bottom=0.0)
    left.set_xticks([1, *range(5, gain_study.num_windows + 1, 5)])
    left.set_title(f"(a) tracking error, {plant} plant, {style.GAIN_METHODS[method].label} gains")
    xlabel = f"time slot (window of {scenario.robot.window_s:g} s)"
    limits = 0.3, gain_study.num_windows + 0.7
    left.set(xlabel=xlabel, ylabel="RMS over the window [cm]", xlim=limits)
    violated = gains[gains["violated"]]
    slots = sorted(violated["slot"].unique())
    places = {slot: place for place, slot in enumerate(slots)}
    groups = violated.groupby("method", sort=False)
    for number, (name, group) in enumerate(groups):
        look = style.GAIN_METHODS[str(name)]._replace(dashes="none")
        x = group["slot"].map(places) + _SPREAD * (number - 0.5 * (groups.ngroups - 1))
        if group["plant"].iloc[0] != plant:
            look = look._replace(label=f"{look.label}, split plant")
        style.draw_series(right, x, group, "ratio", look)
    paper = violated[violated["method"] == method]
    star: dict[str, Any] = {"marker": "*", "markersize": 9, "color": style.PAPER_COLOR, "zorder": 4}
    x = paper["slot"].map(places)
    right.plot(x, paper["paper_ratio"], linestyle="none", label="paper", **star)
    _ratio_axis(right, violated)
    right.set_xticks(range(len(slots)), [str(slot) for slot in slots])
    right.set_xlim(-0.5, len(slots) - 0.5)
    lowest, highest = paper["ratio"].min(), paper["ratio"].max()
    right.set_title(
        f"(b) all methods; {style.GAIN_METHODS[method].label}: {lowest:.2f} to {highest:.2f}"
    )
    right.set_xlabel("time slot of violated delay")
    style.shared_legend(figure, left, right, columns=5)
    style.caption(
        figure,
        f"Mean over robots and {seeds} seeds; bars: 95 % intervals, "
        "Student t, in (b) of the logarithm. Grey: violated delay. Each gain follows the delay. "
        f"Stars: the paper's Table II.{_missing_bars(violated)}",
    )
    return figure


def _ratio_axis(axes: Axes, drawn: pd.DataFrame) -> None:
    """Make an axis of ratios that starts at 0, holds every finite bound and marks 1."""
    top = float(drawn["ratio_hi"].replace(np.inf, np.nan).max())
    axes.axhline(1.0, color=style.GREY, linewidth=0.9)
    axes.set_ylim(0.0, 1.2 if np.isnan(top) else max(1.2, 1.05 * top))
    axes.set_ylabel("error, adjusted / nominal [1]")


def _missing_bars(violated: pd.DataFrame) -> str:
    """Say why points in (b) have no bar, where some have none."""
    width = violated["ratio_hi"] - violated["ratio_lo"]
    equal = violated["method"][(violated["ratio"] == 1.0) & (width < 1e-9)].unique()
    names = ", ".join(style.GAIN_METHODS[method].label for method in equal)
    return f" No bar ({names}): both gains give the same errors." if names else ""


_SHOWN: dict[str, Any] = {"aspect": "auto", "origin": "lower", "interpolation": "nearest"}
_LEAST_SPAN = 1.25
"""The map's colours reach at least from 1/1.25 to 1.25: noise around 1 stays pale."""


@figure(
    "figX_gain_grid",
    title="Tracking error with the adjusted gain over that with the nominal one, for each "
    "weight q of the regulator and each constant delay in the violated window, in the "
    "same worlds; right, the nominal gain's own error.",
    reads=("windows", "schedules", "growth"),
    when=has_gain_grid,
)
def draw_gain_grid(study: Study) -> Figure:
    """Draw the ratio of errors over the grid, and the nominal loop's own error."""
    scenario, grid = study.scenario, grid_table(study)
    figure, (left, right) = style.new_figure(height_in=3.4, width_ratios=[1.7, 1.0])
    weights = list(dict.fromkeys(grid["weight"]))
    delays = list(dict.fromkeys(grid["delay_s"]))
    cells = grid.set_index(["weight", "delay_s"]).loc[[(q, d) for q in weights for d in delays]]
    shape = len(weights), len(delays)
    ratio = cells["ratio"].to_numpy().reshape(shape)
    error = cells["nominal_cm"].to_numpy().reshape(shape)
    span = _span(ratio)
    ratios = left.imshow(ratio, cmap="PuOr", norm=LogNorm(1.0 / span, span), **_SHOWN)
    errors = right.imshow(error, cmap="Greys", vmin=0.0, vmax=2.0 * error.max(), **_SHOWN)
    for place, cell in zip(np.ndindex(*shape), cells.to_dict("records"), strict=True):
        _write_ratio(left, place, cell, _ink(ratios, place))
        off = cell["nominal_off_track_share"]
        text = f"{cell['nominal_cm']:.2f}" + (f"\n{100.0 * off:.0f} % off" if off > 0.0 else "")
        _write(right, place, text, _ink(errors, place))
    for axes in (left, right):
        axes.grid(False)
        axes.set_xticks(range(len(delays)), [f"{1e3 * delay:g}" for delay in delays])
        axes.set_yticks(range(len(weights)), [f"{weight:g}" for weight in weights])
        axes.tick_params(length=0)
        axes.set(xlabel="delay in violated slots [ms]", ylabel="weight q [1]")
    left.set_title("(a) error, adjusted / nominal [1]")
    right.set_title("(b) nominal gain: error [cm]")
    bar = figure.colorbar(ratios, ax=left, shrink=0.9, pad=0.02)
    bar.set_ticks([1.0 / span, 1.0, span], labels=[f"{t:.2f}" for t in (1.0 / span, 1.0, span)])
    bar.minorticks_off()
    control, own = scenario.control, scenario.gain_study
    style.caption(
        figure,
        f"{style.GAIN_METHODS[control.method].label} gains, {scenario.plant_name} plant, h = "
        f"{1e3 * control.sampling_s:g} ms. Means over {own.sweep_robots} robots and "
        f"{len(own.seeds)} seeds in windows of constant violated delay, with 95 % "
        "intervals. Bold: the interval excludes 1. Hatched: the nominal gain stays in force, the "
        f"ratio is exactly 1. {_trouble(grid)}",
    )
    return figure


def _span(ratio: NDArray[np.float64]) -> float:
    """Return s so that the colours go from 1/s to s and hold every ratio."""
    usable = ratio[np.isfinite(ratio) & (ratio > 0.0)]
    return float(np.exp(np.abs(np.log(usable)).max(initial=np.log(_LEAST_SPAN))))


def _ink(image: AxesImage, place: tuple[int, ...]) -> str:
    """Return black or white, whichever reads better on a cell."""
    values = np.asarray(image.get_array())
    red, green, blue, _ = image.cmap(image.norm(values[place]))
    return "black" if 0.3 * red + 0.59 * green + 0.11 * blue > 0.5 else "white"


def _write(axes: Axes, place: tuple[int, ...], text: str, ink: str, **options: Any) -> None:
    options |= {"ha": "center", "va": "center", "fontsize": 6.5, "linespacing": 1.3}
    axes.text(place[1], place[0], text, color=ink, **options)


def _write_ratio(axes: Axes, place: tuple[int, ...], cell: dict[Hashable, Any], ink: str) -> None:
    """Write a ratio into its cell: bold where it differs from 1; hatched where gains are equal."""
    if cell["effect"] == "same gain":
        corner = place[1] - 0.5, place[0] - 0.5
        hatch: dict[str, Any] = {"edgecolor": "#bbbbbb", "hatch": "////", "linewidth": 0.0}
        axes.add_patch(Rectangle(corner, 1.0, 1.0, facecolor="none", **hatch))
        _write(axes, place, "1", ink, bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0})
        return
    ratio, lo, hi = (cell[f"ratio{end}"] for end in ("", "_lo", "_hi"))
    digits = 2 if hi - lo >= 0.02 else 3
    text = f"{ratio:.{digits}f}\n{lo:.{digits}f}–{hi:.{digits}f}"
    if not (np.isfinite(lo) and np.isfinite(hi)):
        text = f"{ratio:.2f}\nunbounded"
    weight = "bold" if cell["effect"] in ("helps", "hurts") else "normal"
    _write(axes, place, text, ink, fontweight=weight)


def _trouble(grid: pd.DataFrame) -> str:
    """Say how many robots got into trouble: they are in the means, whatever their errors."""
    worst = {
        name: max(float(grid[f"{gain}_{name}_share"].max()) for gain in ("nominal", "adjusted"))
        for name in ("off_track", "saturated")
    }
    return (
        f"Robots over {OFF_TRACK_CM:g} cm in a window: at most {100.0 * worst['off_track']:.0f} % "
        f"in any cell; at their limits for half a window: {100.0 * worst['saturated']:.0f} %. "
        "All are in the means."
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


@figure(
    "figX_gain_sweeps",
    title="First unstable delay of the nominal loop against the sampling interval; the ratio of "
    "tracking errors, adjusted over nominal, against the sampling interval and against "
    "the measurement noise.",
    reads=("windows", "schedules", "stability", "growth"),
    when=has_gain_sweeps,
)
def draw_gain_sweeps(study: Study) -> Figure:
    """Draw first unstable delay and ratio over the sampling interval, ratio over the noise."""
    scenario, sweeps = study.scenario, sweeps_table(study)
    figure, (left, middle, right) = style.new_figure(3)
    own = scenario.gain_study
    look = style.GAIN_METHODS[scenario.control.method]._replace(dashes=(0, (1, 2)))
    sampling, noise = (sweeps[sweeps["axis"] == axis] for axis in ("sampling_s", "noise"))
    h_ms = 1e3 * sampling["sampling_s"].to_numpy()
    low, high = (1e3 * bound for bound in own.violation_delay_s)
    left.axhspan(low, high, **_VIOLATED)
    unstable_ms = 1e3 * sampling["first_unstable_delay_s"].to_numpy()
    known = np.isfinite(unstable_ms)  # no marker where no delay up to T_max is unstable
    dotted: dict[str, Any] = {"color": "#000000", "marker": "o", "linestyle": (0, (1, 2))}
    left.plot(h_ms[known], unstable_ms[known], **dotted)
    left.set_ylim(0.0, 1.3 * max([high, *unstable_ms[known].tolist()]))
    left.set_ylabel("first unstable constant delay [ms]")
    for axes, rows, x in ((middle, sampling, h_ms), (right, noise, np.arange(len(noise)))):
        style.draw_series(axes, x, rows, "ratio", look)
        _ratio_axis(axes, sweeps)
    for axes in (left, middle):
        style.log_ticks(axes, h_ms.tolist())
        axes.set_xlabel("sampling interval h [ms]")
    pairs = zip(noise["noise_position_m"], noise["noise_heading_rad"], strict=True)
    labels = [f"{1e3 * p:g} mm\n{1e3 * a:g} mrad" for p, a in pairs]
    right.set_xticks(range(len(noise)), labels, fontsize=6.5)
    right.set_xlim(-0.4, len(noise) - 0.6)
    right.set(xlabel="measurement noise", title="(c) ratio against noise")
    left.set_title("(a) nominal loop")
    middle.set_title("(b) ratio against h")
    style.caption(
        figure,
        f"q = {scenario.control.weight:g}, {scenario.plant_name} plant, {look.label} gains. "
        f"Grey: the violated delays of (b) and (c), uniform in {low:g} to {high:g} ms. Means over "
        f"{own.sweep_robots} robots and {len(own.seeds)} seeds, 95 % "
        "intervals. (a): spectral radius of the lifted system, delays in whole samples.",
    )
    return figure


@figure(
    "figX_gain_stability",
    title="Longest delay against the weight q: of the nominal gain, exact and by the conditions "
    "C1, C2 and C3, and of the adjusted gain.",
    reads=("stability",),
    when=has_gain_grid,
)
def draw_gain_stability(study: Study) -> Figure:
    """Draw the longest delay against the weight, by each criterion and plant."""
    scenario, regions = study.scenario, stability_frame(study)
    own = regions[regions["axis"] == "weight"]
    plants = list(dict.fromkeys(own["plant"]))
    figure, panels = style.new_figure(len(plants), sharey=True)
    longest_ms = 1e3 * float((own["max_delay_steps"] * own["sampling_s"]).max())
    step = _SHIFT * max(1.0, float(np.ptp(own["value"])))
    for axes, plant, name in zip(panels, plants, "abcdef", strict=False):
        for number, (criterion, look) in enumerate(_CRITERIA.items()):
            rows = own[(own["plant"] == plant) & (own["criterion"] == criterion)]
            if len(rows):
                _draw_region(axes, rows, look, step * (number - 2))
        axes.set_xticks(sorted(set(own["value"])))
        axes.set(title=f"({name}) {plant} plant", xlabel="weight q [1]")
        axes.set(ylabel="longest delay [ms]", ylim=(-0.07 * longest_ms, 1.12 * longest_ms))
    fullest = max(panels, key=lambda axes: len(axes.get_legend_handles_labels()[0]))
    style.shared_legend(figure, fullest, columns=3)
    delay_ms = 1e3 * max(scenario.gain_study.fixed_delay_s)
    style.caption(
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


@figure(
    "figX_gain_traces",
    title="Tracking error slot by slot through a violation (grey), with the nominal gain and "
    "with the gains of every method.",
    reads=("slots",),
    when=has_gain_study,
)
def draw_gain_traces(study: Study) -> Figure:
    """Draw the tracking error slot by slot through a violation, nominal and every method."""
    scenario = study.scenario
    slots = study.measures("slots")
    traces = slots[slots["experiment"] == "gain_study"]
    nominal = traces["gain"] == "nominal"
    methods = traces["value"].mask(nominal, "nominal")
    traces = traces.assign(method=methods, plant=traces["value"].map(STUDY_PLANTS))
    plants = list(dict.fromkeys(traces["plant"]))
    ratios = [1.6, *[1.0] * (len(plants) - 1)]
    figure, panels = style.new_figure(len(plants), sharey=True, width_ratios=ratios, height_in=3.1)
    gain_study, slot_s = scenario.gain_study, scenario.radio.slot_s
    for axes, plant, name in zip(panels, plants, "abcdef", strict=False):
        own = traces[traces["plant"] == plant]
        axes.axvspan(0.0, scenario.robot.window_s, **_VIOLATED)
        for method, rows in own.groupby("method", sort=False):
            by_slot = rows.pivot(index="slot", columns="seed", values="error_cm")
            intervals = [mean_interval(row).columns("error") for row in by_slot.to_numpy()]
            x = (by_slot.index.to_numpy() + 0.5) * slot_s
            style.draw_curve(
                axes, x, pd.DataFrame(intervals), "error", style.GAIN_METHODS[str(method)]
            )
        axes.set(title=f"({name}) {plant} plant", ylabel="error, RMS over robots [cm]")
        axes.set_xlabel("time since the violation began [s]")
        axes.set_ylim(bottom=0.0)
        axes.margins(x=0.01)
    style.shared_legend(figure, *panels, columns=6)
    low, high = (1e3 * bound for bound in gain_study.violation_delay_s)
    calm = [f"{1e3 * bound:g}" for bound in gain_study.calm_delay_s]
    style.caption(
        figure,
        f"Window {min(gain_study.violation_windows)} of the gain study, q = "
        f"{scenario.control.weight:g}. Grey: violated slots, {low:g} to {high:g} ms of delay; "
        f"elsewhere {calm[0]} to {calm[1]} ms. Mean over {len(gain_study.seeds)} seeds of the root "
        f"mean square over {gain_study.num_robots} robots; bands: 95 % intervals (Student t)."
        f"{_equal_traces(traces)}",
    )
    return figure


def _draw_region(axes: Axes, rows: pd.DataFrame, look: Look, shift: float) -> None:
    """Draw one criterion's longest delays; open markers where no longer delay was tried."""
    x, y = rows["value"] + shift, 1e3 * rows["delay_s"]
    axes.plot(x, y, color=look.color, linestyle=look.dashes, marker=look.marker, label=look.label)
    tried = rows["at_least"].to_numpy(bool)
    style.open_marks(axes, x[tried], y[tried], look)


def _equal_traces(traces: pd.DataFrame) -> str:
    """Say which methods have the very errors of the nominal gain, where any has."""
    equal = []
    for _, own in traces.groupby("plant", sort=False):
        errors = {name: rows["error_cm"].to_numpy() for name, rows in own.groupby("method")}
        equal += [
            style.GAIN_METHODS[str(name)].label
            for name, error in errors.items()
            if name != "nominal" and np.array_equal(error, errors["nominal"])
        ]
    return f" {', '.join(equal)}: the nominal gain, at all these delays." if equal else ""
