"""From a name in a scenario to a policy: the one place that knows what names mean."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hiersched.core.registry import UnknownNameError
from hiersched.policies.exact import ExactPolicy
from hiersched.policies.index_rules import CLASSICAL
from hiersched.policies.policy import Policy
from hiersched.policies.registry import RULES, Rule

if TYPE_CHECKING:
    from hiersched.scenario.schema import Scenario

EXACT = "exact"


def untrained_names(scenario: Scenario) -> tuple[str, ...]:
    """Names of all policies of a scenario that need no training."""
    return (*CLASSICAL, EXACT)


def find_policy(scenario: Scenario, name: str) -> Rule | Policy:
    """Return the policy of a name that needs no training.

    Raises
    ------
    UnknownNameError
        If there is none.
    """
    if name == EXACT:
        return ExactPolicy()
    if name not in untrained_names(scenario):
        known = ", ".join(untrained_names(scenario))
        raise UnknownNameError(f"policy = {name!r}: must be one of {known}")
    return RULES[name].standard(scenario)  # type: ignore[attr-defined,no-any-return]
