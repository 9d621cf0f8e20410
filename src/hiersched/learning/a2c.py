"""Synchronous advantage actor-critic of all agents of all seeds (Mnih et al. 2016).

An action is a = tanh(u), u normal around the actor's output with a spread that falls with training;
tanh is fixed, so the likelihood of u is all that a gradient needs. Advantages are generalised
(Schulman et al. 2016). Episodes end by truncation: the value of the state after the last slot
always counts.

Whose advantage makes a user's action more likely is `learning.advantage`: the mean of its slice
(``slice``); its own, of its own return (``user``); or ``counterfactual``, the value of the actions
that were drawn minus that with the user's own action at its mean (Foerster et al. 2018, COMA). That
value is learnt from the users' returns, by critics that also see the actions as they see features:
a user's own and the means of both slices, or those of all users where the network is flat.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional
from torch.nn.functional import smooth_l1_loss

from hiersched.learning.algorithm import ActorCritic, Losses, Outcome, seeded_normals
from hiersched.learning.networks import initial_stack
from hiersched.learning.rewards import observe_multipliers, priced_rewards
from hiersched.learning.stack import Layers, StackedAdam
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
        learning = self._learning
        if learning.advantage == "counterfactual":
            layers = self._critic_layers
            nobody = torch.zeros(1, 1, scenario.num_users, self.network.num_features)
            more = self._action_inputs(nobody, nobody[..., 0]).shape[2]
            self._action_layers = Layers((layers.sizes[0] + more, *layers.sizes[1:]))
            self.action_critic = initial_stack(
                self._action_layers, "action_critic", learning.seeds, zero_output=False
            )
            self.action_adam = StackedAdam(
                self.action_critic, learning.critic_lr, learning.gradient_clip
            )
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
        without_last = inputs[:, : inputs.shape[1] // (num_slots + 1) * num_slots]
        num_envs = features.shape[1] // (num_slots + 1)
        if learning.advantage == "counterfactual":
            self._update_action_critic(features[:, :-num_envs], target.flatten(2, 3))
        if self.critic_adam.steps > learning.critic_warmup_updates:
            worth = self._worth_of_users(features[:, :-num_envs], advantage.flatten(2, 3))
            actor_loss = self._update_actors(without_last, worth)
        return Losses(critic=loss.detach(), actor=actor_loss)

    def _worth_of_users(self, features: Tensor, advantage: Tensor) -> Tensor:
        """Return what each user's action was worth, (seeds, B, U), of advantages (seeds, 2, B, m).

        `independent`: an agent's own advantage; `cooperative`: the mean of both. A worth is brought
        to mean 0 and spread 1 over the rollout and its agent, so the multiplier needs no division.
        """
        learning = self._learning
        counts = torch.tensor(self._counts)
        if learning.advantage == "slice":
            of_agents = self._together(self._means(advantage))
            spread, mean = torch.std_mean(of_agents, dim=2, keepdim=True, correction=0)
            worth = (of_agents - mean) / (spread + _LEAST_SPREAD)
            return worth.repeat_interleave(counts, dim=1).transpose(1, 2)
        if learning.advantage == "user":
            by_user = self.network.slices.join(advantage.transpose(1, 2))
        else:
            by_user = self._counterfactual(features)
        parts = []
        for part in by_user.split_with_sizes(self._counts, dim=2):
            spread, mean = torch.std_mean(part, dim=(1, 2), keepdim=True, correction=0)
            parts.append((part - mean) / (spread + _LEAST_SPREAD))
        return torch.cat(parts, dim=2)

    @property
    def _counts(self) -> list[int]:
        return [self.network.slices.num_urllc, self.network.slices.num_embb]

    def _together(self, of_agents: Tensor) -> Tensor:
        """Give both agents the mean of what is theirs, (seeds, 2, B), where they cooperate."""
        if self._learning.reward == "cooperative":
            return of_agents.mean(1, keepdim=True).expand_as(of_agents)
        return of_agents

    def _action_inputs(self, features: Tensor, actions: Tensor) -> Tensor:
        """Form what critics see of actions (seeds, B, U): as features, and times each feature.

        The products say in a slice's mean in what state the users are that act.
        """
        return self.network.inputs(
            actions.unsqueeze(-1) * functional.pad(features, (1, 0), value=1.0)
        )

    def _action_values(self, critic: Tensor, features: Tensor, actions: Tensor) -> Tensor:
        """Value the users' returns under actions (seeds, B, U), shape (seeds, 2, B, m)."""
        parts = self.network.inputs(features), self._action_inputs(features, actions)
        seen = torch.cat(parts, dim=2)
        return self.network.values(self._action_layers.forward(critic, seen), len(actions))

    def _drawn_actions(self) -> Tensor:
        return torch.from_numpy(_side_by_side(self._drawn)).tanh()

    def _update_action_critic(self, features: Tensor, target: Tensor) -> None:
        """One step of the critics that see actions towards the users' returns."""
        critic = self.action_critic.detach().requires_grad_()
        value = self._action_values(critic, features, self._drawn_actions())
        loss = self._means(smooth_l1_loss(value, target, reduction="none")).mean(2)
        self.action_adam.descend(critic, loss.sum())

    def _counterfactual(self, features: Tensor) -> Tensor:
        """Value of the actions drawn minus that with one user's at its mean, (seeds, B, U)."""
        with torch.no_grad():
            drawn = self._drawn_actions()
            mean = self._raw_actions(self.actor, self.network.inputs(features)).tanh()
            users = torch.repeat_interleave(torch.arange(2), torch.tensor(self._counts))

            def value_of(actions: Tensor) -> Tensor:
                return self._together(
                    self._means(self._action_values(self.action_critic, features, actions))
                )

            executed, differences = value_of(drawn), []
            for user, agent in enumerate(users.tolist()):
                other = drawn.clone()
                other[..., user] = mean[..., user]
                differences.append((executed - value_of(other))[:, agent])
            return torch.stack(differences, dim=2)

    def state(self) -> dict[str, Any]:
        """As in `Algorithm`, when no rollout is under way."""
        state = super().state()
        if self._learning.advantage == "counterfactual":
            state["action"] = [self.action_critic, self.action_adam.state()]
        return state

    def load_state(self, state: dict[str, Any]) -> None:
        """As in `Algorithm`."""
        super().load_state(state)
        if self._learning.advantage == "counterfactual":
            self.action_critic, adam = state["action"]
            self.action_adam.load_state(adam)

    def _update_actors(self, inputs: Tensor, by_user: Tensor) -> Tensor:
        """Make the actions drawn more likely where their worth (seeds, B, U) is positive."""
        drawn = torch.from_numpy(_side_by_side(self._drawn))
        actor = self.actor.detach().requires_grad_()
        raw = self._raw_actions(actor, inputs)
        unlikeliness = 0.5 * ((drawn - raw) / float(self._noise_spread)).square()
        by_agent = (by_user * unlikeliness).split_with_sizes(self._counts, dim=2)
        loss = torch.stack([part.sum(2).mean(1) for part in by_agent], dim=1)
        penalty = self._learning.action_penalty * raw.square().mean((1, 2))
        self.actor_adam.descend(actor, loss.sum() + penalty.sum())
        return loss.detach()


def _side_by_side(slots: list[NDArray[Any]]) -> NDArray[np.float32]:
    """One batch (seeds, T * E, ...) in float32 of T slots (seeds, E, ...)."""
    return np.concatenate(slots, axis=1, dtype=np.float32, casting="same_kind")
