"""What the project promises about itself: units, pins, targets, light imports, small files."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import grimp
import pytest
import yaml

from hiersched.core.extras import EXTRA_OF

MAX_FILE_BYTES = 1024 * 1024

# "name: value  # [unit] paper: why" or "… assumed: why"
KEY_WITH_VALUE = re.compile(r"^\s*[A-Za-z_][\w-]*:\s+(?!#)\S")
UNIT_AND_ORIGIN = re.compile(r"#\s*\[[^\]]+\]\s*(paper|assumed)\b\s*:?\s*\S*")


def unexplained_keys(text: str) -> list[str]:
    """The lines that set a value without saying its unit and where it comes from."""
    return [
        f"{number}: {line.strip()}"
        for number, line in enumerate(text.splitlines(), start=1)
        if KEY_WITH_VALUE.match(line) and not UNIT_AND_ORIGIN.search(line)
    ]


def make_targets(makefile: str) -> set[str]:
    """Names before a colon at the start of a line, without variables and special targets."""
    return set(re.findall(r"^([a-z][\w-]*):(?!=)", makefile, flags=re.MULTILINE))


def pins(constraints: str) -> dict[str, str]:
    """Package name in its normal form -> version."""
    found = {}
    for line in constraints.splitlines():
        if line.strip() and not line.startswith("#"):
            name, separator, version = line.partition("==")
            assert separator, f"not a pin: {line!r}"
            found[re.sub(r"[-_.]+", "-", name).lower()] = version
    return found


def project_table(root: Path) -> dict[str, Any]:
    """The [project] table of pyproject.toml."""
    table: dict[str, Any] = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    return table["project"]


def tracked_files(root: Path) -> list[Path]:
    """The files that git tracks; skips where there is no repository."""
    listing = subprocess.run(
        ["git", "ls-files", "-z"], cwd=root, capture_output=True, text=True, check=False
    )
    if listing.returncode != 0:
        pytest.skip("not a git checkout")
    return [root / name for name in listing.stdout.split("\0") if name]


@pytest.mark.parametrize(
    ("line", "accepted"),
    [
        ("slot_s: 0.01  # [s] assumed: 1 Mbit/s is one packet a slot", True),
        ("  num_prb: 25  # [1] paper: Table I", True),
        ("radio:", True),
        ("# a remark: with a colon", True),
        ("slot_s: 0.01", False),
        ("slot_s: 0.01  # [s]", False),
        ("slot_s: 0.01  # assumed", False),
    ],
)
def test_key_checker_knows_a_good_line(line: str, accepted: bool) -> None:
    assert (unexplained_keys(line) == []) is accepted


def test_every_default_has_unit_and_origin(project_root: Path) -> None:
    text = (project_root / "src/hiersched/config" / "defaults.yaml").read_text(encoding="utf-8")
    assert unexplained_keys(text) == []


def test_numbers_in_yaml_are_numbers(project_root: Path) -> None:
    """PyYAML reads 1e-3 as text: a number that arrives as a string is a typing error."""

    def strings(node: object) -> list[str]:
        if isinstance(node, dict):
            return [text for value in node.values() for text in strings(value)]
        if isinstance(node, list):
            return [text for value in node for text in strings(value)]
        return [node] if isinstance(node, str) else []

    def is_number(text: str) -> bool:
        try:
            float(text)
        except ValueError:
            return False
        return True

    files = sorted((project_root / "src/hiersched/config").rglob("*.yaml"))
    assert files
    quoted = [
        f"{file.name}: {text}"
        for file in files
        for text in strings(yaml.safe_load(file.read_text(encoding="utf-8")))
        if is_number(text)
    ]
    assert quoted == []


def test_makefile_has_the_promised_targets(project_root: Path) -> None:
    targets = make_targets((project_root / "Makefile").read_text(encoding="utf-8"))
    assert {"paper", "smoke", "test", "lint", "bench", "clean", "help"} <= targets


def test_notes_name_modules_that_exist(project_root: Path) -> None:
    text = (project_root / "docs" / "paper_notes.md").read_text(encoding="utf-8")
    named = {name: name for name in re.findall(r"`(hiersched\.[a-z_.]+)`", text)}
    for first, second in re.findall(r"`(hiersched\.[a-z_.]+)`, `(\.[a-z_]+)`", text):
        named[f"{first} {second}"] = first.rpartition(".")[0] + second
    assert named
    assert [text for text, module in named.items() if find_spec(module) is None] == []


def test_no_modules_import_each_other_in_a_circle() -> None:
    """Imports inside functions count; those for annotations alone do not."""
    graph = grimp.build_graph("hiersched", exclude_type_checking_imports=True, cache_dir=None)
    circles = [
        (module, imported)
        for module in sorted(graph.modules)
        for imported in sorted(graph.find_modules_directly_imported_by(module))
        if graph.chain_exists(importer=imported, imported=module)
    ]
    assert circles == []


def test_environment_is_pinned(project_root: Path) -> None:
    text = (project_root / "constraints.txt").read_text(encoding="utf-8")
    pinned = pins(text)
    assert pinned["torch"] == "2.13.0"
    # Local versions, folders and indexes hold on one machine only.
    assert not re.search(r"\+|/|^-|@", re.sub(r"^#.*$", "", text, flags=re.MULTILINE), re.MULTILINE)
    assert [name for name in pinned if name.startswith(("nvidia", "triton", "cuda"))] == []


def test_every_requirement_is_pinned(project_root: Path) -> None:
    project = tomllib.loads((project_root / "pyproject.toml").read_text(encoding="utf-8"))[
        "project"
    ]
    required = [*project["dependencies"]]
    for extra in project["optional-dependencies"].values():
        required += extra
    names = {
        re.sub(r"[-_.]+", "-", re.split(r"[^\w.-]", requirement)[0]).lower()
        for requirement in required
    }
    pinned = pins((project_root / "constraints.txt").read_text(encoding="utf-8"))
    assert names - pinned.keys() == {"hiersched"}  # extras that take in others


def test_no_tracked_file_is_large(project_root: Path) -> None:
    large = [
        f"{file.relative_to(project_root)}: {file.stat().st_size} bytes"
        for file in tracked_files(project_root)
        if file.is_file() and file.stat().st_size > MAX_FILE_BYTES
    ]
    assert large == []


def test_nothing_generated_is_tracked(project_root: Path) -> None:
    generated = {"results", ".snakemake", "__pycache__", ".venv"}
    inside = [
        str(file.relative_to(project_root))
        for file in tracked_files(project_root)
        if generated & set(file.relative_to(project_root).parts)
    ]
    assert inside == []


@pytest.mark.parametrize(
    "modules",
    [
        "hiersched",
        "hiersched.env, hiersched.env.vector, hiersched.env.single",
        "hiersched.simulator, hiersched.simulator.gain_source, hiersched.control",
        "hiersched.log, hiersched.study.metrics, hiersched.replay.verify, hiersched.cli.run",
    ],
)
def test_the_core_imports_nothing_of_the_extras(modules: str) -> None:
    """Nor what `import hiersched` costs every command and every job."""
    code = f"import sys, {modules}; print(*sorted(m for m in sys.modules if '.' not in m))"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert "hiersched" in loaded
    assert [name for name in (*EXTRA_OF, "control") if name in loaded] == []


def test_every_extra_brings_what_its_error_promises(project_root: Path) -> None:
    extras = project_table(project_root)["optional-dependencies"]
    brings = {
        name: {re.split(r"[^\w.-]", requirement)[0] for requirement in requirements}
        for name, requirements in extras.items()
    }
    of_package = {"rerun": "rerun-sdk", "stable_baselines3": "stable-baselines3"}
    missing = [
        (package, extra)
        for package, extra in EXTRA_OF.items()
        if of_package.get(package, package) not in brings[extra]
    ]
    assert missing == []


def test_version_is_the_same_everywhere(project_root: Path) -> None:
    project = tomllib.loads((project_root / "pyproject.toml").read_text(encoding="utf-8"))[
        "project"
    ]
    citation = yaml.safe_load((project_root / "CITATION.cff").read_text(encoding="utf-8"))
    assert str(citation["version"]) == project["version"]
