"""How a stage runs a policy in the worlds of its seeds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hiersched.randomness import world_key
from hiersched.scenario import Scenario
from hiersched.simulator import Gains, Simulator


@dataclass(frozen=True, kw_only=True)
class WorldRun:
    """What a policy did in one world: fields of `SlotRecord` (T, ...), and more for the log."""

    seed: int
    fields: Mapping[str, NDArray[Any]]
    metadata: Mapping[str, str] = field(default_factory=dict)
    attachments: Mapping[str, bytes] = field(default_factory=dict)


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
