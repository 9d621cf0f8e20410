"""Training of all seeds side by side: Algorithm 1 of the paper (docs/paper_notes.md, 5)."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from hiersched.env.core import SlotLoop
from hiersched.learning.checkpoint import load_checkpoint, save_checkpoint
from hiersched.learning.ddpg import Learner
from hiersched.learning.multiplier import Multiplier, episode_constraint, step_multiplier
from hiersched.learning.policy import Policy, copy_slot, single_thread
from hiersched.learning.progress import ProgressFile, RoundSums
from hiersched.learning.replay import ReplayBuffer
from hiersched.randomness import world_key
from hiersched.scenario import Scenario, scenario_sha256
from hiersched.simulator import Gains, SlotRecord

Blocks = dict[str, NDArray[Any]]
OnSlots = Callable[[int, Blocks], None]


def user_rewards(
    one: SlotRecord, after: NDArray[np.float64], scenario: Scenario
) -> NDArray[np.float64]:
    """Share a slice's reward among its users: -(drift + V penalty) / scale, shape (E, U).

    Their mean over a slice's users is the reward in the record, up to the priced constraint.

    Parameters
    ----------
    one
        Record of one slot, leading axes (E, 1).
    after
        Backlog after the slot, shape (E, U), packets.
    scenario
        V, epsilon and the reward scale.
    """
    objective = scenario.objective
    drift = 0.5 * (after**2 - one.backlog_packets[:, 0] ** 2)
    penalty = 1.0 / (one.rate_mbps[:, 0] ** 2 + objective.epsilon)
    return -(drift + objective.penalty_weight * penalty) / scenario.learning.reward_scale


class Trainer:
    """Everything that training changes; `train` runs it.

    A round is one episode in every environment of every seed. Worlds of episode j of seed s:
    ``world_key("train", s, j)``. All random numbers of a seed come from its own generators, so a
    seed learns the same whichever others are trained beside it, up to rounding.
    """

    def __init__(self, scenario: Scenario, gains: Gains) -> None:
        learning, users = scenario.learning, scenario.users
        if learning.episodes % learning.num_envs:
            raise ValueError(
                f"learning.episodes = {learning.episodes}: must be a multiple of "
                f"learning.num_envs = {learning.num_envs}"
            )
        self.scenario = scenario
        self.num_seeds = len(learning.seeds)
        self.num_rounds = learning.episodes // learning.num_envs
        self.round = 0
        self.learner = Learner(scenario)
        self.multiplier = Multiplier.zero((self.num_seeds, users.num_urllc))
        self.generators = [
            np.random.default_rng(world_key("train/draws", seed)) for seed in learning.seeds
        ]
        round_size = learning.num_envs * learning.slots_per_episode
        self.replay = ReplayBuffer(
            self.num_seeds,
            learning.num_envs,
            learning.slots_per_episode,
            max(1, min(learning.replay_capacity // round_size, self.num_rounds)),
            scenario.num_users,
            users.num_urllc,
        )
        self.loop = SlotLoop(scenario, gains, self._worlds(), learning.slots_per_episode)

    def _worlds(self) -> NDArray[np.uint64]:
        learning = self.scenario.learning
        first = self.round * learning.num_envs
        return np.array(
            [
                world_key("train", seed, first + env)
                for seed in learning.seeds
                for env in range(learning.num_envs)
            ],
            dtype=np.uint64,
        )

    def _by_seed(self, values: NDArray[Any]) -> NDArray[Any]:
        return values.reshape(self.num_seeds, -1, *values.shape[1:])

    def _explore(self, actions: NDArray[np.float32], done: float) -> NDArray[np.float32]:
        """Add noise of each seed's own generator; its spread falls linearly with training."""
        learning = self.scenario.learning
        std = learning.exploration_std + done * (
            learning.exploration_final_std - learning.exploration_std
        )
        noise = np.stack(
            [rng.standard_normal(actions.shape[1:], np.float32) for rng in self.generators]
        )
        return np.clip(actions + np.float32(std) * noise, -1.0, 1.0)

    def run_round(self, on_slot: Callable[[SlotRecord, int], None]) -> RoundSums:
        """One episode in every environment, with one update of all agents a slot.

        Parameters
        ----------
        on_slot
            Is given every slot's record, leading axes (seeds * envs, 1), and the slot's index.
        """
        learning = self.scenario.learning
        loop, replay = self.loop, self.replay
        loop.multipliers[:] = np.repeat(self.multiplier.value, learning.num_envs, axis=0)
        features = self._by_seed(loop.reset(self._worlds()))
        replay.start_round(features)
        sums = RoundSums(self.num_seeds, self.scenario.users.num_urllc)
        fewest = max(learning.warmup_slots * learning.num_envs, learning.batch_size)
        for slot in range(learning.slots_per_episode):
            done = (self.round + slot / learning.slots_per_episode) / self.num_rounds
            actions = self._explore(self.learner.act(features), done)
            features = self._by_seed(loop.step(actions.reshape(len(loop.multipliers), -1)))
            self._store(features)
            sums.add(loop.record)
            on_slot(loop.record, slot)
            if len(replay) >= fewest:
                batch = replay.sample(learning.batch_size, self.generators)
                sums.add_losses(self.learner.update(batch, self.multiplier.value))
        self._step_multiplier(sums)
        self.round += 1
        return sums

    def _store(self, following: NDArray[np.float32]) -> None:
        """Add the last slot to the replay buffer."""
        one, after = self.loop.record, self.loop.simulator.state.backlog_packets
        self.replay.add(
            self._by_seed(one.num_prb[:, 0]),
            self._by_seed(user_rewards(one, after, self.scenario)),
            self._by_seed(one.constraint[:, 0]),
            following,
        )

    def _step_multiplier(self, sums: RoundSums) -> None:
        objective = self.scenario.objective
        constraint = episode_constraint(
            objective,
            self.scenario.traffic.reliability,
            sums.due_packets,
            sums.late_packets,
            sums.mean_constraint(),
        )
        self.multiplier = step_multiplier(self.multiplier, constraint, objective)

    def policies(self) -> tuple[Policy, ...]:
        """Return the policies as they stand, one a seed."""
        learning = self.scenario.learning
        actors = self.learner.actor.numpy().reshape(self.num_seeds, 2, -1)
        sha256 = scenario_sha256(self.scenario)
        return tuple(
            Policy(
                parameters=actors[index].copy(),
                hidden=learning.hidden,
                weight_exponent=learning.weight_exponent,
                multipliers=self.multiplier.value[index].copy(),
                seed=seed,
                scenario_sha256=sha256,
            )
            for index, seed in enumerate(learning.seeds)
        )

    def state(self) -> dict[str, Any]:
        """Everything that the next round depends on; worlds are functions of the round."""
        return {
            "round": self.round,
            "learner": self.learner.state(),
            "replay": self.replay.state(),
            "multiplier": [
                torch.from_numpy(self.multiplier.integral),
                torch.from_numpy(self.multiplier.value),
            ],
            "generators": [rng.bit_generator.state for rng in self.generators],
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        self.round = state["round"]
        self.learner.load_state(state["learner"])
        self.replay.load_state(state["replay"])
        integral, value = state["multiplier"]
        self.multiplier = Multiplier(integral=integral.numpy(), value=value.numpy())
        for rng, saved in zip(self.generators, state["generators"], strict=True):
            rng.bit_generator.state = saved


class _EpisodeBlocks:
    """Collects a round's slots and hands them to a caller, episode by episode."""

    def __init__(self, trainer: Trainer, on_slots: OnSlots | None) -> None:
        self._on_slots = on_slots
        self._num_seeds = trainer.num_seeds
        slots = trainer.scenario.learning.slots_per_episode
        self._whole = None if on_slots is None else trainer.loop.simulator.new_record(slots)

    def add(self, one: SlotRecord, slot: int) -> None:
        if self._whole is not None:
            copy_slot(one, self._whole, slot)

    def hand_over(self) -> None:
        if self._on_slots is None or self._whole is None:
            return
        num_envs = len(self._whole.reward_urllc)
        for env in range(num_envs):
            self._on_slots(env // (num_envs // self._num_seeds), self._whole.environment(env))


def train(
    scenario: Scenario,
    gains: Gains,
    *,
    on_slots: OnSlots | None = None,
    progress: Path | None = None,
    checkpoint: Path | None = None,
    show: bool = True,
) -> tuple[Policy, ...]:
    """Train all seeds of `scenario.learning` side by side on one thread.

    Parameters
    ----------
    scenario
        The validated scenario.
    gains
        Gain schedule of the robots.
    on_slots
        Is called after every episode with the index of the seed and the episode's record, arrays
        (T, ...) by field; each seed's episodes come in order. The arrays are overwritten by the
        next round.
    progress
        CSV file with one row a seed and round; None writes none.
    checkpoint
        File to resume from if it exists, rewritten after every round and removed at the end; None
        keeps none. Slots from before a resumption are not reported again.
    show
        Whether to show progress on the terminal.

    Returns
    -------
    policies
        One a seed, in the order of `scenario.learning.seeds`.

    Raises
    ------
    ValueError
        If the episodes are not a multiple of the environments, or the checkpoint is of another
        training.
    """
    learning = scenario.learning
    sha256 = scenario_sha256(scenario)
    trainer = Trainer(scenario, gains)
    report = ProgressFile(progress)
    before = 0.0
    if checkpoint is not None and checkpoint.exists():
        state = load_checkpoint(checkpoint, sha256)
        trainer.load_state(state["trainer"])
        report.rows, before = state["rows"], state["seconds"]
    blocks = _EpisodeBlocks(trainer, on_slots)
    round_slots = learning.num_envs * learning.slots_per_episode
    began = time.perf_counter() - before
    with (
        single_thread(),
        tqdm(
            total=trainer.num_seeds * trainer.num_rounds * round_slots,
            initial=trainer.num_seeds * trainer.round * round_slots,
            desc="training",
            unit=" slots",
            unit_scale=True,
            mininterval=1.0,
            disable=not show,
        ) as bar,
    ):

        def on_slot(one: SlotRecord, slot: int) -> None:
            blocks.add(one, slot)
            bar.update(len(one.reward_urllc))

        while trainer.round < trainer.num_rounds:
            sums = trainer.run_round(on_slot)
            blocks.hand_over()
            seconds = time.perf_counter() - began
            report.add(
                sums,
                seeds=learning.seeds,
                episode=trainer.round * learning.num_envs,
                slots=trainer.round * round_slots,
                multiplier_mean=trainer.multiplier.value.mean(axis=1),
                seconds=seconds,
            )
            bar.set_postfix_str(f"late {100.0 * sums.late_share().mean():.2f} %")
            if checkpoint is not None:
                saved = {"trainer": trainer.state(), "rows": report.rows, "seconds": seconds}
                save_checkpoint(checkpoint, sha256, saved)
    if checkpoint is not None:
        checkpoint.unlink(missing_ok=True)
    return trainer.policies()
