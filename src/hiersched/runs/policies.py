"""How a stage runs a policy in the worlds of its seeds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hiersched.core.randomness import world_key
from hiersched.scenario import Scenario
from hiersched.scenario.schema import Worlds
from hiersched.simulator import Gains, Simulator


@dataclass(frozen=True, kw_only=True)
class WorldRun:
    """What a policy did in one world: fields of `SlotRecord` (T, ...), and more for the log."""

    seed: int
    fields: Mapping[str, NDArray[Any]]
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


class PolicyRunner(Protocol):
    """Runs a policy in one world a seed; worlds of different purposes are independent."""

    def __call__(
        self,
        scenario: Scenario,
        gains: Gains,
        policy: str,
        purpose: str,
        seeds: Sequence[int],
        num_slots: int,
    ) -> Iterator[WorldRun]:
        """Yield the runs in the order of the seeds."""
        ...


def seed_worlds(purpose: str, seeds: Sequence[int]) -> NDArray[np.uint64]:
    """One world a seed, shape (E,): the same for every policy."""
    return np.array([world_key(purpose, seed) for seed in seeds], dtype=np.uint64)


def run_classical(
    scenario: Scenario,
    gains: Gains,
    policy: str,
    purpose: str,
    seeds: Sequence[int],
    num_slots: int,
) -> Iterator[WorldRun]:
    """Run a classical scheduler in all worlds as one batch (a `PolicyRunner`); or the optimum."""
    if policy == "exact":
        from hiersched.runs.exact import run_exact

        yield from run_exact(scenario, gains, purpose, seeds, num_slots)
        return
    record = Simulator(scenario, gains, seed_worlds(purpose, seeds), num_slots).run(policy)
    for index, seed in enumerate(seeds):
        yield WorldRun(seed=seed, fields=record.environment(index))
