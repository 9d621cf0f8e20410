"""Training of all seeds side by side (docs/paper_notes.md, 5)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from hiersched.core.randomness import train_worlds, world_key, world_keys
from hiersched.core.registry import ALGORITHMS
from hiersched.env.core import SlotLoop
from hiersched.learning import a2c, ddpg, es  # noqa: F401  # so that their code counts as ours
from hiersched.learning.algorithm import Algorithm, Outcome
from hiersched.learning.checkpoint import load_checkpoint, save_checkpoint
from hiersched.learning.multiplier import Multiplier, episode_constraint, step_multiplier
from hiersched.learning.progress import RoundSums, write_progress
from hiersched.learning.rewards import user_rewards
from hiersched.policies.policy import Weigher
from hiersched.policies.trained import TrainedPolicy
from hiersched.scenario import Scenario, scenario_sha256
from hiersched.scenario.schema import checkpoint_rounds, worlds_per_round
from hiersched.simulator import Gains, SlotRecord

CHECKPOINT = "checkpoint"
"""Purpose of the worlds in which policies run without noise, the same for all seeds."""

Blocks = dict[str, NDArray[Any]]
OnSlots = Callable[[int, Blocks], None]
OnRecord = Callable[[SlotRecord, int], None]
"""Is given slots as they have run, leading axes (seeds * worlds, T), and the first one's index."""
SLOTS_AT_ONCE = 25
"""Most slots that a population runs before anyone looks: a bound on memory."""


class Trainer:
    """Everything that training changes; `train` runs it.

    A round is one episode in every environment of every seed; `train_worlds` says in which worlds.
    All random numbers of a seed come from its own generators, so a seed learns the same whichever
    others are trained beside it, up to rounding.
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
        self.multiplier = Multiplier.zero((self.num_seeds, users.num_urllc))
        self.generators = [
            np.random.default_rng(world_key("train/draws", seed)) for seed in learning.seeds
        ]
        make = Algorithm if learning.frozen else ALGORITHMS[learning.algorithm]
        self.algorithm: Algorithm = make(scenario, self.generators)
        self.loop = SlotLoop(scenario, gains, self._worlds(), learning.slots_per_episode)
        fixed = world_keys(CHECKPOINT, 0, learning.checkpoint_worlds)
        self._fixed_worlds = np.tile(fixed, self.num_seeds)
        self.fixed_loop = SlotLoop(scenario, gains, self._fixed_worlds, learning.slots_per_episode)

    def _worlds(self) -> NDArray[np.uint64]:
        learning = self.scenario.learning
        first, count = self.round * learning.num_envs, learning.num_envs
        layout = count, worlds_per_round(learning)
        return np.concatenate(
            [train_worlds(seed, first, count, *layout) for seed in learning.seeds]
        )

    def _by_seed(self, values: NDArray[Any]) -> NDArray[Any]:
        return values.reshape(self.num_seeds, -1, *values.shape[1:])

    def _start(self, loop: SlotLoop, worlds: NDArray[np.uint64]) -> NDArray[np.float32]:
        """Begin episodes under the multipliers in force; returns features (seeds, E, U, F)."""
        each = len(worlds) // self.num_seeds
        loop.multipliers[:] = np.repeat(self.multiplier.value, each, axis=0)
        return self._by_seed(loop.reset(worlds))

    def _step(self, loop: SlotLoop, actions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Run one slot under actions (seeds, E, U); returns the next features."""
        return self._by_seed(loop.step(actions.reshape(len(loop.multipliers), -1)))

    def run_round(self, on_record: OnRecord) -> RoundSums:
        """One episode in every environment; the algorithm learns as they run, or behind."""
        sums = RoundSums(self.num_seeds, self.scenario.users.num_urllc)
        features = self._start(self.loop, self._worlds())
        population = self._population(explores=True)
        if population is None:
            self._act_and_learn(features, sums, on_record)
        else:
            for slot, record in self._episode_of(population, self.loop):
                sums.add(record)
                on_record(record, slot)
                self.algorithm.watch(record)
            sums.add_losses(self.algorithm.finish_round(self.round / self.num_rounds))
        objective = self.scenario.objective
        constraint = episode_constraint(
            objective,
            self.scenario.traffic.reliability,
            sums.due_packets,
            sums.late_packets,
            sums.mean_constraint(),
        )
        self.multiplier = step_multiplier(self.multiplier, constraint, objective)
        self.round += 1
        return sums

    def _act_and_learn(
        self, features: NDArray[np.float32], sums: RoundSums, on_record: OnRecord
    ) -> None:
        """Run the episodes of a round slot by slot."""
        loop, algorithm = self.loop, self.algorithm
        slots = self.scenario.learning.slots_per_episode
        algorithm.start_round(features)
        for slot in range(slots):
            done = (self.round + slot / slots) / self.num_rounds
            features = self._step(loop, algorithm.explore(features, done))
            outcome = self._outcome(features)
            sums.add(loop.record)
            on_record(loop.record, slot)
            losses = algorithm.learn(outcome, self.multiplier.value, last=slot == slots - 1)
            if losses is not None:
                sums.add_losses(losses)

    def _population(self, *, explores: bool) -> Weigher | None:
        """Return what runs whole episodes; an algorithm of a plug-in need not have any."""
        make = getattr(self.algorithm, "population", None)
        return None if make is None else make(explores=explores)

    def _episode_of(self, population: Weigher, loop: SlotLoop) -> Iterator[tuple[int, SlotRecord]]:
        """Run the episodes that have begun; yield what has run, and its first slot."""
        slots = self.scenario.learning.slots_per_episode
        at_once = max(n for n in range(1, SLOTS_AT_ONCE + 1) if slots % n == 0)
        record = loop.simulator.new_record(at_once)
        for slot in range(0, slots, at_once):
            loop.run(population, record)
            yield slot, record

    def run_checkpoint(self, on_record: OnRecord) -> None:
        """Run one episode in every fixed world without noise; nothing is learnt from it."""
        loop = self.fixed_loop
        features = self._start(loop, self._fixed_worlds)
        population = self._population(explores=False)
        if population is not None:
            for slot, record in self._episode_of(population, loop):
                on_record(record, slot)
            return
        for slot in range(self.scenario.learning.slots_per_episode):
            features = self._step(loop, self.algorithm.act(features))
            on_record(loop.record, slot)

    def _outcome(self, following: NDArray[np.float32]) -> Outcome:
        """Say what the last slot brought, by seed; its record is overwritten by the next one."""
        one, after = self.loop.record, self.loop.simulator.state.backlog_packets
        return Outcome(
            prb_count=self._by_seed(one.num_prb[:, 0]),
            base_reward=self._by_seed(
                user_rewards(one, after, self.loop.task_costs, self.scenario)
            ),
            constraint=self._by_seed(one.constraint[:, 0]).copy(),
            next_features=following,
        )

    def policies(self) -> tuple[TrainedPolicy, ...]:
        """Return the policies as they stand, one a seed."""
        learning = self.scenario.learning
        actors = self.algorithm.actor.numpy().reshape(self.num_seeds, 2, -1)
        sha256 = scenario_sha256(self.scenario)
        return tuple(
            TrainedPolicy(
                parameters=actors[index].copy(),
                network=learning.network,
                rule=learning.start,
                weighs=learning.weighs,
                observe_robots=learning.observe_robots,
                observe_demand=learning.observe_demand,
                hidden=() if learning.network == "linear" else learning.hidden,
                weight_exponent=learning.weight_exponent,
                num_embb=self.scenario.users.num_embb,
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
            "algorithm": self.algorithm.state(),
            "multiplier": [
                torch.from_numpy(self.multiplier.integral),
                torch.from_numpy(self.multiplier.value),
            ],
            "generators": [rng.bit_generator.state for rng in self.generators],
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        self.round = state["round"]
        self.algorithm.load_state(state["algorithm"])
        integral, value = state["multiplier"]
        self.multiplier = Multiplier(integral=integral.numpy(), value=value.numpy())
        for rng, saved in zip(self.generators, state["generators"], strict=True):
            rng.bit_generator.state = saved


@contextmanager
def single_thread() -> Iterator[None]:
    """One torch thread within: the bits of a matrix product depend on the number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class _EpisodeBlocks:
    """Collects the slots of episodes side by side and hands them to a caller, one by one."""

    def __init__(self, loop: SlotLoop, num_seeds: int, on_slots: OnSlots | None) -> None:
        self._on_slots, self._num_seeds = on_slots, num_seeds
        slots = loop.simulator.num_slots
        self._whole = None if on_slots is None else loop.simulator.new_record(slots)

    def add(self, record: SlotRecord, slot: int) -> None:
        if self._whole is not None:
            self._whole.rows[:, slot : slot + record.rows.shape[1]] = record.rows

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
    on_checkpoint: OnSlots | None = None,
    progress: Path | None = None,
    checkpoint: Path | None = None,
    show: bool = True,
) -> tuple[TrainedPolicy, ...]:
    """Train all seeds of `scenario.learning` side by side on one thread; return a policy a seed.

    `on_slots` is called after every episode with the index of the seed and the episode's record,
    arrays (T, ...) by field; each seed's episodes come in order, and the arrays are overwritten by
    the next round. `on_checkpoint` likewise for the episodes without noise in the fixed worlds,
    which run at the start and after some rounds (`checkpoint_rounds`), and only for it.

    `progress` is a CSV file with one row a seed and round, `checkpoint` a file to resume from if it
    exists, rewritten after every round and removed at the end; slots from before a resumption are
    not reported again. `show` shows progress on the terminal.

    ValueError if the episodes are not a multiple of the environments, or the checkpoint is of
    another training.
    """
    learning = scenario.learning
    sha256 = scenario_sha256(scenario)
    trainer = Trainer(scenario, gains)
    rows: list[dict[str, float]] = []
    before = 0.0
    if checkpoint is not None and checkpoint.exists():
        state = load_checkpoint(checkpoint, sha256)
        trainer.load_state(state["trainer"])
        rows, before = state["rows"], state["seconds"]
    blocks = _EpisodeBlocks(trainer.loop, trainer.num_seeds, on_slots)
    fixed = _EpisodeBlocks(trainer.fixed_loop, trainer.num_seeds, on_checkpoint)
    rounds = checkpoint_rounds(learning) if on_checkpoint is not None else ()
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

        def on_record(record: SlotRecord, slot: int) -> None:
            blocks.add(record, slot)
            bar.update(record.reward_urllc.size)

        def run_fixed() -> None:
            trainer.run_checkpoint(fixed.add)
            fixed.hand_over()

        if trainer.round == 0 and 0 in rounds:
            run_fixed()
        while trainer.round < trainer.num_rounds:
            sums = trainer.run_round(on_record)
            blocks.hand_over()
            if trainer.round in rounds:
                run_fixed()
            seconds = time.perf_counter() - began
            columns = sums.columns()
            rows += [
                {
                    "episode": trainer.round * learning.num_envs,
                    "seed": seed,
                    "slots": trainer.round * round_slots,
                    **{name: float(values[index]) for name, values in columns.items()},
                    "multiplier_mean": float(trainer.multiplier.value[index].mean()),
                    "seconds": round(seconds, 3),
                }
                for index, seed in enumerate(learning.seeds)
            ]
            if progress is not None:
                write_progress(progress, rows)
            bar.set_postfix_str(f"late {100.0 * sums.late_share().mean():.2f} %")
            if checkpoint is not None:
                saved = {"trainer": trainer.state(), "rows": rows, "seconds": seconds}
                save_checkpoint(checkpoint, sha256, saved)
    if checkpoint is not None:
        checkpoint.unlink(missing_ok=True)
    return trainer.policies()
