"""Where adjusted gains help: the grid of weight and delay as a map."""

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

from hiersched.scenario import Scenario
from hiersched.study.fifo import FloatArray
from hiersched.study.metrics import OFF_TRACK_CM
from hiersched.study.style import GAIN_METHODS, caption, new_figure

_SHOWN: dict[str, Any] = {"aspect": "auto", "origin": "lower", "interpolation": "nearest"}
_LEAST_SPAN = 1.25
"""The map's colours reach at least from 1/1.25 to 1.25: noise around 1 stays pale."""


def draw_gain_grid(grid: pd.DataFrame, scenario: Scenario) -> Figure:
    """Draw the ratio of errors over the grid, and the nominal loop's own error.

    Parameters
    ----------
    grid
        From `gain_summary.grid_table`.
    scenario
        The scenario that was run.
    """
    figure, (left, right) = new_figure(height_in=3.4, width_ratios=[1.7, 1.0])
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
        _mark_effect(left, place, str(cell["effect"]), _ratio_text(cell), _ink(ratios, place))
        _write(right, place, _error_text(cell), _ink(errors, place))
    for axes in (left, right):
        _label_axes(axes, weights, delays)
    left.set_title("(a) error, adjusted / nominal [1]")
    right.set_title("(b) nominal gain: error [cm]")
    bar = figure.colorbar(ratios, ax=left, shrink=0.9, pad=0.02)
    bar.set_ticks([1.0 / span, 1.0, span], labels=[f"{t:.2f}" for t in (1.0 / span, 1.0, span)])
    bar.minorticks_off()
    control, study = scenario.control, scenario.gain_study
    caption(
        figure,
        f"{GAIN_METHODS[control.method].label} gains, {scenario.plant_name} plant, h = "
        f"{1e3 * control.sampling_s:g} ms. Means over {study.sweep_robots} robots and "
        f"{len(study.seeds)} seeds in windows of constant violated delay, with 95 % "
        "intervals. Bold: the interval excludes 1. Hatched: the nominal gain stays in force, the "
        f"ratio is exactly 1. {_trouble(grid)}",
    )
    return figure


def _span(ratio: FloatArray) -> float:
    """Return s so that the colours go from 1/s to s and hold every ratio."""
    usable = ratio[np.isfinite(ratio) & (ratio > 0.0)]
    return float(np.exp(np.abs(np.log(usable)).max(initial=np.log(_LEAST_SPAN))))


def _ink(image: AxesImage, place: tuple[int, ...]) -> str:
    """Return black or white, whichever reads better on a cell."""
    values = np.asarray(image.get_array())
    red, green, blue, _ = image.cmap(image.norm(values[place]))
    return "black" if 0.3 * red + 0.59 * green + 0.11 * blue > 0.5 else "white"


def _label_axes(axes: Axes, weights: list[float], delays: list[float]) -> None:
    axes.grid(False)
    axes.set_xticks(range(len(delays)), [f"{1e3 * delay:g}" for delay in delays])
    axes.set_yticks(range(len(weights)), [f"{weight:g}" for weight in weights])
    axes.tick_params(length=0)
    axes.set_xlabel("delay in violated slots [ms]")
    axes.set_ylabel("weight q [1]")


def _write(axes: Axes, place: tuple[int, ...], text: str, ink: str, **options: Any) -> None:
    options |= {"ha": "center", "va": "center", "fontsize": 6.5, "linespacing": 1.3}
    axes.text(place[1], place[0], text, color=ink, **options)


def _mark_effect(axes: Axes, place: tuple[int, ...], effect: str, text: str, ink: str) -> None:
    """Write a ratio into its cell: bold where it differs from 1; hatched where gains are equal."""
    if effect == "same gain":
        corner = place[1] - 0.5, place[0] - 0.5
        look: dict[str, Any] = {
            "facecolor": "none",
            "edgecolor": "#bbbbbb",
            "hatch": "////",
            "linewidth": 0.0,
        }
        axes.add_patch(Rectangle(corner, 1.0, 1.0, **look))
        _write(axes, place, "1", ink, bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0})
    else:
        weight = "bold" if effect in ("helps", "hurts") else "normal"
        _write(axes, place, text, ink, fontweight=weight)


def _ratio_text(cell: dict[Hashable, Any]) -> str:
    lo, hi = cell["ratio_lo"], cell["ratio_hi"]
    if not (np.isfinite(lo) and np.isfinite(hi)):
        return f"{cell['ratio']:.2f}\nunbounded"
    digits = 2 if hi - lo >= 0.02 else 3
    return f"{cell['ratio']:.{digits}f}\n{lo:.{digits}f}–{hi:.{digits}f}"


def _error_text(cell: dict[Hashable, Any]) -> str:
    off = cell["nominal_off_track_share"]
    return f"{cell['nominal_cm']:.2f}" + (f"\n{100.0 * off:.0f} % off" if off > 0.0 else "")


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
