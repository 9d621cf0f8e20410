"""One look for all figures: sizes, palette, lines and markers that also tell apart in grey.

Figures are made without pyplot, so nothing here depends on a display or leaves state behind.
"""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.ticker import FixedFormatter, FixedLocator, NullFormatter, NullLocator

from hiersched.core.files import write_bytes
from hiersched.policies.find import EXACT
from hiersched.policies.registry import RULES, Look
from hiersched.scenario import Scenario
from hiersched.study.statistics import mean_interval

WIDTH_IN = 7.2
PANEL_HEIGHT_IN = 2.7
DPI = 200
CAPTION_CHARACTERS = 150
GREY = "#5f5f5f"
PAPER_COLOR = "#000000"

_RC: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.titlelocation": "left",
    "axes.titlepad": 7.0,
    "axes.labelsize": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.5,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "legend.handlelength": 2.6,
    "lines.linewidth": 1.4,
    "lines.markersize": 4.5,
    "errorbar.capsize": 2.5,
    "axes.formatter.useoffset": False,
    "figure.constrained_layout.w_pad": 0.06,
    "figure.constrained_layout.h_pad": 0.05,
    "svg.hashsalt": "hiersched",
    "svg.fonttype": "path",
    "path.simplify": True,
}


ALGORITHM_NAMES = ("ddpg", "a2c")
"""Words that are written in capitals."""


_EXACT = Look("exact optimum", "#000000", (0, (1, 4)), "*")
_LEARNED_COLOR = "#0072B2"
_LEARNER_LOOKS = (
    ("#AA3377", (0, (5, 1.5)), "X"),
    ("#44AA99", (0, (2, 1.2)), "v"),
    ("#B59D00", (0, (6, 1.5, 1, 1.5)), "P"),
    ("#332288", (0, (1, 1)), "h"),
    ("#661100", (0, (8, 2)), "<"),
)
"""Of the learners besides the scenario's own, in their order; over again after the last."""
_OWN_LOOKS = (
    ("#B03060", (0, (4, 2, 1, 2)), "*"),
    ("#4B7F52", (0, (2, 1, 2, 3)), "8"),
    ("#6A5ACD", (0, (9, 2)), "H"),
    ("#A0522D", (0, (1, 1, 3, 1)), "d"),
)
"""Of the policies that a scenario adds, likewise."""
CONTROL = Look("learns nothing", GREY, (0, (3, 1.5)), "d")
"""Of learners whose actors stay as they start."""
SLICES = {
    "embb": Look("eMBB", "#E69F00", (0, (4, 1.5)), "s"),
    "urllc": Look("URLLC", "#0072B2", "-", "o"),
}
GAIN_METHODS = {
    "nominal": Look("nominal gain", "#D55E00", (0, (4, 1.5)), "s"),
    "krasovskii": Look("Krasovskii", "#0072B2", "-", "o"),
    "razumikhin": Look("Razumikhin", "#009E73", (0, (6, 1.5, 1, 1.5)), "^"),
    "predictor": Look("predictor", "#CC79A7", (0, (1, 1.2)), "D"),
    "latency_compensated": Look("latency-compensated", "#3b3b3b", (0, (7, 1, 2, 1)), "v"),
    "h2": Look("H2", "#E69F00", (0, (3, 1, 1, 1)), "P"),
}
"""How the methods of the gain study are drawn."""


def policy_look(policy: str, scenario: Scenario | None = None) -> Look:
    """Return how a policy is drawn, the same in every figure.

    Parameters
    ----------
    policy
        A rule, or a learner or policy of the scenario.
    scenario
        Its learners, the study's own first, and its own policies; unless given there is ``ddpg``.
    """
    learners = ["ddpg"] if scenario is None else list(scenario.learned)
    if policy in learners:
        words = policy.split("_")
        text = " ".join([words[0].upper() if words[0] in ALGORITHM_NAMES else words[0], *words[1:]])
        place = learners.index(policy)
        if place == 0:
            return Look(f"DRL ({text})", _LEARNED_COLOR, "-", "o")
        return Look(text, *_LEARNER_LOOKS[(place - 1) % len(_LEARNER_LOOKS)])
    own = [] if scenario is None else list(scenario.policies)
    if policy in own:
        return Look(policy.replace("_", " "), *_OWN_LOOKS[own.index(policy) % len(_OWN_LOOKS)])
    return _EXACT if policy == EXACT else RULES[policy].look  # type: ignore[attr-defined]


@contextmanager
def house_style() -> Iterator[None]:
    """Draw with the house style inside a with block."""
    with mpl.rc_context(_RC):
        yield


def new_figure(
    columns: int = 2, *, height_in: float = PANEL_HEIGHT_IN, **subplots: Any
) -> tuple[Figure, list[Axes]]:
    """Return a figure of panels side by side."""
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    axes = figure.subplots(1, columns, squeeze=False, **subplots)
    return figure, list(axes[0])


def caption(figure: Figure, text: str) -> None:
    """Write small print below the panels."""
    lines = textwrap.fill(text, CAPTION_CHARACTERS)
    figure.supxlabel(lines, fontsize=6.5, color=GREY, x=0.01, ha="left", multialignment="left")


def shared_legend(
    figure: Figure, axes: Axes, *, columns: int | None = None, side: str = "left"
) -> None:
    """Put a panel's legend above the panels, for all of them."""
    # Matplotlib lists plain lines before error bars: measured series first, references last.
    entries = sorted(
        zip(*axes.get_legend_handles_labels(), strict=True),
        key=lambda entry: not isinstance(entry[0], ErrorbarContainer),
    )
    handles, labels = [entry[0] for entry in entries], [entry[1] for entry in entries]
    figure.legend(
        handles,
        labels,
        loc="outside upper right" if side == "right" else "outside upper left",
        ncols=columns or len(labels),
        columnspacing=1.4,
    )


def note_at(axes: Axes, text: str, x: float, y: float, **options: Any) -> None:
    """Write small text into a panel, on white."""
    axes.annotate(
        text,
        (x, y),
        fontsize=7,
        bbox={"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 0.8},
        zorder=5,
        **options,
    )


def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as SVG and PNG; equal figures give equal bytes (on one version of matplotlib).

    Parameters
    ----------
    figure
        The figure.
    folder
        Where to.
    name
        File name without suffix.

    Returns
    -------
    list of Path
        The two files.
    """
    written = []
    for suffix, metadata in (("svg", {"Date": None}), ("png", {"Software": None})):
        stream = io.BytesIO()
        figure.savefig(stream, format=suffix, dpi=DPI, metadata=metadata)
        written.append(write_bytes(folder / f"{name}.{suffix}", stream.getvalue()))
    return written


def share_intervals(shares: npt.NDArray[np.float64]) -> dict[str, list[float]]:
    """Return mean and interval over worlds at every point; shares have shape (points, worlds)."""
    intervals = [mean_interval(row) for row in shares]
    return {
        "share": [interval.mean for interval in intervals],
        "share_lo": [interval.lo for interval in intervals],
        "share_hi": [interval.hi for interval in intervals],
    }


def draw_series(
    axes: Axes,
    x: npt.ArrayLike,
    mean: npt.ArrayLike,
    lo: npt.ArrayLike,
    hi: npt.ArrayLike,
    look: Look,
    *,
    floor: float | None = None,
    label: str | None = None,
) -> None:
    """Draw means with their intervals as error bars, joined by a line.

    A bar without an upper bound is an arrow out of the panel, which does not stretch the axis.

    Parameters
    ----------
    axes
        Panel.
    x, mean, lo, hi
        Points, shape (n,).
    look
        Colour, dashes, marker, label.
    floor
        Where a logarithmic axis shows 0: means of 0 get an open marker there, bars stop there.
    label
        Label instead of the look's own.
    """
    middle, low, high = (np.asarray(values, dtype=np.float64) for values in (mean, lo, hi))
    places = np.asarray(x, dtype=np.float64)
    zero = np.zeros(len(middle), bool)
    if floor is not None:
        zero = middle <= 0.0
        middle, low, high = (np.maximum(values, floor) for values in (middle, low, high))
    unbounded = (high == np.inf) & np.isfinite(low)
    axes.errorbar(
        places,
        middle,
        yerr=[middle - low, np.where(unbounded, 0.0, high - middle)],
        color=look.color,
        linestyle=look.dashes,
        marker=look.marker,
        elinewidth=0.9,
        label=look.label if label is None else label,
    )
    if zero.any():
        axes.plot(
            places[zero],
            middle[zero],
            linestyle="none",
            marker=look.marker,
            markerfacecolor="white",
            markeredgecolor=look.color,
            zorder=4,
        )
    for place, at in zip(places[unbounded], middle[unbounded], strict=True):
        unbounded_bar(axes, place, at, look)


def unbounded_bar(axes: Axes, x: float, y: float, look: Look, *, which: str = "y") -> None:
    """Draw an arrow from a point to the upper end of an axis, ``x`` or ``y``."""
    end = ("data", "axes fraction") if which == "y" else ("axes fraction", "data")
    axes.annotate(
        "",
        (x, 1.0) if which == "y" else (1.0, y),
        xytext=(x, y),
        xycoords=end,
        textcoords="data",
        arrowprops={
            **{"arrowstyle": "->", "color": look.color, "linewidth": 0.9},
            **{"shrinkA": 0.0, "shrinkB": 0.0},
        },
    )


def arrows_text(hi: npt.ArrayLike) -> str:
    """Say what an arrow instead of a bar is, where there is one among these upper bounds."""
    return " Arrows: no upper bound." if (np.asarray(hi, np.float64) == np.inf).any() else ""


def zero_floor(values: npt.ArrayLike) -> float:
    """Return where a logarithmic axis shows 0: well below the smallest positive value."""
    finite = np.asarray(values, dtype=np.float64).ravel()
    positive = finite[np.isfinite(finite) & (finite > 0.0)]
    if not positive.size:
        return 1e-6
    return float(10.0 ** (math.floor(math.log10(float(positive.min())) - 0.1) - 0.7))


def log_axis_with_zero(
    axes: Axes, floor: float, values: npt.ArrayLike, *, which: str = "y"
) -> None:
    """Make an axis logarithmic with a mark for 0 at its lower end, set apart by a dotted line.

    Parameters
    ----------
    axes
        Panel.
    floor
        Where 0 is shown, from `zero_floor`.
    values
        What has to fit, of any shape; NaN counts for nothing.
    which
        ``x`` or ``y``.
    """
    finite = np.asarray(values, dtype=np.float64).ravel()
    top = max([10.0 * floor, *finite[np.isfinite(finite)].tolist()])
    first = math.ceil(math.log10(floor))
    last = max(first + 1, math.ceil(math.log10(top)))
    decades = range(first, last + 1)
    axis = axes.yaxis if which == "y" else axes.xaxis
    (axes.set_yscale if which == "y" else axes.set_xscale)("log")
    limits = axes.set_ylim if which == "y" else axes.set_xlim
    limits(floor * 0.72, max(top * 1.6, 10.0 ** (first + 1)))
    shown = [d for d in decades if 10.0**d <= max(top * 1.6, 10.0 ** (first + 1))]
    axis.set_major_locator(FixedLocator([floor, *(10.0**d for d in shown)]))
    axis.set_major_formatter(FixedFormatter(["0", *(f"$10^{{{d}}}$" for d in shown)]))
    axis.set_minor_locator(NullLocator())
    line = axes.axhline if which == "y" else axes.axvline
    line(math.sqrt(floor * 10.0**first), color=GREY, linestyle=(0, (1, 3)), linewidth=0.8, zorder=0)


def log_ticks(axes: Axes, values: Sequence[float], *, which: str = "x") -> None:
    """Make an axis logarithmic with a tick at each of the values."""
    axis = axes.xaxis if which == "x" else axes.yaxis
    (axes.set_xscale if which == "x" else axes.set_yscale)("log")
    axis.set_major_locator(FixedLocator(list(values)))
    axis.set_major_formatter(FixedFormatter([f"{value:g}" for value in values]))
    axis.set_minor_locator(NullLocator())
    axis.set_minor_formatter(NullFormatter())
