"""What the documents promise: generated tables, commands, links, a schema that is right."""

from __future__ import annotations

import argparse
import inspect
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator

from hiersched.cli import _parser, main
from hiersched.core import registry
from hiersched.core.seam import Seam
from hiersched.experiments.points import experiments
from hiersched.models import seams
from hiersched.models.model import Setup
from hiersched.policies.registry import ALLOCATIONS, RULES
from hiersched.policies.seams import ALLOCATE
from hiersched.scenario import ScenarioError, load_scenario, parameter_notes
from hiersched.simulator.loop import run_slots

FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CONFIG = "src/hiersched/config"


def documents(root: Path) -> dict[str, str]:
    """Markdown file, relative to the root -> its text."""
    patterns = ("*.md", "config/*.md", "docs/**/*.md", "src/**/*.md")
    places = (root.glob(pattern) for pattern in patterns)
    return {
        path.relative_to(root).as_posix(): path.read_text(encoding="utf-8")
        for paths in places
        for path in paths
    }


@pytest.fixture(scope="module")
def generate(project_root: Path, load_module: Callable[[Path], ModuleType]) -> ModuleType:
    """docs/generate.py as a module."""
    return load_module(project_root / "docs/generate.py")


# What is generated.


def test_documents_and_schema_are_what_would_be_written(project_root: Path) -> None:
    """In a process of its own: plug-ins of other tests are models too."""
    pytest.importorskip("torch")  # it names functions of the learners
    command = [sys.executable, str(project_root / "docs/generate.py"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, ""), f"make docs: {done.stdout}{done.stderr}"


def test_an_edited_table_is_found(generate: ModuleType, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Users\n\n<!-- generated: keys users -->\n<!-- end -->\n\nMore.\n")
    text = generate.generated(page)
    assert text.startswith("# Users\n\n<!-- generated: keys users -->\n| key | default |")
    assert text.endswith("\n<!-- end -->\n\nMore.\n")
    assert "| `num_urllc` | `10` | users | assumed | whole number ≥ 1 |" in text
    page.write_text(text.replace("`10`", "`11`"))
    assert generate.generated(page) == text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<!-- generated: keyz users -->\n<!-- end -->\n", "keyz: must be one of keys, models,"),
        ("<!-- generated: keys user -->\n<!-- end -->\n", "keys user: no keys of such a section"),
        ("<!-- generated: models -->\n", "a mark that is not closed"),
    ],
)
def test_a_wrong_mark_is_an_error(
    text: str, message: str, generate: ModuleType, tmp_path: Path
) -> None:
    page = tmp_path / "page.md"
    page.write_text(text)
    with pytest.raises(ValueError, match=re.escape(message)):
        generate.generated(page)


def test_every_key_stands_in_a_table(project_root: Path) -> None:
    text = documents(project_root)[f"{CONFIG}/README.md"]
    marks = re.findall(r"<!-- generated: keys ([\w ]+) -->", text)
    sections = [section for words in marks for section in words.split()]
    assert len(sections) == len(set(sections))
    assert set(sections) == {note.key.partition(".")[0] for note in parameter_notes()}


def test_what_the_newcomer_looks_for_is_defined_there(project_root: Path) -> None:
    text = documents(project_root)["docs/architecture.md"].split("<!-- generated: where -->")[1]
    found = re.findall(r"\[`([\w.]+)`\]\(\.\./([^)]+)\)", text.split("<!-- end -->")[0])
    assert len(found) > 30
    for name, file in found:
        module, _, inside = name.partition(".")
        assert module == Path(file).stem
        code = (project_root / file).read_text(encoding="utf-8")
        last = inside.rpartition(".")[2]
        assert not last or re.search(rf"^ *(def |class )?{last}\b", code, re.MULTILINE), name


def test_a_slot_passes_the_functions_that_the_page_names(project_root: Path) -> None:
    """In this order, at most twenty; the kernels are those of the page's scenario."""
    page = documents(project_root)["docs/architecture.md"]
    section = page.split("## A slot from YAML to figure")[1].split("\n## ")[0]
    rows = re.findall(r"^\| (\d+) \| `([\w.]+)` \| `([\w/]+)\.py` \|(.*)", section, re.MULTILINE)
    assert [int(number) for number, *_ in rows] == list(range(1, len(rows) + 1))
    assert section.count("\n|") - 2 == len(rows) <= 20
    for _, name, file, text in rows:
        module = import_module(f"hiersched.{file.replace('/', '.')}")
        assert attrgetter(name)(module).__module__ == module.__name__
        for called in re.findall(r"\(`[\w.]*?(\w+)`(?:, `(\w+)`)?\)", text):
            for other in filter(None, called):
                assert _is_defined(other, project_root), other
    scenario = load_scenario("smoke")
    setup = Setup(scenario=scenario, num_envs=1, num_slots=1)
    lagrangian = ALLOCATIONS[RULES["drift_plus_penalty"].standard(scenario).allocation](2, 3)
    radio, traffic = scenario.radio, scenario.traffic
    steps = {  # of the loop -> what stands in the table for them
        "_observe": ["_observe"],
        "_decide": [_kernel(ALLOCATE, lagrangian)],
        "plugs.deliver": [_kernel(seams.DELIVER, radio.link.words(setup))],
        "plugs.arrivals": [_kernel(seams.OFFER, traffic.arrivals.words(setup))],
        "_offer_service": ["_offer_service"],
        "plugs.queue": [_kernel(seams.SERVE, traffic.queue.words(setup))],
        "_account": ["_account"],
        "_move_robots": [_kernel(seams.DRIVE, scenario.plant.words(setup))],
        "draw_channel": [
            _kernel(seams.DRAW_FADING, radio.fading.words(setup)),
            _kernel(seams.RATE_PRBS, radio.link.words(setup)),
        ],
    }
    code = inspect.getsource(run_slots.py_func)
    order = sorted(steps, key=code.index)
    inside = [name for _, name, *_ in rows][6:16]
    assert inside == [name for step in order for name in steps[step]]


def _is_defined(name: str, root: Path) -> bool:
    files = (root / "src/hiersched").rglob("*.py")
    return any(f"def {name}(" in file.read_text(encoding="utf-8") for file in files)


def _kernel(seam: Seam, words: Any) -> str:
    return str(seam._kernels[type(words)].py_func.__name__)


def test_files_of_the_smoke_study_are_those_of_the_table(project_root: Path) -> None:
    """Every output of the workflow has a row."""
    text = documents(project_root)["docs/results.md"].split("<!-- generated: study-files -->")[1]
    names = re.findall(r"`([^`]+)`", text.split("<!-- end -->")[0])
    rows = [
        re.sub(r"<[^>]+>", "[^/]+", re.escape(name).replace("\\<", "<").replace("\\>", ">"))
        for name in names
    ]
    rows += [row.replace("/[^/]+/[^/]+/seed", "/[^/]+/seed") for row in rows]  # without a value
    rows += [row.replace("/[^/]+/[^/]+/crossed", "/[^/]+/crossed") for row in rows]
    from hiersched.experiments import files
    from hiersched.experiments.points import groups, trained_learners

    scenario = load_scenario("smoke")
    outputs = [files.SCENARIO, files.STABILITY, files.BOUND, *files.CLAIMS]
    for experiment in experiments(scenario).values():
        for group in groups(scenario, experiment):
            outputs += files.group_files(scenario, experiment, group)
    for learner in trained_learners(scenario):
        outputs += [*files.policy_files(scenario, learner), files.progress_file(learner)]
        outputs += files.learner_logs(scenario, learner)
    assert len(outputs) > 100
    assert [name for name in outputs if not any(re.fullmatch(row, name) for row in rows)] == []


# The schema of a scenario.

WRONG: tuple[dict[str, Any], ...] = (
    {"users": {"num_urlc": 4}},
    {"users": {"num_urllc": 0}},
    {"users": {"num_urllc": 2.5}},
    {"users": None},
    {"traffic": {"load": "high"}},
    {"traffic": {"reliability": 1.0}},
    {"control": {"method": "lqr"}},
    {"radio": {"fading": "rayleigh"}},
    {"radio": {"fading": {"model": "rayliegh"}}},
    {"radio": {"fading": {"model": "rayleigh", "scal": 1.0}}},
    {"radio": {"fading": {"scal": 1.0}}},
    {"radio": {"fading": {"scale": 0.0}}},
    {"radio": {"path_loss": {"cell_radius_m": 100.0}}},
    {"plant": {"model": "linear", "A": [1.0]}},
    {"learning": {"algorithm": "ppo"}},
    {"learning": {"hidden": []}},
    {"learners": {"b": {"netwrk": "mlp"}}},
    {"learners": {"b": {"algorithm": "ppo"}}},
    {"policies": {"mine": {"model": "pff"}}},
    {"policies": {"mine": {"model": "log_rule", "slope": 1.0}}},
    {"policies": {"mine": {"model": "log_rule", "offset": 0.5}}},
    {"policies": {"mine": {"import": "no_colon"}}},
    {"policies": {"mine": {"import": "numpy:mean", "rule": "mine"}}},
    {"policies": {"mine": {}}},
    {"policies": {"pf": {"model": "edf"}}},
    {"sweeps": {"load": [0.9]}},
    {"sweeps": {"axes": {"load": {"vary": {"traffic.lod": [1.0]}}}}},
    {"sweeps": {"axes": {"load": {"vary": {"traffic.load": []}}}}},
    {"sweeps": {"axes": {"load": {"vary": {"traffic.load": 1.0}}}}},
    {"sweeps": {"axes": {"load": {"policies": "some"}}}},
    {"sweeps": {"axes": {"load": {"values": [1.0]}}}},
    {"gain_study": {"violation_delay_s": [0.1]}},
    {"name": "My study"},
    {"extends": 3},
    {"radios": {}},
)

RIGHT: tuple[dict[str, Any], ...] = (
    {},
    {"name": "mine_2", "extends": "paper", "learners": {"a2c": {"hidden": [32]}, "b": None}},
    {"traffic": {"load": 1, "urllc_offered_mbps": 12.0}},
    {"control": {"hold_samples": None, "max_delay_s": 0.04}},
    {"radio": {"fading": {"scale": 2.0}, "path_loss": {"model": "macro", "shadowing_db": 0.0}}},
    {"radio": {"path_loss": {"model": "none"}}},
    {"policies": {"flat": {"model": "log_rule", "gain": 1.0}}},
    {"policies": {"mean": {"import": "statistics:mean", "rule": "edf"}}},
    {"sweeps": {"axes": {"traffic.load": [0.9, 1.0], "load": None}}},
    {"sweeps": {"axes": {"both": {"vary": {"traffic.load": [0.9], "radio.noise_dbm": [-90.0]}}}}},
    {"sweeps": {"axes": {"load": {"policies": ["pf", "edf"]}}}},
    {"gain_study": {"methods": []}, "generalise": {"cells": []}, "bound": {"slots_per_log": 0}},
)


@pytest.fixture(scope="module")
def schema(project_root: Path) -> Draft202012Validator:
    text = (project_root / CONFIG / "scenario.schema.json").read_text(encoding="utf-8")
    found = json.loads(text)
    Draft202012Validator.check_schema(found)
    return Draft202012Validator(found)


def loads(path: Path) -> bool:
    """Whether the package takes a scenario."""
    try:
        experiments(load_scenario(path))
    except ScenarioError:
        return False
    return True


@pytest.mark.parametrize("overlay", WRONG, ids=json.dumps)
def test_the_schema_refuses_what_the_package_refuses(
    overlay: dict[str, Any], schema: Draft202012Validator, tmp_path: Path
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(overlay), encoding="utf-8")
    assert not loads(path)
    assert not schema.is_valid(overlay)


@pytest.mark.parametrize("overlay", RIGHT, ids=json.dumps)
def test_the_schema_takes_what_the_package_takes(
    overlay: dict[str, Any], schema: Draft202012Validator, tmp_path: Path
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(overlay), encoding="utf-8")
    assert [error.message for error in schema.iter_errors(overlay)] == []
    experiments(load_scenario(path))


def test_plugins_add_models_that_the_schema_does_not_know(schema: Draft202012Validator) -> None:
    fading = {"radio": {"fading": {"model": "mine", "speed_mps": 3.0}}}
    rule = {"policies": {"steep": {"model": "urgent", "slope": 2.0}}}
    for overlay in (fading, rule, {"learning": {"algorithm": "evolution"}}):
        assert not schema.is_valid(overlay)
        assert not schema.is_valid({"plugins": [], **overlay})
        assert schema.is_valid({"plugins": ["mine.py"], **overlay})
        assert schema.is_valid({"extends": "other.yaml", **overlay})
    typo = {"plugins": ["mine.py"], "radio": {"fading": {"model": "rayleigh", "scal": 1.0}}}
    assert not schema.is_valid(typo)


def test_files_of_the_package_name_the_schema_and_keep_it(
    project_root: Path, schema: Draft202012Validator, tmp_path: Path, capsys: Any
) -> None:
    assert main(["new", str(tmp_path / "new")]) == 0
    capsys.readouterr()
    assert main(["scenario", "schema"]) == 0
    (tmp_path / "new/scenario.schema.json").write_text(capsys.readouterr().out, encoding="utf-8")
    files = [*(project_root / CONFIG / "scenarios").glob("*.yaml"), tmp_path / "new/mine.yaml"]
    assert len(files) >= 5
    for file in files:
        text = file.read_text(encoding="utf-8")
        named = re.match(r"# yaml-language-server: \$schema=(\S+)\n", text)
        assert named, file
        assert json.loads((file.parent / named[1]).read_text(encoding="utf-8")) == schema.schema
        assert [error.message for error in schema.iter_errors(yaml.safe_load(text))] == [], file


def test_every_key_has_a_description_and_its_default(schema: Draft202012Validator) -> None:
    def at(node: dict[str, Any], key: str) -> dict[str, Any]:
        for part in key.split("."):
            name = node.get("$ref", "").rpartition("/")[2]
            node = (schema.schema["$defs"][name] if name else node)["properties"][part]
        return node

    assert at(schema.schema, "traffic.load")["default"] == 0.95
    sections = {note.key.partition(".")[0] for note in parameter_notes()}
    for note in parameter_notes():
        if note.key.count(".") == 1 and not note.key.endswith(".model"):
            node = at(schema.schema, note.key)
            assert node["description"].startswith(f"[{note.unit}] {note.origin}")
            assert "default" in node
    assert sections <= schema.schema["properties"].keys()


# What people read.


def test_the_readme_is_short_and_needs_no_results(project_root: Path) -> None:
    """Its snippet is run by tests/test_snippets.py."""
    text = documents(project_root)["README.md"]
    assert text.count("\n") <= 120
    (snippet,) = [block for kind, block in FENCE.findall(text) if kind == "python"]
    assert "results/" not in snippet


def test_the_verdicts_have_one_number_each() -> None:
    from hiersched.study.claims.report import BEGIN, END, insert_table

    claim = {
        "number": 3,
        "claim": "rates rise",
        "reference": "Fig. 5",
        "verdict": "depends",
        "base": {"statements": [{"text": "first: 2 [1, 3]"}, {"text": "second: 0 [0, 1]"}]},
    }
    empty = {**claim, "number": 4, "verdict": "not judged", "base": {"statements": []}}
    text = insert_table(f"a\n{BEGIN}\nold\n{END}\nb\n", json.dumps({"claims": [claim, empty]}))
    *_, third, fourth, end, after = text.splitlines()
    assert third == "| 3 | rates rise (Fig. 5) | first: 2 [1, 3] | **depends** |"
    assert fourth == "| 4 | rates rise (Fig. 5) | – | **not judged** |"
    assert (end, after) == (END, "b")
    assert "old" not in text


def headings(text: str) -> set[str]:
    """Return the anchors of a page."""
    found = re.findall(r"^#+ (.*)$", FENCE.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", name.lower()).replace(" ", "-") for name in found}


def test_links_lead_somewhere(project_root: Path) -> None:
    pages = documents(project_root)
    broken = []
    for page, text in pages.items():
        prose = re.sub(r"`[^`\n]*`", "", FENCE.sub("", text))
        for link in re.findall(r"\]\(([^)\s]+)\)", prose):
            if link.startswith(("http://", "https://")):
                continue
            name, _, anchor = link.partition("#")
            target = (project_root / page).parent / name if name else project_root / page
            is_page = target.is_file() and target.suffix == ".md"
            inside = headings(target.read_text(encoding="utf-8")) if is_page else set()
            if not target.exists() or (anchor and anchor not in inside):
                broken.append(f"{page}: {link}")
    assert broken == []


def commands(parser: argparse.ArgumentParser, name: str = "") -> dict[str, set[str]]:
    """Return every command and its options."""
    found = {name: set(parser._option_string_actions)}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for word, sub in action.choices.items():
                found |= commands(sub, f"{name} {word}".strip())
    return found


def test_commands_of_the_pages_exist(project_root: Path) -> None:
    """Of each `hiersched …`, in blocks and in the text: the command and its options."""
    known = commands(_parser())
    wrong, seen = [], set()
    for page, text in documents(project_root).items():
        lines = [line for _, block in FENCE.findall(text) for line in block.splitlines()]
        lines += re.findall(r"`([^`\n]+)`", FENCE.sub("", text))
        lines += re.findall(r"^    (hiersched .*)$", text, re.MULTILINE)
        for line in lines:
            called = re.match(r"\s*hiersched ((?:scenario )?[a-z]+)\b(.*)", line)
            if called is None:
                continue
            name, rest = called.groups()
            said = re.split(r" {5,}| # | > |--snakemake", rest)[0]
            options = set(re.findall(r"(?<!\S)--[a-z]+", said))
            seen.add(name)
            if name not in known or not options <= known[name]:
                wrong.append(f"{page}: {line.strip()}")
    assert wrong == []
    assert {"new", "run", "scenario check", "scenario schema", "replay"} <= seen


def test_make_targets_of_the_pages_exist(project_root: Path) -> None:
    makefile = (project_root / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z][\w-]*):(?!=)", makefile, re.MULTILINE))
    named = {
        target
        for text in documents(project_root).values()
        for target in re.findall(r"(?:^|`)make ([a-z][a-z-]*)", text, re.MULTILINE)
    }
    assert {"paper", "test", "docs"} <= named
    assert named <= targets


def test_scenarios_of_the_pages_are_valid(
    project_root: Path, schema: Draft202012Validator, tmp_path: Path
) -> None:
    """The schema takes every scenario of a page; the package those that name no other file."""
    count = 0
    for page, text in documents(project_root).items():
        for kind, block in re.findall(r"^ *```(\w*)\n(.*?)^ *```$", text, re.M | re.S):
            if kind != "yaml":
                continue
            overlay = yaml.safe_load(block) or {}
            assert [e.message for e in schema.iter_errors(overlay)] == [], f"{page}: {block}"
            entries = overlay.get("policies", {}).values()
            if "plugins" not in overlay and not any({"sb3", "onnx"} & {*one} for one in entries):
                path = tmp_path / "mine.yaml"
                path.write_text(yaml.safe_dump(overlay), encoding="utf-8")
                experiments(load_scenario(path))
                count += 1
    assert count >= 5


def test_the_changelog_has_readable_parts(project_root: Path) -> None:
    text = documents(project_root)["CHANGELOG.md"]
    releases = re.findall(r"^## \[(.*)\]$", text, re.MULTILINE)
    assert releases[0] == "Unreleased"
    parts = set(re.findall(r"^### (.*)$", text, re.MULTILINE))
    assert parts <= {"Added", "Changed", "Removed", "Fixed", "Changes results"}
    version = re.search(r'^version = "(.*)"$', (project_root / "pyproject.toml").read_text(), re.M)
    assert version
    assert releases[1] == version[1]


# docs/extending/shown.md


@pytest.fixture
def shown(project_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The files of the page in the working directory; its command and its last block."""
    text = documents(project_root)["docs/extending/shown.md"]
    code, scenario, command, after = FENCE.findall(text)
    assert [code[0], scenario[0], command[0], after[0]] == ["python", "yaml", "", "python"]
    (tmp_path / "my_results.py").write_text(code[1], encoding="utf-8")
    (tmp_path / "mine.yaml").write_text(scenario[1], encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield command[1].strip(), after[1]
    if sys.modules.pop("my_results", None):
        registry._forget((tmp_path / "my_results.py").resolve())


def test_a_table_a_figure_and_a_claim_of_a_plugin(shown: tuple[str, str]) -> None:
    """The stages of the page's command, in this process, then its last block."""
    from hiersched.experiments.gains import design_gains
    from hiersched.experiments.run import run_experiment
    from hiersched.experiments.worlds import untrained_policies
    from hiersched.study.built_in import shown as shown_of
    from hiersched.study.claims.report import join_claims
    from hiersched.study.measure import measure
    from hiersched.study.metrics import measured_row
    from hiersched.study.registry import CLAIMS, FIGURES, TABLES
    from hiersched.study.show import show

    scenario, results = load_scenario("mine.yaml"), Path("results/mine")
    design_gains(scenario, "schedule", results / "gains/schedule.json")
    for name in ("evaluate", "load"):
        run_experiment(scenario, results, name, "classical", untrained_policies, measured_row)
    measure(scenario, results, "classical")
    for kind, kinds, name in (
        ("table", TABLES, "jitter"),
        ("figure", FIGURES, "figX_jitter"),
        ("claim", CLAIMS, "claim11"),
    ):
        assert name in shown_of(kinds, scenario)
        show(scenario, results, kind, name, "my_results")
    join_claims(scenario, results, ["claim11"])
    exec(compile(shown[1], "shown.md", "exec"), {})
    assert "| edf | 10.64" in (results / "tables/jitter.md").read_text(encoding="utf-8")
    claims = json.loads((results / "claims.json").read_text(encoding="utf-8"))["claims"]
    assert [claim["verdict"] for claim in claims] == ["reproduced"]
    assert [run["value"] for run in claims[0]["sensitivity"]] == ["0.85", "1.0"]
    assert (results / "figures/figX_jitter.png").stat().st_size > 10_000


@pytest.mark.nightly
def test_the_workflow_has_a_job_for_each(shown: tuple[str, str]) -> None:
    """The page's command, as a plan."""
    words = shown[0].replace("--snakemake='", "--snakemake='-n ").strip()
    hiersched = f"'{sys.executable}' -m hiersched.cli"
    done = subprocess.run(
        words.replace("hiersched", hiersched, 1), shell=True, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    planned = done.stdout + done.stderr
    for name in ("table_jitter", "figure_figX_jitter", "claim11", "claims", "measure_classical"):
        assert f"{name}_mine" in planned
    assert "table_policies" not in planned
    shutil.rmtree("results", ignore_errors=True)
