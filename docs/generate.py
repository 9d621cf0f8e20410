"""Writes what the documents say of names and keys, from the code that has them.

In a Markdown file ``<!-- generated: NAME WORDS -->`` and ``<!-- end -->`` enclose what the block
NAME of this file returns for WORDS. ``make docs`` writes all of them, and the JSON schema of
scenarios; ``python docs/generate.py --check`` says which files it would write.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import yaml

sys.path.insert(0, str(Path(__file__).parent))

from scenario_schema import as_text, defaults, model_schema, property_at, scenario_schema, value_at

from hiersched.cli import _parser
from hiersched.experiments import files
from hiersched.models.model import SECTIONS
from hiersched.policies.index_rules import CLASSICAL
from hiersched.policies.registry import RULES
from hiersched.policies.task_rules import TASK_RULES
from hiersched.scenario import parameter_notes
from hiersched.study import built_in as built_in  # registers what is shown
from hiersched.study import measure, metrics
from hiersched.study.registry import CLAIMS, FIGURES, TABLES

ROOT = Path(__file__).resolve().parents[1]
SCHEMA = ROOT / "src/hiersched/config/scenario.schema.json"
MARK = re.compile(
    r"^(<!-- generated: ([a-z-]+)((?: [\w.-]+)*) -->\n)(.*?)(<!-- end -->)$", re.M | re.S
)

BLOCKS: dict[str, Callable[..., str]] = {}


def block(build: Callable[..., str]) -> Callable[..., str]:
    """Register a block under the name of its function."""
    BLOCKS[build.__name__.replace("_", "-")] = build
    return build


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    cells = [[text.replace("|", "\\|") for text in row] for row in lines]
    return "\n".join("|".join(["", *(f" {t} " if t else " " for t in row), ""]) for row in cells)


def code(text: Any) -> str:
    """Set a text as code; nothing stays nothing."""
    return f"`{text}`" if str(text) else ""


def first_sentence(text: str | None) -> str:
    """Return the first sentence of a docstring, as one line, without reST's double backquotes."""
    line = " ".join((text or "").split("\n\n")[0].split())
    return re.split(r"(?<=\.) (?=[A-Z])", line)[0].replace("``", "`")


# Keys of a scenario.


@cache
def schema() -> dict[str, Any]:
    """Return the JSON schema of a scenario."""
    return scenario_schema()


def allowed(node: dict[str, Any] | None) -> str:
    """Say in words what a JSON schema allows."""
    if not node:
        return "any"
    if "anyOf" in node:
        return " or ".join(dict.fromkeys(map(allowed, node["anyOf"])))
    if "enum" in node:
        return ", ".join(map(code, node["enum"]))
    kind = node.get("type")
    if kind == "array":
        return _allowed_list(node)
    if kind in ("integer", "number"):
        return {"integer": "whole number", "number": "number"}[kind] + _range(node)
    if kind == "string":
        names = ", ".join(map(code, node.get("examples", ())))
        return names or ("a name" if "pattern" in node else "text")
    names = {"boolean": "`true`, `false`", "null": "`null`", "object": "mapping"}
    return names[str(kind)]


def _allowed_list(node: dict[str, Any]) -> str:
    if "prefixItems" in node:
        entries = dict.fromkeys(map(allowed, node["prefixItems"]))
        return f"[{len(node['prefixItems'])} of: {'; '.join(entries)}]"
    entry = node.get("items")
    if entry and entry.get("items"):
        return "matrix"
    return f"{'one or more of' if node.get('minItems') else 'list of'}: {allowed(entry)}"


def _range(node: dict[str, Any]) -> str:
    ends = []
    for name, sign in (
        ("minimum", "≥"),
        ("exclusiveMinimum", ">"),
        ("maximum", "≤"),
        ("exclusiveMaximum", "<"),
    ):
        if name in node:
            ends.append(f"{sign} {'2³¹' if node[name] == 2**31 else format(node[name], '.12g')}")
    return f" {', '.join(ends)}" if ends else ""


def flow(value: Any) -> str:
    """Write a value as it stands in YAML, on one line; long runs of numbers are shortened."""
    if isinstance(value, list) and len(value) > 3 and all(isinstance(n, int) for n in value):
        if value == list(range(value[0], value[-1] + 1)):
            return f"[{value[0]}, {value[1]}, …, {value[-1]}]"
    if value is None:
        return "null"
    text = yaml.safe_dump(value, default_flow_style=True, width=10**6, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...")


@block
def keys(*sections: str) -> str:
    """Return a table of the keys of sections: default, unit, origin, what is allowed, meaning."""
    rows = []
    for note in parameter_notes():
        section, _, key = note.key.partition(".")
        if section not in sections:
            continue
        place = note.key.removesuffix(".model")
        if place in SECTIONS and place != note.key:
            may_be = ", ".join(map(code, SECTIONS[place]))
        else:
            may_be = allowed(_key_schema(note.key))
        default = flow(value_at(defaults(), note.key))
        shown = key if len(sections) == 1 and key else note.key
        rows.append((code(shown), code(default), note.unit, note.origin, may_be, note.meaning))
    if not rows:
        raise ValueError(f"generated: keys {' '.join(sections)}: no keys of such a section")
    return table(("key", "default", "unit", "origin", "allowed", "meaning"), rows)


def _key_schema(key: str) -> dict[str, Any] | None:
    parent, _, name = key.rpartition(".")
    if parent in SECTIONS:
        model = SECTIONS[parent][value_at(defaults(), key=parent)["model"]]
        return model_schema(model)["properties"][name]
    if key.startswith("sweeps.axes."):
        return schema()["$defs"]["Axis"]["properties"][name]
    return property_at(schema(), key)


@block
def models() -> str:
    """Return a table of the models of every place, with the keys that each has."""
    rows = []
    for place, section in SECTIONS.items():
        for name in section:
            rows += _model_rows(place, section[name])
    return table(("place", "model", "key", "default", "unit", "allowed", "meaning"), rows)


def _model_rows(place: str, kind: type) -> list[tuple[str, ...]]:
    properties = model_schema(kind)["properties"]
    model = properties.pop("model")["const"]
    notes = kind.notes()
    rows = [(code(place), code(model), "", "", "", "", first_sentence(kind.__doc__))]
    standard = value_at(defaults(), place)
    for key, node in properties.items():
        given = inspect.signature(kind).parameters[key].default
        if standard["model"] == model:
            given = standard[key]
        default = "" if given is inspect.Parameter.empty else code(flow(given))
        rows.append(
            ("", "", code(key), default, notes[key].unit, allowed(node), notes[key].meaning)
        )
    return rows


@block
def rules() -> str:
    """Return a table of the schedulers, with the keys that each has as a policy."""
    rows = []
    for name in (*CLASSICAL, *TASK_RULES):
        rule = RULES[name]
        own = model_schema(rule)["properties"]
        del own["model"]
        given = inspect.signature(rule).parameters
        texts = (f"`{key}` {code(flow(given[key].default))}: {allowed(own[key])}" for key in own)
        knob = code(rule.knob or "")
        rows.append((code(name), first_sentence(rule.__doc__), knob, "; ".join(texts)))
    return table(("rule", "what it does", "knob", "keys and their defaults"), rows)


@block
def task_rules() -> str:
    """Return a table of the schedulers by the task: weight, source, what each knows, its knob."""
    rows = []
    for name in TASK_RULES:
        rule = RULES[name]
        text = " ".join((inspect.getdoc(rule) or "").split())
        weight = first_sentence(rule.__doc__)
        knows = "the task" if rule.knows_task else "no task"
        knob = code(rule.knob or "")
        rows.append((code(name), weight, text.removeprefix(weight).strip(), knows, knob))
    return table(("rule", "weight", "source", "knows", "knob"), rows)


# Files and measures of a study.


@block
def study_files() -> str:
    """Return a table of the files of a study, from the functions that name them."""
    stubs = {
        "experiment": SimpleNamespace(name="<experiment>"),
        "point": SimpleNamespace(value="<value>"),
        "scenario": SimpleNamespace(
            learned={"<learner>": SimpleNamespace(seeds=("<N>",))},
        ),
        **{name: f"<{name}>" for name in ("design", "learner", "policy", "table", "group", "cell")},
        "seed": "<N>",
    }
    rows = []
    for name, text in attribute_docs(ast.parse(inspect.getsource(files))).items():
        value = getattr(files, name)
        names = [value] if isinstance(value, str) else value
        rows.append((" ".join(map(code, names)), text))
    named = [entry for entry in vars(files).values() if _names_a_file(entry)]
    for function in (*named, files.policy_files, measure.table_file):
        given = (stubs[name] for name in inspect.signature(function).parameters)
        found = function(*given)
        path = found if isinstance(found, str) else found[0]
        rows.append((code(path), first_sentence(function.__doc__)))
    rows += [
        (
            "`tables/<table>.csv` `tables/<table>.md` `tables/<table>.html`",
            "A table, to compute with and, unless it is for that alone, to read.",
        ),
        ("`figures/<figure>.svg` `figures/<figure>.png`", "A figure."),
        ("`claims/claim<N>.json`", "A claim by itself."),
        ("`logs/` `benchmarks/`", "What each job printed, and how long it took."),
    ]
    return table(("file", "what it is"), sorted(rows))


def _names_a_file(thing: Any) -> bool:
    """Whether it is a function of `experiments.files` that returns the name of one file."""
    is_own = inspect.isfunction(thing) and thing.__module__ == files.__name__
    return is_own and thing.__annotations__["return"] == "str" and "folder" not in thing.__name__


def attribute_docs(body: ast.Module | ast.ClassDef) -> dict[str, str]:
    """Return the strings behind assignments; one string is of all names since the one before."""
    found: dict[str, str] = {}
    waiting: list[str] = []
    for node in body.body:
        if isinstance(node, ast.AnnAssign):
            waiting.append(ast.unparse(node.target))
        elif isinstance(node, ast.Assign):
            waiting += map(ast.unparse, node.targets)
        elif isinstance(node, ast.Expr) and waiting:
            text = " ".join(ast.literal_eval(node.value).split())
            found |= dict.fromkeys(waiting, text)
            waiting = []
    return found


@block
def measures() -> str:
    """Return a table of the tables of measures, from the docstring that defines them."""
    named = {*measure.RUN_TABLES, *measure.TASK_TABLES, *measure.GAIN_TABLES, "episodes"}
    said = re.findall(r"^(\w+)\n((?:    .*\n)+)", f"{measure.__doc__}\n", re.MULTILINE)
    if {name for name, _ in said} != named:
        raise ValueError(f"{measure.__name__}: its docstring has not the tables {sorted(named)}")
    rows = ((code(name), " ".join(text.split())) for name, text in said)
    return table(("table", "a row is"), rows)


@block
def columns() -> str:
    """Return a table of the columns of the runs, from the fields of `RunMetrics`."""
    (body,) = ast.parse(inspect.getsource(metrics.RunMetrics)).body
    said = attribute_docs(body)
    missing = metrics.RunMetrics.__annotations__.keys() - said.keys()
    if missing:
        raise ValueError(f"RunMetrics: nothing is said of {', '.join(sorted(missing))}")
    rows: dict[str, list[str]] = {}
    for name, text in said.items():
        rows.setdefault(text, []).append(code(name))
    return table(
        ("column", "what it is"), ((" ".join(names), text) for text, names in rows.items())
    )


# What a study shows.


@block
def shown(kind: str) -> str:
    """Return a table of the tables, figures or claims."""
    if kind == "claims":
        rows = (
            (
                claim.name.removeprefix("claim"),
                claim.title,
                claim.reference,
                " ".join(filter(None, (claim.note, claim.unswept))),
                " ".join(map(code, claim.reads)),
            )
            for claim in map(CLAIMS.__getitem__, CLAIMS)
        )
        return table(("", "claim", "in the paper", "how it is measured", "reads"), rows)
    registry = {"tables": TABLES, "figures": FIGURES}[kind]
    rows = (
        (
            code(thing.name),
            thing.title.rstrip("."),
            " ".join(map(code, thing.reads)) or "(the scenario)",
            link(thing.file, thing.build.__name__),
        )
        for thing in (registry[name] for name in sorted(registry))
    )
    return table((kind.removesuffix("s"), "shows", "reads", "made by"), rows)


def link(file: Path, name: str, to: str = "../") -> str:
    """Return a link from docs/ to something in a file."""
    path = file.relative_to(ROOT).as_posix()
    return f"[`{name}`]({to}{path})"


# Commands.


@block
def commands() -> str:
    """Return what `hiersched` takes, from its parser."""
    return "\n\n".join(_commands(_parser()))


def _commands(parser: argparse.ArgumentParser) -> Iterable[str]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                if any(isinstance(a, argparse._SubParsersAction) for a in sub._actions):
                    yield from _commands(sub)
                else:
                    yield _command(sub)


def _command(parser: argparse.ArgumentParser) -> str:
    given = [action for action in parser._actions if action.dest != "help"]
    places = [_place(action) for action in given if not action.option_strings]
    said = (parser.description or "").strip()
    lines = [f"### `{' '.join([parser.prog, *places])}`", "", f"{said[:1].upper()}{said[1:]}"]
    rows = [(code(_option(action)), action.help or "") for action in given]
    closed = lines[-1] if lines[-1].endswith(".") else f"{lines[-1]}."
    return "\n".join([*lines[:-1], closed, *(["", table(("", ""), rows)] if rows else [])])


def _place(action: argparse.Action) -> str:
    name = str(action.metavar or action.dest)
    return f"{name} …" if action.nargs == "+" else name


def _option(action: argparse.Action) -> str:
    if not action.option_strings:
        return _place(action)
    takes = "" if action.nargs == 0 else f" {action.metavar or action.dest.upper()}"
    return f"{action.option_strings[-1]}{takes}"


@block
def targets() -> str:
    """Return the targets of the Makefile, as `make help` lists them."""
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    found = re.findall(r"^([a-z-]+):.*?## (.*)$", text, re.MULTILINE)
    return table(("", ""), ((f"`make {name}`", said) for name, said in found))


# Where things are.

WHERE = {
    "the slot loop": ("hiersched.simulator.loop:run_slots",),
    "draws of the world: streams, keys": ("hiersched.core.randomness:draw_uniforms",),
    "arrivals, and how they fall with the rate": ("hiersched.models.traffic.poisson",),
    "the sojourn of every packet in the FIFO queue": ("hiersched.models.queue.fifo:serve_user",),
    "a policy of another library, in a file": ("hiersched.policies.files",),
    "the page of a log, that of a study": (
        "hiersched.replay.page.build",
        "hiersched.study.page.build",
    ),
    "the same once more, from logs": ("hiersched.study.fifo:sojourn_slots",),
    "the dexterity index (DI)": ("hiersched.models.plant.dexterity:dexterity_index",),
    "the gain in force at a delay": ("hiersched.models.plant.feedback:entry_in_force",),
    "the weights of M-LWDF, and of any rule": ("hiersched.policies.index_rules:index_m_lwdf",),
    "the weights by the robots' task": ("hiersched.policies.task_rules:index_task",),
    "the knob of a rule": ("hiersched.policies.factor:Factored",),
    "what caps a rule's rates: its need": (
        "hiersched.policies.needs:expected_packets",
        "hiersched.policies.needs:need_mbps",
    ),
    "what a policy's name means": ("hiersched.policies.find:find_policy",),
    "the slot's Lagrangian": ("hiersched.allocation.objective:slot_terms",),
    "the delay constraint y: from late packets, the paper's surrogate": (
        "hiersched.simulator.loop:_account",
        "hiersched.allocation.objective:delay_surrogate",
    ),
    "what an agent sees": ("hiersched.policies.features",),
    "an environment: one world, a batch": ("hiersched.env.single", "hiersched.env.vector"),
    "the picture of an environment": ("hiersched.env.picture:Pictures",),
    "rewards of the agents": ("hiersched.learning.rewards",),
    "C1, C2, C3: is a gain safe up to a delay?": (
        "hiersched.control:analyse_razumikhin",
        "hiersched.control:analyse_delay_razumikhin",
        "hiersched.control:analyse_krasovskii",
    ),
    "the filter, and what it expects": (
        "hiersched.control:design_lqg",
        "hiersched.models.plant.estimator:estimate_now",
    ),
    "commands that cross the network": ("hiersched.models.plant.command_link",),
    "growth over delays that were measured": (
        "hiersched.control:second_moment_growth",
        "hiersched.simulator.loop_growth:loop_growth",
        "hiersched.study.growth:write_growth",
    ),
    "gains by C1 and C3": (
        "hiersched.control:RazumikhinSynthesis",
        "hiersched.control:KrasovskiiSynthesis",
    ),
    "the check of a certificate": ("hiersched.control:certify",),
    "what a scenario may hold": ("hiersched.scenario.schema:Scenario",),
    "an error text of a scenario: a key, type or range": (
        "hiersched.scenario.fault_text:describe",
    ),
    "likewise: values that do not fit each other": (
        "hiersched.scenario.consistency:inconsistencies",
    ),
    "an axis of the sweeps: what it varies, its points": (
        "hiersched.scenario.schema:Axis",
        "hiersched.experiments.feasible:load_study",
    ),
    "a field of the log": ("hiersched.core.fields:FIELDS",),
    "what runs in a study": ("hiersched.experiments.points:experiments",),
    "where a study's files lie": ("hiersched.experiments.files",),
    "whether a job runs again": (
        "hiersched.experiments.dependencies:stage_spec",
        "hiersched.experiments.fingerprint:code_fingerprint",
    ),
    "a measure of a run": ("hiersched.study.metrics:RunMetrics",),
    "a column of a table": (
        "hiersched.study.tables.policies",
        "hiersched.study.tables.gains",
        "hiersched.study.tables.paper",
    ),
    "one table of many studies": ("hiersched.study.across:table_across",),
    "intervals of means and ratios": ("hiersched.study.samples", "hiersched.study.lognormal"),
    "a table, figure or claim": ("hiersched.study.registry:Shown",),
    "the colour of a user": ("hiersched.core.colours:user_colours",),
    "the colour of a policy": (
        "hiersched.policies.registry:Look",
        "hiersched.study.figures.style:policy_look",
    ),
    "the numbers of a claim, and its range": ("hiersched.study.claims.judged",),
    "the rule of the verdicts": ("hiersched.study.claims.verdicts:Judged",),
    "what `hiersched replay` compares": ("hiersched.replay.verify:verify",),
    "what a command takes": ("hiersched.cli.run:add_commands",),
}
"""What a newcomer looks for -> ``module:name`` of where it is."""


@block
def where() -> str:
    """Return a table of where things are; whatever is not there is an error."""
    rows = []
    for thing, places in WHERE.items():
        rows.append((thing, ", ".join(map(_found, places))))
    return table(("what", "where"), rows)


def _found(place: str) -> str:
    """Return a link to ``module:name``, where it is defined; to the module without a name."""
    module, _, name = place.partition(":")
    found: Any = import_module(module)
    for part in filter(None, name.split(".")):
        found = getattr(found, part)
    if inspect.isclass(found) or callable(found):  # it may be imported there
        module = found.__module__
    file = Path(sys.modules[module].__file__ or "")
    return link(file, ".".join(filter(None, (file.stem, name))))


# Writing.


def documents() -> list[Path]:
    """Return the Markdown files with generated blocks."""
    places = (ROOT.glob("*.md"), ROOT.glob("docs/**/*.md"), ROOT.glob("src/**/*.md"))
    found = sorted(path for paths in places for path in paths)
    return [path for path in found if "<!-- generated:" in path.read_text(encoding="utf-8")]


def generated(path: Path) -> str:
    """Return what a Markdown file has to be."""
    text = path.read_text(encoding="utf-8")
    if len(re.findall("^<!-- generated:", text, re.M)) != len(MARK.findall(text)):
        raise ValueError(f"{path}: a mark that is not closed, or is none")
    return MARK.sub(_filled, text)


def _filled(match: re.Match[str]) -> str:
    begin, name, words, _, end = match.groups()
    if name not in BLOCKS:
        raise ValueError(f"generated: {name}: must be one of {', '.join(BLOCKS)}")
    return f"{begin}{BLOCKS[name](*words.split())}\n{end}"


def outdated() -> dict[Path, str]:
    """Return the files that are not what they have to be, with what that is."""
    wanted = {path: generated(path) for path in documents()}
    wanted[SCHEMA] = as_text(schema()) + "\n"
    return {
        path: text
        for path, text in wanted.items()
        if not path.exists() or path.read_text(encoding="utf-8") != text
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Write the generated parts of the documents.")
    parser.add_argument("--check", action="store_true", help="write nothing; status 1 if one would")
    given = parser.parse_args()
    found = outdated()
    for path, text in found.items():
        print(path.relative_to(ROOT))
        if not given.check:
            path.write_text(text, encoding="utf-8")
    sys.exit(bool(found) and given.check)
