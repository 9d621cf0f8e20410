"""Training: both agents of all seeds, every slot logged; a killed run goes on where it was."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.control import GainSchedule
from hiersched.experiments import files
from hiersched.experiments.gains import load_gains
from hiersched.experiments.logging import RunLabel, log_block, open_log
from hiersched.experiments.points import learner_scenario
from hiersched.learning.checkpoint import load_checkpoint
from hiersched.learning.trainer import train
from hiersched.log import LogReader, LogWriter
from hiersched.scenario import Scenario, scenario_sha256
from hiersched.scenario.schema import checkpoint_rounds, worlds_per_round


@dataclass
class RoundLogs:
    """Logs of the rounds that are complete, one file a seed and round, beside the checkpoint.

    A round is so many episodes side by side, of the training or, without noise, in the fixed
    worlds. A log cannot be continued, so those of the seeds are put together from these at the end.
    """

    scenario: Scenario
    schedule: GainSchedule
    learner: str
    folder: Path
    stage: str  # train or checkpoint
    profile: str
    num_envs: int  # episodes of a round
    num_rounds: int  # rounds in all
    first_round: int  # rounds that were complete before

    def __post_init__(self) -> None:
        self._episodes = [self.first_round * self.num_envs] * len(self.scenario.learning.seeds)
        self._writers: dict[int, LogWriter] = {}

    def add(self, seed_index: int, fields: Mapping[str, NDArray[Any]]) -> None:
        """Log the next episode of a seed."""
        episode = self._episodes[seed_index]
        round_index, env = divmod(episode, self.num_envs)
        if env == 0:
            path = self.path(seed_index, round_index)
            self._writers[seed_index] = self._open(path, seed_index, {"round": str(round_index)})
        writer = self._writers[seed_index]
        first_slot = episode * self.scenario.learning.slots_per_episode
        log_block(writer, self.scenario, self.schedule, fields, first_slot)
        self._episodes[seed_index] += 1
        if env == self.num_envs - 1:
            writer.close()

    def join(self, seed_index: int, path: Path, attachments: Mapping[str, bytes]) -> None:
        """Put the rounds of a seed together into one log."""
        with self._open(path, seed_index, {}, attachments) as writer:
            for round_index in range(self.num_rounds):
                with LogReader(self.path(seed_index, round_index)) as part:
                    fields: dict[str, NDArray[Any]] = {}
                    slots = np.empty(0, np.uint64)
                    for topic in part.topics:
                        fields |= part.read(topic)
                        slots = fields.pop("slot")
                    writer.write_block(int(slots[0]), fields)
                    for event in part.events():
                        writer.event(*event)

    def path(self, seed_index: int, round_index: int) -> Path:
        """File of one seed and round."""
        seed = self.scenario.learning.seeds[seed_index]
        return self.folder / f"{self.stage}_seed{seed}_round{round_index}.mcap"

    def _open(
        self,
        path: Path,
        seed_index: int,
        metadata: Mapping[str, str],
        attachments: Mapping[str, bytes] | None = None,
    ) -> LogWriter:
        learning = self.scenario.learning
        if self.stage == "train":
            metadata = {"worlds_per_round": str(worlds_per_round(learning)), **metadata}
        return open_log(
            path,
            self.scenario,
            self.schedule,
            RunLabel(stage=self.stage, policy=self.learner, seed=learning.seeds[seed_index]),
            profile=self.profile,
            metadata={
                "slots_per_episode": str(learning.slots_per_episode),
                "episodes": str(self.num_envs * self.num_rounds),
                "episodes_per_round": str(self.num_envs),
                "start": learning.start,
                "weighs": learning.weighs,
                **metadata,
            },
            attachments=attachments,
        )


def train_and_log(
    study: Scenario, learner: str, results: Path, code: str, *, show: bool = True
) -> None:
    """Train all seeds of one of `study.learned`; write policies, progress and logs.

    The scenario's gain schedule lies in `results`, the folder of the study. `code` names the code:
    a checkpoint of the same code and scenario is where training goes on, to the same bits; any
    other is removed. With `show` the terminal shows progress.
    """
    scenario = learner_scenario(study, learner)
    schedule, gains = load_gains(results / files.gain_file("schedule"), scenario)
    checkpoint = _checkpoint_folder(results, scenario, learner, code) / "training.pt"
    done = 0
    if checkpoint.exists():
        done = int(load_checkpoint(checkpoint, scenario_sha256(scenario))["trainer"]["round"])
        print(f"going on after round {done} of {checkpoint}", flush=True)
    learning = scenario.learning
    rounds = checkpoint_rounds(learning)
    make_logs = partial(RoundLogs, scenario, schedule, learner, checkpoint.parent)
    is_logged, profile = files.logs_training(study), scenario.log.train_profile
    logs = make_logs(
        stage="train",
        profile=profile,
        num_envs=learning.num_envs,
        num_rounds=learning.episodes // learning.num_envs,
        first_round=done,
    )
    fixed = make_logs(
        stage="checkpoint",
        profile=profile if is_logged else "decisions",
        num_envs=learning.checkpoint_worlds,
        num_rounds=len(rounds),
        first_round=sum(r <= done for r in rounds) if done else 0,
    )
    progress = results / files.progress_file(learner)
    progress.parent.mkdir(parents=True, exist_ok=True)
    policies = train(
        scenario,
        gains,
        on_slots=logs.add if is_logged else None,
        on_checkpoint=fixed.add,
        progress=progress,
        checkpoint=checkpoint,
        show=show,
    )
    weight_files = files.policy_files(study, learner)
    wanted = {results / name for name in (*files.learner_logs(study, learner), *weight_files)}
    for old in progress.parent.glob("*seed*"):
        if old not in wanted:
            old.unlink()
    for index, policy in enumerate(policies):
        weights = results / weight_files[index]
        policy.save(weights)
        if is_logged:
            attachments = {weights.name: weights.read_bytes()}
            logs.join(index, results / files.training_log(learner, policy.seed), attachments)
        fixed.join(index, results / files.checkpoint_log(learner, policy.seed), {})
    shutil.rmtree(checkpoint.parents[1])


def _checkpoint_folder(results: Path, scenario: Scenario, learner: str, code: str) -> Path:
    """Make the folder of this very training, and remove those of the learner's others."""
    folder = results / files.CHECKPOINTS / learner / f"{scenario_sha256(scenario)[:16]}_{code[:16]}"
    if folder.parent.exists():
        for other in folder.parent.iterdir():
            if other != folder:
                shutil.rmtree(other)
    folder.mkdir(parents=True, exist_ok=True)
    return folder
