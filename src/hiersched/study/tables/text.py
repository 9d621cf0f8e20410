"""Tables as text: CSV with full precision, Markdown to read."""

from __future__ import annotations

import math
from typing import Any

import pandas as pd

SEEDS_NOTE = "Means over seeds, in brackets their Student t 95 % intervals."
LOGGED_NOTE = (
    "The learned policy's slots are those of its logs: world i ran the policy of training seed i."
)
LEARNED_NOTE = (
    "Learned policies: every trained policy in every world, ratios and differences by world within "
    "each; intervals have the parts of both."
)
RATIO_NOTE = (
    "Ratios are geometric means over the same worlds, in brackets Student's 95 % interval of their "
    "logarithms."
)
NONE_NOTE = (
    "A share of 0 in a world enters a ratio as the least share that could be seen there. Where "
    "those of a policy do, ratio and upper bound are upper bounds, and the lower bound is 0; where "
    "those of the baseline do, ratio and lower bound are lower bounds, and there is no upper one; "
    "a dash: both do."
)
LOOP_NOTE = (
    "`loop`: whether the second moment of the linear loop shrinks or grows over the delays that "
    "the logs have, worlds together, of the user for whom it grows most without a hold of its "
    "gains: in the evaluation as it runs, elsewhere without the hold; `loop_growth`: its factor a "
    "sample. A filter's is that on a straight line. `not known`: delays too long to tell, or a "
    "filter whose beliefs are wrong; `local`: nothing of the loop crosses the network."
)
FORCED_LOOP_NOTE = (
    "`…loop`: whether the second moment of the linear loop, as it runs, shrinks or grows over the "
    "delays of these windows, all robots together; `…loop_growth`: its factor a sample. A filter's "
    "is that on a straight line. `not known`: delays too long to tell, or a filter whose beliefs "
    "are wrong."
)
TROUBLE_NOTE = (
    "Shares of robots: `off_track`, over 10 cm in a window; `saturated`, at a control limit for "
    "half of one. All robots are in the means."
)


def markdown_text(table: pd.DataFrame, title: str, note: str) -> str:
    """Return a table as Markdown, a mean and its bounds in one cell."""
    names, rows = _cells(table)
    lines = [f"# {title}", "", note, ""]
    lines.append("| " + " | ".join(names) + " |")
    lines.append("|" + "|".join(_alignment(table, name) for name in names) + "|")
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def aligned_text(table: pd.DataFrame) -> str:
    """Return a table for a terminal, a mean and its bounds in one cell: numbers on the right."""
    names, rows = _cells(table)
    widths = [max(map(len, column)) for column in zip(names, *rows, strict=True)]
    right = [pd.api.types.is_numeric_dtype(table[name]) for name in names]
    lines = []
    for row in [names, *rows]:
        cells = zip(row, widths, right, strict=True)
        line = "  ".join(f"{cell:>{w}}" if number else f"{cell:<{w}}" for cell, w, number in cells)
        lines.append(line.rstrip() + "\n")
    return "".join(lines)


def _cells(table: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """Return the names of the columns and the rows as text, a mean and its bounds in one cell."""
    merged, names = merged_columns(table)
    rows = [
        [
            interval_text(row[name], row[f"{name}_lo"], row[f"{name}_hi"])
            if name in merged
            else cell_text(row[name])
            for name in names
        ]
        for row in table.to_dict("records")
    ]
    return names, rows


def merged_columns(table: pd.DataFrame) -> tuple[list[str], list[str]]:
    """Return the columns that have bounds, and all that are no bounds themselves."""
    merged = [name for name in table.columns if {f"{name}_lo", f"{name}_hi"} <= set(table.columns)]
    bounds = {f"{name}_{end}" for name in merged for end in ("lo", "hi")}
    return merged, [name for name in table.columns if name not in bounds]


def interval_text(mean: float, lo: float, hi: float) -> str:
    """Return a mean and its interval, to two digits of its half width or of each number.

    A mean of 0 is given by its upper bound.
    """
    if not math.isfinite(mean):
        return "–"
    if math.isfinite(lo) and hi == math.inf:
        return f"{_rounded(mean, 3)} [{_rounded(lo, 2)}, ∞)"
    if not (math.isfinite(lo) and math.isfinite(hi)):
        return cell_text(mean) if math.isnan(lo) else f"{cell_text(mean)} [unbounded]"
    half = (hi - lo) / 2.0
    if half <= 1e-12 * abs(mean):
        return f"{cell_text(mean)} [±0]"
    if mean == lo == 0.0:
        return f"< {hi:.2g}"
    decimals = 1 - math.floor(math.log10(half))
    skewed = hi > 10.0 * lo > 0.0 or hi > 30.0 * abs(mean)
    if not -3 <= decimals <= 6 or skewed:  # each number with digits of its own
        return f"{_rounded(mean, 3)} [{_rounded(lo, 2)}, {_rounded(hi, 2)}]"
    decimals = max(0, decimals)
    return f"{mean:.{decimals}f} [{lo:.{decimals}f}, {hi:.{decimals}f}]"


def _rounded(value: float, digits: int) -> str:
    """Return a number with so many significant digits; no power of ten below a million."""
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(value) < 1e6 else text


def cell_text(value: Any) -> str:
    """Return a cell: numbers with four significant digits, no number as a dash."""
    if isinstance(value, bool) or not isinstance(value, float):
        return str(value).replace("|", "\\|")
    return _rounded(value, 4) if math.isfinite(value) else "–"


def _alignment(table: pd.DataFrame, name: str) -> str:
    return "---:" if pd.api.types.is_numeric_dtype(table[name]) else "---"
