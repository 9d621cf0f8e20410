"""What passes between the trainer and an algorithm, slot by slot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor


class Outcome(NamedTuple):
    """What a slot brought, leading axes (seeds, E)."""

    prb_count: NDArray[np.uint32]  # (U,) executed
    base_reward: NDArray[np.float64]  # (U,) of each user, without the constraint
    constraint: NDArray[np.float64]  # (R,) y of each URLLC user
    next_features: NDArray[np.float32]  # (U, F) at the start of the next slot


@dataclass
class Losses:
    """Losses of an update, shape (seeds, 2) each; the actors' is None while they wait."""

    critic: Tensor
    actor: Tensor | None


class Algorithm(Protocol):
    """How the agents of all seeds explore and learn; the trainer runs the worlds."""

    @property
    def actor(self) -> Tensor:
        """Parameters of the actors, shape (seeds * 2, P)."""
        ...

    def start_round(self, features: NDArray[np.float32]) -> None:
        """Begin a round of episodes with features (seeds, E, U, F)."""
        ...

    def act(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Act without noise, shape (seeds, E, U)."""
        ...

    def explore(self, features: NDArray[np.float32], done: float) -> NDArray[np.float32]:
        """Act with noise, shape (seeds, E, U), when a share `done` of the training is over."""
        ...

    def learn(
        self, outcome: Outcome, multipliers: NDArray[np.float64], *, last: bool
    ) -> Losses | None:
        """Take a slot in, the episodes' last one or not, and learn from it or wait."""
        ...

    def state(self) -> dict[str, Any]:
        """Everything that the next round depends on, for `load_state`."""
        ...

    def load_state(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        ...


def exploration_spread(first: float, final: float, done: float) -> np.float32:
    """Spread of the noise: it falls linearly with training."""
    return np.float32(first + done * (final - first))


def seeded_normals(
    generators: list[np.random.Generator], shape: tuple[int, ...]
) -> NDArray[np.float32]:
    """Draw standard normals of each seed's own generator, shape (seeds, *shape)."""
    return np.stack([rng.standard_normal(shape, np.float32) for rng in generators])
