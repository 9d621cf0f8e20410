"""Policies by name, and how an experiment runs them in the worlds of its seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.core.randomness import world_key
from hiersched.policies.files import FilePolicy
from hiersched.policies.find import find_policy
from hiersched.scenario import Scenario
from hiersched.simulator import Gains, Simulator
from hiersched.simulator.simulator import AnyPolicy


@dataclass(frozen=True, kw_only=True)
class RunnablePolicy:
    """A policy, and what its logs carry so that it can be run again."""

    policy: AnyPolicy
    metadata: Mapping[str, str] = field(default_factory=dict)
    attachments: Mapping[str, bytes] = field(default_factory=dict)


PolicySource = Callable[[Scenario, str], Sequence[RunnablePolicy]]
"""(scenario, name) -> the policies of that name: one, or one a training seed."""


@dataclass(frozen=True, kw_only=True)
class WorldRun:
    """What a policy did in one world, and more for the log."""

    seed: int  # of the world
    fields: Mapping[str, NDArray[Any]]  # of `SlotRecord`, leading axis (T,)
    logged: bool = True  # else measures are all that stays of the run
    metadata: Mapping[str, str] = field(default_factory=dict)
    attachments: Mapping[str, bytes] = field(default_factory=dict)

    def beginning(self, num_slots: int) -> WorldRun:
        """Return the first slots of the run."""
        fields = {name: values[:num_slots] for name, values in self.fields.items()}
        return replace(self, fields=fields)


def seed_worlds(purpose: str, seeds: Sequence[int]) -> NDArray[np.uint64]:
    """One world a seed, shape (E,): the same for every policy."""
    return np.array([world_key(purpose, seed) for seed in seeds], dtype=np.uint64)


def untrained_policies(scenario: Scenario, name: str) -> tuple[RunnablePolicy]:
    """Return the policy of a name that needs no training (a `PolicySource`)."""
    entry = scenario.policies.get(name)
    metadata = entry.metadata if isinstance(entry, FilePolicy) else {}
    return (RunnablePolicy(policy=find_policy(scenario, name), metadata=metadata),)


def run_worlds(
    scenario: Scenario,
    gains: Gains,
    policies: Sequence[RunnablePolicy],
    purpose: str,
    seeds: Sequence[int],
    num_slots: int,
) -> Iterator[WorldRun]:
    """Run policies in one world a seed; worlds of different purposes are independent.

    Of `policies`, one or one a training seed, each runs `num_slots` in every world, and world i
    under policy i, modulo their number, is logged. Logs of all pairs would be ten times as large; a
    log of any of them comes from that of a rule in its world, with ``hiersched replay LOG --policy
    FILE``. Yields policy by policy, the worlds of each in the order of their seeds.
    """
    for index, runnable in enumerate(policies):
        own = seeds[index :: len(policies)]
        simulator = Simulator(scenario, gains, seed_worlds(purpose, seeds), num_slots)
        record = simulator.run(runnable.policy)
        for place, seed in enumerate(seeds):
            yield WorldRun(
                seed=seed,
                fields=record.environment(place),
                logged=seed in own,
                metadata=runnable.metadata,
                attachments=runnable.attachments,
            )
