"""From a name in a scenario to a policy: the one place that knows what names mean."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from hiersched.core.registry import UnknownNameError
from hiersched.policies.exact import ExactPolicy
from hiersched.policies.index_rules import CLASSICAL
from hiersched.policies.policy import FunctionPolicy, Policy
from hiersched.policies.registry import RULES, Rule

if TYPE_CHECKING:
    from hiersched.scenario.schema import Scenario

EXACT = "exact"
UNTRAINED = (*CLASSICAL, EXACT)
"""Policies of every scenario that need no training."""


def untrained_names(scenario: Scenario) -> tuple[str, ...]:
    """Names of all policies of a scenario that need no training: its own are the last."""
    return (*UNTRAINED, *scenario.policies)


def find_policy(scenario: Scenario, name: str) -> Rule | Policy:
    """Return the policy of a name that needs no training.

    Raises
    ------
    UnknownNameError
        If there is none.
    """
    if name in scenario.policies:
        entry = scenario.policies[name]
        if isinstance(entry, Rule):
            return entry
        module, _, function = entry.source.partition(":")
        return FunctionPolicy(
            getattr(import_module(module), function), entry.rule, entry.parameters
        )
    if name == EXACT:
        return ExactPolicy()
    if name not in CLASSICAL:
        known = ", ".join(untrained_names(scenario))
        raise UnknownNameError(f"policy = {name!r}: must be one of {known}")
    return standard_rule(scenario, name)


def standard_rule(scenario: Scenario, name: str) -> Rule:
    """Return a classical scheduler as it runs under its own name."""
    rule: Rule = RULES[name].standard(scenario)  # type: ignore[attr-defined]
    return rule
