"""Synchronous advantage actor-critic of all agents of all seeds (Mnih et al. 2016).

An action is a = tanh(u), u normal around the actor's output with a spread that falls with training;
tanh is fixed, so the likelihood of u is all that a gradient needs. Advantages are generalised
(Schulman et al. 2016). Episodes end by truncation: the value of the state after the last slot
always counts.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from hiersched.learning.algorithm import ActorCritic, Losses, Outcome, seeded_normals
from hiersched.learning.rewards import observe_multipliers, priced_rewards
from hiersched.scenario.schema import Scenario

_LEAST_SPREAD = 1e-6
"""Of the advantages of a batch, when they are brought to the spread 1."""


def advantages(rewards: Tensor, values: Tensor, discount: float, decay: float) -> Tensor:
    """Generalised advantages, A_t = r_t + g V_{t+1} - V_t + g l A_{t+1}.

    Rewards have shape (seeds, 2, T, E, m), values T + 1 slots: the last is that of the state after
    the rollout. g is the discount, l the decay.
    """
    errors = rewards + discount * values[:, :, 1:] - values[:, :, :-1]
    result = torch.empty_like(errors)
    following = torch.zeros_like(errors[:, :, 0])
    for slot in range(errors.shape[2] - 1, -1, -1):
        following = errors[:, :, slot] + discount * decay * following
        result[:, :, slot] = following
    return result


class A2c(ActorCritic):
    """One update of all agents a rollout of a few slots in all environments."""

    def __init__(self, scenario: Scenario, generators: list[np.random.Generator]) -> None:
        super().__init__(scenario, generators, sees_counts=False)
        self._features: list[NDArray[np.float32]] = []
        self._drawn: list[NDArray[np.float32]] = []
        self._outcomes: list[Outcome] = []
        self._noise_spread = self._spread(0.0)

    def start_round(self, features: NDArray[np.float32]) -> None:
        """As in `Algorithm`; every rollout has been learnt from by the end of the last round."""
        self._features = [features]

    def act(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """As in `Algorithm`."""
        actions: NDArray[np.float32] = np.tanh(self._means_of_actions(features).numpy())
        return actions

    def explore(self, features: NDArray[np.float32], done: float) -> NDArray[np.float32]:
        """As in `Algorithm`; the spread changes between rollouts only."""
        if not self._outcomes:
            self._noise_spread = self._spread(done)
        mean = self._means_of_actions(features).numpy()
        drawn = mean + self._noise_spread * seeded_normals(self._generators, mean.shape[1:])
        self._drawn.append(drawn)
        actions: NDArray[np.float32] = np.tanh(drawn)
        return actions

    def learn(
        self, outcome: Outcome, multipliers: NDArray[np.float64], *, last: bool
    ) -> Losses | None:
        """As in `Algorithm`: update when the rollout is full or the episodes end."""
        self._outcomes.append(outcome)
        self._features.append(outcome.next_features)
        if len(self._outcomes) < self._learning.rollout_slots and not last:
            return None
        losses = self._update(multipliers)
        self._features = self._features[-1:]
        self._drawn, self._outcomes = [], []
        return losses

    def _update(self, multipliers: NDArray[np.float64]) -> Losses:
        """One step of every critic and every actor on the rollout."""
        learning, num_slots = self._learning, len(self._outcomes)
        features = observe_multipliers(_side_by_side(self._features), multipliers)
        inputs = self.network.inputs(features)
        reward = self.network.pool(
            priced_rewards(
                _side_by_side([outcome.base_reward for outcome in self._outcomes]),
                _side_by_side([outcome.constraint for outcome in self._outcomes]),
                multipliers,
                learning.reward_scale,
            )
        )
        reward = reward.view(*reward.shape[:2], num_slots, -1, reward.shape[3])
        critic = self.critic.detach().requires_grad_()
        value = self.network.values(self._critic_layers.forward(critic, inputs), len(multipliers))
        value = value.view(*value.shape[:2], num_slots + 1, -1, value.shape[3])
        with torch.no_grad():
            advantage = advantages(reward, value, learning.discount, learning.gae_decay)
            target = advantage + value[:, :, :-1]
        loss = self._means(smooth_l1_loss(value[:, :, :-1], target, reduction="none")).mean((2, 3))
        self.critic_adam.descend(critic, loss.sum())
        actor_loss = None
        if self.critic_adam.steps > learning.critic_warmup_updates:
            without_last = inputs[:, : inputs.shape[1] // (num_slots + 1) * num_slots]
            actor_loss = self._update_actors(without_last, self._means(advantage).flatten(2))
        return Losses(critic=loss.detach(), actor=actor_loss)

    def _update_actors(self, inputs: Tensor, advantage: Tensor) -> Tensor:
        """Make the actions drawn more likely where the advantage (seeds, 2, B) is positive.

        `independent`: an agent's own advantage; `cooperative`: the mean of both. An advantage is
        brought to mean 0 and spread 1 over the rollout, so the multiplier needs no division.
        """
        if self._learning.reward == "cooperative":
            advantage = advantage.mean(1, keepdim=True).expand_as(advantage)
        spread, mean = torch.std_mean(advantage, dim=2, keepdim=True, correction=0)
        worth = (advantage - mean) / (spread + _LEAST_SPREAD)
        slices = self.network.slices
        counts = torch.tensor((slices.num_urllc, slices.num_embb))
        by_user = worth.repeat_interleave(counts, dim=1).transpose(1, 2)
        drawn = torch.from_numpy(_side_by_side(self._drawn))
        actor = self.actor.detach().requires_grad_()
        raw = self._raw_actions(actor, inputs)
        unlikeliness = 0.5 * ((drawn - raw) / float(self._noise_spread)).square()
        by_agent = (by_user * unlikeliness).split_with_sizes(counts.tolist(), dim=2)
        loss = torch.stack([part.sum(2).mean(1) for part in by_agent], dim=1)
        penalty = self._learning.action_penalty * raw.square().mean((1, 2))
        self.actor_adam.descend(actor, loss.sum() + penalty.sum())
        return loss.detach()


def _side_by_side(slots: list[NDArray[Any]]) -> NDArray[np.float32]:
    """One batch (seeds, T * E, ...) in float32 of T slots (seeds, E, ...)."""
    return np.concatenate(slots, axis=1, dtype=np.float32, casting="same_kind")
