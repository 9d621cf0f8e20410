"""One update of all agents of all seeds: Algorithm 1 of the paper (DDPG, Lillicrap et al. 2016)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from hiersched.learning.algorithm import Losses
from hiersched.learning.divisible_prbs import RELAXATIONS
from hiersched.learning.networks import initial_stack, learner_network
from hiersched.learning.replay_buffer import Transitions
from hiersched.learning.rewards import observe_multipliers, priced_rewards
from hiersched.learning.stack import StackedAdam
from hiersched.scenario.schema import Scenario


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
        self._relaxation = RELAXATIONS[learning.start]
        self.network = learner_network(learning, scenario.users)
        self._critic_layers = self.network.critic(sees_counts=True)
        self._shares = self.network.value_shares()
        self.actor = initial_stack(self.network.actor, "actor", learning.seeds, zero_output=True)
        self.critic = initial_stack(
            self._critic_layers, "critic", learning.seeds, zero_output=False
        )
        self.target_actor = self.actor.clone()
        self.target_critic = self.critic.clone()
        clip = learning.gradient_clip
        self.actor_adam = StackedAdam(self.actor, learning.actor_lr, clip)
        self.critic_adam = StackedAdam(self.critic, learning.critic_lr, clip)

    def act(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Act without noise: a in [-1, 1], shape (seeds, E, U), on features (seeds, E, U, F)."""
        with torch.no_grad():
            inputs = self.network.inputs(torch.from_numpy(features))
            return self._raw_actions(self.actor, inputs, len(features)).tanh().numpy()

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
        features = observe_multipliers(batch.features, multipliers)
        following = observe_multipliers(batch.next_features, multipliers)
        inputs = self.network.inputs(features)
        scale = self._learning.reward_scale
        reward = priced_rewards(batch.base_reward, batch.constraint, multipliers, scale)
        target = self._targets(reward, following)
        critic_loss = self._update_critics(inputs, torch.from_numpy(batch.prb_count), target)
        actor_loss = None
        if self.critic_adam.steps > self._learning.critic_warmup_updates:
            actor_loss = self._update_actors(inputs, features, multipliers)
        self.target_actor.lerp_(self.actor, self._learning.target_rate)
        self.target_critic.lerp_(self.critic, self._learning.target_rate)
        return Losses(critic=critic_loss, actor=actor_loss)

    def _targets(self, reward: Tensor, following: Tensor) -> Tensor:
        """Form r + discount Q'(s', n'), shape (seeds, 2, B, m); truncation never drops Q'."""
        with torch.no_grad():
            inputs = self.network.inputs(following)
            actions = self._raw_actions(self.target_actor, inputs, len(following)).tanh()
            weights = torch.exp(self._learning.weight_exponent * actions)
            shares = self._relaxation(weights, following, self._num_prb)
            value = self._parts(self.target_critic, inputs, shares)
            return self.network.pool(reward) + self._learning.discount * value

    def _update_critics(self, inputs: Tensor, prb_count: Tensor, target: Tensor) -> Tensor:
        critic = self.critic.requires_grad_()
        value = self._parts(critic, inputs, prb_count)
        loss = self._means(smooth_l1_loss(value, target, reduction="none")).mean(-1)
        (gradient,) = torch.autograd.grad(loss.sum(), critic)
        self.critic = critic.detach()
        self.critic_adam.step(self.critic, gradient)
        return loss.detach()

    def _update_actors(
        self, inputs: Tensor, features: Tensor, multipliers: NDArray[np.float64]
    ) -> Tensor:
        """Raise the value of the allocation that the actors' weights would buy.

        An agent's own reward is what its critic predicts. `independent`: an actor raises its own
        critic's value, the other agent's weights held. `cooperative`: both raise the mean of the
        two critics, which is the value of the mean reward, since values are linear in rewards.
        """
        actor = self.actor.requires_grad_()
        raw = self._raw_actions(actor, inputs, len(features))
        log_weights = self._learning.weight_exponent * raw.tanh()
        if self._learning.reward == "cooperative":
            value = self._value(inputs, features, log_weights)
        else:
            value = torch.stack(
                [
                    self._value(inputs, features, own)[:, agent]
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

    def _value(self, inputs: Tensor, features: Tensor, log_weights: Tensor) -> Tensor:
        """Q of both agents, shape (seeds, 2, B), under weights; the floor passes a gradient."""
        floor_slope = self._learning.floor_slope
        shares = self._relaxation(log_weights.exp(), features, self._num_prb, floor_slope)
        return self._means(self._parts(self.critic, inputs, shares))

    def _other_held(self, log_weights: Tensor) -> tuple[Tensor, Tensor]:
        """For each agent the same logarithms, of which only its own pass a gradient."""
        urllc = torch.arange(log_weights.shape[-1]) < self.network.slices.num_urllc
        held = log_weights.detach()
        return torch.where(urllc, log_weights, held), torch.where(urllc, held, log_weights)

    def _raw_actions(self, actor: Tensor, inputs: Tensor, num_seeds: int) -> Tensor:
        """Return the outputs of the actors before tanh, shape (seeds, B, U)."""
        return self.network.raw_actions(self.network.actor.forward(actor, inputs), num_seeds)

    def _parts(self, critic: Tensor, inputs: Tensor, prb_count: Tensor) -> Tensor:
        """Return the values whose weighted sum is Q, shape (seeds, 2, B, m)."""
        seen = torch.cat((inputs, self.network.count_inputs(prb_count)), dim=2)
        return self.network.values(self._critic_layers.forward(critic, seen), len(prb_count))

    def _means(self, parts: Tensor) -> Tensor:
        """Means over the users of each slice, shape (seeds, 2, B), from (seeds, 2, B, m)."""
        return torch.einsum("sabn,an->sab", parts, self._shares)

    def state(self) -> dict[str, Any]:
        """Everything needed to go on, for `load_state`."""
        return {
            "actor": self.actor,
            "critic": self.critic,
            "target_actor": self.target_actor,
            "target_critic": self.target_critic,
            "adam": [self.actor_adam.state(), self.critic_adam.state()],
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Take over what `state` returned."""
        self.actor, self.critic = state["actor"], state["critic"]
        self.target_actor, self.target_critic = state["target_actor"], state["target_critic"]
        for adam, saved in zip((self.actor_adam, self.critic_adam), state["adam"], strict=True):
            adam.load_state(saved)
