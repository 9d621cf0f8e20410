"""The workflow as a module of another one, as snakedeploy writes it, and the catalogue's file."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

DEPLOYED = """
from snakemake.utils import min_version


min_version("6.10.0")


configfile: "config/config.yaml"


module hiersched:
    snakefile:
        "git+file://{repository}/workflow/Snakefile@main"
    config:
        config


use rule * from hiersched
"""
GIT = ("git", "-c", "user.name=test", "-c", "user.email=test@localhost")


@pytest.fixture(scope="module")
def repository(tmp_path_factory: pytest.TempPathFactory, project_root: Path) -> Path:
    """A git repository with the workflow and its configuration: no package."""
    folder = tmp_path_factory.mktemp("hiersched_repository")
    for name in ("workflow", "config", "src/hiersched/workflow"):
        shutil.copytree(project_root / name, folder / name)
    for words in (
        ("init", "--quiet", "-b", "main"),
        ("add", "."),
        ("commit", "--quiet", "-m", "1"),
    ):
        subprocess.run([*GIT, *words], cwd=folder, check=True)
    return folder


def test_the_workflow_is_a_module_of_another(
    repository: Path,
    tmp_path: Path,
    project_root: Path,
    planned: Callable[[subprocess.CompletedProcess[str]], set[str]],
) -> None:
    """Its files come from the repository, its scripts from the package; the scenarios are ours."""
    shutil.copytree(project_root / "config", tmp_path / "config")
    (tmp_path / "config/config.yaml").write_text("scenarios: [mine.yaml]\n", encoding="utf-8")
    (tmp_path / "mine.yaml").write_text("evaluate: {policies: [pf]}\n", encoding="utf-8")
    (tmp_path / "workflow").mkdir()
    text = DEPLOYED.format(repository=repository)
    (tmp_path / "workflow/Snakefile").write_text(text, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "snakemake", "-n"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(project_root / "src")},
        capture_output=True,
        text=True,
        check=False,
    )
    jobs = planned(done)
    assert {"kernels", "resolve_mine", "evaluate_classical_mine", "table_policies_mine"} <= jobs


def test_the_catalogue_finds_what_it_looks_for(project_root: Path) -> None:
    """As its pages on adding workflows ask for it."""
    for name in ("workflow/Snakefile", "config/README.md"):
        path = project_root / name
        assert path.is_file()
        assert not path.is_symlink()  # read through an interface that does not follow links
    readme = (project_root / "README.md").read_text(encoding="utf-8").lower()
    assert "snakemake" in readme
    assert "workflow" in readme
    said = (project_root / ".snakemake-workflow-catalog.yml").read_text(encoding="utf-8")
    usage = yaml.safe_load(said)["usage"]
    assert set(usage) == {"mandatory-flags", "software-stack-deployment", "report"}
    rules = [*project_root.glob("workflow/**/*"), *project_root.glob("src/**/workflow/**/*.smk")]
    directives = "\n".join(p.read_text(encoding="utf-8") for p in rules if p.is_file())
    deployed = usage["software-stack-deployment"]
    assert deployed["conda"] is bool(re.search(r"^\s*conda:", directives, re.MULTILINE))
    assert deployed["apptainer"] is bool(re.search(r"^\s*container", directives, re.MULTILINE))
    assert deployed["apptainer+conda"] is (deployed["conda"] and deployed["apptainer"])
    assert usage["report"] is ("report(" in directives)
    config = yaml.safe_load((project_root / "config/config.yaml").read_text(encoding="utf-8"))
    assert config == {"scenarios": ["paper"]}
