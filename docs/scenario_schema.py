"""The JSON schema of a scenario's file, from the classes that read it; `generate.py` writes it.

Every key may be left out: a file holds what differs. Where a file has plug-ins or extends another
scenario, models and algorithms may have names and keys that the package does not know.
"""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import yaml
from pydantic import TypeAdapter

from hiersched.core.registry import BUILT_IN_ALGORITHMS
from hiersched.models.model import SECTIONS, Section
from hiersched.policies.files import FILE_POLICIES
from hiersched.policies.find import ImportedPolicy
from hiersched.policies.index_rules import CLASSICAL
from hiersched.policies.registry import RULES
from hiersched.scenario import parameter_notes
from hiersched.scenario.plugins import CONFIG
from hiersched.scenario.schema import Scenario

Json = dict[str, Any]

DRAFT = "https://json-schema.org/draft/2020-12/schema"
NAMES_WHAT_IS_NOT_OURS = {
    "anyOf": [
        {"required": ["extends"]},
        {"required": ["plugins"], "properties": {"plugins": {"minItems": 1}}},
    ]
}


@cache
def defaults() -> Json:
    """Return the defaults of every key."""
    return yaml.safe_load((CONFIG / "defaults.yaml").read_text(encoding="utf-8"))


def value_at(data: Json, key: str) -> Any:
    """Return the value at a dotted key."""
    for part in key.split("."):
        data = data[part]
    return data


def scenario_schema() -> Json:
    """Return the schema."""
    schema = _plain(TypeAdapter(Scenario).json_schema())
    definitions, sections = schema["$defs"], schema["properties"]
    for key, section in SECTIONS.items():
        _put(schema, key, _any_model(section))
    sections["extends"] = {
        "type": "string",
        "description": "name or path of the scenario that this one departs from",
    }
    sections["policies"] = {
        "type": "object",
        "propertyNames": {"pattern": "^[a-z][a-z0-9_]*$", "not": {"enum": list(CLASSICAL)}},
        "additionalProperties": _policy(),
    }
    sections["learners"] = {
        "type": "object",
        "additionalProperties": {"anyOf": [sections["learning"], {"type": "null"}]},
    }
    kinds = sections["robot_kinds"]["patternProperties"]
    for pattern, kind in kinds.items():
        kinds[pattern] = {"anyOf": [kind, {"type": "null"}]}
    definitions["Family"]["properties"]["policy"] = _policy()
    for name in ("families", "cells"):
        holder = definitions["TaskStudy"]["properties"][name]
        kinds = holder["patternProperties"]
        for pattern, kind in kinds.items():
            kinds[pattern] = {"anyOf": [kind, {"type": "null"}]}
    definitions["Learning"]["properties"]["algorithm"]["examples"] = list(BUILT_IN_ALGORITHMS)
    definitions["Sweeps"]["properties"]["axes"] = _axes(schema)
    for note in parameter_notes():
        known = property_at(schema, note.key)
        said = {"description": f"[{note.unit}] {note.origin}: {note.meaning}".rstrip(": ")}
        if known is not None:
            default = value_at(defaults(), note.key)
            said["default"] = default
            if default is None and {"type": "null"} not in known.get("anyOf", ()):
                _put(schema, note.key, {"anyOf": [known, {"type": "null"}]})
                known = property_at(schema, note.key)
            known.update(said)
    title = {"$schema": DRAFT, "title": "Scenario of hiersched"}
    return {**title, **schema, "if": NAMES_WHAT_IS_NOT_OURS, "else": {"properties": _ours()}}


def as_text(value: Any, indent: str = "") -> str:
    """Write JSON: on one line what fits there."""
    flat = json.dumps(value, ensure_ascii=False)
    if not isinstance(value, dict | list) or len(indent) + len(flat) <= 160:
        return flat
    ends = "{}" if isinstance(value, dict) else "[]"
    inner = indent + " "
    entries = (
        [f"{json.dumps(key)}: {as_text(entry, inner)}" for key, entry in value.items()]
        if isinstance(value, dict)
        else [as_text(entry, inner) for entry in value]
    )
    lines = ",\n".join(inner + entry for entry in entries)
    return f"{ends[0]}\n{lines}\n{indent}{ends[1]}"


def property_at(schema: Json, key: str) -> Json | None:
    """Return the schema at a dotted key; None where a key has no schema of its own."""
    found = schema
    for part in key.split("."):
        found = _resolved(schema, found).get("properties", {}).get(part)
        if found is None:
            return None
    return found


def model_schema(kind: type) -> Json:
    """Return the schema of a model's keys, `model` first."""
    schema = _plain(TypeAdapter(kind).json_schema())
    for key, note in kind.notes().items():
        if note.meaning:
            said = f"[{note.unit}] {note.origin}: {note.meaning}"
            schema["properties"][key]["description"] = said
    return schema


def _resolved(schema: Json, node: Json) -> Json:
    name = node.get("$ref", "").rpartition("/")[2]
    return schema["$defs"][name] if name else node


def _put(schema: Json, key: str, value: Json) -> None:
    parent, _, name = key.rpartition(".")
    holder = property_at(schema, parent) if parent else schema
    _resolved(schema, holder)["properties"][name] = value


def _plain(node: Any) -> Any:
    """Leave out titles, which repeat the keys, and which keys a class needs."""
    if isinstance(node, list):
        return [_plain(entry) for entry in node]
    if not isinstance(node, dict):
        return node
    return {
        key: {name: _plain(entry) for name, entry in value.items()}
        if key in ("properties", "$defs")
        else _plain(value)
        for key, value in node.items()
        if key not in ("title", "required")
    }


def _models(section: Section) -> dict[str, Json]:
    return {name: model_schema(section[name]) for name in section}


def _any_model(section: Section) -> Json:
    """Return what may stand where a model is chosen; without `model`, keys of the one in force."""
    models = _models(section)
    keys: Json = {}
    for own in models.values():
        keys.update(own["properties"])
    del keys["model"]
    names = {"description": "[model] which model", "type": "string"}
    other = {"properties": {"model": {"not": {"enum": list(models)}}}, "required": ["model"]}
    return {
        "type": "object",
        "properties": {"model": {**names, "examples": list(models)}},
        "oneOf": [
            *({**own, "required": ["model"]} for own in models.values()),
            {"properties": keys, "not": {"required": ["model"]}},
            other,
        ],
    }


def _our_model(section: Section) -> Json:
    """Return what may stand there where nothing but our models is known."""
    models = _models(section)
    default = models[value_at(defaults(), section.key)["model"]]
    return {
        "anyOf": [
            {"required": ["model"], "properties": {"model": {"enum": list(models)}}},
            {"propertyNames": {"enum": [key for key in default["properties"] if key != "model"]}},
        ]
    }


def _policy() -> Json:
    imported = _plain(TypeAdapter(ImportedPolicy).json_schema())
    imported["properties"]["rule"]["enum"] = list(CLASSICAL)
    policy = _any_model(RULES)
    *rules, unnamed, other = policy["oneOf"]
    others = [{**imported, "required": ["import"]}]
    for key, kind in FILE_POLICIES.items():
        others.append({**_plain(TypeAdapter(kind).json_schema()), "required": [key]})
    named = ("model", "import", *FILE_POLICIES)
    unnamed["not"] = {"anyOf": [{"required": [key]} for key in named]}
    return {**policy, "oneOf": [*rules, *others, unnamed, other]}


def _axes(schema: Json) -> Json:
    """Return what axes of a sweep may be: in full, short as a list under a key, or none."""
    full = {**schema["$defs"]["Axis"], "minProperties": 1}
    forms = [full, {"type": "array", "minItems": 1}, {"type": "null"}]
    return {
        "type": "object",
        "description": "name -> what it varies, or null: none; a list under a key is short for it",
        "propertyNames": {"pattern": "^[a-z][A-Za-z0-9_.]*$"},
        "properties": {
            name: {"anyOf": [full, {"type": "null"}], "default": axis}
            for name, axis in value_at(defaults(), "sweeps.axes").items()
        },
        "additionalProperties": {"anyOf": forms},
    }


def _ours() -> Json:
    """Return what is allowed besides where nothing but the package's models is known."""
    ours: Json = {}
    for key, section in SECTIONS.items():
        parent, _, name = key.rpartition(".")
        holder = ours.setdefault(parent, {"properties": {}})["properties"] if parent else ours
        holder[name] = _our_model(section)
    named = {"required": ["model"], "properties": {"model": {"enum": list(RULES)}}}
    others = [{"required": [key]} for key in ("import", *FILE_POLICIES)]
    ours["policies"] = {"additionalProperties": {"anyOf": [*others, named]}}
    learning = {"properties": {"algorithm": {"enum": list(BUILT_IN_ALGORITHMS)}}}
    ours["learning"], ours["learners"] = learning, {"additionalProperties": learning}
    keys = [note.key for note in parameter_notes() if not note.key.startswith("sweeps.")]
    of_models = [
        f"{key}.{name}"
        for key, section in SECTIONS.items()
        for own in _models(section).values()
        for name in own["properties"]
    ]
    known = {"enum": list(dict.fromkeys([*keys, *SECTIONS, *of_models]))}
    varied = {"propertyNames": {"anyOf": [known, {"pattern": r"^policies\."}]}}
    axes = {"additionalProperties": {"properties": {"vary": varied}}}
    ours["sweeps"] = {"properties": {"axes": axes}}
    return ours
