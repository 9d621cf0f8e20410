"""Makes one registered table, figure or claim and writes its files."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path

from hiersched.scenario import Scenario
from hiersched.study.registry import CLAIMS, FIGURES, TABLES
from hiersched.study.study import Study


def show(scenario: Scenario, results: Path, kind: str, name: str, module: str) -> None:
    """Make a ``table``, ``figure`` or ``claim`` of a study and write its files.

    It is registered by that name in a module; the scenario's plug-ins are imported already.
    """
    if module not in sys.modules:
        import_module(module)
    study = Study(scenario, results)
    if kind == "table":
        from hiersched.study.tables.text import write_table

        shown = TABLES[name]
        write_table(shown, shown.build(study), results / "tables")
    elif kind == "figure":
        from hiersched.study.figures.style import house_style, save_figure

        with house_style():
            save_figure(FIGURES[name].build(study), results / "figures", name)
    else:
        from hiersched.study.claims.report import claim_json, write_json

        shown = CLAIMS[name]
        write_json(results / f"claims/{name}.json", claim_json(shown, shown.build(study)))
