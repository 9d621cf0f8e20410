"""Algorithm 1 of the paper: DDPG of all agents of all seeds (Lillicrap et al. 2016)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import smooth_l1_loss

from hiersched.learning.algorithm import ActorCritic, Losses, Outcome, seeded_normals
from hiersched.learning.divisible_prbs import RELAXATIONS
from hiersched.learning.replay_buffer import ReplayBuffer, Transitions
from hiersched.learning.rewards import observe_multipliers, priced_rewards
from hiersched.scenario.schema import Scenario


class Ddpg(ActorCritic):
    """Noise on the action, a replay buffer, one update of all agents a slot."""

    _STACKS = ("actor", "critic", "target_actor", "target_critic")

    def __init__(self, scenario: Scenario, generators: list[np.random.Generator]) -> None:
        super().__init__(scenario, generators, sees_counts=True)
        learning = scenario.learning
        self._num_prb = scenario.radio.num_prb
        self._relaxation = RELAXATIONS[learning.start]
        self.target_actor, self.target_critic = self.actor.clone(), self.critic.clone()
        round_size = learning.num_envs * learning.slots_per_episode
        num_rounds = learning.episodes // learning.num_envs
        self.replay = ReplayBuffer(
            len(learning.seeds),
            learning.num_envs,
            learning.slots_per_episode,
            max(1, min(learning.replay_capacity // round_size, num_rounds)),
            scenario.users.num_urllc,
            (scenario.num_users, self.network.num_features),
        )

    def start_round(self, features: NDArray[np.float32]) -> None:
        """As in `Algorithm`."""
        self.replay.start_round(features)

    def act(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """As in `Algorithm`."""
        return self._means_of_actions(features).tanh().numpy()

    def explore(self, features: NDArray[np.float32], done: float) -> NDArray[np.float32]:
        """As in `Algorithm`."""
        actions = self.act(features)
        noise = seeded_normals(self._generators, actions.shape[1:])
        return np.clip(actions + self._spread(done) * noise, -1.0, 1.0)

    def learn(
        self, outcome: Outcome, multipliers: NDArray[np.float64], *, last: bool
    ) -> Losses | None:
        """As in `Algorithm`."""
        learning = self._learning
        self.replay.add(outcome)
        if len(self.replay) < max(learning.warmup_slots * learning.num_envs, learning.batch_size):
            return None
        batch = self.replay.sample(learning.batch_size, self._generators)
        return self.update(batch, multipliers)

    def update(self, batch: Transitions, multipliers: NDArray[np.float64]) -> Losses:
        """One step of every critic and every actor, then of the targets.

        Rewards and features of the batch are formed with the multipliers now in force, shape
        (seeds, R).
        """
        learning = self._learning
        features = observe_multipliers(batch.features, multipliers)
        following = observe_multipliers(batch.next_features, multipliers)
        inputs = self.network.inputs(features)
        reward = priced_rewards(
            batch.base_reward, batch.constraint, multipliers, learning.reward_scale
        )
        target = self._targets(reward, following)
        critic_loss = self._update_critics(inputs, torch.from_numpy(batch.prb_count), target)
        actor_loss = None
        if self.critic_adam.steps > learning.critic_warmup_updates:
            actor_loss = self._update_actors(inputs, features, multipliers)
        self.target_actor.lerp_(self.actor, learning.target_rate)
        self.target_critic.lerp_(self.critic, learning.target_rate)
        return Losses(critic=critic_loss, actor=actor_loss)

    def _targets(self, reward: Tensor, following: Tensor) -> Tensor:
        """Form r + discount Q'(s', n'), shape (seeds, 2, B, m); truncation never drops Q'."""
        with torch.no_grad():
            inputs = self.network.inputs(following)
            actions = self._raw_actions(self.target_actor, inputs).tanh()
            weights = torch.exp(self._learning.weight_exponent * actions)
            shares = self._relaxation(weights, following, self._num_prb)
            value = self._parts(self.target_critic, inputs, shares)
            return self.network.pool(reward) + self._learning.discount * value

    def _update_critics(self, inputs: Tensor, prb_count: Tensor, target: Tensor) -> Tensor:
        critic = self.critic.detach().requires_grad_()
        value = self._parts(critic, inputs, prb_count)
        loss = self._means(smooth_l1_loss(value, target, reduction="none")).mean(-1)
        self.critic_adam.descend(critic, loss.sum())
        return loss.detach()

    def _update_actors(
        self, inputs: Tensor, features: Tensor, multipliers: NDArray[np.float64]
    ) -> Tensor:
        """Raise the value of the allocation that the actors' weights would buy.

        An agent's own reward is what its critic predicts. `independent`: an actor raises its own
        critic's value, the other agent's weights held. `cooperative`: both raise the mean of the
        two critics, which is the value of the mean reward, since values are linear in rewards.
        """
        actor = self.actor.detach().requires_grad_()
        raw = self._raw_actions(actor, inputs)
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
        self.actor_adam.descend(actor, (loss.sum(-1) / price + penalty).sum())
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

    def _parts(self, critic: Tensor, inputs: Tensor, prb_count: Tensor) -> Tensor:
        """Return the values whose weighted sum is Q, shape (seeds, 2, B, m)."""
        seen = torch.cat((inputs, self.network.count_inputs(prb_count)), dim=2)
        return self.network.values(self._critic_layers.forward(critic, seen), len(prb_count))

    def state(self) -> dict[str, Any]:
        """As in `Algorithm`."""
        return super().state() | {"replay": self.replay.state()}

    def load_state(self, state: dict[str, Any]) -> None:
        """As in `Algorithm`."""
        super().load_state(state)
        self.replay.load_state(state["replay"])
