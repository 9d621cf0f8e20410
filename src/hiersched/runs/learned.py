"""How a stage runs the learned policies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from hiersched.learning.policy import Policy, rollout
from hiersched.runs.policies import WorldRun, seed_worlds
from hiersched.scenario import Scenario
from hiersched.simulator import Gains, Simulator


class LearnedRunner:
    """A `PolicyRunner`: world i runs the policy of training seed i, modulo their number.

    Parameters
    ----------
    files
        Weights of the policies, in the order of the training seeds.
    """

    def __init__(self, files: Sequence[Path]) -> None:
        self._policies = [Policy.load(path) for path in files]
        self._weights = [path.read_bytes() for path in files]

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
        runs: dict[int, WorldRun] = {}
        for index, learned in enumerate(self._policies):
            worlds = seeds[index :: len(self._policies)]
            if not worlds:
                continue
            simulator = Simulator(scenario, gains, seed_worlds(purpose, worlds), num_slots)
            if len(learned.multipliers) != scenario.users.num_urllc:
                learned = learned.for_users(scenario.users.num_urllc)
            record = rollout(simulator, learned)
            for place, seed in enumerate(worlds):
                runs[seed] = WorldRun(
                    seed=seed,
                    fields=record.environment(place),
                    metadata={
                        "policy_seed": str(learned.seed),
                        "start": learned.start,
                        # The bits of a matrix product depend on the number of worlds in it.
                        "batch_seeds": ",".join(map(str, worlds)),
                    },
                    attachments={f"policy_seed{learned.seed}.pt": self._weights[index]},
                )
        for seed in seeds:
            yield runs[seed]
