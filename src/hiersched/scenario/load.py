"""Read a scenario: defaults, overlay, validation; the only place that reads YAML."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

from hiersched.core.faults import did_you_mean
from hiersched.models.model import SECTIONS
from hiersched.policies.files import PolicyFileError
from hiersched.scenario.consistency import inconsistencies
from hiersched.scenario.fault_text import ScenarioError, allowed_keys, describe, meant, section_keys
from hiersched.scenario.old_keys import converted
from hiersched.scenario.plugins import CONFIG, load_plugins
from hiersched.scenario.policy_files import with_policy_files
from hiersched.scenario.reference_file import ReferenceFileError, read_reference
from hiersched.scenario.schema import Scenario, hold_of
from hiersched.scenario.strict_yaml import parse_yaml

DEFAULTS = CONFIG / "defaults.yaml"


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: cannot be read: {error}") from error
    return _parse_yaml(text, path)


def _parse_yaml(text: str, path: Path) -> dict[str, Any]:
    try:
        data = parse_yaml(text)
    except yaml.MarkedYAMLError as error:
        mark, context = error.problem_mark, f"{error.context}: " if error.context else ""
        place = f" (line {mark.line + 1}, column {mark.column + 1})" if mark else ""
        raise ScenarioError(f"{path}: not valid YAML: {context}{error.problem}{place}") from error
    except yaml.YAMLError as error:
        text = " ".join(str(error).split())
        raise ScenarioError(f"{path}: not valid YAML: {text}") from error
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ScenarioError(
            f"{path}: a scenario is a mapping of sections, not {type(data).__name__}"
        )
    return data


_WHOLE = ("vary", "values")
"""Keys whose mappings replace each other."""


def _merge(base: Mapping[str, Any], overlay: Mapping[str, Any]) -> dict[str, Any]:
    """Put what an overlay names over a mapping.

    Where it names another `model`, nothing stays; nor does what an axis of a sweep varied, or what
    a cell of the study of the task had.
    """
    if "model" in base and overlay.get("model", base["model"]) != base["model"]:
        return dict(overlay)
    merged = {**base, **overlay}
    for key, value in overlay.items():
        old = base.get(key)
        if isinstance(old, dict) and isinstance(value, dict) and key not in _WHOLE:
            merged[key] = _merge(old, value)
    return merged


def find_scenario(name_or_path: str | Path) -> Path:
    """Path of a scenario given by the name of a shipped one or by path.

    ScenarioError if there is no such file; the message lists the scenarios that exist, and asks for
    the one, or the file here or in the folder of the path, that was probably meant.
    """
    path = Path(name_or_path)
    shipped = {file.stem: file for file in sorted((CONFIG / "scenarios").glob("*.yaml"))}
    if str(name_or_path) in shipped:
        return shipped[str(name_or_path)]
    try:
        if path.is_dir():
            raise ScenarioError(f"{path}: a folder; a scenario is a YAML file")
        if path.is_file():
            return path
    except OSError as error:
        raise ScenarioError(f"{str(path)[:200]}: cannot be read: {error.strerror}") from error
    folders = [folder for folder in (path.parent, Path()) if folder.is_dir()]
    here = {file.stem: str(file) for folder in folders for file in folder.glob("*.y*ml")}
    raise ScenarioError(
        f"{path}: no such {'file' if path.suffix in ('.yaml', '.yml') else 'scenario'}; there are: "
        f"{', '.join(shipped)}{did_you_mean(path.stem, here | {stem: stem for stem in shipped})} "
        "(one of your own is a YAML file, given by its path: hiersched new DIR makes one)"
    )


def _read_overlays(path: Path) -> list[tuple[Path, dict[str, Any]]]:
    """Read a scenario and those that it extends, one after the other: itself first."""
    overlays: list[tuple[Path, dict[str, Any]]] = []
    while True:
        overlay = _with_axes(_read_yaml(path))
        base = overlay.pop("extends", None)
        overlays.append((path, overlay))
        if base is None:
            return overlays
        if not isinstance(base, str):
            raise ScenarioError(f"{path}: extends = {base!r}: must be the name or path of one")
        beside = path.parent / base
        try:
            found = find_scenario(beside if beside.is_file() else base)
        except ScenarioError as error:
            raise ScenarioError(f"{path}: extends = {base!r}: {error}") from error
        if any(found.resolve() == file.resolve() for file, _ in overlays):
            raise ScenarioError(f"{path}: extends = {base!r}: which extends this file in turn")
        path = found


def _with_points(merged: dict[str, Any], sources: _Sources) -> dict[str, Any]:
    """Put the rows of the reference file into the scenario, unless it holds them already."""
    robot, sweeps = merged.get("robot"), merged.get("sweeps")
    if not isinstance(robot, dict) or not isinstance(sweeps, dict):
        return merged  # validation says what is wrong
    name = robot.get("reference_file")
    if not isinstance(name, str) or robot.get("reference_points") is not None:
        return merged
    path = next(file for file, data in sources if "reference_file" in (data.get("robot") or {}))
    axes = sweeps.get("axes")
    swept = [
        axis["vary"].get("robot.reference")
        for axis in (axes.values() if isinstance(axes, dict) else ())
        if isinstance(axis, dict) and isinstance(axis.get("vary"), dict)
    ]
    followed = robot.get("reference")
    followed = followed if isinstance(followed, list) else [followed]
    if "file" not in followed and not any(
        isinstance(values, list) and "file" in values for values in swept
    ):
        raise ScenarioError(
            f"{path}: robot.reference_file = {name!r}: needs robot.reference: file (or file among "
            "the values of a sweep)"
        )
    try:
        points = read_reference(path.parent / name)
    except ReferenceFileError as error:
        raise ScenarioError(f"{path}: robot.reference_file: {error}") from error
    return {**merged, "robot": {**robot, "reference_points": [list(point) for point in points]}}


def _with_axes(overlay: dict[str, Any], *, whole: bool = False) -> dict[str, Any]:
    """Write axes in full: a list under a key varies that key.

    The `whole` scenario has no axes that are null, and all others say whose they are.
    """
    sweeps = overlay.get("sweeps")
    if not isinstance(sweeps, dict) or not isinstance(sweeps.get("axes"), dict):
        return overlay  # validation says what is wrong
    axes = {
        name: {"vary": {name: axis}} if isinstance(axis, list) else axis
        for name, axis in sweeps["axes"].items()
    }
    if whole:
        axes = {
            name: {"policies": None, **axis} if isinstance(axis, dict) else axis
            for name, axis in axes.items()
            if axis is not None
        }
    return {**overlay, "sweeps": {**sweeps, "axes": axes}}


def _without_none(merged: dict[str, Any]) -> dict[str, Any]:
    """Leave out the families and cells of studies, and kinds of robots, that are null."""
    for place in ("task_study", "gain_study"):
        study = merged.get(place)
        if not isinstance(study, dict):
            continue  # validation says what is wrong
        kept = {
            name: {key: value for key, value in study[name].items() if value is not None}
            for name in ("families", "cells")
            if isinstance(study.get(name), dict)
        }
        merged = {**merged, place: {**study, **kept}}
    if isinstance(kinds := merged.get("robot_kinds"), dict):
        merged["robot_kinds"] = {name: kind for name, kind in kinds.items() if kind is not None}
    return merged


def _with_learners(merged: dict[str, Any]) -> dict[str, Any]:
    """Fill in what learners leave to the section `learning`."""
    base, learners = merged.get("learning"), merged.get("learners")
    if not isinstance(base, dict) or not isinstance(learners, dict):
        return merged  # validation says what is wrong
    whole = {
        name: _merge(base, own or {}) if isinstance(own, dict | None) else own
        for name, own in learners.items()
    }
    return {**merged, "learners": whole}


def _with_hold(merged: dict[str, Any]) -> dict[str, Any]:
    """Fill in how long gains are held: a schedule's for a while, those of a predictor never."""
    control = merged.get("control")
    if not isinstance(control, dict) or control.get("hold_samples", 0) is not None:
        return merged
    samples = hold_of(str(control.get("method")))
    return {**merged, "control": {**control, "hold_samples": samples}}


def load_scenario(name_or_path: str | Path, *, defaults: Path | None = None) -> Scenario:
    """Load, merge and validate a scenario.

    `name_or_path` is the name of a shipped scenario, or the path of an overlay or of a resolved
    one; `defaults` is the file with every key, that of the package unless given.

    Raises
    ------
    ScenarioError
        On an unreadable file, an unknown or missing key, a wrong type, a value out of range, or
        values that do not fit each other; every fault is listed with file, key, value and what is
        allowed.
    """
    path = find_scenario(name_or_path)
    defaults = DEFAULTS if defaults is None else defaults
    overlays = _read_overlays(path)
    merged = _read_yaml(defaults)
    for _, overlay in reversed(overlays):  # one that is resolved stands on its own
        merged = _merge(merged, overlay) if _missing_keys(overlay) else overlay
    sources = [*overlays, (defaults, {})]
    merged = _without_none(_with_points(_with_axes(merged, whole=True), sources))
    merged = _with_learners(merged)
    try:
        merged = with_policy_files(merged, sources)
    except PolicyFileError as error:
        raise ScenarioError(str(error)) from error
    if "name" not in overlays[0][1]:  # that of a scenario which it extends is not its own
        merged["name"] = path.stem
    _load_plugins(merged, sources)
    return _validate(_with_hold(merged), sources)


def with_values(scenario: Scenario, values: Mapping[str, Any], where: str) -> Scenario:
    """Return a scenario with other values at dotted keys: a point of a sweep.

    Values are as they would stand in YAML. ScenarioError if there is no such key, or the values do
    not fit it or the rest of the scenario; `where`, such as the axis that varies them, stands
    before every fault. A key in which robots differ (`robot_kinds`) cannot be varied for all.
    """
    data = scenario_to_dict(scenario)
    for key, value in values.items():
        for name, kind in scenario.robot_kinds.items():
            if key in kind.values and "robot_kinds" not in values:
                raise ScenarioError(
                    f"{where}.{key}: robots of the kind {name} have their own "
                    f"(robot_kinds.{name}.values): must be another key"
                )
        holder: Any = {}
        inner: Any = data
        passed: list[str] = []
        for part in key.split("."):
            known = list(inner) if isinstance(inner, dict) else []
            if part not in known:
                raise ScenarioError(
                    f"{where}.{key}: unknown key; allowed in "
                    f"{'.'.join(passed) or 'a scenario'}: {', '.join(known) or 'none'}"
                    f"{meant(part, known)}"
                )
            holder, inner = inner, inner[part]
            passed.append(part)
        holder[passed[-1]] = value
    given = ", ".join(f"{key} = {value!r}" for key, value in values.items())
    return _validate(data, [(Path(f"{where}: with {given}"), data)], swept=True)


@lru_cache(maxsize=64)
def kinds_of_robots(scenario: Scenario) -> tuple[Scenario, ...]:
    """Return a scenario for each kind of robot, in which all robots are of that kind.

    The first is for robots of which `robot_kinds` says nothing, the others are in the order of
    `Scenario.kind_of_robot`. ScenarioError as of `with_values`.
    """
    if not scenario.robot_kinds:
        return (scenario,)
    alike = replace(scenario, robot_kinds={})
    kinds = [
        with_values(alike, kind.values, f"robot_kinds.{name}.values")
        for name, kind in sorted(scenario.robot_kinds.items())
    ]
    return alike, *kinds


_Sources = Sequence[tuple[Path, Mapping[str, Any]]]
"""Files of a scenario, the one that stands over the others first, and what each holds."""


@cache
def _adapter() -> TypeAdapter[Scenario]:
    """Return what reads a scenario; making it takes longer than reading."""
    return TypeAdapter(Scenario)


def _validate(merged: Mapping[str, Any], sources: _Sources, *, swept: bool = False) -> Scenario:
    """Return the scenario; its plug-ins are there already. A swept one runs in sweeps alone."""
    path = sources[0][0]
    try:
        text = json.dumps(merged)
    except (TypeError, ValueError) as error:
        raise ScenarioError(
            f"{path}: a value is neither number, text, list nor mapping: {error}"
        ) from error
    try:
        scenario = _adapter().validate_json(text, strict=True)
    except ValidationError as error:
        raise ScenarioError(describe(error, merged, sources)) from error
    if faults := scenario_faults(scenario, swept=swept):
        raise ScenarioError("\n".join(f"{path}: {fault}" for fault in faults))
    return scenario


def scenario_faults(scenario: Scenario, *, swept: bool = False) -> list[str]:
    """List what does not fit each other in a scenario whose values are each allowed.

    A `swept` one is a point of a sweep: nothing else of the study runs in it.
    """
    return inconsistencies(scenario, swept=swept) or _kind_faults(scenario)


def _kind_faults(scenario: Scenario) -> list[str]:
    """Say which kinds of robots cannot be, alone or beside the others."""
    try:
        own, *kinds = kinds_of_robots(scenario)
    except ScenarioError as error:
        return str(error).split("\n")
    return [
        f"robot_kinds.{name}.values: a plant of {kind.robot_sizes[:2]} states and inputs with "
        f"{kind.loop_kind!r} feedback: must be {own.robot_sizes[:2]} and {own.loop_kind!r}, as for "
        "the other robots"
        for name, kind in zip(sorted(scenario.robot_kinds), kinds, strict=True)
        if (kind.robot_sizes, kind.loop_kind) != (own.robot_sizes, own.loop_kind)
    ]


def _load_plugins(merged: Mapping[str, Any], sources: _Sources) -> None:
    """Import plug-ins, before validation asks what there is."""
    names = merged.get("plugins")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        names = []  # validation says what is wrong
    faults = load_plugins(names, [file for file, _ in sources])
    if faults:
        path = next((file for file, data in sources if "plugins" in data), sources[0][0])
        raise ScenarioError("\n".join(f"{path}: {fault}" for fault in faults))


def load_resolved(text: str, origin: Path) -> tuple[Scenario, tuple[str, ...], str]:
    """Load a scenario that was written complete, perhaps by a version with fewer keys.

    `text` is YAML from `scenario_to_yaml`; `origin` is where it comes from, for errors.

    Returns
    -------
    scenario, added, sha256
        The scenario, its old keys in their new places; the keys that it lacks, whose values are
        today's defaults; and the hash of what is written, as `scenario_sha256` had it then.
    """
    written = _parse_yaml(text, origin)
    sha256 = _sha256(written)
    data = converted(written)
    _load_plugins(data, [(origin, data)])
    missing = _missing_keys(data)
    if not missing:
        return _validate(data, [(origin, data)]), (), sha256
    defaults = _read_yaml(DEFAULTS)
    if isinstance(data.get("sweeps"), Mapping) and "axes" in data["sweeps"]:
        defaults["sweeps"]["axes"] = {}  # axes that it lacks are not wanted
    whole = _with_axes(_merge(defaults, data), whole=True)
    merged = _with_hold(_with_learners(whole))
    return _validate(merged, [(origin, data), (DEFAULTS, {})]), tuple(missing), sha256


def resolved_values(path: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Read the values of a resolved scenario without its plug-ins, which may be gone.

    Returns
    -------
    values, added
        Dotted key -> value, lists whole, old keys in their new places; and the keys that the
        scenario lacks, whose values are today's defaults: an earlier version wrote it.

    Raises
    ------
    ScenarioError
        If it is no YAML, or has no name.
    """
    data = converted(_read_yaml(path))
    if not isinstance(data.get("name"), str):
        raise ScenarioError(f"{path}: no scenario: it has no name")
    missing = _missing_keys(data)
    if missing:
        data = _merge(_read_yaml(DEFAULTS), data)
    return dict(_dotted(data, "")), tuple(missing)


def _dotted(data: Mapping[str, Any], before: str) -> Iterator[tuple[str, Any]]:
    """Go through the values of nested mappings with their dotted keys."""
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", value


def _missing_keys(data: Mapping[str, Any]) -> list[str]:
    """Dotted keys that a scenario lacks; of a model, those that it has no default for as well."""
    missing = []
    known = section_keys()
    for section in (field.name for field in fields(Scenario)):
        present = data.get(section)
        if section in known:
            holder = present if isinstance(present, Mapping) else {}
            missing += [f"{section}.{key}" for key in known[section] if key not in holder]
        elif section not in data:
            missing.append(section)
    for place in SECTIONS:
        values: Any = data
        for part in place.split("."):
            values = values.get(part) if isinstance(values, Mapping) else None
        if isinstance(values, Mapping):
            keys = tuple(allowed_keys(tuple(place.split(".")), data))
            missing += [f"{place}.{key}" for key in keys if key not in values]
    return missing


def scenario_to_dict(scenario: Scenario) -> dict[str, Any]:
    """Plain mapping of a scenario: numbers, text, lists and mappings only."""
    result: dict[str, Any] = json.loads(json.dumps(asdict(scenario)))
    for entry in result["policies"].values():
        if "source" in entry:
            entry["import"] = entry.pop("source")
    return result


def scenario_to_yaml(scenario: Scenario) -> str:
    """Write the resolved scenario as YAML that `load_scenario` reads back to the same scenario."""
    return yaml.safe_dump(scenario_to_dict(scenario), sort_keys=False, width=100)


def scenario_sha256(scenario: Scenario) -> str:
    """Hash of the canonical JSON of a scenario."""
    return _sha256(scenario_to_dict(scenario))


def _sha256(data: Mapping[str, Any]) -> str:
    text = json.dumps(data, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
