"""What every key means: from the comments of the defaults, and from the classes of models."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from hiersched.models.model import SECTIONS, Model
from hiersched.policies.registry import Rule
from hiersched.scenario.fault_text import ScenarioError
from hiersched.scenario.plugins import CONFIG
from hiersched.scenario.schema import Scenario, model_at

_KEY_LINE = re.compile(
    r"^(\s*)([A-Za-z_0-9]+):\s*([^#]*?)\s*"
    r"(?:#\s*\[([^\]]+)\]\s*(paper|assumed)(?::\s*(.*))?|#.*)?$"
)


@dataclass(frozen=True, kw_only=True)
class ParameterNote:
    """What is said of one key: dotted key, unit, paper or assumed, meaning."""

    key: str
    unit: str
    origin: str
    meaning: str


def parameter_notes(defaults: Path | None = None) -> list[ParameterNote]:
    """Read unit, origin and meaning of every key, from the comments of the defaults file.

    ScenarioError if a key has none of the form ``# [unit] paper|assumed: meaning``.
    """
    path = defaults or CONFIG / "defaults.yaml"
    notes: list[ParameterNote] = []
    sections: list[tuple[int, str]] = []  # those that a line is in, and how far they are indented
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        match = _KEY_LINE.match(line)
        if match is None:
            continue
        indent, key, value, unit, origin, meaning = match.groups()
        while sections and sections[-1][0] >= len(indent):
            sections.pop()
        if not value:
            sections.append((len(indent), key))
            continue
        if unit is None:
            raise ScenarioError(
                f"{path}: line {number}: {key} lacks its comment '# [unit] paper|assumed: …'"
            )
        dotted = ".".join([*(name for _, name in sections), key])
        notes.append(ParameterNote(key=dotted, unit=unit, origin=origin, meaning=meaning or ""))
    return notes


def scenario_notes(scenario: Scenario, defaults: Path | None = None) -> list[ParameterNote]:
    """Return the note of every key that a scenario has; ScenarioError as from `parameter_notes`.

    The keys of models that are not the defaults' have theirs from the classes.
    """
    notes = parameter_notes(defaults)
    for section in SECTIONS:
        places = [place for place, note in enumerate(notes) if _section(note.key) == section]
        own = _own_notes(section, model_at(scenario, section))
        # What the defaults say of the keys of their own model stands.
        if {note.key for note in own} != {notes[place].key for place in places}:
            notes[places[0] : places[-1] + 1] = own
    axes = {f"sweeps.axes.{name}.vary" for name in scenario.sweeps.axes}
    notes = [
        note
        for note in notes
        if not note.key.startswith("sweeps.axes.") or f"{_section(note.key)}.vary" in axes
    ]
    known = {note.key for note in notes}
    notes += [
        ParameterNote(key=key, unit="values", origin="assumed", meaning="a sweep")
        for key in sorted(axes - known)
    ]
    for name, policy in scenario.policies.items():
        if isinstance(policy, Rule):
            notes += _own_notes(f"policies.{name}", policy)
    return notes


def _section(key: str) -> str:
    return key.rpartition(".")[0]


def _own_notes(place: str, model: Model) -> list[ParameterNote]:
    """Return what the class of a model at a place says of its keys."""
    return [
        ParameterNote(key=f"{place}.{key}", **vars(note)) for key, note in model.notes().items()
    ]
