"""What the agents' networks see and say: small ones shared by the users of a slice, or flat ones.

The networks of a stack are those of the seeds times two agents, entry 2 * seed + agent, with agent
0 = URLLC and agent 1 = eMBB. Slices of different size are padded to the larger one (`Slices`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from hiersched.core.randomness import world_key
from hiersched.learning.stack import Layers
from hiersched.policies.features import NEED_SCALE, num_features
from hiersched.policies.learned import layer_sizes
from hiersched.scenario.schema import Learning, Users

NUM_AGENTS = 2


@dataclass(frozen=True)
class Slices:
    """Users of both slices as an array of two equally long rows: (..., U, *) <-> (..., 2, n, *)."""

    num_urllc: int
    num_embb: int

    @property
    def width(self) -> int:
        """n, users of the larger slice."""
        return max(self.num_urllc, self.num_embb)

    def split(self, users: Tensor) -> Tensor:
        """Form the rows of both slices, (..., 2, n, F) from (..., U, F); 0 where no user is."""
        parts = users.split_with_sizes((self.num_urllc, self.num_embb), dim=-2)
        return torch.stack(
            [functional.pad(part, (0, 0, 0, self.width - part.shape[-2])) for part in parts], dim=-3
        )

    def join(self, rows: Tensor) -> Tensor:
        """Inverse of `split` for one number per user: shape (..., U) from (..., 2, n)."""
        return torch.cat((rows[..., 0, : self.num_urllc], rows[..., 1, : self.num_embb]), dim=-1)

    def shares(self) -> Tensor:
        """1 / users of the slice, 0 where no user is, shape (2, n): sums with it are means."""
        shares = torch.zeros(NUM_AGENTS, self.width)
        shares[0, : self.num_urllc] = 1.0 / self.num_urllc
        shares[1, : self.num_embb] = 1.0 / self.num_embb
        return shares


@dataclass(frozen=True)
class Network(ABC):
    """How features become the inputs of both agents' networks, and outputs actions and values.

    The actors' inputs are the first ones of the critics'.

    An agent values m numbers: those of every user of its slice, or its slice's mean.
    """

    slices: Slices
    num_features: int
    hidden: tuple[int, ...]

    kind: ClassVar[str]

    @property
    def actor(self) -> Layers:
        """Sizes of the actors."""
        users = self.slices.num_urllc, self.slices.num_embb
        return Layers(layer_sizes(self.kind, self.hidden, self.num_features, *users))

    def critic(self, *, sees_counts: bool) -> Layers:
        """Sizes of the critics of states, or of states and what was executed."""
        more = self.num_counts if sees_counts else 0
        return Layers((self.num_inputs + more, *self.hidden, 1))

    @property
    def num_inputs(self) -> int:
        """Width of the `inputs`."""
        return self.actor.sizes[0]

    def actor_outputs(self, actors: Tensor, inputs: Tensor) -> Tensor:
        """Evaluate actors (S, P) on inputs (S, N, …), some of which may be for critics alone."""
        return self.actor.forward(actors, inputs[..., : self.actor.sizes[0]])

    def raw_actions(self, outputs: Tensor, num_seeds: int) -> Tensor:
        """Order the outputs of the actors before tanh by user, shape (seeds, B, U)."""
        rows = outputs.view(num_seeds, NUM_AGENTS, -1, self.slices.width).transpose(1, 2)
        return self.slices.join(rows)

    def values(self, outputs: Tensor, num_seeds: int) -> Tensor:
        """Order the outputs of the critics as values, shape (seeds, 2, B, m)."""
        return outputs.view(num_seeds, NUM_AGENTS, -1, self.value_shares().shape[1])

    @abstractmethod
    def inputs(self, features: Tensor) -> Tensor:
        """Form what the actors see, (seeds * 2, N, inputs), from (seeds, B, U, F)."""

    @property
    @abstractmethod
    def num_counts(self) -> int:
        """Further inputs of a critic that sees what was executed."""

    @abstractmethod
    def count_inputs(self, prb_count: Tensor) -> Tensor:
        """Form these inputs, (seeds * 2, N, num_counts), from PRB counts (seeds, B, U)."""

    @abstractmethod
    def pool(self, user_rewards: Tensor) -> Tensor:
        """Form what an agent values, (seeds, 2, B, m), of the users' rewards (seeds, B, U)."""

    @abstractmethod
    def value_shares(self) -> Tensor:
        """Weights, shape (2, m): a value's sum with them is that of the slice's mean reward."""


class SharedNetwork(Network):
    """One small network applied to every user of a slice, with the means of both slices.

    It does not care how many users there are, nor in what order.
    """

    kind = "shared"
    num_counts = 1

    def inputs(self, features: Tensor) -> Tensor:
        """As in `Network`."""
        rows = self.slices.split(features)
        means = torch.einsum("sbanf,an->sbaf", rows, self.slices.shares())
        own_mean = means.unsqueeze(3).expand_as(rows)
        other_mean = means.flip(2).unsqueeze(3).expand_as(rows)
        inputs = torch.cat((rows, own_mean, other_mean), dim=-1).transpose(1, 2)
        return inputs.reshape(NUM_AGENTS * features.shape[0], -1, 3 * features.shape[-1])

    def count_inputs(self, prb_count: Tensor) -> Tensor:
        """As in `Network`."""
        rows = self.pool(prb_count) / NEED_SCALE
        return rows.reshape(NUM_AGENTS * len(prb_count), -1, 1)

    def pool(self, user_rewards: Tensor) -> Tensor:
        """As in `Network`."""
        return self.slices.split(user_rewards.unsqueeze(-1)).squeeze(-1).transpose(1, 2)

    def value_shares(self) -> Tensor:
        """As in `Network`."""
        return self.slices.shares()


class LinearNetwork(SharedNetwork):
    """One sum over a user's own features, with the critics of a shared network."""

    kind = "linear"

    @property
    def actor(self) -> Layers:
        """As in `Network`."""
        return Layers(layer_sizes(self.kind, (), self.num_features, 1, 1))

    @property
    def num_inputs(self) -> int:
        """As in `Network`."""
        return 3 * self.num_features


class FlatNetwork(Network):
    """One network an agent over all users side by side, as a reader of the paper would write it."""

    kind = "mlp"

    @property
    def num_counts(self) -> int:
        """As in `Network`."""
        return self.slices.num_urllc + self.slices.num_embb

    def inputs(self, features: Tensor) -> Tensor:
        """As in `Network`."""
        return features.flatten(2).repeat_interleave(NUM_AGENTS, dim=0)

    def count_inputs(self, prb_count: Tensor) -> Tensor:
        """As in `Network`."""
        return (prb_count / NEED_SCALE).repeat_interleave(NUM_AGENTS, dim=0)

    def pool(self, user_rewards: Tensor) -> Tensor:
        """As in `Network`."""
        rows = self.slices.split(user_rewards.unsqueeze(-1)).squeeze(-1)
        return torch.einsum("sban,an->sab", rows, self.slices.shares()).unsqueeze(-1)

    def value_shares(self) -> Tensor:
        """As in `Network`."""
        return torch.ones(NUM_AGENTS, 1)


NETWORKS: dict[str, type[Network]] = {
    kind.kind: kind for kind in (SharedNetwork, FlatNetwork, LinearNetwork)
}


def learner_network(learning: Learning, users: Users) -> Network:
    """Make the network of a learner's section `learning` for so many users."""
    return NETWORKS[learning.network](
        Slices(users.num_urllc, users.num_embb),
        num_features(learning.observe_robots, learning.observe_demand),
        learning.hidden,
    )


def initial_stack(
    layers: Layers, name: str, seeds: tuple[int, ...], *, zero_output: bool
) -> Tensor:
    """Parameters of both agents of every seed, shape (seeds * 2, P), each of its own stream."""
    rows = [
        layers.initial(np.random.default_rng(world_key(name, seed, agent)), zero_output=zero_output)
        for seed in seeds
        for agent in range(NUM_AGENTS)
    ]
    return torch.from_numpy(np.stack(rows))
