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

    _ARRAYS = ("_features", "_prb_count", "_base_reward", "_constraint")

    def __init__(
        self,
        num_seeds: int,
        num_envs: int,
        num_slots: int,
        num_rounds: int,
        num_urllc: int,
        feature_shape: tuple[int, int],
    ) -> None:
        place = (num_seeds, num_rounds, num_slots, num_envs)
        # One slot more than transitions: the features of t + 1 are the next ones of t.
        self._features = np.zeros(
            (num_seeds, num_rounds, num_slots + 1, num_envs, *feature_shape), np.float32
        )
        self._prb_count = np.zeros((*place, feature_shape[0]), np.float32)
        self._base_reward = np.zeros((*place, feature_shape[0]), np.float32)
        self._constraint = np.zeros((*place, num_urllc), np.float32)
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
        self._features[:, self._row, 0] = features

    def add(self, outcome: Outcome) -> None:
        """Add a slot of all environments."""
        row, slot = self._row, self._slot
        self._prb_count[:, row, slot] = outcome.prb_count
        self._base_reward[:, row, slot] = outcome.base_reward
        self._constraint[:, row, slot] = outcome.constraint
        self._features[:, row, slot + 1] = outcome.next_features
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
        here = (seed, row, slot, env)
        return Transitions(
            features=self._features[here],
            prb_count=self._prb_count[here],
            base_reward=self._base_reward[here],
            constraint=self._constraint[here],
            next_features=self._features[seed, row, slot + 1, env],
        )

    @property
    def _row(self) -> int:
        return (self._started - 1) % self._num_rounds

    def state(self) -> dict[str, Any]:
        """Everything needed to go on, for `load_state`."""
        arrays = {name: torch.from_numpy(getattr(self, name)) for name in self._ARRAYS}
        return {"arrays": arrays, "started": self._started, "slot": self._slot}

    def load_state(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        for name, saved in state["arrays"].items():
            setattr(self, name, saved.numpy())
        self._started, self._slot = state["started"], state["slot"]
