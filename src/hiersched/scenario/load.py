"""Read a scenario: defaults, overlay, validation; the only place that reads YAML."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter, ValidationError

from hiersched.scenario.consistency import inconsistencies
from hiersched.scenario.reference_file import ReferenceFileError, read_reference
from hiersched.scenario.schema import Scenario, hold_of

CONFIG = Path("config")
_KEY_LINE = re.compile(
    r"^(\s*)([A-Za-z_0-9]+):\s*([^#]*?)\s*"
    r"(?:#\s*\[([^\]]+)\]\s*(paper|assumed)(?::\s*(.*))?|#.*)?$"
)


class ScenarioError(ValueError):
    """A scenario that cannot be run: the message names file, key, value and what is allowed."""


class _UniqueKeyLoader(yaml.SafeLoader):
    """PyYAML keeps the last of two equal keys in silence; this loader refuses them."""


def _unique_mapping(loader: _UniqueKeyLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    seen = set()
    for key_node, _ in node.value:
        key = loader.construct_object(key_node)
        if key in seen:
            raise yaml.constructor.ConstructorError(
                None, None, f"the key {key!r} stands twice", key_node.start_mark
            )
        seen.add(key)
    return loader.construct_mapping(node, deep=True)


_UniqueKeyLoader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _unique_mapping)


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: cannot be read: {error}") from error
    return _parse_yaml(text, path)


def _parse_yaml(text: str, path: Path) -> dict[str, Any]:
    try:
        data = yaml.load(text, Loader=_UniqueKeyLoader)
    except yaml.YAMLError as error:
        raise ScenarioError(f"{path}: not valid YAML: {error}") from error
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ScenarioError(
            f"{path}: a scenario is a mapping of sections, not {type(data).__name__}"
        )
    return data


def _merge(base: Mapping[str, Any], overlay: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in overlay.items():
        old = merged.get(key)
        merged[key] = (
            _merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
        )
    return merged


def _holds(data: Any, location: tuple[str | int, ...]) -> bool:
    for part in location:
        if isinstance(data, Mapping) and part in data:
            data = data[part]
        elif isinstance(data, list) and isinstance(part, int) and part < len(data):
            data = data[part]
        else:
            return False
    return True


def _value_at(data: Any, location: tuple[str | int, ...]) -> Any:
    for part in location:
        data = data[part]
    return data


def _describe(
    error: ValidationError,
    merged: Mapping[str, Any],
    overlay: Mapping[str, Any],
    names: tuple[Path, Path],
) -> str:
    lines = []
    for item in error.errors():
        # Branches of a union append their own name to the location: cut back to what stands in the
        # file.
        location = item["loc"]
        while location and not _holds(merged, location) and item["type"] != "missing":
            location = location[:-1]
        path, defaults = names
        source = path if _holds(overlay, location) or item["type"] == "missing" else defaults
        key = ".".join(str(part) for part in location)
        if item["type"] == "missing":
            lines.append(f"{source}: {key}: missing")
            continue
        value = _value_at(merged, location)
        message = item["msg"].replace("Input should be", "must be")
        if item["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
            section = location[0] if len(location) > 1 else None
            message = f"unknown key; allowed: {', '.join(_allowed_keys(section))}"
        elif isinstance(value, str) and re.fullmatch(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+", value):
            message += " (YAML takes 1e-3 and 1.0e6 for text: write 1.0e-3, 1.0e+6)"
        lines.append(f"{source}: {key} = {value!r}: {message}")
    return "\n".join(dict.fromkeys(lines))


def _allowed_keys(section: str | int | None) -> list[str]:
    if section is None:
        return [field.name for field in fields(Scenario)]
    return list(_KEYS_OF_SECTION.get("learning" if section == "learners" else str(section), ()))


def _keys_of_sections() -> dict[str, tuple[str, ...]]:
    from typing import get_type_hints

    hints = get_type_hints(Scenario)
    return {
        name: tuple(field.name for field in fields(hint))
        for name, hint in hints.items()
        if hasattr(hint, "__dataclass_fields__")
    }


_KEYS_OF_SECTION = _keys_of_sections()


def find_scenario(name_or_path: str | Path) -> Path:
    """Path of a scenario given by name (in config/scenarios) or by path.

    Raises
    ------
    ScenarioError
        If there is no such file; the message lists the scenarios that exist.
    """
    path = Path(name_or_path)
    if path.suffix in (".yaml", ".yml") or path.exists():
        if path.is_dir():
            raise ScenarioError(f"{path}: a folder; a scenario is a YAML file")
        if not path.is_file():
            raise ScenarioError(f"{path}: no such file")
        return path
    candidate = CONFIG / "scenarios" / f"{name_or_path}.yaml"
    if not candidate.is_file():
        known = sorted(p.stem for p in (CONFIG / "scenarios").glob("*.yaml"))
        raise ScenarioError(
            f"{candidate}: no such scenario; there are: {', '.join(known) or 'none'}"
        )
    return candidate


def _find_defaults(scenario: Path) -> Path:
    folders = [Path(), *scenario.resolve().parents]
    candidates = [folder / CONFIG / "defaults.yaml" for folder in folders]
    found = next((path for path in candidates if path.is_file()), None)
    if found is None:
        raise ScenarioError(
            f"{scenario}: no {CONFIG / 'defaults.yaml'} in the working directory or above the "
            "file; it holds every key, a scenario only what differs"
        )
    return found


def _with_points(merged: dict[str, Any], path: Path) -> dict[str, Any]:
    """Put the rows of the reference file into the scenario, unless it holds them already."""
    robot, sweeps = merged.get("robot"), merged.get("sweeps")
    if not isinstance(robot, dict) or not isinstance(sweeps, dict):
        return merged  # validation says what is wrong
    name = robot.get("reference_file")
    if not isinstance(name, str) or robot.get("reference_points") is not None:
        return merged
    swept = sweeps.get("reference")
    if robot.get("reference") != "file" and not (isinstance(swept, list) and "file" in swept):
        raise ScenarioError(
            f"{path}: robot.reference_file = {name!r}: needs robot.reference: file (or file among "
            "sweeps.reference)"
        )
    try:
        points = read_reference(path.parent / name)
    except ReferenceFileError as error:
        raise ScenarioError(f"{path}: robot.reference_file: {error}") from error
    return {**merged, "robot": {**robot, "reference_points": [list(point) for point in points]}}


def _with_learners(merged: dict[str, Any]) -> dict[str, Any]:
    """Fill in what learners leave to the section `learning`."""
    base, learners = merged.get("learning"), merged.get("learners")
    if not isinstance(base, dict) or not isinstance(learners, dict):
        return merged  # validation says what is wrong
    whole = {
        name: _merge(base, {} if own is None else own)
        if own is None or isinstance(own, dict)
        else own
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

    Parameters
    ----------
    name_or_path
        Name of a file in ``config/scenarios`` or path of an overlay (or of a resolved scenario).
    defaults
        The file with every key. Unless given: ``config/defaults.yaml`` here or, failing that, in
        the nearest folder above the scenario that has one.

    Raises
    ------
    ScenarioError
        On an unreadable file, an unknown or missing key, a wrong type, a value out of range, or
        values that do not fit each other; every fault is listed with file, key, value and what is
        allowed.
    """
    path = find_scenario(name_or_path)
    defaults = defaults if defaults is not None else _find_defaults(path)
    overlay = _read_yaml(path)
    merged = _with_learners(_with_points(_merge(_read_yaml(defaults), overlay), path))
    merged.setdefault("name", path.stem)
    return _validate(_with_hold(merged), overlay, path, defaults)


def _validate(
    merged: Mapping[str, Any], overlay: Mapping[str, Any], path: Path, defaults: Path
) -> Scenario:
    try:
        text = json.dumps(merged)
    except (TypeError, ValueError) as error:
        raise ScenarioError(
            f"{path}: a value is neither number, text, list nor mapping: {error}"
        ) from error
    try:
        scenario = TypeAdapter(Scenario).validate_json(text, strict=True)
    except ValidationError as error:
        raise ScenarioError(_describe(error, merged, overlay, (path, defaults))) from error
    faults = inconsistencies(scenario)
    if faults:
        raise ScenarioError("\n".join(f"{path}: {fault}" for fault in faults))
    return scenario


def load_resolved(text: str, origin: Path) -> tuple[Scenario, tuple[str, ...], str]:
    """Load a scenario that was written complete, perhaps by a version with fewer keys.

    Parameters
    ----------
    text
        Resolved YAML, from `scenario_to_yaml`.
    origin
        Where it comes from, for errors.

    Returns
    -------
    scenario, added, sha256
        The scenario; the keys that it lacks, whose values are today's defaults; and the hash of
        what is written, as `scenario_sha256` had it then.

    Raises
    ------
    ScenarioError
        As `load_scenario`; also where keys are missing and there is no file of defaults.
    """
    written = _parse_yaml(text, origin)
    sha256 = _sha256(written)
    known: dict[str, tuple[str, ...]] = {str(key): () for key in _allowed_keys(None)}
    known.update(_KEYS_OF_SECTION)
    missing = [
        f"{section}.{key}" if key else section
        for section, keys in known.items()
        for key in (keys or ("",))
        if (key not in written.get(section, {}) if key else section not in written)
    ]
    if not missing:
        return _validate(written, written, origin, origin), (), sha256
    defaults = _find_defaults(origin)
    merged = _with_hold(_with_learners(_merge(_read_yaml(defaults), written)))
    return _validate(merged, written, origin, defaults), tuple(missing), sha256


def scenario_to_dict(scenario: Scenario) -> dict[str, Any]:
    """Plain mapping of a scenario: numbers, text, lists and mappings only."""
    result: dict[str, Any] = json.loads(json.dumps(asdict(scenario)))
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


@dataclass(frozen=True, kw_only=True)
class ParameterNote:
    """What `config/defaults.yaml` says of one key: dotted key, unit, paper or assumed, meaning."""

    key: str
    unit: str
    origin: str
    meaning: str


def parameter_notes(defaults: Path | None = None) -> list[ParameterNote]:
    """Read unit, origin and meaning of every key, from the comments of the defaults file.

    Raises
    ------
    ScenarioError
        If a key has no comment of the form ``# [unit] paper|assumed: meaning``.
    """
    path = defaults if defaults is not None else CONFIG / "defaults.yaml"
    notes: list[ParameterNote] = []
    section = ""
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        match = _KEY_LINE.match(line)
        if match is None:
            continue
        indent, key, value, unit, origin, meaning = match.groups()
        if not indent and not value:
            section = key
            continue
        if unit is None:
            raise ScenarioError(
                f"{path}: line {number}: {key} lacks its comment '# [unit] paper|assumed: …'"
            )
        dotted = f"{section}.{key}" if indent else key
        notes.append(ParameterNote(key=dotted, unit=unit, origin=origin, meaning=meaning or ""))
    return notes
