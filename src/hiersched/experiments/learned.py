"""Trained policies by the files of their weights."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

from hiersched.experiments.worlds import PolicySource, RunnablePolicy
from hiersched.policies.trained import TrainedPolicy
from hiersched.scenario import Scenario


def learned_policies(files: Sequence[Path]) -> PolicySource:
    """Return a source of policies: whatever the name, those of these files of weights, in order."""

    @cache
    def load(path: Path) -> tuple[TrainedPolicy, bytes]:
        weights = path.read_bytes()
        return TrainedPolicy.from_bytes(weights, path), weights

    def source(scenario: Scenario, name: str) -> tuple[RunnablePolicy, ...]:
        return tuple(runnable(*load(path), scenario) for path in files)

    return source


def runnable(policy: TrainedPolicy, weights: bytes, scenario: Scenario) -> RunnablePolicy:
    """Take a trained policy to a scenario's users, with what its logs carry."""
    return RunnablePolicy(
        policy=policy.for_users(scenario.users.num_urllc, scenario.users.num_embb),
        metadata={
            "policy_seed": str(policy.seed),
            "start": policy.rule,
            "weighs": policy.weighs,
        },
        attachments={f"policy_seed{policy.seed}.json": weights},
    )
