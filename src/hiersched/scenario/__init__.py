"""Scenarios: YAML in, frozen dataclasses out."""

import hiersched.models.built_in  # noqa: F401  # registers the models that scenarios name
from hiersched.scenario.fault_text import ScenarioError
from hiersched.scenario.load import (
    find_scenario,
    kinds_of_robots,
    load_resolved,
    load_scenario,
    scenario_faults,
    scenario_sha256,
    scenario_to_dict,
    scenario_to_yaml,
    with_values,
)
from hiersched.scenario.notes import ParameterNote, parameter_notes, scenario_notes
from hiersched.scenario.schema import Scenario, delay_steps

__all__ = [
    "ParameterNote",
    "Scenario",
    "ScenarioError",
    "delay_steps",
    "find_scenario",
    "kinds_of_robots",
    "load_resolved",
    "load_scenario",
    "parameter_notes",
    "scenario_faults",
    "scenario_notes",
    "scenario_sha256",
    "scenario_to_dict",
    "scenario_to_yaml",
    "with_values",
]
