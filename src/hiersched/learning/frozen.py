"""A control that learns nothing: actors that stay as they start, under an algorithm's noise.

What its rewards and queues do during training comes from noise and multipliers, not from learning.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hiersched.learning.algorithm import Losses, Outcome, exploration_spread, seeded_normals
from hiersched.learning.networks import initial_stack, learner_network
from hiersched.scenario.schema import Scenario


class Frozen:
    """An `Algorithm` whose actors output 0: the scheduler `learning.start`, plus noise.

    Parameters
    ----------
    scenario
        Section `learning` decides: its algorithm says how noise becomes an action.
    generators
        Of each seed, for the noise.
    """

    def __init__(self, scenario: Scenario, generators: list[np.random.Generator]) -> None:
        learning = scenario.learning
        self._learning = learning
        self._generators = generators
        network = learner_network(learning, scenario.users)
        self.actor: Tensor = initial_stack(network.actor, "actor", learning.seeds, zero_output=True)

    def start_round(self, features: NDArray[np.float32]) -> None:
        """As in `Algorithm`: nothing is kept."""

    def act(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """As in `Algorithm`."""
        return np.zeros(features.shape[:-1], np.float32)

    def explore(self, features: NDArray[np.float32], done: float) -> NDArray[np.float32]:
        """As in `Algorithm`."""
        learning = self._learning
        spread = exploration_spread(learning.exploration_std, learning.exploration_final_std, done)
        noise = spread * seeded_normals(self._generators, features.shape[1:-1])
        actions: NDArray[np.float32]
        actions = np.tanh(noise) if learning.algorithm == "a2c" else np.clip(noise, -1.0, 1.0)
        return actions

    def learn(
        self, outcome: Outcome, multipliers: NDArray[np.float64], *, last: bool
    ) -> Losses | None:
        """As in `Algorithm`: nothing is learnt."""
        return None

    def state(self) -> dict[str, Any]:
        """As in `Algorithm`."""
        return {}

    def load_state(self, state: dict[str, Any]) -> None:
        """As in `Algorithm`."""
