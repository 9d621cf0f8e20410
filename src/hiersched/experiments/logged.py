"""What a log says about its run: enough to run it again, and every field of its slots."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.control import GainSchedule
from hiersched.core.fields import FIELDS
from hiersched.core.randomness import train_worlds, world_key, world_keys
from hiersched.experiments.logging import logged_fields
from hiersched.experiments.points import ForcedDelays
from hiersched.log import LogError, LogReader
from hiersched.policies.policy import LoggedDecisions
from hiersched.scenario import Scenario, ScenarioError, load_resolved
from hiersched.simulator import Gains, Simulator
from hiersched.simulator.gain_source import check_gains
from hiersched.simulator.loop_gains import loop_gains

STAGES = ("train", "checkpoint", "evaluate", "sweep", "generalise", "task", "gain_study")
BATCH_SLOTS = 8192  # what is computed at once: memory for a few dozen megabytes of records


@dataclass(frozen=True)
class Batch:
    """Slots that are computed at once: `num_slots` each of `num_envs` episodes."""

    first_slot: int  # in the log
    first_env: int
    num_envs: int
    num_slots: int
    begins: bool  # whether they begin their episodes

    @property
    def stop_slot(self) -> int:
        """Number of the slot behind the last in the log."""
        return self.first_slot + self.num_envs * self.num_slots


@dataclass(frozen=True, kw_only=True)
class LoggedRun:
    """A run, as its log describes it."""

    path: Path
    metadata: dict[str, str]
    attachments: dict[str, bytes]
    unknown_fields: tuple[str, ...]  # those of `LogReader`, which cannot be computed
    scenario: Scenario  # what the run was of: from the attachments
    schedule: GainSchedule
    gains: Gains
    added_keys: tuple[str, ...]  # that the scenario of an older version lacks: today's defaults
    keys: NDArray[np.uint64]  # world of each episode, (N,); but for training and checkpoints N = 1
    episode_slots: int  # of an episode; the last one can be shorter
    num_slots: int  # in the log

    @property
    def stage(self) -> str:
        """One of `STAGES`."""
        return self.metadata["stage"]

    @property
    def profile(self) -> str:
        """One of `core.fields.PROFILES`, or that of another version."""
        return self.metadata["profile"]

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
            for first in range(0, self.num_slots, BATCH_SLOTS):
                count = min(BATCH_SLOTS, self.num_slots - first)
                yield Batch(first, 0, 1, count, first == 0)
            return
        at_once = max(1, BATCH_SLOTS // self.episode_slots)
        whole, rest = divmod(self.num_slots, self.episode_slots)
        for env in range(0, whole, at_once):
            count = min(at_once, whole - env)
            yield Batch(env * self.episode_slots, env, count, self.episode_slots, True)
        if rest:
            yield Batch(whole * self.episode_slots, whole, 1, rest, True)


def load_run(path: str | os.PathLike[str]) -> LoggedRun:
    """Read what a log of one of the stages says about its run; the log is checked whole.

    LogError if the log is damaged, or does not say all that it takes to run it again.
    """
    with LogReader(path) as log:
        metadata, attachments = log.metadata, log.attachments
        num_slots, unknown_fields = log.num_slots, log.unknown_fields
        slots = log.read(log.topics[0], [])["slot"] if log.topics else np.empty(0)

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
        scenario, added_keys, sha256 = _scenario(attachments["scenario.yaml"])
        schedule = _schedule(attachments["schedule.json"], scenario)
        keys, episode_slots = _worlds(metadata, num_slots)
        if stage_delays := metadata.get("delays"):
            ForcedDelays.from_json(stage_delays)
        if int(warmup := metadata.get("warmup_slots", "0")) < 0:
            raise ValueError(f"warmup_slots = {warmup}: must be 0 or more")
    except (ScenarioError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise fail(str(error)) from error
    if sha256 != metadata["scenario_sha256"]:
        raise fail("the attached scenario is not the one that its metadata name")
    return LoggedRun(
        path=Path(path),
        metadata=metadata,
        attachments=attachments,
        unknown_fields=unknown_fields,
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
    if stage not in ("train", "checkpoint"):
        return np.array([world_key(stage, seed)], np.uint64), num_slots
    episode_slots = int(metadata["slots_per_episode"])
    if episode_slots < 1:
        raise ValueError(f"slots_per_episode = {episode_slots}: must be 1 or more")
    episodes = -(-num_slots // episode_slots)
    if stage == "train":
        per_round = metadata.get("episodes_per_round", "1")
        worlds = int(metadata.get("worlds_per_round", per_round))  # one an episode before
        return train_worlds(seed, 0, episodes, int(per_round), worlds), episode_slots
    # The fixed worlds, the same for all seeds and once more at every checkpoint.
    fixed = world_keys(stage, 0, int(metadata["episodes_per_round"]))
    return np.resize(fixed, episodes), episode_slots


@lru_cache(maxsize=8)  # logs in a row carry the same ones
def _scenario(text: bytes) -> tuple[Scenario, tuple[str, ...], str]:
    return load_resolved(text.decode(), Path("scenario.yaml"))


@lru_cache(maxsize=8)
def _schedule(text: bytes, scenario: Scenario) -> GainSchedule:
    schedule = GainSchedule.from_json(text.decode(), vouched=True)
    check_gains(schedule, scenario)
    return schedule


@dataclass(frozen=True, kw_only=True)
class RunSlots:
    """Fields of every slot of a run: name -> values, leading axis (T,)."""

    source: str | os.PathLike[str]  # the log, or the name of a run that has none
    metadata: dict[str, str]
    num_urllc: int  # the first users are URLLC users
    slot_s: float  # length of a slot [s]
    warmup_slots: int  # the first slots, which measures leave out
    fields: dict[str, NDArray[Any]]

    def measured(self, name: str) -> NDArray[Any]:
        """Return a field behind the warm-up."""
        return self.fields[name][self.warmup_slots :]


TOPIC_OF = {field.name: field.topic for field in FIELDS}
"""Topic of each field of the table."""


def read_slots(path: str | os.PathLike[str], names: Sequence[str]) -> RunSlots:
    """Read fields of every slot of a run in one world, whatever the profile of its log.

    What the log has is read. What it lacks is computed from its decisions, and whatever else the
    log has, of what this version knows, must come out of them to the last bit.

    LogError if the log is damaged, or is not what the simulator computes from its decisions.
    ValueError On a field that is not in the table.
    """
    if unknown := [name for name in names if name not in TOPIC_OF]:
        raise ValueError(f"names: {', '.join(unknown)}: no field of a log")
    with LogReader(path, verify="chunks") as log:
        wanted = {topic: [n for n in names if TOPIC_OF[n] == topic] for topic in TOPIC_OF.values()}
        complete = all(
            topic in log.topics and set(own) <= set(log.known_fields(topic))
            for topic, own in wanted.items()
            if own
        )
        fields: dict[str, NDArray[Any]] = {}
        for topic in log.topics:
            own = wanted.get(topic, []) if complete else log.known_fields(topic)
            if own:
                fields |= log.read(topic, own)
        fields.pop("slot", None)
        metadata, num_urllc, slot_s = log.metadata, log.dims.num_urllc, log.slot_ns * 1e-9
    return RunSlots(
        source=path,
        metadata=metadata,
        num_urllc=num_urllc,
        slot_s=slot_s,
        warmup_slots=int(metadata.get("warmup_slots", "0")),
        fields=fields if complete else _recompute(load_run(path), fields, names),
    )


def needed_field(run: LoggedRun, logged: dict[str, NDArray[Any]], name: str) -> NDArray[Any]:
    """Return what only the log says of a run; LogError if it does not."""
    if name not in logged:
        raise LogError(run.path, 0, f"it has no {name}, which nothing else says")
    return logged[name]


def _recompute(
    run: LoggedRun, logged: dict[str, NDArray[Any]], names: Sequence[str]
) -> dict[str, NDArray[Any]]:
    """Run a world again under its logged allocation, checked against all that is logged."""
    if len(run.keys) != 1 or run.stage == "gain_study":
        raise LogError(run.path, 0, "not of a policy in one world: its slots cannot be computed")
    owners = needed_field(run, logged, "prb_owner")
    simulator = Simulator(run.scenario, run.gains, run.keys, run.num_slots)
    multipliers = needed_field(run, logged, "multiplier")[:1].copy()
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in names}
    for batch in run.batches():
        here = slice(batch.first_slot, batch.stop_slot)
        record = simulator.run(LoggedDecisions(owners[None, here]), multipliers=multipliers)
        if "weight" in logged:  # which decided nothing here
            record.weight[0] = logged["weight"][here]
        computed = logged_fields((*logged, *names), run.scenario, record.environment(0))
        for name, values in logged.items():
            if values[here].tobytes() != computed[name].tobytes():
                raise LogError(run.path, 0, f"its {name} does not follow from its decisions")
        for name in names:
            parts[name].append(computed[name].copy())
    return {name: np.concatenate(part) for name, part in parts.items()}
