"""What a log says about the run that it is of: enough to run it again."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hiersched.control import GainSchedule
from hiersched.log import LogError, LogReader
from hiersched.randomness import world_key, world_keys
from hiersched.scenario import Scenario, ScenarioError, load_resolved
from hiersched.simulator import Gains
from hiersched.simulator.gains import loop_gains

STAGES = ("train", "evaluate", "sweep", "generalise", "gain_study")
_BATCH_SLOTS = 8192  # what is computed at once: memory for a few dozen megabytes of records


@dataclass(frozen=True)
class Batch:
    """Slots that are computed at once: `num_envs` episodes, `num_slots` of each.

    Parameters
    ----------
    first_slot
        Number of the first slot in the log.
    first_env, num_envs
        Which episodes.
    num_slots
        Slots of each episode.
    begins
        Whether these are the first slots of their episodes.
    """

    first_slot: int
    first_env: int
    num_envs: int
    num_slots: int
    begins: bool

    @property
    def stop_slot(self) -> int:
        """Number of the slot behind the last in the log."""
        return self.first_slot + self.num_envs * self.num_slots


@dataclass(frozen=True, kw_only=True)
class LoggedRun:
    """A run, as its log describes it.

    Attributes
    ----------
    path
        The log.
    metadata, attachments
        Those of the log.
    profile
        That of the log.
    scenario, schedule, gains
        What the run was of: from the attachments.
    added_keys
        Keys that the attached scenario lacks, since an older version wrote it: they have today's
        defaults.
    keys
        World of each episode, shape (N,); but for training N is 1.
    episode_slots
        Slots of an episode; the last one can be shorter.
    num_slots
        Slots in the log.
    """

    path: Path
    metadata: dict[str, str]
    attachments: dict[str, bytes]
    profile: str
    scenario: Scenario
    schedule: GainSchedule
    gains: Gains
    added_keys: tuple[str, ...]
    keys: NDArray[np.uint64]
    episode_slots: int
    num_slots: int

    @property
    def stage(self) -> str:
        """One of `STAGES`."""
        return self.metadata["stage"]

    @property
    def policy(self) -> str:
        """Name of the policy that decided."""
        return self.metadata["policy"]

    @property
    def seed(self) -> int:
        """Seed of the run."""
        return int(self.metadata["seed"])

    def batches(self) -> Iterator[Batch]:
        """Cut the run into batches, in the order of the log."""
        if len(self.keys) == 1:
            for first in range(0, self.num_slots, _BATCH_SLOTS):
                count = min(_BATCH_SLOTS, self.num_slots - first)
                yield Batch(first, 0, 1, count, first == 0)
            return
        at_once = max(1, _BATCH_SLOTS // self.episode_slots)
        whole, rest = divmod(self.num_slots, self.episode_slots)
        for env in range(0, whole, at_once):
            count = min(at_once, whole - env)
            yield Batch(env * self.episode_slots, env, count, self.episode_slots, True)
        if rest:
            yield Batch(whole * self.episode_slots, whole, 1, rest, True)


def load_run(path: str | os.PathLike[str]) -> LoggedRun:
    """Read what a log says about its run.

    Parameters
    ----------
    path
        A log of one of the stages; it is checked whole.

    Raises
    ------
    LogError
        If the log is damaged, or does not say all that it takes to run it again.
    """
    with LogReader(path) as log:
        metadata, attachments = log.metadata, log.attachments
        num_slots, profile = log.num_slots, log.profile
        slots = log.read(log.topics[0], [])["slot"]

    def fail(what: str) -> LogError:
        return LogError(path, 0, f"cannot be run again: {what}")

    if not num_slots or not np.array_equal(slots, np.arange(num_slots, dtype=np.uint64)):
        raise fail("it does not have all slots from 0 on (a part of a log, or with a gap)")
    missing = {"stage", "policy", "seed", "scenario_sha256"} - set(metadata)
    missing |= {"scenario.yaml", "schedule.json"} - set(attachments)
    if missing:
        raise fail(f"it has no {', '.join(sorted(missing))}")
    if metadata["stage"] not in STAGES:
        raise fail(f"its stage is {metadata['stage']!r}; allowed: {', '.join(STAGES)}")
    try:
        scenario, added_keys, sha256 = load_resolved(
            attachments["scenario.yaml"].decode(), Path(f"{path}: scenario.yaml")
        )
        schedule = GainSchedule.from_json(attachments["schedule.json"].decode())
        keys, episode_slots = _worlds(metadata, num_slots)
    except (ScenarioError, ValueError, KeyError) as error:
        raise fail(str(error)) from error
    if sha256 != metadata["scenario_sha256"]:
        raise fail("the attached scenario is not the one that its metadata name")
    return LoggedRun(
        path=Path(path),
        metadata=metadata,
        attachments=attachments,
        profile=profile,
        scenario=scenario,
        schedule=schedule,
        gains=loop_gains(schedule, scenario.control.gain),
        added_keys=added_keys,
        keys=keys,
        episode_slots=episode_slots,
        num_slots=num_slots,
    )


def _worlds(metadata: dict[str, str], num_slots: int) -> tuple[NDArray[np.uint64], int]:
    """World of each episode, and the slots of one."""
    stage, seed = metadata["stage"], int(metadata["seed"])
    if stage != "train":
        return np.array([world_key(stage, seed)], np.uint64), num_slots
    episode_slots = int(metadata["slots_per_episode"])
    return world_keys(stage, seed, -(-num_slots // episode_slots)), episode_slots
