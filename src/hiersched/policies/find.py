"""From a name in a scenario to a policy: the one place that knows what names mean."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError

from hiersched.allocation.exact import exact_allocation
from hiersched.allocation.objective import slot_terms
from hiersched.core.faults import did_you_mean
from hiersched.core.parameters import STRICT, OwnKeys
from hiersched.core.registry import UnknownNameError
from hiersched.policies.files import FilePolicy, OnnxPolicy, PolicyFileError, Sb3Policy, Spaces
from hiersched.policies.index_rules import CLASSICAL
from hiersched.policies.policy import Agent, FunctionPolicy, Owners, Policy, View
from hiersched.policies.registry import RULES, Rule
from hiersched.policies.task_rules import TASK_RULES as TASK_RULES  # registers them

if TYPE_CHECKING:
    from hiersched.scenario.schema import Scenario

EXACT = "exact"
UNTRAINED = (*CLASSICAL, EXACT)
"""Policies of every scenario that need no training."""


class ExactPolicy:
    """The optimum of every slot; a slot of 20 users takes about a tenth of a second a world."""

    def decide(self, view: View) -> Owners:
        """As in `Policy`."""
        num_envs, num_users, num_prb = view.rate_mbps.shape
        owners = np.empty((num_envs, num_prb), np.uint32)
        for env, rate in enumerate(view.rate_mbps):
            state = (view.backlog_packets[env], view.dexterity_index[env], view.multiplier[env])
            terms = slot_terms(view.constants, *state, np.ones(num_users), np.zeros((2, num_users)))
            owners[env] = exact_allocation(rate, terms).prb_owner
        return Owners(owners)


def _compiled_rule(name: str) -> str:
    if name not in CLASSICAL:
        raise PydanticCustomError(
            "unknown_rule",
            "must be one of {known}{meant}",
            {"known": ", ".join(CLASSICAL), "meant": did_you_mean(name, CLASSICAL)},
        )
    return name


@dataclass(frozen=True, kw_only=True)
class ImportedPolicy:
    """A policy from a function: ``import: "module:function"``, and what it is given.

    `source`, the key `import`, is where the function is, `rule` the scheduler whose utility its
    weights multiply; `parameters` are keyword arguments.
    """

    __pydantic_config__ = STRICT
    source: Annotated[
        str,
        Field(
            alias="import",
            pattern=r"^[A-Za-z_][A-Za-z0-9_]*(\.[A-Za-z_][A-Za-z0-9_]*)*:[A-Za-z_][A-Za-z0-9_]*$",
        ),
    ]
    rule: Annotated[str, AfterValidator(_compiled_rule)] = "pf"
    parameters: OwnKeys = field(default_factory=dict, hash=False)


def untrained_names(scenario: Scenario) -> tuple[str, ...]:
    """Names of all policies of a scenario that need no training: its own are the last."""
    return (*UNTRAINED, *scenario.policies)


def is_rule(scenario: Scenario, name: str) -> bool:
    """Whether a name is that of a rule; no policy is imported or loaded to say so."""
    return name in CLASSICAL or isinstance(scenario.policies.get(name), Rule)


def file_spaces(entry: FilePolicy) -> Spaces:
    """Read the spaces of a policy in a file; no code in the file runs.

    PolicyFileError if it is no such file.
    """
    if isinstance(entry, Sb3Policy):
        from hiersched.policies.sb3 import read_spaces

        return read_spaces(entry)
    from hiersched.policies.onnx import open_graph

    assert isinstance(entry, OnnxPolicy)  # there are no others
    return open_graph(entry).spaces


def _agent(entry: FilePolicy, scenario: Scenario) -> Agent:
    """Load a policy in a file for a scenario; code in the file runs."""
    if isinstance(entry, Sb3Policy):
        from hiersched.policies.sb3 import Sb3Agent

        return Sb3Agent(entry, scenario)
    from hiersched.policies.onnx import OnnxAgent

    assert isinstance(entry, OnnxPolicy)
    return OnnxAgent(entry, scenario)


def find_policy(scenario: Scenario, name: str) -> Rule | Policy | Agent:
    """Return the policy of a name that needs no training; UnknownNameError if there is none.

    One in a file is loaded, which runs code that is in the file: PolicyFileError if it cannot be,
    or does not fit the scenario.
    """
    if name in scenario.policies:
        entry = scenario.policies[name]
        if isinstance(entry, Rule):
            return entry
        if isinstance(entry, FilePolicy):
            try:
                return _agent(entry, scenario)
            except PolicyFileError as error:
                raise PolicyFileError(f"policies.{name}.{error}") from error
        module, _, function = entry.source.partition(":")
        return FunctionPolicy(
            getattr(import_module(module), function), entry.rule, entry.parameters
        )
    if name == EXACT:
        return ExactPolicy()
    if name not in CLASSICAL:
        known = untrained_names(scenario)
        text = f"must be one of {', '.join(known)}{did_you_mean(name, known)}"
        raise UnknownNameError(f"policy = {name!r}: {text}")
    rule: Rule = RULES[name].standard(scenario)  # type: ignore[attr-defined]
    return rule
