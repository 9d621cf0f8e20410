"""What a job depends on, as one line: the values of the keys that it reads and its code's hash.

Snakemake compares the parameters of a rule as a set of values without names, so all of them are in
this one. A value that the job does not read leaves it as it is, and so does a comment.
"""

from __future__ import annotations

import hashlib
import json
import sys
from dataclasses import asdict, fields
from importlib.metadata import packages_distributions, version
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from hiersched.core.registry import ALGORITHMS, BUILT_IN_ALGORITHMS, registered_files
from hiersched.core.seam import outside_files
from hiersched.experiments.fingerprint import code_fingerprint
from hiersched.experiments.gains import designs
from hiersched.experiments.points import (
    Experiment,
    cell_of,
    experiments,
    groups,
    learner_scenario,
    task_families,
)
from hiersched.models.model import SECTIONS
from hiersched.policies.find import ImportedPolicy
from hiersched.scenario import Scenario, scenario_to_dict
from hiersched.scenario.plugins import plugin_modules
from hiersched.scenario.schema import model_at
from hiersched.simulator.gain_source import design_values

if TYPE_CHECKING:
    from hiersched.study.registry import Shown

_SECTIONS = {
    *SECTIONS,
    *(field.name for field in fields(Scenario)),
} - {"name", "plugins", "policies", "learners", "robot_kinds"}
"""Keys that hold other keys."""

_SLOT_LOOP = (
    *("name", "plugins", "users", "radio", "traffic", "schedulers"),
    *("robot", "robot_kinds", "control", "plant"),
    "objective.penalty_weight",
    "objective.epsilon",
    "objective.delay_exponent",
    "objective.constraint",
    "learning.reward_scale",
)
"""What the slot loop reads, whoever decides."""

_LOG_FORM = ("log.compression", "log.chunk_bytes")


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


def training_sha256(scenario: Scenario, learner: str, code: str) -> str:
    """Hash the code of a training, that of our package and that of the plug-ins it uses."""
    parts = {"package": code, **plugin_hashes(learner_scenario(scenario, learner))}
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def plugin_hashes(scenario: Scenario) -> dict[str, str]:
    """Return a hash of the sources of every plug-in that a scenario names or takes a model from.

    Those that add figures, tables or claims alone are left out: no run depends on them.
    """
    shown = registered_files("study") - registered_files("")
    modules = {
        name: module
        for name, module in plugin_modules(scenario).items()
        if str(module.__file__) not in shown
    }
    found = {name: sources_sha256(module) for name, module in modules.items()}
    learners = [
        ALGORITHMS[learning.algorithm]
        for learning in scenario.learned.values()
        if learning.algorithm not in BUILT_IN_ALGORITHMS
    ]
    kinds = [*(type(model_at(scenario, key)) for key in SECTIONS), *learners]
    names = [getattr(kind, "__module__", "") for kind in kinds]
    names += [
        policy.source.partition(":")[0]
        if isinstance(policy, ImportedPolicy)
        else type(policy).__module__
        for policy in scenario.policies.values()
    ]
    for module in map(sys.modules.get, names):
        if module is not None and module not in modules.values():
            found |= _outside_hash(module)
    return found


def _is_ours(module: ModuleType) -> bool:
    return module.__name__.partition(".")[0] == __name__.partition(".")[0]


def _outside_hash(module: ModuleType) -> dict[str, str]:
    """Return the hash of a module that is not ours, by its name: one of an installed package.

    Its helpers are not read, so the versions of its distribution count too.
    """
    if _is_ours(module):
        return {}
    names = packages_distributions().get(module.__name__.partition(".")[0], ())
    versions = "".join(f" {name} {version(name)}" for name in sorted(set(names)))
    return {module.__name__: sources_sha256(module) + versions}


def sources_sha256(module: ModuleType) -> str:
    """Hash the files of a module and of what it imports, but for installed packages."""
    return _sha256_of({*outside_files(module), str(module.__file__)})


def _sha256_of(files: set[str]) -> str:
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(hashlib.sha256(Path(file).read_bytes()).digest())
    return digest.hexdigest()


def neighbours_sha256(thing: Shown) -> str:
    """Hash what a registered thing of a plug-in imports from beside its own file.

    What of its own file it depends on, `code_fingerprint` says.
    """
    module = sys.modules[thing.module]
    return _sha256_of(set() if _is_ours(module) else {*outside_files(module)} - {str(thing.file)})


def stage_spec(stage: str, values: Any, script: Path, *, only: str = "") -> str:
    """Return the parameter of a rule: canonical JSON of the values and of the hash of its code.

    Of a registered function `only` is its name: see `code_fingerprint`.
    """
    document = {"stage": stage, "code": code_fingerprint(script, only=only), "values": values}
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)


def gains_values(scenario: Scenario, design: str) -> dict[str, Any]:
    """Pick what one gain schedule depends on."""
    return _with_plant_code(scenario, json.loads(design_values(designs(scenario)[design])))


def _with_plant_code(scenario: Scenario, values: dict[str, Any]) -> dict[str, Any]:
    return {**values, "plugins": _outside_hash(sys.modules[type(scenario.plant).__module__])}


def train_values(scenario: Scenario, learner: str) -> dict[str, Any]:
    """Pick what the training of a learner depends on: not the other learners."""
    keys = (*_SLOT_LOOP, "objective", "learning", *_LOG_FORM, "log.train_profile")
    return picked(learner_scenario(scenario, learner), keys)


def run_values(scenario: Scenario, experiment: Experiment, group: str) -> dict[str, Any]:
    """Pick what a group of policies in an experiment depends on, besides gains and weights.

    Keys in which its points differ stand with the points, so that the scenario's own value of a
    swept key changes nothing.
    """
    policies = groups(scenario, experiment)[group]
    added = [f"policies.{name}" for name in policies if name in scenario.policies]
    keys = (*_SLOT_LOOP, *_LOG_FORM, *added)
    base = picked(scenario, keys)
    points = {p.value: picked(p.scenario, keys) for p, _ in experiment.runs(policies)}
    swept = {key for point in experiment.points for key in point.values}
    different = {
        key
        for values in (base, *points.values())
        for key in values
        if values.get(key) != base.get(key)
        or any(f"{key}.".startswith(f"{k}.") or k.startswith(f"{key}.") for k in swept)
    } | {key for values in points.values() for key in base.keys() - values.keys()}
    return {
        **{key: value for key, value in base.items() if key not in different},
        "points": {
            value: {key: v for key, v in values.items() if key in different}
            for value, values in points.items()
        },
        "delays": {p.value: p.delays.to_json() for p in experiment.points if p.delays},
        "seeds": experiment.seeds,
        "worlds": [experiment.warmup_s, experiment.duration_s],
        "logs": [experiment.profile, experiment.full_logs, experiment.full_log_s],
        "policies": sorted(policies),
    }


def tune_values(scenario: Scenario, experiment: Experiment) -> dict[str, Any]:
    """Pick what the knobs of a cell depend on: its scenario, families and design worlds."""
    cell = cell_of(experiment)
    study = scenario.task_study
    families = task_families(scenario, cell)
    return {
        **picked(experiment.points[0].scenario, _SLOT_LOOP),
        "families": {name: asdict(family) for name, family in families.items()},
        "seeds": study.design_seeds,
        "worlds": [study.warmup_s, study.duration_s],
        "limits": [study.embb_share, study.embb_late_excess, study.cells[cell].bound_late],
    }


def measure_values(scenario: Scenario, group: str) -> dict[str, Any]:
    """Pick what the measures of a group depend on, besides the logs: what is in which of them."""
    read = ("name", "plugins", "users", "radio", "traffic", "objective.penalty_weight", "robot")
    values = picked(scenario, read)
    for experiment in experiments(scenario).values():
        if group in groups(scenario, experiment):
            values[experiment.name] = run_values(scenario, experiment, group)
    if group in scenario.learned:
        values["training seeds"] = list(scenario.learned[group].seeds)
    return values


def growth_values(scenario: Scenario) -> dict[str, Any]:
    """Pick what the growth of loops depends on, besides chains and gains."""
    return {
        f"{experiment.name} {group}": run_values(scenario, experiment, group)
        for experiment in experiments(scenario).values()
        for group in groups(scenario, experiment)
    }


def bound_values(scenario: Scenario) -> dict[str, Any]:
    """Pick what the exact optima depend on, besides the logs."""
    return picked(scenario, (*_SLOT_LOOP, "evaluate", "bound"))


def stability_values(scenario: Scenario) -> dict[str, Any]:
    """Pick what the stability regions depend on, besides the gains."""
    study = picked(scenario, ("gain_study",))
    return _with_plant_code(scenario, {**json.loads(design_values(scenario)), **study})


def scenario_values(scenario: Scenario, notes: str = "") -> dict[str, Any]:
    """Pick every value; `notes` is more text that the result shows, such as units."""
    return {
        "scenario": scenario_to_dict(scenario),
        "notes": hashlib.sha256(notes.encode()).hexdigest(),
    }
