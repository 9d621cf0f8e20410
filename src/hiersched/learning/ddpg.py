"""One update of all agents of all seeds: Algorithm 1 of the paper (DDPG, Lillicrap et al. 2016)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from hiersched.env.features import MULTIPLIER, multiplier_feature
from hiersched.learning.networks import (
    ACTOR_INPUTS,
    CRITIC_INPUTS,
    NUM_AGENTS,
    Layers,
    Slices,
    count_input,
    network_inputs,
)
from hiersched.learning.relaxation import prb_shares
from hiersched.learning.replay import Transitions
from hiersched.randomness import world_key
from hiersched.scenario.schema import Scenario

_ADAM_DECAY, _ADAM_SQUARE_DECAY, _ADAM_EPSILON = 0.9, 0.999, 1e-8


class StackedAdam:
    """Adam (Kingma and Ba 2015) on the rows of a flat tensor, each clipped to a gradient norm."""

    def __init__(self, parameters: Tensor, learning_rate: float, gradient_clip: float) -> None:
        self._learning_rate = learning_rate
        self._gradient_clip = gradient_clip
        self.mean = torch.zeros_like(parameters)
        self.square = torch.zeros_like(parameters)
        self.steps = 0

    def step(self, parameters: Tensor, gradient: Tensor) -> None:
        """Move `parameters`, shape (S, P), against `gradient`, in place."""
        norm = torch.linalg.vector_norm(gradient, dim=1, keepdim=True)
        gradient = gradient * (self._gradient_clip / norm.clamp(min=self._gradient_clip))
        self.steps += 1
        self.mean.lerp_(gradient, 1.0 - _ADAM_DECAY)
        self.square.mul_(_ADAM_SQUARE_DECAY).addcmul_(
            gradient, gradient, value=1.0 - _ADAM_SQUARE_DECAY
        )
        unbias = (1.0 - _ADAM_SQUARE_DECAY**self.steps) ** 0.5
        rate = self._learning_rate / (1.0 - _ADAM_DECAY**self.steps)
        scale = self.square.sqrt().div_(unbias).add_(_ADAM_EPSILON)
        parameters.addcdiv_(self.mean, scale, value=-rate)


@dataclass
class Losses:
    """Losses of an update, shape (seeds, 2) each; the actors' is None while they wait."""

    critic: Tensor
    actor: Tensor | None


class Learner:
    """Actors, critics, their targets and optimisers, for all seeds side by side.

    Parameters
    ----------
    scenario
        Sections `learning`, `objective` and `users` decide.
    """

    def __init__(self, scenario: Scenario) -> None:
        learning = scenario.learning
        self._learning = learning
        self._num_prb = scenario.radio.num_prb
        self.slices = Slices(scenario.users.num_urllc, scenario.users.num_embb)
        self._shares = self.slices.shares()
        self.actor_layers = Layers((ACTOR_INPUTS, *learning.hidden, 1))
        self.critic_layers = Layers((CRITIC_INPUTS, *learning.hidden, 1))
        self.actor = self._initial(self.actor_layers, "actor", zero_output=True)
        self.critic = self._initial(self.critic_layers, "critic", zero_output=False)
        self.target_actor = self.actor.clone()
        self.target_critic = self.critic.clone()
        clip = learning.gradient_clip
        self.actor_adam = StackedAdam(self.actor, learning.actor_lr, clip)
        self.critic_adam = StackedAdam(self.critic, learning.critic_lr, clip)

    def _initial(self, layers: Layers, name: str, *, zero_output: bool) -> Tensor:
        rows = [
            layers.initial(
                np.random.default_rng(world_key(name, seed, agent)), zero_output=zero_output
            )
            for seed in self._learning.seeds
            for agent in range(NUM_AGENTS)
        ]
        return torch.from_numpy(np.stack(rows))

    def act(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Act without noise: a in [-1, 1], shape (seeds, E, U), on features (seeds, E, U, F)."""
        with torch.no_grad():
            inputs = network_inputs(torch.from_numpy(features), self.slices)
            return self._actions(self.actor, inputs, features.shape[0]).numpy()

    def update(self, batch: Transitions, multipliers: NDArray[np.float64]) -> Losses:
        """One step of every critic and every actor, then of the targets.

        Parameters
        ----------
        batch
            From the replay buffer.
        multipliers
            The multipliers now in force, shape (seeds, R); rewards and features are formed with
            them.
        """
        features, following = _with_multiplier(batch, multipliers)
        inputs = network_inputs(features, self.slices)
        reward = compose_rewards(batch, multipliers, self.slices, self._learning.reward_scale)
        target = self._targets(reward, following)
        critic_loss = self._update_critics(inputs, torch.from_numpy(batch.prb_count), target)
        actor_loss = None
        if self.critic_adam.steps > self._learning.critic_warmup_updates:
            actor_loss = self._update_actors(inputs, len(features), multipliers)
        self.target_actor.lerp_(self.actor, self._learning.target_rate)
        self.target_critic.lerp_(self.critic, self._learning.target_rate)
        return Losses(critic=critic_loss, actor=actor_loss)

    def _targets(self, reward: Tensor, following: Tensor) -> Tensor:
        """Form r + discount Q'(s', n'), shape (seeds, 2, B, n); truncation never drops Q'."""
        with torch.no_grad():
            inputs = network_inputs(following, self.slices)
            actions = self._actions(self.target_actor, inputs, len(following))
            shares = prb_shares(torch.exp(self._learning.weight_exponent * actions), self._num_prb)
            value = self._user_values(self.target_critic, inputs, shares)
            return reward + self._learning.discount * value

    def _update_critics(self, inputs: Tensor, prb_count: Tensor, target: Tensor) -> Tensor:
        critic = self.critic.requires_grad_()
        value = self._user_values(critic, inputs, prb_count)
        loss = self._means(smooth_l1_loss(value, target, reduction="none")).mean(-1)
        (gradient,) = torch.autograd.grad(loss.sum(), critic)
        self.critic = critic.detach()
        self.critic_adam.step(self.critic, gradient)
        return loss.detach()

    def _update_actors(
        self, inputs: Tensor, num_seeds: int, multipliers: NDArray[np.float64]
    ) -> Tensor:
        """Raise the value of the allocation that the actors' weights would buy.

        An agent's own reward is what its critic predicts. `independent`: an actor raises its own
        critic's value, the other agent's weights held. `cooperative`: both raise the mean of the
        two critics, which is the value of the mean reward, since values are linear in rewards.
        """
        actor = self.actor.requires_grad_()
        raw = self._raw_actions(actor, inputs, num_seeds)
        log_weights = self._learning.weight_exponent * raw.tanh()
        if self._learning.reward == "cooperative":
            value = self._values(self.critic, inputs, self._shares_of(log_weights))
        else:
            value = torch.stack(
                [
                    self._values(self.critic, inputs, self._shares_of(own))[:, agent]
                    for agent, own in enumerate(self._other_held(log_weights))
                ],
                dim=1,
            )
        loss = -value.mean(-1)
        price = 1.0 + torch.from_numpy(multipliers.mean(-1)).float()
        penalty = self._learning.action_penalty * raw.square().mean((1, 2))
        (gradient,) = torch.autograd.grad((loss.sum(-1) / price + penalty).sum(), actor)
        self.actor = actor.detach()
        self.actor_adam.step(self.actor, gradient)
        return loss.detach()

    def _shares_of(self, log_weights: Tensor) -> Tensor:
        return prb_shares(log_weights.exp(), self._num_prb, floor_slope=self._learning.floor_slope)

    def _other_held(self, log_weights: Tensor) -> tuple[Tensor, Tensor]:
        """For each agent the same logarithms, of which only its own pass a gradient."""
        urllc = torch.arange(log_weights.shape[-1]) < self.slices.num_urllc
        held = log_weights.detach()
        return torch.where(urllc, log_weights, held), torch.where(urllc, held, log_weights)

    def _actions(self, actor: Tensor, inputs: Tensor, num_seeds: int) -> Tensor:
        return self._raw_actions(actor, inputs, num_seeds).tanh()

    def _raw_actions(self, actor: Tensor, inputs: Tensor, num_seeds: int) -> Tensor:
        """Return the outputs of the actors before tanh, shape (seeds, B, U)."""
        rows = self.actor_layers.forward(actor, inputs)
        rows = rows.view(num_seeds, NUM_AGENTS, -1, self.slices.width).transpose(1, 2)
        return self.slices.join(rows)

    def _user_values(self, critic: Tensor, inputs: Tensor, prb_count: Tensor) -> Tensor:
        """Value of every user, shape (seeds, 2, B, n)."""
        seen = torch.cat((inputs, count_input(prb_count, self.slices)), dim=2)
        rows = self.critic_layers.forward(critic, seen)
        return rows.view(prb_count.shape[0], NUM_AGENTS, -1, self.slices.width)

    def _means(self, rows: Tensor) -> Tensor:
        """Means over the users of each slice, shape (seeds, 2, B), from rows (seeds, 2, B, n)."""
        return torch.einsum("sabn,an->sab", rows, self._shares)

    def _values(self, critic: Tensor, inputs: Tensor, prb_count: Tensor) -> Tensor:
        """Q of both agents, shape (seeds, 2, B): the mean of the slice's user values."""
        return self._means(self._user_values(critic, inputs, prb_count))

    def state(self) -> dict[str, Any]:
        """Everything needed to go on, for `load_state`."""
        return {
            "actor": self.actor,
            "critic": self.critic,
            "target_actor": self.target_actor,
            "target_critic": self.target_critic,
            "adam": [
                (adam.mean, adam.square, adam.steps) for adam in (self.actor_adam, self.critic_adam)
            ],
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        self.actor, self.critic = state["actor"], state["critic"]
        self.target_actor, self.target_critic = state["target_actor"], state["target_critic"]
        for adam, saved in zip((self.actor_adam, self.critic_adam), state["adam"], strict=True):
            adam.mean, adam.square, adam.steps = saved


def compose_rewards(
    batch: Transitions, multipliers: NDArray[np.float64], slices: Slices, reward_scale: float
) -> Tensor:
    """Rewards of every user under the multipliers now in force, shape (seeds, 2, B, n)."""
    reward = batch.base_reward.copy()
    priced = batch.constraint * multipliers[:, None, :].astype(np.float32)
    reward[..., : slices.num_urllc] += priced / reward_scale
    rows = slices.split(torch.from_numpy(reward).unsqueeze(-1))
    return rows.squeeze(-1).transpose(1, 2)


def _with_multiplier(batch: Transitions, multipliers: NDArray[np.float64]) -> tuple[Tensor, Tensor]:
    """Features and next features of the batch with the multipliers now in force among them."""
    seen = multiplier_feature(multipliers)[:, None, :]
    for features in (batch.features, batch.next_features):
        features[:, :, : multipliers.shape[1], MULTIPLIER] = seen
    return torch.from_numpy(batch.features), torch.from_numpy(batch.next_features)
