"""A script's hash changes with what it does, through every import, and with nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest

from hiersched.experiments import fingerprint
from hiersched.experiments.fingerprint import code_fingerprint, reachable_modules

FILES = {
    "hiersched/__init__.py": "",
    "hiersched/near.py": "from hiersched.deep import far\n\ndef f():\n    return far.x\n",
    "hiersched/deep/__init__.py": '"""Package."""\n',
    "hiersched/deep/far.py": "x = 1\n",
    "hiersched/deep/table.csv": "1,2\n",
    "hiersched/config/defaults.yaml": "a: 1\n",
    "hiersched/lazy.py": "y = 2\n",
    "hiersched/relative.py": "from .deep import far\nfrom . import lazy\n",
    "hiersched/other.py": "z = 3\n",
    "script.py": (
        "import json\nfrom hiersched.near import f\n\n"
        "def main():\n    import hiersched.lazy\n    f()\n"
    ),
}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return tmp_path


def hash_of(tree: Path) -> str:
    """The hash as a new process would compute it."""
    for function in (
        fingerprint.code_fingerprint,
        fingerprint._imported_names,
        fingerprint._statements,
    ):
        function.cache_clear()
    return code_fingerprint(tree / "script.py", tree / "hiersched")


def test_imports_are_followed(tree: Path) -> None:
    assert list(reachable_modules(tree / "script.py", tree / "hiersched")) == [
        "hiersched",
        "hiersched.deep",
        "hiersched.deep.far",
        "hiersched.lazy",
        "hiersched.near",
    ]


def test_relative_imports_are_followed(tree: Path) -> None:
    (tree / "script.py").write_text("import hiersched.relative\n", encoding="utf-8")
    assert {"hiersched.deep.far", "hiersched.lazy"} <= set(
        reachable_modules(tree / "script.py", tree / "hiersched")
    )


@pytest.mark.parametrize(
    ("name", "text", "same"),
    [
        ("hiersched/deep/far.py", "x = 2\n", False),
        ("hiersched/deep/far.py", "# why\nx = (  # one\n    1\n)\n", True),
        ("hiersched/deep/far.py", '"""One."""\n\nx = 1\n"""What x is."""\n', True),
        ("hiersched/deep/far.py", "x = '1'\n", False),
        (
            "hiersched/near.py",
            FILES["hiersched/near.py"].replace("return", "'''Why.'''\n    return"),
            True,
        ),
        ("hiersched/near.py", FILES["hiersched/near.py"].replace("far.x", "-far.x"), False),
        ("hiersched/lazy.py", "y = 3\n", False),
        ("hiersched/deep/__init__.py", "import os\n", False),
        ("hiersched/deep/table.csv", "1,3\n", False),
        ("hiersched/config/defaults.yaml", "a: 2\n", True),
        ("hiersched/other.py", "z = 4\n", True),
        ("script.py", FILES["script.py"] + "main()\n", False),
    ],
)
def test_hash_follows_the_code(tree: Path, name: str, text: str, same: bool) -> None:
    before = hash_of(tree)
    (tree / name).write_text(text, encoding="utf-8")
    assert (hash_of(tree) == before) is same


def test_every_script_reaches_what_it_needs(project_root: Path) -> None:
    scripts = project_root / "src/hiersched/workflow/scripts"

    def reached(name: str) -> set[str]:
        return set(reachable_modules(scripts / f"{name}.py"))

    assert {
        "hiersched.learning.ddpg",
        "hiersched.simulator.loop",
        "hiersched.log.writer",
    } <= reached("train")
    assert "hiersched.policies.index_rules" in reached("evaluate_classical")
    assert not any(name.startswith("hiersched.learning") for name in reached("evaluate_classical"))
    assert not any(name.startswith("hiersched.learning") for name in reached("sweep_classical"))
    assert not any(name.startswith("hiersched.learning") for name in reached("gains"))
    assert "hiersched.control.krasovskii" in reached("gains")
    assert not any(name.startswith("hiersched.study") for name in reached("evaluate_classical"))
    assert {name for name in reached("evaluate_learned") if name.startswith("hiersched.study")} == {
        *("hiersched.study", "hiersched.study.metrics", "hiersched.study.fifo")
    }
