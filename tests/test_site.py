"""The site of the documents: its navigation, the check of what is built, the notebooks in it.

`make site` builds all of it, strictly, and is a step of `.ci/run`; here is what it rests on.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import nbformat
import pytest
import yaml

NOT_IN_THE_SITE = {"src/hiersched/config/new/README"}  # of the folder that `hiersched new` makes


@pytest.fixture(scope="module")
def check_site(project_root: Path, load_module: Callable[[Path], ModuleType]) -> ModuleType:
    """docs/check_site.py as a module."""
    return load_module(project_root / "docs/check_site.py")


def files_in(entry: Any) -> Iterator[str]:
    """Pages that a part of the navigation names."""
    if isinstance(entry, dict):
        yield from (name for key, name in entry.items() if key in ("file", "root"))
        entry = list(entry.values())
    if isinstance(entry, list):
        for part in entry:
            yield from files_in(part)


def test_every_page_is_in_the_navigation_once(project_root: Path) -> None:
    places = ("*.md", "config/*.md", "docs/**/*.md", "docs/**/*.ipynb", "src/**/README.md")
    pages = {
        path.relative_to(project_root).with_suffix("").as_posix()
        for place in places
        for path in project_root.glob(place)
    }
    toc = yaml.safe_load((project_root / "docs/_toc.yml").read_text(encoding="utf-8"))
    named = list(files_in(toc))
    assert sorted(named) == sorted(pages - NOT_IN_THE_SITE)


GOOD = """<html><head><link rel="stylesheet" href="a.css"></head><body><h1 id="top-1">A</h1>
<a href="other.html#part">b</a> <a href="#top-1">c</a> <a href="https://example.org/x#y">d</a>
<img src="data:image/png;base64,AA=="></body></html>"""


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("", "", None),
        ("other.html#part", "others.html", "others.html: no such file"),
        ("#part", "#party", "other.html#party: no such anchor"),
        ("#top-1", "#top-2", "#top-2: no such anchor"),
        ("other.html#part", "../../etc/passwd", "../../etc/passwd: no such file"),
        ("https://example", "http://example", "http://example.org/x#y: must be https"),
        ("https://example.org", "https://example", "https://example/x#y: must be https"),
        ("https://example.org/x", "javascript:x", "javascript:x#y: must be https"),
        ("data:image/png;base64,AA==", "https://e.org/a.png", "loads https://e.org/a.png from"),
        ("data:image/png;base64,AA==", "//e.org/a.png", "loads //e.org/a.png from the network"),
        ("data:image/png;base64,AA==", "a.png", "loads a.png, which is not there"),
        ('href="a.css"', 'href="https://e.org/a.css"', "loads https://e.org/a.css from"),
        ("</body>", '<script src="https://e.org/a.js"></script>', "loads https://e.org/a.js"),
    ],
)
def test_a_fault_of_a_page_is_found(
    old: str, new: str, fault: str | None, check_site: ModuleType, tmp_path: Path
) -> None:
    check_site.read.cache_clear()
    (tmp_path / "page.html").write_text(GOOD.replace(old, new, 1) if old else GOOD)
    (tmp_path / "other.html").write_text('<p id="part">')
    (tmp_path / "a.css").write_text("p { background: url(data:image/gif;base64,AA) }")
    found = list(check_site.faults_of(tmp_path / "page.html", tmp_path))
    assert len(found) == (fault is not None)
    assert not fault or fault in found[0]


@pytest.mark.parametrize(
    "style", ["@import 'https://e.org/a.css';", "p { src: url(https://e.org/a.woff2) }"]
)
def test_a_style_sheet_that_loads_from_the_network_is_found(
    style: str, check_site: ModuleType, tmp_path: Path
) -> None:
    (tmp_path / "a.css").write_text(style)
    (fault,) = check_site.faults_of(tmp_path / "a.css", tmp_path)
    assert re.search("loads https://e.org/a.* from the network", fault)


def test_a_public_name_that_no_page_has_is_found(check_site: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "docs/api").mkdir(parents=True)
    (tmp_path / "docs/api/log.html").write_text('<dt id="hiersched.log.LogReader">')
    faults = list(check_site.undocumented(tmp_path))
    assert "hiersched.log.LogWriter is public and on no page of the API" in faults
    assert not any("LogReader" in fault for fault in faults)


# Notebooks.


def notebooks(root: Path) -> list[Path]:
    """All of them."""
    found = sorted((root / "docs/notebooks").glob("*.ipynb"))
    assert found
    return found


def test_notebooks_are_kept_without_outputs(project_root: Path) -> None:
    for path in notebooks(project_root):
        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)
        cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
        assert [cell for cell in cells if cell.outputs or cell.execution_count] == [], path


@pytest.mark.nightly
def test_the_first_look_shows_what_it_says(
    project_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from nbclient import NotebookClient

    monkeypatch.delenv("MPLBACKEND", raising=False)  # else figures go nowhere
    path = project_root / "docs/notebooks/first_look.ipynb"
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=300, resources=resources).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    kinds = [kind for output in outputs for kind in output.get("data", ())]
    text = "".join(output.get("text", "") for output in outputs)
    assert kinds.count("image/png") == 2
    assert kinds.count("text/html") == 3
    assert "traffic.lod" in text
    assert "adjusted certified" in text
    late = [float(share) for share in re.findall(r"favour .*: ([\d.]+) % of", text)]
    assert len(late) == 2
    assert late[1] < 0.5 * late[0]
