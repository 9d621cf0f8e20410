"""Policies by name, and how a stage runs them in the worlds of its seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.core.randomness import world_key
from hiersched.policies.find import find_policy
from hiersched.scenario import Scenario
from hiersched.scenario.schema import Worlds
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
    """What a policy did in one world: fields of `SlotRecord` (T, ...), and more for the log.

    Attributes
    ----------
    seed
        Of the world.
    fields
        Name -> values, leading axis (T,).
    logged
        Whether the run is to have a log; else its measures are all that stays of it.
    metadata, attachments
        Of that log.
    """

    seed: int
    fields: Mapping[str, NDArray[Any]]
    logged: bool = True
    metadata: Mapping[str, str] = field(default_factory=dict)
    attachments: Mapping[str, bytes] = field(default_factory=dict)

    def after(self, warmup_slots: int) -> WorldRun:
        """Return the run with its warm-up noted, which measures leave out."""
        return replace(self, metadata={**self.metadata, "warmup_slots": str(warmup_slots)})

    def beginning(self, num_slots: int) -> WorldRun:
        """Return the first slots of the run."""
        fields = {name: values[:num_slots] for name, values in self.fields.items()}
        return replace(self, fields=fields)


def world_slots(worlds: Worlds, slot_s: float) -> tuple[int, int]:
    """Slots of a world and those of its warm-up, which are the first of them."""
    return round((worlds.warmup_s + worlds.duration_s) / slot_s), round(worlds.warmup_s / slot_s)


def seed_worlds(purpose: str, seeds: Sequence[int]) -> NDArray[np.uint64]:
    """One world a seed, shape (E,): the same for every policy."""
    return np.array([world_key(purpose, seed) for seed in seeds], dtype=np.uint64)


def untrained_policies(scenario: Scenario, name: str) -> tuple[RunnablePolicy]:
    """Return the policy of a name that needs no training (a `PolicySource`)."""
    return (RunnablePolicy(policy=find_policy(scenario, name)),)


def run_worlds(
    scenario: Scenario,
    gains: Gains,
    policies: Sequence[RunnablePolicy],
    purpose: str,
    seeds: Sequence[int],
    num_slots: int,
    *,
    crossed: bool = False,
) -> Iterator[WorldRun]:
    """Run policies in one world a seed; worlds of different purposes are independent.

    Parameters
    ----------
    scenario, gains
        What is run.
    policies
        One, or one a training seed.
    purpose, seeds
        Of the worlds.
    num_slots
        Of every world.
    crossed
        Whether every policy runs in every world, as one batch. Else world i runs policy i, modulo
        their number. These runs are logged in either case, the others are not.

    Yields
    ------
    WorldRun
        Policy by policy, the worlds of each in the order of their seeds.
    """
    for index, runnable in enumerate(policies):
        own = seeds[index :: len(policies)]
        worlds = seeds if crossed else own
        if not worlds:
            continue
        simulator = Simulator(scenario, gains, seed_worlds(purpose, worlds), num_slots)
        record = simulator.run(runnable.policy)
        for place, seed in enumerate(worlds):
            yield WorldRun(
                seed=seed,
                fields=record.environment(place),
                logged=seed in own,
                metadata=runnable.metadata,
                attachments=runnable.attachments,
            )
