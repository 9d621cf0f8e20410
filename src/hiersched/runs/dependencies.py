"""What a job depends on, as one line: the values of the keys that it reads and its code's hash.

Snakemake compares the parameters of a rule as a set of values without names, so all of them are in
this one. A value that the job does not read leaves it as it is, and so does a comment.
"""

from __future__ import annotations

import hashlib
import json
import sys
from dataclasses import fields
from pathlib import Path
from types import ModuleType
from typing import Any

from hiersched.core.registry import ALGORITHMS
from hiersched.core.seam import outside_files
from hiersched.models.model import SECTIONS
from hiersched.policies.find import ImportedPolicy
from hiersched.runs.fingerprint import code_fingerprint
from hiersched.runs.variants import (
    SWEPT_KEYS,
    gain_designs,
    group_policies,
    learner_scenario,
    swept_policies,
    swept_values,
    value_text,
)
from hiersched.scenario import Scenario, scenario_to_dict
from hiersched.scenario.plugins import plugin_modules
from hiersched.scenario.schema import model_at

_SECTIONS = {
    *SECTIONS,
    *(field.name for field in fields(Scenario)),
} - {"name", "plugins", "policies", "learners"}
"""Keys that hold other keys."""

_LOG_FORM = ("log.compression", "log.chunk_bytes")
_CONSTRAINT = (
    "objective.penalty_weight",
    "objective.epsilon",
    "objective.delay_exponent",
    "objective.constraint",
)
_ROBOTS = ("robot", "control", "plant")
_SLOT_LOOP = ("name", "plugins", "users", "radio", "traffic", *_CONSTRAINT, "schedulers", *_ROBOTS)
"""Pick what the slot loop reads, whoever decides; `learning.reward_scale` is in its rewards."""

_DESIGN = (
    "control.sampling_s",
    "control.weight",
    "control.max_delay_s",
    "control.loop",
    "control.operator_share",
    "control.method",
    "control.decay_rate",
    "robot.speed_mps",
    "robot.actuator_lag_s",
    "plant.model",
)
"""What every design reads; `gains_values` adds the keys of the plant."""

_FORCED_DELAYS = (
    "name",
    "plugins",
    *_ROBOTS,
    "radio.slot_s",
    "gain_study.seeds",
    "gain_study.violation_delay_s",
    "gain_study.calm_delay_s",
)

_SWEPT_GAINS = {
    "grid": ("gain_study.weight", "gain_study.fixed_delay_s"),
    "sampling_s": ("sweeps.sampling_s",),
    "noise": ("gain_study.noise_position_m", "gain_study.noise_heading_rad"),
}
"""Axis of a sweep of the gain study -> the keys with its points."""

KEYS: dict[str, tuple[str, ...]] = {
    "gains": _DESIGN,
    "train": (*_SLOT_LOOP, "objective", "learning", *_LOG_FORM, "log.train_profile"),
    "evaluate": (
        *_SLOT_LOOP,
        "learning.reward_scale",
        "evaluate.seeds",
        "evaluate.warmup_s",
        "evaluate.duration_s",
        "evaluate.full_logs",
        "evaluate.full_log_s",
        *_LOG_FORM,
        "log.evaluate_profile",
    ),
    "sweep": (
        *_SLOT_LOOP,
        "learning.reward_scale",
        "sweeps.seeds",
        "sweeps.warmup_s",
        "sweeps.duration_s",
        *_LOG_FORM,
        "log.sweep_profile",
    ),
    "generalise": (
        *_SLOT_LOOP,
        "learning.reward_scale",
        "generalise.seeds",
        "generalise.warmup_s",
        "generalise.duration_s",
        "generalise.cells",
        *_LOG_FORM,
        "log.sweep_profile",
    ),
    "measure": (
        "name",
        "plugins",
        "users",
        "radio",
        "traffic",
        "objective.penalty_weight",
        "robot.window_s",
        "evaluate.seeds",
        "sweeps.seeds",
        "generalise.seeds",
        "generalise.cells",
    ),
    "bound": (*_SLOT_LOOP, "learning.reward_scale", "evaluate", "bound"),
    "gain_study": (
        *_FORCED_DELAYS,
        "gain_study.methods",
        "gain_study.num_robots",
        "gain_study.num_windows",
        "gain_study.violation_windows",
        *_LOG_FORM,
        "log.gain_study_profile",
    ),
    "gain_sweep": (
        *_FORCED_DELAYS,
        "gain_study.sweep_robots",
        "gain_study.sweep_windows",
        *_LOG_FORM,
        "log.gain_study_profile",
    ),
    "stability": (
        *_DESIGN,
        "sweeps.sampling_s",
        "gain_study.weight",
        "gain_study.fixed_delay_s",
    ),
}
"""Stage -> the keys that it reads; a section stands for all its keys."""


def picked(scenario: Scenario, keys: tuple[str, ...]) -> dict[str, Any]:
    """Values of dotted keys and sections, flat: ``radio.fading.scale`` -> 1.0.

    `plugins` are the hashes of their sources: an edited plug-in is another value.
    """
    sections = scenario_to_dict(scenario)
    flat: dict[str, Any] = {}
    for key in keys:
        value: Any = sections
        for part in key.split("."):
            value = value[part]
        flat |= {"plugins": plugin_hashes(scenario)} if key == "plugins" else _flat(key, value)
    return flat


def _flat(key: str, value: Any) -> dict[str, Any]:
    """Values below a key, those of models in it key by key."""
    if key not in _SECTIONS:
        return {key: value}
    return {
        dotted: inner
        for name, part in value.items()
        for dotted, inner in _flat(f"{key}.{name}", part).items()
    }


def plugin_hashes(scenario: Scenario) -> dict[str, str]:
    """Return a hash of the sources of every plug-in that a scenario names or takes a model from."""
    modules = plugin_modules(scenario)
    found = {name: _sources_sha256(module) for name, module in modules.items()}
    models = [model_at(scenario, key) for key in SECTIONS]
    rules = [
        policy for policy in scenario.policies.values() if not isinstance(policy, ImportedPolicy)
    ]
    learners = [ALGORITHMS.loaded(learning.algorithm) for learning in scenario.learned.values()]
    kinds = (*map(type, models), *map(type, rules), *learners)
    names = [getattr(kind, "__module__", "") for kind in kinds]
    names += [
        policy.source.partition(":")[0]
        for policy in scenario.policies.values()
        if isinstance(policy, ImportedPolicy)
    ]
    for module in map(sys.modules.get, names):
        if module is not None and module not in modules.values():
            found |= _outside_hash(module)
    return found


def _outside_hash(module: ModuleType) -> dict[str, str]:
    """Return the hash of a module that is not ours, by its name: one of an installed package."""
    if module.__name__.partition(".")[0] == __name__.partition(".")[0]:
        return {}
    return {module.__name__: _sources_sha256(module)}


def _sources_sha256(module: ModuleType) -> str:
    """Hash the files of a module and of what it imports, but for installed packages."""
    digest = hashlib.sha256()
    for file in sorted({*outside_files(module), str(module.__file__)}):
        digest.update(hashlib.sha256(Path(file).read_bytes()).digest())
    return digest.hexdigest()


def _design_values(scenario: Scenario, keys: tuple[str, ...]) -> dict[str, Any]:
    """Pick keys, and what the design of a plant's gains reads of the plant."""
    own = scenario.plant.design_keys
    plant = ("plant",) if own is None else tuple(f"plant.{name}" for name in own)
    values = picked(scenario, (*keys, *plant))
    return {**values, "plugins": _outside_hash(sys.modules[type(scenario.plant).__module__])}


def stage_spec(stage: str, values: dict[str, Any], script: Path) -> str:
    """Return the parameter of a rule: canonical JSON of the values and of the hash of its code."""
    document = {"stage": stage, "code": code_fingerprint(script), "values": values}
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)


def gains_values(scenario: Scenario, design: str) -> dict[str, Any]:
    """Pick what one gain schedule depends on."""
    return _design_values(gain_designs(scenario)[design], KEYS["gains"])


def train_values(scenario: Scenario, learner: str) -> dict[str, Any]:
    """Pick what the training of a learner depends on: not the other learners."""
    return picked(learner_scenario(scenario, learner), KEYS["train"])


def evaluate_values(scenario: Scenario, group: str) -> dict[str, Any]:
    """Pick what the evaluation of a group of policies depends on, besides its gains and weights."""
    policies = group_policies(scenario, scenario.evaluate.policies, group)
    return {**picked(scenario, KEYS["evaluate"]), **_policy_values(scenario, policies)}


def sweep_values(scenario: Scenario, axis: str, group: str) -> dict[str, Any]:
    """Pick what a group along a sweep depends on: not the value that the sweep replaces."""
    values = picked(scenario, (*KEYS["sweep"], f"sweeps.{axis}"))
    if axis in ("rayleigh_scale", "reference", "load"):
        del values[SWEPT_KEYS[axis]]
    elif axis == "service_coefficient_mbps":
        del values["traffic.service_coefficient_mbps"]
        values |= picked(scenario, ("sweeps.sampling_s",))
    policies = group_policies(scenario, swept_policies(scenario, axis), group)
    return {**values, **_policy_values(scenario, policies)}


def cell_values(scenario: Scenario, group: str) -> dict[str, Any]:
    """Pick what a group of policies in cells of other sizes depends on."""
    policies = group_policies(scenario, scenario.generalise.policies, group)
    return {**picked(scenario, KEYS["generalise"]), **_policy_values(scenario, policies)}


def _policy_values(scenario: Scenario, policies: tuple[str, ...]) -> dict[str, Any]:
    """Pick the names of policies, and the keys of those among them that the scenario adds."""
    added = picked(
        scenario, tuple(f"policies.{name}" for name in policies if name in scenario.policies)
    )
    return {**added, "policies": sorted(policies)}


def measure_values(scenario: Scenario, group: str) -> dict[str, Any]:
    """Pick what the measures of a group depend on, besides the logs: what is in which of them."""
    values = picked(scenario, KEYS["measure"])
    for axis in SWEPT_KEYS:
        policies = group_policies(scenario, swept_policies(scenario, axis), group)
        if policies:
            points = [value_text(value) for value in swept_values(scenario, axis)]
            values[f"sweep of {axis}"] = [*policies, *points]
    for section in ("evaluate", "generalise"):
        policies = group_policies(scenario, getattr(scenario, section).policies, group)
        values[f"policies of {section}"] = list(policies)
    if group in scenario.learned:
        values["training seeds"] = list(scenario.learned[group].seeds)
    return values


def bound_values(scenario: Scenario) -> dict[str, Any]:
    """Pick what the exact optima depend on, besides the logs."""
    return picked(scenario, KEYS["bound"])


def gain_study_values(scenario: Scenario) -> dict[str, Any]:
    """Pick what the gain study depends on."""
    return picked(scenario, KEYS["gain_study"])


def gain_sweep_values(scenario: Scenario, axis: str) -> dict[str, Any]:
    """Pick what a sweep of the gain study depends on."""
    return picked(scenario, (*KEYS["gain_sweep"], *_SWEPT_GAINS[axis]))


def stability_values(scenario: Scenario) -> dict[str, Any]:
    """Pick what the stability regions depend on, besides the gains."""
    return _design_values(scenario, KEYS["stability"])


def scenario_values(scenario: Scenario, notes: str = "") -> dict[str, Any]:
    """Pick every value; `notes` is more text that the result shows, such as units."""
    return {
        "scenario": scenario_to_dict(scenario),
        "notes": hashlib.sha256(notes.encode()).hexdigest(),
    }
