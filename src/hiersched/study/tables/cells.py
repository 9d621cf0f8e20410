"""Tables as pages show them: headings with units, the names of figures, rounded numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from hiersched.policies.find import UNTRAINED
from hiersched.policies.registry import RULES
from hiersched.scenario import Scenario
from hiersched.study.headings import heading
from hiersched.study.tables.text import cell_text, interval_text, merged_columns

_POLICY_COLUMNS = (
    *("policy", "learner", "baseline", "best_classical", "decider", "states_of"),
    *("blind", "classical", "aware", "twin"),
)
"""Columns whose cells name a policy."""


class Head(NamedTuple):
    """The heading of a column, its name in the file, and whether it is of numbers."""

    text: str
    name: str
    is_number: bool


class Cell(NamedTuple):
    """A cell of a table: its text, and the number or text by which it sorts; "" is none."""

    text: str
    key: str


def read_table(path: Path) -> pd.DataFrame:
    """Read a table of a study: an empty cell is no number, and text such as "nan" is text."""
    return pd.read_csv(path, keep_default_na=False, na_values=[""])


def readable(table: pd.DataFrame, scenario: Scenario) -> tuple[list[Head], list[list[Cell]]]:
    """Return the headings and the rows of a table: a mean and its bounds are one cell.

    Headings are words and a unit; policies and methods are called as in the figures.
    """
    merged, names = merged_columns(table)
    heads = [
        Head(heading(str(name)), str(name), pd.api.types.is_numeric_dtype(table[name]))
        for name in names
    ]
    rows = [
        [_cell(row, name, name in merged, scenario) for name in names]
        for row in table.to_dict("records")
    ]
    return heads, rows


def _cell(row: Mapping[Any, Any], name: str, has_bounds: bool, scenario: Scenario) -> Cell:
    value = row[name]
    if isinstance(value, int | float) and not isinstance(value, bool):
        bounds = [row[f"{name}_{end}"] for end in ("lo", "hi") if has_bounds]
        return Cell(interval_text(value, *bounds) if bounds else cell_text(value), _key(value))
    text = _words(value, name, scenario)
    return Cell(text, text)


def _key(value: float) -> str:
    """Return a number as the script of a page reads it."""
    if math.isfinite(value):
        return str(value)
    return "" if math.isnan(value) else str(value).replace("inf", "Infinity")


def _words(value: Any, name: str, scenario: Scenario) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if name in _POLICY_COLUMNS:
        return _policy_label(str(value), scenario)
    return _method_label(str(value)) if name == "method" else str(value)


def _policy_label(name: str, scenario: Scenario) -> str:
    """Return what figures call a policy; a name that is none is its own."""
    from hiersched.study.figures.style import policy_look

    known = (*UNTRAINED, *RULES, *scenario.learned, *scenario.policies)
    return policy_look(name, scenario).label if name in known else name


def _method_label(name: str) -> str:
    """Return what figures call a method of the gain study; a name that is none is its own."""
    from hiersched.study.figures.style import GAIN_METHODS

    return GAIN_METHODS[name].label if name in GAIN_METHODS else name
