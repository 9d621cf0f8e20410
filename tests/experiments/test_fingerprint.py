"""A script's hash changes with what it does, through every import, and with nothing else."""

from __future__ import annotations

import platform
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from hiersched.experiments.fingerprint import (
    code_fingerprint,
    kernels_name,
    reachable_modules,
)

FILES = {
    "hiersched/__init__.py": "",
    "hiersched/near.py": (
        "from hiersched.deep import far\nfrom hiersched.types import TYPE_CHECKING\n\n"
        "def f():\n    return far.x\n"
    ),
    "hiersched/deep/__init__.py": '"""Package."""\n',
    "hiersched/deep/far.py": "x = 1\n",
    "hiersched/deep/table.csv": "1,2\n",
    "hiersched/config/defaults.yaml": "a: 1\n",
    "hiersched/lazy.py": "y = 2\n",
    "hiersched/relative.py": "from .deep import far\nfrom . import lazy\n",
    "hiersched/other.py": "z = 3\n",
    "hiersched/types.py": (
        "from typing import TYPE_CHECKING\n\nif TYPE_CHECKING:\n    from hiersched.other import z\n"
    ),
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


def hash_of(tree: Path, script: str = "script.py", *, only: str = "") -> str:
    """The hash of a copy: what is known of a file is known for good."""
    with TemporaryDirectory() as folder:
        copy = Path(shutil.copytree(tree, Path(folder) / "tree"))
        return code_fingerprint(copy / script, copy / "hiersched", only=only)


def test_imports_are_followed(tree: Path) -> None:
    assert list(reachable_modules(tree / "script.py", tree / "hiersched")) == [
        "hiersched",
        "hiersched.deep",
        "hiersched.deep.far",
        "hiersched.lazy",
        "hiersched.near",
        "hiersched.types",
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


# Registered functions: a figure depends on itself and on what it calls, not on its neighbours.

SHOWN = {
    "figures.py": (
        "from hiersched.registry import figure\nfrom hiersched.tables import count, first\n\n"
        "def draw(y):\n    return count(y)\n\n"
        "@figure('one')\ndef one(study):\n    return draw(study)\n\n"
        "@figure('two')\ndef two(study):\n    return draw(first(study))\n\n"
        "@figure('three')\ndef three(study):\n    return one(study)\n"
    ),
    "tables.py": (
        "from hiersched.registry import table\n\ndef count(x):\n    return 1\n\n"
        "@table('first')\ndef first(study):\n    return second(study)\n\n"
        "@table('second')\ndef second(study):\n    return 2\n\n"
        "@table('third')\ndef third(study):\n    return 3\n"
    ),
    "registry.py": "def figure(name):\n    return str\n\ntable = figure\n",
}


@pytest.mark.parametrize(
    ("file", "old", "new", "figures"),
    [
        ("figures.py", "return draw(study)", "return 5", {"one", "three"}),
        ("figures.py", "return draw(first(study))", "return 5", {"two"}),
        ("figures.py", "return one(study)", "return two(study)", {"three"}),
        ("figures.py", "return count(y)", "return -count(y)", {"one", "two", "three"}),
        ("figures.py", "@figure('one')", "@figure('won')", {"one", "three"}),
        ("tables.py", "return 1", "return -1", {"one", "two", "three"}),
        # `first` is imported, `second` is called by it, and `third` is nobody's. What a module
        # imports it may use anywhere.
        ("tables.py", "return second(study)", "return 9", {"one", "two", "three"}),
        ("tables.py", "return 2", "return -2", {"one", "two", "three"}),
        ("tables.py", "return 3", "return -3", set()),
        (
            "tables.py",
            "@table('third')\n",
            "",
            {"one", "two", "three"},
        ),  # not registered: it counts
    ],
)
def test_a_registered_function_counts_where_it_is_reached(
    tree: Path, file: str, old: str, new: str, figures: set[str]
) -> None:
    for name, text in SHOWN.items():
        (tree / "hiersched" / name).write_text(text, encoding="utf-8")

    def hashes() -> dict[str, str]:
        script = "hiersched/figures.py"
        return {name: hash_of(tree, script, only=name) for name in ("one", "two", "three")}

    before, path = hashes(), tree / "hiersched" / file
    assert len(set(before.values())) == 3
    assert old in SHOWN[file]
    path.write_text(SHOWN[file].replace(old, new), encoding="utf-8")
    after = hashes()
    assert {name for name in before if after[name] != before[name]} == figures


def test_of_a_module_that_is_imported_whole_everything_counts(tree: Path) -> None:
    for name, text in SHOWN.items():
        (tree / "hiersched" / name).write_text(text, encoding="utf-8")
    for line in ("import hiersched.tables", "from hiersched import tables"):
        (tree / "script.py").write_text(f"{line}\n", encoding="utf-8")
        before = hash_of(tree)
        path = tree / "hiersched/tables.py"
        path.write_text(SHOWN["tables.py"].replace("return 3", "return -3"), encoding="utf-8")
        assert hash_of(tree) != before
        path.write_text(SHOWN["tables.py"], encoding="utf-8")


def test_every_script_reaches_what_it_needs(project_root: Path) -> None:
    package = project_root / "src/hiersched"

    def reached(name: str, part: str = "") -> set[str]:
        found = reachable_modules(package / "workflow/scripts" / f"{name}.py")
        return {module for module in found if module.startswith(f"hiersched.{part}")}

    assert {
        "hiersched.learning.ddpg",
        "hiersched.simulator.loop",
        "hiersched.log.writer",
    } <= reached("train")
    assert "hiersched.policies.index_rules" in reached("run")
    for name in ("run", "gains", "measure", "bound", "stability"):
        assert reached(name, "learning") == set()
    assert "hiersched.control.krasovskii" in reached("gains")
    assert reached("gains", "study") == set()
    measures = {"hiersched.study", "hiersched.study.metrics", "hiersched.study.fifo"}
    assert reached("run", "study") == set()
    assert reached("run_learned", "study") == measures
    assert reached("measure", "study") == {*measures, "hiersched.study.measure"}


def test_a_figure_reaches_no_other_file_of_figures(project_root: Path) -> None:
    """Nor do tables reach figures or claims, nor claims figures."""
    study = project_root / "src/hiersched/study"

    def reached(file: str) -> set[str]:
        parts = ("figures.", "tables.", "claims.", "built_in")
        found = (m.removeprefix("hiersched.study.") for m in reachable_modules(study / file))
        return {module for module in found if module.startswith(parts)}

    tables = {"tables.policies", "tables.text"}
    assert reached("tables/policies.py") == {"tables.text"}
    assert reached("figures/rates.py") == {"figures.style", *tables}
    assert not any(m.startswith(("figures", "built_in")) for m in reached("claims/judged.py"))


def test_a_job_on_another_machine_names_the_kernels_as_its_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def name(node: str, run: str) -> str:
        monkeypatch.setattr(platform, "node", lambda: node)
        monkeypatch.setenv("HIERSCHED_RUN", run)
        kernels_name.cache_clear()
        return kernels_name()

    on_login = name("login", "12 login")
    assert name("node7", "12 login") == on_login == name("login", "")
    assert name("node7", "12 node7") != on_login
    kernels_name.cache_clear()
