"""Evolution strategies of both actors of all seeds (Salimans et al. 2017).

A round is a generation. `learning.pairs` times a disturbance of all parameters is drawn, and actors
that are moved by it one way and the other run an episode in each world of the round, beside the
scheduler `learning.start`, which does not move. The worlds are functions of their keys, so all of
them meet the same fading and arrivals: common random numbers.

The fitness of a member with `learning.fitness` = ``tracking`` is

    -ln(E / 1 cm) - p max(0, 0.995 - S / S0),

E the root mean square of a robot's tracking error over the episode, averaged over robots and
worlds, S the packets of eMBB users that were served in all worlds, S0 those under the start, p
`learning.shortfall_price`. With ``reward`` it is the mean reward over slots and worlds: the agent's
own, or the mean of both where `learning.reward` is cooperative. Ranks take the place of fitnesses.
The step is momentum over the running root mean square of all of an actor's gradient, times
`learning.actor_lr`, which falls to 0 over the training: a step by parameter, such as Adam's, goes
as far where there is nothing but noise as where there is a slope, and a constant one never settles.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hiersched.learning.algorithm import Algorithm, Losses, Outcome, seeded_normals
from hiersched.learning.networks import NUM_AGENTS
from hiersched.learning.rewards import priced_rewards
from hiersched.scenario.schema import Scenario, worlds_per_round

_SERVED_SHARE = 0.995
"""Of what the start serves of eMBB: what a policy may fall to without a price."""
_MOMENTUM, _SQUARE_DECAY = 0.8, 0.9
_LEAST_SCALE = 1e-12
_LEAST_ERROR_CM = 1e-6
"""Taken for an error below it: robots that rest on their reference have a fitness too."""


def centred_ranks(fitness: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ranks from -1/2 to 1/2 along axis 1, shape (S, M, A); equals share the mean of theirs."""
    one, other = fitness[:, :, None], fitness[:, None]
    below = (other < one).sum(2) + 0.5 * ((other == one).sum(2) - 1)
    ranks: NDArray[np.float64] = below / (fitness.shape[1] - 1) - 0.5
    return ranks


class EvolutionStrategy(Algorithm):
    """One update of all actors a round."""

    def __init__(self, scenario: Scenario, generators: list[np.random.Generator]) -> None:
        super().__init__(scenario, generators)
        learning = self._learning
        self._num_urllc = scenario.users.num_urllc
        self._members = 2 * learning.pairs + 1
        if learning.num_envs % self._members:
            raise ValueError(
                f"learning.num_envs = {learning.num_envs}: must be a multiple of 2 * "
                f"learning.pairs + 1 = {self._members}"
            )
        self._worlds = worlds_per_round(learning)
        self._mean = torch.zeros_like(self.actor)
        self._square = torch.zeros_like(self.actor[:, :1])
        self._done = 0.0

    def start_round(self, features: NDArray[np.float32]) -> None:
        """As in `Algorithm`: draw the disturbances, half of which are the others' mirror images."""
        learning, num_seeds = self._learning, len(features)
        one_way = seeded_normals(
            self._generators, (learning.pairs, NUM_AGENTS, self.actor.shape[1])
        )
        self._noise = np.concatenate((one_way, -one_way), axis=1)  # (seeds, 2 pairs, 2, P)
        centre = self.actor.view(num_seeds, 1, NUM_AGENTS, -1)
        noise = learning.perturbation_std * torch.from_numpy(self._noise)
        self._population = (centre + noise).flatten(0, 2)
        self._slots = 0
        self._square_error = np.zeros((num_seeds, self._members, self._worlds, self._num_urllc))
        self._served = np.zeros((num_seeds, self._members))
        self._reward = np.zeros((num_seeds, self._members, NUM_AGENTS))

    def act(self, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """As in `Algorithm`."""
        return self._actions(self.actor, features)

    def explore(self, features: NDArray[np.float32], done: float) -> NDArray[np.float32]:
        """As in `Algorithm`: each member acts in its environments, the start in the first ones."""
        self._done = done
        num_seeds, _, num_users, _ = features.shape
        mine = features[:, self._worlds :].reshape(-1, self._worlds, *features.shape[2:])
        actions = self._actions(self._population, mine).reshape(num_seeds, -1, num_users)
        start = np.zeros((num_seeds, self._worlds, num_users), np.float32)
        return np.concatenate((start, actions), axis=1)

    def _actions(self, actors: Tensor, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """Actions (S, B, U) of S policies; tanh in double, as compiled policies form it."""
        with torch.no_grad():
            inputs = self.network.inputs(torch.from_numpy(features))
            outputs = self.network.actor_outputs(actors, inputs)
            raw = self.network.raw_actions(outputs, len(features)).numpy()
        return np.tanh(raw.astype(np.float64)).astype(np.float32)

    def learn(
        self, outcome: Outcome, multipliers: NDArray[np.float64], *, last: bool
    ) -> Losses | None:
        """As in `Algorithm`: update when the episodes end."""
        self._slots += 1
        record, num_urllc = outcome.record, self._num_urllc
        error_cm = 100.0 * record.tracking_error_m[:, 0]
        self._square_error += (error_cm**2).reshape(self._square_error.shape)
        there = record.backlog_packets[:, 0, num_urllc:] + record.arrivals_packets[:, 0, num_urllc:]
        served = np.minimum(record.service_packets[:, 0, num_urllc:], there).sum(1)
        self._served += served.reshape(*self._served.shape, -1).sum(2)
        if self._learning.fitness == "reward":
            self._add_rewards(outcome, multipliers)
        return self._update() if last else None

    def _add_rewards(self, outcome: Outcome, multipliers: NDArray[np.float64]) -> None:
        """Add a slot's rewards of both agents, averaged over a member's worlds."""
        rewards = priced_rewards(
            outcome.base_reward.astype(np.float32),
            outcome.constraint.astype(np.float32),
            multipliers,
            self._learning.reward_scale,
        ).numpy()
        slices = rewards[..., : self._num_urllc], rewards[..., self._num_urllc :]
        means = np.stack([part.mean(-1, dtype=np.float64) for part in slices], axis=-1)
        if self._learning.reward == "cooperative":
            means[:] = means.mean(-1, keepdims=True)
        self._reward += means.reshape(*self._served.shape, -1, NUM_AGENTS).mean(2)

    def _fitness(self) -> NDArray[np.float64]:
        """Fitness of every member for both agents, shape (seeds, M, 2), the start the first."""
        if self._learning.fitness == "reward":
            return self._reward / self._slots
        error_cm = np.sqrt(self._square_error / self._slots).mean((2, 3))
        share = self._served / np.maximum(self._served[:, :1], 1.0)
        shortfall = np.maximum(0.0, _SERVED_SHARE - share)
        error_cm = np.maximum(error_cm, _LEAST_ERROR_CM)
        fitness = -np.log(error_cm) - self._learning.shortfall_price * shortfall
        return np.repeat(fitness[..., None], NUM_AGENTS, axis=2)

    def _update(self) -> Losses:
        """Move the actors along the mean of the disturbances, weighted by the members' ranks."""
        fitness = self._fitness()[:, 1:]
        ranks = centred_ranks(fitness).astype(np.float32)
        scale = -1.0 / (self._noise.shape[1] * self._learning.perturbation_std)
        descent = scale * np.einsum("sma,smap->sap", ranks, self._noise)
        self._step(torch.from_numpy(descent.astype(np.float32)).flatten(0, 1))
        return Losses(critic=None, actor=torch.from_numpy(-fitness.mean(1)))

    def _step(self, gradient: Tensor) -> None:
        """Move the actors, shape (S 2, P), against a gradient, in place."""
        self._mean.lerp_(gradient, 1.0 - _MOMENTUM)
        square = gradient.square().mean(1, keepdim=True)
        first = self._square == 0.0
        self._square = torch.where(first, square, self._square.lerp(square, 1.0 - _SQUARE_DECAY))
        rate = self._learning.actor_lr * (1.0 - self._done)
        self.actor -= rate * self._mean / self._square.sqrt().clamp(min=_LEAST_SCALE)

    def state(self) -> dict[str, Any]:
        """As in `Algorithm`, between two rounds."""
        return {"actor": self.actor, "mean": self._mean, "square": self._square}

    def load_state(self, state: dict[str, Any]) -> None:
        """As in `Algorithm`."""
        self.actor = state["actor"]
        self._mean, self._square = state["mean"], state["square"]
