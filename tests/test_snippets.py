"""The Python snippets of the pages run from top to bottom, each page's in one namespace.

Those of README.md and docs/control.md need nothing. docs/results.md, docs/log.md, docs/how_to.md
and docs/clusters.md read results or logs: they run on those of `make smoke` if HIERSCHED_RESULTS
says where they lie, as `.ci/run` does. A block that imports a package of `OPTIONAL` is left out
where that is missing.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
RESULTS = os.environ.get("HIERSCHED_RESULTS")
ON_SMOKE = {
    'load_scenario("paper")': 'load_scenario("smoke")',
    "results/paper": RESULTS or "",
    "seed1001": "seed101",
    '"run.mcap"': f'"{RESULTS}/runs/evaluate/pf/seed101_full.mcap"',
}
"""What a page says of its own results -> the same of the small pipeline's."""

OPTIONAL = {"stable_baselines3", "torchrl", "PIL"}
PAGES = {
    "README.md": {},
    "docs/control.md": {},
    "docs/environments.md": {},
    "docs/results.md": ON_SMOKE,
    "docs/log.md": ON_SMOKE,
    "docs/clusters.md": ON_SMOKE,
    "docs/how_to.md": {**ON_SMOKE, '"pf.mcap"': ON_SMOKE['"run.mcap"']},
}
"""Page -> what is put in place of what."""


@pytest.mark.nightly
@pytest.mark.parametrize("page", PAGES)
def test_snippets_run_from_top_to_bottom(page, project_root, monkeypatch):
    """Each block is compiled with its line numbers, so that a failure names the page's line."""
    if PAGES[page] and RESULTS is None:
        pytest.skip("reads the results of make smoke: HIERSCHED_RESULTS=results/smoke")
    monkeypatch.chdir(project_root)
    path = project_root / page
    text = path.read_text(encoding="utf-8")
    assert len(BLOCK.findall(text)) == text.count("```python") > 0
    for said, meant in PAGES[page].items():
        text = text.replace(said, meant)
    namespace = {"__name__": path.stem}
    missing: list[str] = []
    for block in BLOCK.finditer(text):
        lines_above = text.count("\n", 0, block.start(1))
        code = compile("\n" * lines_above + block.group(1), str(path), "exec")
        try:
            exec(code, namespace)
        except ImportError as error:
            if error.name not in OPTIONAL:
                raise
            missing.append(error.name)
    if missing:
        pytest.skip(f"ran but for the blocks that need {', '.join(missing)}")


def test_every_page_with_snippets_is_run(project_root: Path) -> None:
    pages = [*project_root.glob("*.md"), *project_root.glob("docs/*.md")]
    pages += project_root.glob("src/hiersched/config/*.md")
    # Those of docs/extending: tests/test_extending.py and test_docs.py.
    found = {
        path.relative_to(project_root).as_posix()
        for path in pages
        if "```python" in path.read_text(encoding="utf-8")
    }
    assert found == set(PAGES)
