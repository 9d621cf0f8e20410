from __future__ import annotations

import re

import hiersched.control


def test_functions_that_the_page_mentions_exist(project_root):
    page = (project_root / "docs/control.md").read_text(encoding="utf-8")
    functions = r"`((?:analyse|synthesise|build|load|hold|switching|simulate)_\w+)"
    mentioned = set(re.findall(functions, page))
    assert len(mentioned) > 5
    assert mentioned <= set(hiersched.control.__all__)
