"""What passes between the trainer and an algorithm, slot by slot, and what algorithms share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hiersched.learning.networks import initial_stack, learner_network
from hiersched.learning.stack import StackedAdam
from hiersched.policies.policy import Weigher
from hiersched.scenario.schema import Scenario
from hiersched.simulator import SlotRecord


class Outcome(NamedTuple):
    """What a slot brought, leading axes (seeds, E)."""

    prb_count: NDArray[np.uint32]  # (U,) executed
    base_reward: NDArray[np.float64]  # (U,) of each user, without the constraint
    constraint: NDArray[np.float64]  # (R,) y of each URLLC user
    next_features: NDArray[np.float32]  # (U, F) at the start of the next slot


@dataclass
class Losses:
    """Losses of an update, shape (seeds, 2) each; None of actors that wait, without critics."""

    critic: Tensor | None
    actor: Tensor | None


class Algorithm:
    """How the agents of all seeds explore and learn; the trainer runs the worlds.

    Most act slot by slot, with `act`, `explore` and `learn`. One whose `population` is a policy
    lets it run whole episodes, watches them and learns behind.

    This one learns nothing, the control `learning.frozen`: its actors output 0, which is the
    scheduler `learning.start`, and explore with the noise of `learning.algorithm`. What its rewards
    and queues do during training comes from noise and multipliers alone. Algorithms that learn may
    derive from it. All draws come from `generators`, one a seed.
    """

    actor: Tensor  # parameters of the actors, (seeds * 2, P)

    def __init__(self, scenario: Scenario, generators: list[np.random.Generator]) -> None:
        learning = scenario.learning
        self._learning = learning
        self._generators = generators
        self.network = learner_network(learning, scenario.users)
        self.actor = initial_stack(self.network.actor, "actor", learning.seeds, zero_output=True)

    def population(self, *, explores: bool) -> Weigher | None:
        """Return what acts in the coming episodes of all worlds, or None: slot by slot.

        It `explores`, or runs without noise.
        """
        return None

    def watch(self, record: SlotRecord) -> None:
        """Take in slots that a population which explores has run, leading axes (seeds * E, T)."""

    def finish_round(self, done: float) -> Losses:
        """Learn from the episodes that it has watched; a share `done` of the training is over."""
        raise NotImplementedError

    def start_round(self, features: NDArray[np.float32]) -> None:
        """Begin a round of episodes with features (seeds, E, U, F)."""

    def act(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Act without noise: a in [-1, 1], shape (seeds, E, U), on features (seeds, E, U, F)."""
        return np.zeros(features.shape[:-1], np.float32)

    def explore(self, features: NDArray[np.float32], done: float) -> NDArray[np.float32]:
        """Act with noise, shape (seeds, E, U), when a share `done` of the training is over."""
        noise = self._spread(done) * seeded_normals(self._generators, features.shape[1:-1])
        actions: NDArray[np.float32]
        actions = np.tanh(noise) if self._learning.algorithm == "a2c" else np.clip(noise, -1.0, 1.0)
        return actions

    def learn(
        self, outcome: Outcome, multipliers: NDArray[np.float64], *, last: bool
    ) -> Losses | None:
        """Take a slot in, the episodes' last one or not, and learn from it or wait.

        Rewards and features are formed with the multipliers now in force, shape (seeds, R).
        """
        return None

    def state(self) -> dict[str, Any]:
        """Everything that the next round depends on, for `load_state`."""
        return {}

    def load_state(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""

    def _spread(self, done: float) -> np.float32:
        """Return the spread of the noise: it falls linearly with training."""
        first, final = self._learning.exploration_std, self._learning.exploration_final_std
        return np.float32(first + done * (final - first))


class ActorCritic(Algorithm):
    """Actors and critics of all seeds side by side, with their optimisers."""

    _STACKS: ClassVar[tuple[str, ...]] = ("actor", "critic")

    def __init__(
        self, scenario: Scenario, generators: list[np.random.Generator], *, sees_counts: bool
    ) -> None:
        super().__init__(scenario, generators)
        learning = scenario.learning
        self._critic_layers = self.network.critic(sees_counts=sees_counts)
        self._shares = self.network.value_shares()
        self.critic = initial_stack(
            self._critic_layers, "critic", learning.seeds, zero_output=False
        )
        self.actor_adam = StackedAdam(self.actor, learning.actor_lr, learning.gradient_clip)
        self.critic_adam = StackedAdam(self.critic, learning.critic_lr, learning.gradient_clip)

    def _means_of_actions(self, features: NDArray[np.float32]) -> Tensor:
        """Return the actors' outputs before tanh, shape (seeds, E, U), without a gradient."""
        with torch.no_grad():
            inputs = self.network.inputs(torch.from_numpy(features))
            return self._raw_actions(self.actor, inputs)

    def _raw_actions(self, actor: Tensor, inputs: Tensor) -> Tensor:
        """Return the outputs of the actors before tanh, shape (seeds, B, U)."""
        outputs = self.network.actor_outputs(actor, inputs)
        return self.network.raw_actions(outputs, len(self._learning.seeds))

    def _means(self, parts: Tensor) -> Tensor:
        """Return means over the users of each slice, (seeds, 2, ...), from (seeds, 2, ..., m)."""
        return torch.einsum("sa...n,an->sa...", parts, self._shares)

    def state(self) -> dict[str, Any]:
        """As in `Algorithm`, when no rollout is under way."""
        adam = [self.actor_adam.state(), self.critic_adam.state()]
        return {"adam": adam, **{name: getattr(self, name) for name in self._STACKS}}

    def load_state(self, state: dict[str, Any]) -> None:
        """As in `Algorithm`."""
        for name in self._STACKS:
            setattr(self, name, state[name])
        for adam, saved in zip((self.actor_adam, self.critic_adam), state["adam"], strict=True):
            adam.load_state(saved)


def seeded_normals(
    generators: list[np.random.Generator], shape: tuple[int, ...]
) -> NDArray[np.float32]:
    """Draw standard normals of each seed's own generator, shape (seeds, *shape)."""
    return np.stack([rng.standard_normal(shape, np.float32) for rng in generators])
