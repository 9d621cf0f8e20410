"""Faults of a scenario as text: file, key, value and what is allowed."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any, get_type_hints

from pydantic import ValidationError

from hiersched.core.faults import InputError, did_you_mean
from hiersched.models.model import SECTIONS, Section
from hiersched.policies.files import FILE_POLICIES
from hiersched.policies.registry import RULES
from hiersched.scenario.old_keys import new_key
from hiersched.scenario.schema import Axis, Family, LoopCell, Scenario, TaskCell

Location = tuple[str | int, ...]


class ScenarioError(InputError, ValueError):
    """A scenario that cannot be run: the message names file, key, value and what is allowed."""


MOST_SHOWN = 300
"""Characters of a value that a fault shows: it may be a whole section."""


def describe(
    error: ValidationError,
    merged: Mapping[str, Any],
    sources: Sequence[tuple[Path, Mapping[str, Any]]],
) -> str:
    """Return a line for every fault that validation found.

    `merged` is the scenario on its defaults; `sources` are its files and what each holds: its own,
    those that it extends, and last the defaults.
    """
    lines = []
    for item in error.errors():
        location = _place(item, merged)
        holders = [file for file, data in sources if _holds(data, location)]
        missing = item["type"] == "missing"
        source = sources[0][0] if missing else [*holders, sources[-1][0]][0]
        lines.append(f"{source}: {_fault(item, location, merged)}")
    return "\n".join(dict.fromkeys(lines))


def own_faults(
    error: ValidationError, place: str, values: Mapping[str, Any], allowed: Sequence[str]
) -> list[str]:
    """Return the faults of a mapping that stands at a dotted place, as ``key = value: …``.

    `allowed` are the keys that the mapping may have.
    """
    faults = [
        f"{place}.{_fault(item, _place(item, values), values, allowed)}" for item in error.errors()
    ]
    return list(dict.fromkeys(faults))


def _place(item: Any, values: Mapping[str, Any]) -> Location:
    """Cut a location back to what stands in the file: branches of a union append their names."""
    location: Location = item["loc"]
    while location and not _holds(values, location) and item["type"] != "missing":
        location = location[:-1]
    return location


def _fault(
    item: Any, location: Location, merged: Mapping[str, Any], allowed: Sequence[str] | None = None
) -> str:
    key = ".".join(str(part) for part in location)
    if item["type"] == "missing":
        return f"{key}: missing"
    value = _value_at(merged, location)
    message = item["msg"].replace("Input should be", "must be")
    if item["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        message = new_key(key, value) or "unknown key"
        allowed = allowed_keys(location[:-1], merged) if allowed is None else allowed
        if message == "unknown key" and allowed:
            message += f"; allowed: {', '.join(allowed)}{meant(str(location[-1]), allowed)}"
    elif isinstance(value, str) and re.fullmatch(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+", value):
        message += " (YAML takes 1e-3 and 1.0e6 for text: write 1.0e-3, 1.0e+6)"
    shown = repr(value)
    shown = shown if len(shown) <= MOST_SHOWN else f"{shown[:MOST_SHOWN]}…"
    return f"{key} = {shown}: {message}"


def meant(name: str, allowed: Sequence[str]) -> str:
    """Ask for the key that was probably meant: one much like it here, or its like elsewhere."""
    elsewhere = {key: f"{place}.{key}" for place, keys in section_keys().items() for key in keys}
    return did_you_mean(name, allowed) or did_you_mean(name, elsewhere, cutoff=0.8)


def _holds(data: Any, location: Location) -> bool:
    for part in location:
        if isinstance(data, list):
            data = dict(enumerate(data))
        if not isinstance(data, Mapping) or part not in data:
            return False
        data = data[part]
    return True


def _value_at(data: Any, location: Location) -> Any:
    return reduce(getitem, location, data)


def allowed_keys(location: Location, merged: Mapping[str, Any]) -> list[str]:
    """Return the keys that a mapping at a place of a scenario may have; none for other places."""
    if not location:
        return [field.name for field in fields(Scenario)]
    place = ".".join(str(part) for part in location)
    if place in SECTIONS:
        return _model_keys(SECTIONS[place], _value_at(merged, location))
    section = str(location[0])
    if location[:2] == ("sweeps", "axes"):
        return [field.name for field in fields(Axis)]
    if location[:2] == ("task_study", "cells"):
        return [field.name for field in fields(TaskCell)]
    if location[:2] == ("gain_study", "cells"):
        return [field.name for field in fields(LoopCell)]
    if location[:2] == ("task_study", "families"):
        if location[3:] == ("policy",):
            return _model_keys(RULES, _value_at(merged, location))
        return [field.name for field in fields(Family)]
    if section == "policies":
        return _policy_keys(_value_at(merged, location))
    return list(section_keys().get("learning" if section == "learners" else section, ()))


def _policy_keys(entry: Mapping[str, Any]) -> list[str]:
    if "import" in entry:
        return ["import", "rule", "parameters"]
    for key, kind in FILE_POLICIES.items():
        if key in entry:
            return [field.name for field in fields(kind)]
    return _model_keys(RULES, entry)


def _model_keys(section: Section, values: Mapping[str, Any]) -> list[str]:
    kind = section.loaded(str(values.get("model")))
    return [] if kind is None else list(kind.notes())


def section_keys() -> dict[str, tuple[str, ...]]:
    """Return the keys of every section, but for sections that hold a model."""
    return {
        name: tuple(field.name for field in fields(hint))
        for name, hint in get_type_hints(Scenario).items()
        if is_dataclass(hint)
    }
