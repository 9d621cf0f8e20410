"""What another policy would have done in the very world of a log."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

from hiersched.core.faults import did_you_mean
from hiersched.experiments.learned import runnable
from hiersched.experiments.logged import BATCH_SLOTS, LoggedRun
from hiersched.experiments.logging import RunLabel, log_block, open_log
from hiersched.experiments.worlds import RunnablePolicy, untrained_policies
from hiersched.log import LogError
from hiersched.policies.find import untrained_names
from hiersched.policies.trained import TrainedPolicy
from hiersched.simulator import Simulator
from hiersched.simulator.simulator import AnyPolicy


class NamedPolicy(NamedTuple):
    """A policy that is ready to run, and its name for the metadata."""

    name: str
    runnable: RunnablePolicy


def policy_of(run: LoggedRun, policy: str) -> NamedPolicy:
    """Find a policy for the world of a log.

    `policy` is the name of one that needs no training, that of the log's own learned policy, whose
    weights are attached to it, or a file of weights.

    Raises
    ------
    LogError
        If the log has no decisions, or not the weights of its policy.
    ValueError
        If there is no such policy, or the file is none that can be used.
    """
    if run.stage == "gain_study":
        raise LogError(run.path, 0, "no policy decided in this log: its delays are forced")
    names = untrained_names(run.scenario)
    if policy in names:
        return NamedPolicy(policy, *untrained_policies(run.scenario, policy))
    if Path(policy).is_file():
        return _trained(run, Path(policy).read_bytes(), policy)
    if policy == run.policy:
        return _own_policy(run)
    known = [*names, *([] if run.policy in names else [run.policy])]
    raise ValueError(
        f"policy = {policy!r}: must be one of {', '.join(known)}, or a file of weights"
        f"{did_you_mean(policy, known)}"
    )


def _own_policy(run: LoggedRun) -> NamedPolicy:
    """Take the learned policy from the log."""
    wanted = f"policy_seed{run.metadata.get('policy_seed')}.json"
    what = f"it does not have the weights of {run.policy} (attachment {wanted})"
    if run.stage == "train":
        what = (
            f"{run.policy} was learning in this log, with noise on its actions, and is not to be "
            "had any more; give a file of weights"
        )
    if run.stage == "train" or wanted not in run.attachments:
        raise LogError(run.path, 0, what)
    return _trained(run, run.attachments[wanted], f"{run.path}: attachment {wanted}")


def _trained(run: LoggedRun, weights: bytes, origin: str) -> NamedPolicy:
    """Make a policy of its weights, taken to the scenario's numbers of users."""
    policy = TrainedPolicy.from_bytes(weights, origin)
    is_learned = run.policy not in untrained_names(run.scenario)
    name = run.policy if is_learned else run.scenario.learning.algorithm
    return NamedPolicy(name, runnable(policy, weights, run.scenario))


def rerun(run: LoggedRun, policy: NamedPolicy, out: str | os.PathLike[str]) -> None:
    """Run a policy in the world of a log, and log it to `out` as the stage would have.

    With the log's own policy the new log has the digest of the old one.
    """
    label = RunLabel(
        stage=run.stage,
        policy=policy.name,
        seed=run.seed,
        axis=run.metadata.get("axis", ""),
        value=run.metadata.get("value", ""),
    )
    kept = ("slots_per_episode", "episodes", "episodes_per_round", "warmup_slots")
    metadata = {key: run.metadata[key] for key in kept if key in run.metadata}
    with open_log(
        Path(out),
        run.scenario,
        run.schedule,
        label,
        profile=run.profile,
        metadata={**metadata, **policy.runnable.metadata},
        attachments=policy.runnable.attachments,
    ) as writer:
        for first, fields in _episodes(run, policy.runnable.policy):
            log_block(writer, run.scenario, run.schedule, fields, first)


def _episodes(run: LoggedRun, policy: AnyPolicy) -> Iterator[tuple[int, dict[str, NDArray[Any]]]]:
    """Run the episodes; yield the first slot of each and its fields (T, ...)."""
    at_once = max(1, BATCH_SLOTS // run.episode_slots)
    for start in range(0, len(run.keys), at_once):
        keys = run.keys[start : start + at_once]
        record = Simulator(run.scenario, run.gains, keys, run.episode_slots).run(policy)
        for env in range(len(keys)):
            first = (start + env) * run.episode_slots
            count = min(run.episode_slots, run.num_slots - first)
            fields = record.environment(env)
            yield first, {name: values[:count] for name, values in fields.items()}
