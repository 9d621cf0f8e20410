"""What another policy would have done in the very world of a log."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hiersched.log import LogError
from hiersched.policies.rules import CLASSICAL
from hiersched.runs.logged import LoggedRun
from hiersched.runs.logging import RunLabel, log_block, open_log
from hiersched.runs.policies import seed_worlds
from hiersched.simulator import Simulator, SlotRecord

if TYPE_CHECKING:
    from hiersched.learning.policy import Policy

_BATCH_SLOTS = 8192
Run = Callable[[Simulator], SlotRecord]


@dataclass(frozen=True, kw_only=True)
class Decider:
    """A policy that is ready to run.

    Attributes
    ----------
    name
        For the metadata.
    run
        Runs all worlds of a simulator to the horizon.
    metadata, attachments
        What the log has to carry so that it can be run again.
    batch_seeds
        Seeds of the worlds that have to run side by side, ours among them: the bits of a matrix
        product depend on the number of its rows. Empty: ours alone.
    """

    name: str
    run: Run
    metadata: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    batch_seeds: tuple[int, ...] = ()


def find_policy(run: LoggedRun, policy: str) -> Decider:
    """Find a policy for the world of a log.

    Parameters
    ----------
    run
        The log's run.
    policy
        Name of a classical scheduler, the name of the log's own learned policy, whose weights are
        attached to it, or a file of weights.

    Raises
    ------
    LogError
        If the log has no decisions, or not the weights of its policy.
    ValueError
        If there is no such policy, or the file is none that can be used.
    """
    if run.stage == "gain_study":
        raise LogError(run.path, 0, "no policy decided in this log: its delays are forced")
    if policy in CLASSICAL:
        return Decider(name=policy, run=lambda simulator: simulator.run(policy))
    if Path(policy).is_file():
        return _weights(run, Path(policy).read_bytes(), (run.seed,))
    if policy == run.policy:
        return _own_policy(run)
    known = [*CLASSICAL, *([] if run.policy in CLASSICAL else [run.policy])]
    raise ValueError(
        f"policy = {policy!r}: must be one of {', '.join(known)}, or a file of weights"
    )


def _own_policy(run: LoggedRun) -> Decider:
    """Take the learned policy from the log."""
    if run.stage == "train":
        raise LogError(
            run.path,
            0,
            f"{run.policy} was learning in this log, with noise on its actions, and is not to be "
            "had any more; give a file of weights",
        )
    wanted = f"policy_seed{run.metadata.get('policy_seed')}.pt"
    if wanted not in run.attachments or "batch_seeds" not in run.metadata:
        raise LogError(
            run.path, 0, f"it does not have the weights of {run.policy} (attachment {wanted}, "
            "metadata batch_seeds)",
        )  # fmt: skip
    seeds = tuple(int(seed) for seed in run.metadata["batch_seeds"].split(","))
    return _weights(run, run.attachments[wanted], seeds)


def _weights(run: LoggedRun, weights: bytes, batch_seeds: tuple[int, ...]) -> Decider:
    """Make a policy of its weights, taken to the scenario's number of URLLC users."""
    from hiersched.learning.policy import Policy, rollout

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "policy.pt")
        file.write_bytes(weights)
        policy: Policy = Policy.load(file)
    users = run.scenario.users
    if len(policy.multipliers) != users.num_urllc:
        policy = policy.for_users(users.num_urllc)
    name = run.scenario.learning.algorithm if run.policy in CLASSICAL else run.policy
    return Decider(
        name=name,
        run=lambda simulator: rollout(simulator, policy),
        metadata={
            "policy_seed": str(policy.seed),
            "start": policy.start,
            "batch_seeds": ",".join(map(str, batch_seeds)),
        },
        attachments={f"policy_seed{policy.seed}.pt": weights},
        batch_seeds=batch_seeds,
    )


def rerun(run: LoggedRun, decider: Decider, out: str | os.PathLike[str]) -> None:
    """Run another policy in the world of a log, and log it as the stage would have.

    With the log's own policy the new log has the digest of the old one.

    Parameters
    ----------
    run
        The log's run.
    decider
        From `find_policy`.
    out
        The log to be.
    """
    label = RunLabel(
        stage=run.stage,
        policy=decider.name,
        seed=run.seed,
        axis=run.metadata.get("axis", ""),
        value=run.metadata.get("value", ""),
    )
    kept = ("slots_per_episode", "episodes", "episodes_per_round", "warmup_slots")
    with open_log(
        Path(out),
        run.scenario,
        run.schedule,
        label,
        profile=run.profile,
        metadata={
            **{key: run.metadata[key] for key in kept if key in run.metadata},
            **decider.metadata,
        },
        attachments=decider.attachments,
    ) as writer:
        for first, fields in _episodes(run, decider):
            log_block(writer, run.scenario, run.schedule, fields, first)


def _episodes(run: LoggedRun, decider: Decider) -> Iterator[tuple[int, dict[str, NDArray[Any]]]]:
    """Run the episodes; yield the first slot of each and its fields (T, ...)."""
    if len(run.keys) == 1:
        seeds = decider.batch_seeds or (run.seed,)
        record = decider.run(_simulator(run, seed_worlds(run.stage, seeds), run.num_slots))
        yield 0, record.environment(seeds.index(run.seed))
        return
    at_once = max(1, _BATCH_SLOTS // run.episode_slots)
    for start in range(0, len(run.keys), at_once):
        keys = run.keys[start : start + at_once]
        record = decider.run(_simulator(run, keys, run.episode_slots))
        for env in range(len(keys)):
            first = (start + env) * run.episode_slots
            count = min(run.episode_slots, run.num_slots - first)
            fields = record.environment(env)
            yield first, {name: values[:count] for name, values in fields.items()}


def _simulator(run: LoggedRun, keys: NDArray[np.uint64], num_slots: int) -> Simulator:
    return Simulator(run.scenario, run.gains, keys, num_slots)
