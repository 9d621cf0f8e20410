"""Builds the page of a study from the files that its jobs have written."""

from __future__ import annotations

import hashlib
import json
import math
import platform
import subprocess
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from hiersched.core.extras import naming_extras
from hiersched.core.files import write_bytes
from hiersched.core.html import asset, data_url, page
from hiersched.experiments import files
from hiersched.experiments.fingerprint import PACKAGE_FOLDER
from hiersched.experiments.points import experiments
from hiersched.scenario import Scenario, scenario_sha256, scenario_to_yaml
from hiersched.study.built_in import shown
from hiersched.study.headings import heading
from hiersched.study.registry import FIGURES, TABLES, Shown
from hiersched.study.tables.text import cell_text, interval_text, merged_columns

MOST_SVG_BYTES = 500_000
"""A drawing that is larger is shown as the pixels that lie beside it."""
MOST_ROWS = 400
"""A table with more rows is for computing, and named with its file."""
_SOFTWARE = (
    *("hiersched", "numpy", "scipy", "numba", "torch", "cvxpy", "clarabel", "pandas"),
    *("matplotlib", "snakemake", "mcap"),
)


class Cell(NamedTuple):
    """A cell of a table: its text, and the number or text by which it sorts."""

    text: str
    key: str


class Table(NamedTuple):
    """A table on the page."""

    name: str
    title: str
    note: str
    file: str
    columns: list[tuple[str, str, bool]]  # heading, name in the file, whether it is of numbers
    rows: list[list[Cell]]  # none of a table that is only named
    num_rows: int


def write_study_page(scenario: Scenario, results: Path) -> Path:
    """Write ``report.html`` of a study into its folder `results`, of the files that are there.

    It has the verdicts on claims, every figure, every table to read, and where they come from, in
    one file that asks no network for anything. Returns its path.
    """
    with naming_extras():
        import jinja2

    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters["codes"] = _codes
    template = environment.from_string(asset(__package__, "study.html"))
    body = template.render(
        scenario=scenario.name,
        yaml=scenario_to_yaml(scenario),
        claims=_claims(results),
        figures=[_figure(thing, results) for _, thing in sorted(shown(FIGURES, scenario).items())],
        tables=[_table(thing, results) for _, thing in sorted(shown(TABLES, scenario).items())],
        provenance=_provenance(scenario),
        seeds=_seeds(scenario),
        digests=_digests(results),
        jobs=_jobs(results),
        logs=_logs(results),
        results=results.as_posix(),
    )
    text = page(
        f"{scenario.name}: study",
        body,
        styles=(asset(__package__, "study.css"),),
        scripts=(asset(__package__, "study.js"),),
    )
    return write_bytes(results / files.PAGE, text.encode())


def _codes(text: str) -> Any:
    """Return markup of a text in which `words` in backquotes are code; all else is escaped."""
    from markupsafe import Markup, escape

    parts = str(text).split("`")
    if len(parts) % 2 == 0:
        return escape(text)
    return Markup("").join(
        Markup("<code>{}</code>").format(part) if i % 2 else escape(part)
        for i, part in enumerate(parts)
    )


def _claims(results: Path) -> dict[str, Any] | None:
    """Return the document of the verdicts, if the study judges claims."""
    path = results / files.CLAIMS[0]
    if not path.exists():
        return None
    claims: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return claims


def _figure(thing: Shown, results: Path) -> dict[str, str]:
    svg, png = (results / f"figures/{thing.name}.{end}" for end in ("svg", "png"))
    if svg.stat().st_size <= MOST_SVG_BYTES:
        address = data_url("image/svg+xml", svg.read_bytes())
    else:
        address = data_url("image/png", png.read_bytes())
    return {"name": thing.name, "title": thing.title, "note": thing.note, "address": address}


def _table(thing: Shown, results: Path) -> Table:
    """Return a table with the columns of its Markdown, a number and its interval in one cell."""
    file = f"tables/{thing.name}.csv"
    content = pd.read_csv(results / file, keep_default_na=False,
                          na_values=[""])  # fmt: skip
    is_read = thing.columns != () and len(content) <= MOST_ROWS
    columns = thing.columns or content.columns
    merged, names = merged_columns(content[[name for name in columns if name in content]])
    numeric = {name for name in names if pd.api.types.is_numeric_dtype(content[name])}
    rows = content.to_dict("records") if is_read else []
    return Table(
        name=thing.name,
        title=thing.title,
        note=thing.note,
        file=file,
        columns=[(heading(str(name)), str(name), name in numeric) for name in names],
        rows=[[_cell(row, name, name in merged) for name in names] for row in rows],
        num_rows=len(content),
    )


def _cell(row: Mapping[Any, Any], name: str, has_bounds: bool) -> Cell:
    value = row[name]
    if has_bounds:
        text = interval_text(value, row[f"{name}_lo"], row[f"{name}_hi"])
    else:
        text = cell_text(value).replace("\\|", "|")
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if is_number and not math.isfinite(value):
        return Cell(text, "" if math.isnan(value) else str(value).replace("inf", "Infinity"))
    return Cell(text, str(value))


def _provenance(scenario: Scenario) -> list[tuple[str, str]]:
    """Return lines of label and text: what this page has been made by."""
    software = [f"{name} {found}" for name in _SOFTWARE if (found := _version(name))]
    return [
        ("Scenario", f"{scenario.name}, SHA-256 {scenario_sha256(scenario)}"),
        ("Plug-ins", ", ".join(map(str, scenario.plugins)) or "none"),
        ("Commit", _commit()),
        ("Software", ", ".join(software)),
        ("Python", f"{platform.python_version()} on {platform.machine()}, {platform.system()}"),
    ]


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _commit() -> str:
    """Name the commit of the package's sources when the page is made, if git knows one."""
    unknown = "not known: hiersched does not run from a clone"

    def git(*words: str) -> str:
        call = ["git", "-C", str(PACKAGE_FOLDER), *words]
        return subprocess.run(call, capture_output=True, text=True, check=True).stdout.strip()

    try:
        # A clone of another project may have the package's folder within, ignored or not.
        if not git("ls-files", "--", "study"):
            return unknown
        changed = git("status", "--porcelain", "--", ".")
        return git("rev-parse", "HEAD") + (
            ", with changes that are not committed" if changed else ""
        )
    except (OSError, subprocess.CalledProcessError):
        return unknown


def _seeds(scenario: Scenario) -> list[tuple[str, str]]:
    """Return what runs, and its seeds."""
    rows = [
        (f"training of {name}", _ranges(learning.seeds))
        for name, learning in scenario.learned.items()
    ]
    rows += [(name, _ranges(e.seeds)) for name, e in experiments(scenario).items()]
    if scenario.task_study.cells:
        rows.append(("design worlds of the task study", _ranges(scenario.task_study.design_seeds)))
    return rows


def _ranges(seeds: Sequence[int]) -> str:
    """Return numbers as text, runs of three and more as their ends."""
    runs: list[list[int]] = []
    for seed in seeds:
        if runs and seed == runs[-1][-1] + 1:
            runs[-1].append(seed)
        else:
            runs.append([seed])
    return ", ".join(
        f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs
    )


def _digests(results: Path) -> list[tuple[str, str]]:
    """Return the SHA-256 of what the page shows and of what was measured, by file."""
    found = [results / name for name in files.CLAIMS]
    for folder in ("tables", "measures", "gains", "tune"):
        found += sorted((results / folder).rglob("*.*"))
    return [
        (path.relative_to(results).as_posix(), hashlib.sha256(path.read_bytes()).hexdigest())
        for path in found
        if path.is_file() and path.suffix != ".md"
    ]


def _jobs(results: Path) -> list[list[Cell]]:
    """Return name, time, CPU time [s] and memory [MB] of every job that was measured."""
    rows = []
    for path in sorted((results / "benchmarks").glob("*.tsv")):
        table = pd.read_csv(path, sep="\t")
        numbers = (float(table[name].sum()) for name in ("s", "cpu_time"))
        memory = float(pd.to_numeric(table["max_rss"], errors="coerce").max())
        cells = [Cell(_plain(value), str(value)) for value in (*numbers, memory)]
        rows.append([Cell(path.stem, path.stem), *cells])
    return rows


def _plain(value: float) -> str:
    return f"{value:,.1f}" if math.isfinite(value) else "–"


def _logs(results: Path) -> list[list[Cell]]:
    """Return path and size of every log."""
    rows = []
    for path in sorted(p for d in (files.RUNS, "train") for p in (results / d).rglob("*.mcap")):
        name, size = path.relative_to(results).as_posix(), path.stat().st_size
        rows.append([Cell(name, name), Cell(f"{size:,}", str(size))])
    return rows
