"""Makes one registered table, figure or claim and writes its files."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from hiersched.scenario import Scenario
from hiersched.study.registry import CLAIMS, FIGURES, TABLES, Shown
from hiersched.study.study import Study

if TYPE_CHECKING:
    import pandas as pd


def show(scenario: Scenario, results: Path, kind: str, name: str, module: str) -> None:
    """Make a ``table``, ``figure`` or ``claim`` of a study and write its files.

    It is registered by that name in a module; the scenario's plug-ins are imported already.
    """
    if module not in sys.modules:
        import_module(module)
    study = Study(scenario, results)
    if kind == "table":
        shown = TABLES[name]
        write_table(shown, shown.build(study), results / "tables", scenario)
    elif kind == "figure":
        from hiersched.study.figures.style import house_style, save_figure

        with house_style():
            save_figure(FIGURES[name].build(study), results / "figures", name)
    else:
        from hiersched.study.claims.report import claim_json, write_json

        shown = CLAIMS[name]
        write_json(results / f"claims/{name}.json", claim_json(shown, shown.build(study)))


def write_table(shown: Shown, content: pd.DataFrame, folder: Path, scenario: Scenario) -> None:
    """Write a table: CSV, and HTML and Markdown unless it has no columns to read."""
    from hiersched.core.files import csv_text, write_bytes
    from hiersched.study.tables.cells import read_table
    from hiersched.study.tables.html import table_page
    from hiersched.study.tables.text import markdown_text

    csv = write_bytes(folder / f"{shown.name}.csv", csv_text(content).encode())
    if shown.columns != ():
        text = markdown_text(shown.read_columns(content), shown.title, shown.note)
        write_bytes(folder / f"{shown.name}.md", text.encode())
        # Of the file, as the page of the study has it: both say the same of a cell.
        page = table_page(shown, read_table(csv), scenario)
        write_bytes(folder / f"{shown.name}.html", page.encode())
