from __future__ import annotations

import re
from pathlib import Path

import hiersched.control

PAGE = Path(__file__).resolve().parents[2] / "docs" / "control.md"
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def test_snippets_run_from_top_to_bottom(capsys):
    """Each block is compiled with its line numbers, so that a failure names the page's line."""
    text = PAGE.read_text(encoding="utf-8")
    blocks = list(BLOCK.finditer(text))
    assert len(blocks) == text.count("```python") > 0
    namespace = {"__name__": "control_page"}
    for block in blocks:
        line = text.count("\n", 0, block.start(1))
        code = compile("\n" * line + block.group(1), str(PAGE), "exec")
        exec(code, namespace)
    assert "adjusted" in capsys.readouterr().out


def test_functions_that_the_page_mentions_exist():
    functions = r"`((?:analyse|synthesise|build|load|hold|switching|simulate)_\w+)"
    mentioned = set(re.findall(functions, PAGE.read_text(encoding="utf-8")))
    assert len(mentioned) > 5
    assert mentioned <= set(hiersched.control.__all__)
