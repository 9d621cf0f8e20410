"""Builds the page of a study from the files that its jobs have written."""

from __future__ import annotations

import hashlib
import json
import math
import platform
import subprocess
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from hiersched.core.extras import naming_extras
from hiersched.core.files import write_bytes
from hiersched.core.html import asset, codes, data_url, page
from hiersched.experiments import files
from hiersched.experiments.fingerprint import PACKAGE_FOLDER
from hiersched.experiments.points import experiments
from hiersched.scenario import Scenario, scenario_sha256, scenario_to_yaml
from hiersched.study.built_in import shown
from hiersched.study.outputs import run_files, shown_files, source_files
from hiersched.study.registry import CLAIMS, FIGURES, TABLES, Shown
from hiersched.study.tables.cells import Cell, Head, read_table, readable

MOST_SVG_BYTES = 500_000
"""A drawing that is larger is shown as the pixels that lie beside it."""
MOST_ROWS = 400
"""A table with more rows is for computing, and named with its file."""
_SOFTWARE = (
    *("hiersched", "numpy", "scipy", "numba", "torch", "cvxpy", "clarabel", "pandas"),
    *("matplotlib", "snakemake", "mcap"),
)


class Table(NamedTuple):
    """A table on the page."""

    name: str
    title: str
    note: str
    file: str
    heads: list[Head]
    rows: list[list[Cell]]  # none of a table that is only named
    num_rows: int


def write_study_page(scenario: Scenario, results: Path, jobs: Sequence[str] = ()) -> Path:
    """Write ``report.html`` of a study into its folder `results`, which has all its files.

    It has the verdicts on claims, every figure, every table to read, and where they come from, in
    one file that asks no network for anything: of what the scenario asks for, whatever else lies in
    the folder. Of `jobs`, by name, it has the times that were measured. Returns its path.
    """
    with naming_extras():
        import jinja2
        from markupsafe import Markup

    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters["codes"] = lambda text: Markup(codes(text))
    template = environment.from_string(asset(__package__, "study.html"))
    figures, tables = shown(FIGURES, scenario), shown(TABLES, scenario)
    body = template.render(
        scenario=scenario.name,
        yaml=scenario_to_yaml(scenario),
        claims=_claims(scenario, results),
        figures=[_figure(figures[name], results) for name in sorted(figures)],
        tables=[_table(tables[name], scenario, results) for name in sorted(tables)],
        provenance=_provenance(scenario),
        seeds=_seeds(scenario),
        digests=_digests(scenario, results),
        jobs=_jobs(jobs, results),
        logs=_logs(scenario, results),
        results=results.as_posix(),
    )
    text = page(
        f"{scenario.name}: study",
        body,
        styles=(asset(__package__, "study.css"),),
        scripts=(asset(__package__, "study.js"),),
    )
    return write_bytes(results / files.PAGE, text.encode())


def _claims(scenario: Scenario, results: Path) -> dict[str, Any] | None:
    """Return the document of the verdicts, if the study judges claims."""
    if not shown(CLAIMS, scenario):
        return None
    claims: dict[str, Any] = json.loads((results / files.CLAIMS[0]).read_text(encoding="utf-8"))
    return claims


def _figure(thing: Shown, results: Path) -> dict[str, str]:
    svg, png = (results / f"figures/{thing.name}.{end}" for end in ("svg", "png"))
    if svg.stat().st_size <= MOST_SVG_BYTES:
        address = data_url("image/svg+xml", svg.read_bytes())
    else:
        address = data_url("image/png", png.read_bytes())
    return {"name": thing.name, "title": thing.title, "note": thing.note, "address": address}


def _table(thing: Shown, scenario: Scenario, results: Path) -> Table:
    """Return a table; a long one, or one to compute with, without its rows."""
    file = f"tables/{thing.name}.csv"
    content = read_table(results / file)
    is_read = thing.columns != () and len(content) <= MOST_ROWS
    heads, rows = readable(thing.read_columns(content), scenario) if is_read else ([], [])
    return Table(
        name=thing.name,
        title=thing.title,
        note=thing.note,
        file=file,
        heads=heads,
        rows=rows,
        num_rows=len(content),
    )


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


def _digests(scenario: Scenario, results: Path) -> list[tuple[str, str]]:
    """Return the SHA-256 of the numbers shown and of what they were made of, by file."""
    numbers = [name for name in shown_files(scenario) if name.endswith((".csv", ".json"))]
    return [
        (name, hashlib.sha256((results / name).read_bytes()).hexdigest())
        for name in (*numbers, *source_files(scenario))
    ]


def _jobs(names: Iterable[str], results: Path) -> list[list[Cell]]:
    """Return name, time, CPU time [s] and memory [MB] of the jobs that were measured."""
    rows = []
    for name in sorted(names):
        path = results / f"benchmarks/{name}.tsv"
        if not path.exists():  # Snakemake does not ask for it again
            continue
        table = pd.read_csv(path, sep="\t")
        numbers = (float(table[column].sum()) for column in ("s", "cpu_time"))
        memory = float(pd.to_numeric(table["max_rss"], errors="coerce").max())
        cells = [Cell(_plain(value), str(value)) for value in (*numbers, memory)]
        rows.append([Cell(name, name), *cells])
    return rows


def _plain(value: float) -> str:
    return f"{value:,.1f}" if math.isfinite(value) else "–"


def _logs(scenario: Scenario, results: Path) -> list[list[Cell]]:
    """Return path and size of every log."""
    names = sorted(name for name in run_files(scenario) if name.endswith(".mcap"))
    sizes = [(results / name).stat().st_size for name in names]
    return [
        [Cell(name, name), Cell(f"{size:,}", str(size))]
        for name, size in zip(names, sizes, strict=True)
    ]
