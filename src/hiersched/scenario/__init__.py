"""Scenarios: YAML in, frozen dataclasses out."""

from hiersched.scenario.load import (
    ParameterNote,
    ScenarioError,
    find_scenario,
    load_resolved,
    load_scenario,
    parameter_notes,
    scenario_sha256,
    scenario_to_dict,
    scenario_to_yaml,
)
from hiersched.scenario.schema import Scenario, delay_steps

__all__ = [
    "ParameterNote",
    "Scenario",
    "ScenarioError",
    "delay_steps",
    "find_scenario",
    "load_resolved",
    "load_scenario",
    "parameter_notes",
    "scenario_sha256",
    "scenario_to_dict",
    "scenario_to_yaml",
]
