"""What every rule and script has, and what none may have."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest


def rules(project_root: Path) -> dict[str, str]:
    """Text of every rule but `all`, by the name of its script."""
    found = {}
    for path in sorted((project_root / "src/hiersched/workflow" / "rules").glob("*.smk")):
        text = path.read_text(encoding="utf-8")
        for block in re.split(r"^ *rule\b", text, flags=re.MULTILINE)[1:]:
            name = block.split(":")[0].strip() or re.findall(r'f"(.+)_{s.name}"', block)[0]
            found[f"{path.stem}: {name}"] = block
    return found


def test_every_rule_is_complete(project_root: Path) -> None:
    blocks = rules(project_root)
    assert len(blocks) > 10, list(blocks)
    for name, block in blocks.items():
        for directive in ("message:", "output:", "log:", "threads:", "shell:"):
            assert directive in block, (name, directive)
        # Jobs that write a page or two are over before they can be measured.
        measured = any(job in name for job in ("measure", "growth"))
        short = (name.startswith("study: ") and not measured) or "resolve" in name
        assert ("benchmark:" in block) != short, name
        assert re.search(r"\bspec=", block) or "kernels" in name, name
        assert not re.search(r"^\s*(run|script):", block, re.MULTILINE), name
        assert "ancient(" not in block, name
        assert "{sys.executable:q}" in block, name


def test_scripts_are_short(project_root: Path) -> None:
    scripts = sorted((project_root / "src/hiersched/workflow" / "scripts").glob("*.py"))
    assert scripts
    for path in scripts:
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 60, path.name


@pytest.mark.parametrize("name", ["default", "slurm"])
def test_profiles_rerun_what_is_incomplete(project_root: Path, name: str) -> None:
    text = (project_root / "src/hiersched/workflow" / "profiles" / name / "config.yaml").read_text(
        encoding="utf-8"
    )
    assert "rerun-incomplete: true" in text
    assert "printshellcmds: true" in text


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("config", "message"),
    [
        (
            "scenarios=[papper]",
            "papper: no such scenario; there are: {shipped}; did you mean paper?",
        ),
        ("scenario=[paper]", "--config scenario: unknown; allowed: scenarios="),
    ],
)
def test_a_wrong_scenario_is_one_message(project_root: Path, config: str, message: str) -> None:
    files = (project_root / "src/hiersched/config/scenarios").glob("*.yaml")
    shipped = ", ".join(sorted(path.stem for path in files))
    done = subprocess.run(
        [sys.executable, "-m", "snakemake", "-n", "--config", config],
        cwd=project_root,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode != 0
    assert message.format(shipped=shipped) in done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) < 8
