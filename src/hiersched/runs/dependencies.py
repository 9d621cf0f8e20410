"""What a job depends on, as one line: the values of the keys that it reads and its code's hash.

Snakemake compares the parameters of a rule as a set of values without names, so all of them are in
this one. A value that the job does not read leaves it as it is, and so does a comment.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

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

_LOG_FORM = ("log.compression", "log.chunk_bytes")
_CONSTRAINT = (
    "objective.penalty_weight",
    "objective.epsilon",
    "objective.delay_exponent",
    "objective.constraint",
)
_ROBOTS = ("robot", "control", "linear_plant")
_SLOT_LOOP = ("name", "users", "radio", "traffic", *_CONSTRAINT, "schedulers", *_ROBOTS)
"""Pick what the slot loop reads, whoever decides; `learning.reward_scale` is in its rewards."""

_DESIGN = (
    "control.sampling_s",
    "control.weight",
    "control.max_delay_s",
    "control.plant",
    "control.operator_share",
    "control.method",
    "control.decay_rate",
    "robot.speed_mps",
    "robot.actuator_lag_s",
    *(f"linear_plant.{name}" for name in ("A", "A_d", "B", "Q", "R")),
)
_FORCED_DELAYS = (
    "name",
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
    """Values of dotted keys and sections, flat: ``radio.slot_s`` -> 0.01."""
    sections = scenario_to_dict(scenario)
    flat: dict[str, Any] = {}
    for key in keys:
        section, _, name = key.partition(".")
        values = sections[section]
        if name:
            flat[key] = values[name]
        elif isinstance(values, dict):
            flat |= {f"{section}.{inner}": value for inner, value in values.items()}
        else:
            flat[key] = values
    return flat


def stage_spec(stage: str, values: dict[str, Any], script: Path) -> str:
    """Return the parameter of a rule: canonical JSON of the values and of the hash of its code."""
    document = {"stage": stage, "code": code_fingerprint(script), "values": values}
    return json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)


def gains_values(scenario: Scenario, design: str) -> dict[str, Any]:
    """Pick what one gain schedule depends on."""
    return picked(gain_designs(scenario)[design], KEYS["gains"])


def train_values(scenario: Scenario, learner: str) -> dict[str, Any]:
    """Pick what the training of a learner depends on: not the other learners."""
    return picked(learner_scenario(scenario, learner), KEYS["train"])


def evaluate_values(scenario: Scenario, group: str) -> dict[str, Any]:
    """Pick what the evaluation of a group of policies depends on, besides its gains and weights."""
    policies = group_policies(scenario, scenario.evaluate.policies, group)
    return {**picked(scenario, KEYS["evaluate"]), "policies": sorted(policies)}


def sweep_values(scenario: Scenario, axis: str, group: str) -> dict[str, Any]:
    """Pick what a group along a sweep depends on: not the value that the sweep replaces."""
    values = picked(scenario, (*KEYS["sweep"], f"sweeps.{axis}"))
    if axis in ("rayleigh_scale", "reference", "load"):
        del values[SWEPT_KEYS[axis]]
    elif axis == "service_coefficient_mbps":
        del values["traffic.service_coefficient_mbps"]
        values |= picked(scenario, ("sweeps.sampling_s",))
    policies = group_policies(scenario, swept_policies(scenario, axis), group)
    return {**values, "policies": sorted(policies)}


def cell_values(scenario: Scenario, group: str) -> dict[str, Any]:
    """Pick what a group of policies in cells of other sizes depends on."""
    policies = group_policies(scenario, scenario.generalise.policies, group)
    return {**picked(scenario, KEYS["generalise"]), "policies": sorted(policies)}


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
    return picked(scenario, KEYS["stability"])


def scenario_values(scenario: Scenario, notes: str = "") -> dict[str, Any]:
    """Pick every value; `notes` is more text that the result shows, such as units."""
    return {
        "scenario": scenario_to_dict(scenario),
        "notes": hashlib.sha256(notes.encode()).hexdigest(),
    }
