"""The replay buffer of both agents, in whole episodes, for all seeds side by side.

It stores what happened (features, PRB counts, the parts of the rewards and the constraint), never a
reward: the multiplier moves, and a reward that contained an old one would mislead.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from hiersched.learning.algorithm import Outcome


class Transitions(NamedTuple):
    """A batch of transitions, leading axes (seeds, B): features and the `Outcome`, in float32."""

    features: NDArray[np.float32]  # (U, F) at the start of the slot
    prb_count: NDArray[np.float32]
    base_reward: NDArray[np.float32]
    constraint: NDArray[np.float32]
    next_features: NDArray[np.float32]


class ReplayBuffer:
    """The last rounds of training; a round is one episode in every environment.

    It keeps `num_rounds` of them: ``num_rounds * num_envs * num_slots`` transitions a seed.
    `feature_shape` is (U, F), `num_urllc` R.
    """

    def __init__(
        self,
        num_seeds: int,
        num_envs: int,
        num_slots: int,
        num_rounds: int,
        num_urllc: int,
        feature_shape: tuple[int, int],
    ) -> None:
        num_users, place = feature_shape[0], (num_seeds, num_rounds, num_slots, num_envs)
        # One slot more than transitions: the features of t + 1 are the next ones of t.
        shapes = {
            "features": (num_seeds, num_rounds, num_slots + 1, num_envs, *feature_shape),
            "prb_count": (*place, num_users),
            "base_reward": (*place, num_users),
            "constraint": (*place, num_urllc),
        }
        self._arrays = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
        self._num_rounds, self._num_slots, self._num_envs = num_rounds, num_slots, num_envs
        self._started = self._slot = 0

    def __len__(self) -> int:
        """Transitions of each seed that can be sampled."""
        full = min(max(self._started - 1, 0), self._num_rounds - 1)
        return (full * self._num_slots + self._slot) * self._num_envs

    def start_round(self, features: NDArray[np.float32]) -> None:
        """Begin a round with features (seeds, envs, U, F), in place of the oldest one."""
        self._started += 1
        self._slot = 0
        self._arrays["features"][:, self._row, 0] = features

    def add(self, outcome: Outcome) -> None:
        """Add a slot of all environments."""
        row, slot = self._row, self._slot
        for name in ("prb_count", "base_reward", "constraint"):
            self._arrays[name][:, row, slot] = getattr(outcome, name)
        self._arrays["features"][:, row, slot + 1] = outcome.next_features
        self._slot += 1

    def sample(self, batch_size: int, generators: list[np.random.Generator]) -> Transitions:
        """Draw `batch_size` transitions of each seed uniformly, with one generator a seed."""
        size = len(self)
        draws = np.stack([rng.integers(size, size=batch_size) for rng in generators])
        age, place = np.divmod(draws, self._num_slots * self._num_envs)
        slot, env = np.divmod(place, self._num_envs)
        # `age` counts from the oldest full round; the round in progress comes last.
        first = max(self._started - self._num_rounds, 0)
        row = (first + age) % self._num_rounds
        seed = np.arange(len(generators))[:, None]
        following = self._arrays["features"][seed, row, slot + 1, env]
        drawn = {name: array[seed, row, slot, env] for name, array in self._arrays.items()}
        return Transitions(**drawn, next_features=following)

    @property
    def _row(self) -> int:
        return (self._started - 1) % self._num_rounds

    def state(self) -> dict[str, Any]:
        """Everything needed to go on, for `load_state`."""
        arrays = {name: torch.from_numpy(array) for name, array in self._arrays.items()}
        return {"arrays": arrays, "started": self._started, "slot": self._slot}

    def load_state(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        self._arrays = {name: saved.numpy() for name, saved in state["arrays"].items()}
        self._started, self._slot = state["started"], state["slot"]
