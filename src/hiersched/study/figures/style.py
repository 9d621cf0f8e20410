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
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.ticker import FixedFormatter, FixedLocator, NullFormatter, NullLocator

from hiersched.core.files import write_bytes
from hiersched.policies.find import EXACT
from hiersched.policies.registry import RULES, Look
from hiersched.policies.task_rules import TASK_RULES
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
    "lqg": Look("filter (LQG)", "#56B4E9", "-", "X"),
}
"""How the methods of the gain study are drawn."""


def policy_look(policy: str, scenario: Scenario | None = None) -> Look:
    """Return how a policy is drawn, the same in every figure.

    A rule, or a learner or policy of the scenario; without one the only learner is ``ddpg``. The
    first policy of each rule of `TASK_RULES` has that rule's look under its own name.
    """
    learners = ["ddpg"] if scenario is None else list(scenario.learned)
    own = {} if scenario is None else scenario.policies
    if policy in learners:
        first, *others = policy.split("_")
        text = " ".join([first.upper() if first in ALGORITHM_NAMES else first, *others])
        place = learners.index(policy)
        if place == 0:
            return Look(f"DRL ({text})", _LEARNED_COLOR, "-", "o")
        return Look(text, *_LEARNER_LOOKS[(place - 1) % len(_LEARNER_LOOKS)])
    if policy in own:
        kinds = [getattr(entry, "model", None) for entry in own.values()]
        place = list(own).index(policy)
        rule = kinds[place]
        if rule in TASK_RULES and rule not in kinds[:place]:
            _, *look = RULES[rule].look  # type: ignore[attr-defined]
        else:
            look = list(_OWN_LOOKS[place % len(_OWN_LOOKS)])
        return Look(policy.replace("_", " "), *look)
    return _EXACT if policy == EXACT else RULES[policy].look  # type: ignore[attr-defined]


@contextmanager
def house_style() -> Iterator[None]:
    """Draw with the house style inside a with block."""
    with mpl.rc_context(_RC):
        yield


def new_figure(
    columns: int = 2, rows: int = 1, *, height_in: float = PANEL_HEIGHT_IN, **subplots: Any
) -> tuple[Figure, list[Axes]]:
    """Return a figure of so many panels, row by row."""
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **subplots)
    return figure, list(axes.flat)


def caption(figure: Figure, text: str) -> None:
    """Write small print below the panels."""
    lines = textwrap.fill(text, CAPTION_CHARACTERS)
    figure.supxlabel(lines, fontsize=6.5, color=GREY, x=0.01, ha="left", multialignment="left")


def shared_legend(
    figure: Figure, *panels: Axes, columns: int | None = None, side: str = "left"
) -> None:
    """Put one legend above all panels, with the entries of some of them, each once."""
    entries = {
        label: handle
        for axes in panels
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    # Matplotlib lists plain lines before error bars: measured series first, references last.
    labels = sorted(entries, key=lambda label: not isinstance(entries[label], ErrorbarContainer))
    figure.legend(
        [entries[label] for label in labels],
        labels,
        loc="outside upper right" if side == "right" else "outside upper left",
        ncols=columns or len(labels),
        columnspacing=1.4,
    )


def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as SVG and PNG and return both files.

    Equal figures give equal bytes, on one version of matplotlib.
    """
    written = []
    for suffix, metadata in (("svg", {"Date": None}), ("png", {"Software": None})):
        stream = io.BytesIO()
        figure.savefig(stream, format=suffix, dpi=DPI, metadata=metadata)
        written.append(write_bytes(folder / f"{name}.{suffix}", stream.getvalue()))
    return written


def share_intervals(shares: npt.NDArray[np.float64]) -> pd.DataFrame:
    """Return `share` (_lo, _hi), mean over worlds at every point, of shape (points, worlds)."""
    return pd.DataFrame([mean_interval(row).columns("share") for row in shares])


def draw_curve(
    axes: Axes,
    x: npt.ArrayLike,
    rows: pd.DataFrame,
    measure: str,
    look: Look,
    *,
    cut: tuple[float, float] = (-math.inf, math.inf),
    alpha: float = 0.15,
    **line: Any,
) -> None:
    """Draw a measure as a line and its bounds, cut at a least and a greatest value, as a band.

    There is no band where its opacity `alpha` is 0.
    """
    low, high = (rows[f"{measure}_{end}"].clip(*cut) for end in ("lo", "hi"))
    if alpha:
        axes.fill_between(x, low, high, color=look.color, alpha=alpha, linewidth=0)
    style = {"color": look.color, "linestyle": look.dashes, "label": look.label, **line}
    axes.plot(x, rows[measure], **style)


def draw_series(
    axes: Axes,
    x: npt.ArrayLike,
    rows: pd.DataFrame,
    measure: str,
    look: Look,
    *,
    floor: float | None = None,
) -> None:
    """Draw means with their intervals as error bars, joined by a line.

    A bar without an upper bound is an arrow out of the panel, which does not stretch the axis. Rows
    have the columns `measure`, ``_lo`` and ``_hi`` behind it too. Where a logarithmic axis shows 0,
    at `floor`, means of 0 get an open marker, and bars stop there.
    """
    middle, low, high = (rows[f"{measure}{end}"].to_numpy(float) for end in ("", "_lo", "_hi"))
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
        label=look.label,
    )
    if zero.any():
        open_marks(axes, places[zero], middle[zero], look, zorder=4)
    for place, at in zip(places[unbounded], middle[unbounded], strict=True):
        unbounded_bar(axes, place, at, look)


def open_marks(axes: Axes, x: npt.ArrayLike, y: npt.ArrayLike, look: Look, **options: Any) -> None:
    """Draw a look's markers, filled with white."""
    style: dict[str, Any] = {"linestyle": "none", "marker": look.marker, **options}
    axes.plot(x, y, markerfacecolor="white", markeredgecolor=look.color, **style)


def draw_mark(
    axes: Axes,
    row: Any,
    measure: str,
    y: float,
    look: Look,
    *,
    floor: float = -math.inf,
    hollow: bool = False,
    **options: Any,
) -> None:
    """Draw one mean at a height, its interval as a bar sideways; nothing lies left of the floor.

    The row is one of `draw_series`; a hollow mark is white inside; options are of `Axes.errorbar`.
    """
    at, low, high = (max(float(row[f"{measure}{end}"]), floor) for end in ("", "_lo", "_hi"))
    if high == np.inf:
        unbounded_bar(axes, at, y, look, which="x")
        high = at
    axes.errorbar(
        [at],
        [y],
        xerr=[[at - low], [high - at]],
        color=look.color,
        marker=look.marker,
        markerfacecolor="white" if hollow else look.color,
        **options,
    )


def unbounded_bar(axes: Axes, x: float, y: float, look: Look, *, which: str = "y") -> None:
    """Draw an arrow from a point to the upper end of an axis, ``x`` or ``y``."""
    style = {"arrowstyle": "->", "color": look.color, "linewidth": 0.9}
    axes.annotate(
        "",
        (x, 1.0) if which == "y" else (1.0, y),
        xytext=(x, y),
        xycoords=("data", "axes fraction") if which == "y" else ("axes fraction", "data"),
        textcoords="data",
        arrowprops={**style, "shrinkA": 0.0, "shrinkB": 0.0},
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

    It is shown at `floor`, from `zero_floor`; the values have to fit, NaN counts for nothing.
    """
    finite = np.asarray(values, dtype=np.float64).ravel()
    first = math.ceil(math.log10(floor))
    top = max([10.0 * floor, *finite[np.isfinite(finite)].tolist()])
    end = max(top * 1.6, 10.0 ** (first + 1))
    last = max(first + 1, math.ceil(math.log10(top)))
    shown = [decade for decade in range(first, last + 1) if 10.0**decade <= end]
    axes.set(**{f"{which}scale": "log", f"{which}lim": (floor * 0.72, end)})
    axis = axes.yaxis if which == "y" else axes.xaxis
    axis.set_major_locator(FixedLocator([floor, *(10.0**decade for decade in shown)]))
    axis.set_major_formatter(FixedFormatter(["0", *(f"$10^{{{decade}}}$" for decade in shown)]))
    axis.set_minor_locator(NullLocator())
    line = axes.axhline if which == "y" else axes.axvline
    line(math.sqrt(floor * 10.0**first), color=GREY, linestyle=(0, (1, 3)), linewidth=0.8, zorder=0)


def log_ticks(axes: Axes, values: Sequence[float]) -> None:
    """Make the axis of x logarithmic with a tick at each of the values."""
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(FixedLocator(list(values)))
    axes.xaxis.set_major_formatter(FixedFormatter([f"{value:g}" for value in values]))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_minor_formatter(NullFormatter())
