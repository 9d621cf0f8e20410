"""DDPG in training: noise on the action, a replay buffer, one update of all agents a slot."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hiersched.learning.algorithm import Losses, Outcome, exploration_spread, seeded_normals
from hiersched.learning.ddpg import Learner
from hiersched.learning.replay_buffer import ReplayBuffer
from hiersched.policies.features import num_features
from hiersched.scenario.schema import Scenario


class Ddpg:
    """An `Algorithm`: Algorithm 1 of the paper.

    Parameters
    ----------
    scenario
        Section `learning` decides.
    generators
        Of each seed, for noise and batches.
    """

    def __init__(self, scenario: Scenario, generators: list[np.random.Generator]) -> None:
        learning = scenario.learning
        self._learning = learning
        self._generators = generators
        self.learner = Learner(scenario)
        round_size = learning.num_envs * learning.slots_per_episode
        num_rounds = learning.episodes // learning.num_envs
        self.replay = ReplayBuffer(
            len(learning.seeds),
            learning.num_envs,
            learning.slots_per_episode,
            max(1, min(learning.replay_capacity // round_size, num_rounds)),
            scenario.users.num_urllc,
            (scenario.num_users, num_features(learning.observe_robots)),
        )

    @property
    def actor(self) -> Tensor:
        """As in `Algorithm`."""
        return self.learner.actor

    def start_round(self, features: NDArray[np.float32]) -> None:
        """As in `Algorithm`."""
        self.replay.start_round(features)

    def act(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """As in `Algorithm`."""
        return self.learner.act(features)

    def explore(self, features: NDArray[np.float32], done: float) -> NDArray[np.float32]:
        """As in `Algorithm`."""
        learning = self._learning
        actions = self.act(features)
        spread = exploration_spread(learning.exploration_std, learning.exploration_final_std, done)
        noise = seeded_normals(self._generators, actions.shape[1:])
        return np.clip(actions + spread * noise, -1.0, 1.0)

    def learn(
        self, outcome: Outcome, multipliers: NDArray[np.float64], *, last: bool
    ) -> Losses | None:
        """As in `Algorithm`."""
        learning = self._learning
        self.replay.add(*outcome)
        if len(self.replay) < max(learning.warmup_slots * learning.num_envs, learning.batch_size):
            return None
        batch = self.replay.sample(learning.batch_size, self._generators)
        return self.learner.update(batch, multipliers)

    def state(self) -> dict[str, Any]:
        """As in `Algorithm`."""
        return {"learner": self.learner.state(), "replay": self.replay.state()}

    def load_state(self, state: dict[str, Any]) -> None:
        """As in `Algorithm`."""
        self.learner.load_state(state["learner"])
        self.replay.load_state(state["replay"])
