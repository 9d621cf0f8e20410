"""Evolution strategies of both actors of all seeds (Salimans et al. 2017).

A round is a generation. `learning.pairs` times a disturbance of all parameters is drawn, and actors
that are moved by it one way and the other run an episode in each world of the round, beside the
scheduler `learning.start`, which does not move. The worlds are functions of their keys, so all of
them meet the same fading and arrivals: common random numbers.

The fitness of a member with `learning.fitness` = ``tracking`` is

    -ln(E / 1 cm) - p max(0, 0.99 - S / S0),

E the root mean square of the robots' tracking errors over an episode, as a geometric mean over
worlds, S the packets of eMBB users that met their deadlines in all worlds, S0 those under the
start, p `learning.shortfall_price`. Packets that are served late do not count: a fitness of the
throughput alone makes all video late, up to where none is lost. With ``reward`` it is the mean of
the rewards as they are logged, over slots and worlds: the agent's own, or the mean of both where
`learning.reward` is cooperative. Ranks take the place of fitnesses.
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

from hiersched.learning.algorithm import Algorithm, Losses, seeded_normals
from hiersched.learning.networks import NUM_AGENTS
from hiersched.models.model import Setup
from hiersched.policies.learned import NetworkWords, network_words
from hiersched.policies.policy import Weigher
from hiersched.scenario.schema import Learning, Scenario, Users, worlds_per_round
from hiersched.simulator import SlotRecord

_TIMELY_SHARE = 0.99
"""Of what the start serves of eMBB in time: what a policy may fall to without a price."""
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


class Population(Weigher):
    """Policies of a learner side by side, each in as many worlds as the others.

    Their parameters, shape (M, 2, P), change from episode to episode; those of a compiled policy
    change in place.
    """

    def __init__(self, learning: Learning, users: Users) -> None:
        self.rule, self.weighs = learning.start, learning.weighs
        self.parameters = np.empty((0, NUM_AGENTS, 0), np.float32)
        self._learning, self._users = learning, users
        self._words: tuple[NetworkWords, Setup] | None = None

    def words(self, setup: Setup) -> NetworkWords:
        """As in `Weigher`."""
        learning, users = self._learning, self._users
        words = network_words(
            self.parameters,
            learning.network,
            () if learning.network == "linear" else learning.hidden,
            observe_robots=learning.observe_robots,
            observe_demand=learning.observe_demand,
            weight_exponent=learning.weight_exponent,
            num_urllc=users.num_urllc,
            num_embb=users.num_embb,
        )._replace(envs_per_policy=setup.num_envs // len(self.parameters))
        if self._words is None:
            self._words = words, setup
        return words

    def become(self, parameters: NDArray[np.float32]) -> None:
        """Take over other parameters, shape (M, 2, P), M as before."""
        self.parameters = parameters
        if self._words is None:
            return
        words, setup = self._words
        for old, new in zip(words, self.words(setup), strict=True):
            if isinstance(old, np.ndarray):
                old[...] = new


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
        self._explorers = Population(learning, scenario.users)
        self._centres = Population(learning, scenario.users)

    def population(self, *, explores: bool) -> Population:
        """As in `Algorithm`: beside the start all members, or the centre of each seed alone.

        Half of the disturbances are the others' mirror images. The members of a seed stand in
        their order, the start first.
        """
        learning, num_seeds = self._learning, len(self._generators)
        centre = self.actor.numpy().reshape(num_seeds, 1, NUM_AGENTS, -1)
        if not explores:
            self._centres.become(centre[:, 0])
            return self._centres
        one_way = seeded_normals(
            self._generators, (learning.pairs, NUM_AGENTS, self.actor.shape[1])
        )
        self._noise = np.concatenate((one_way, -one_way), axis=1)  # (seeds, 2 pairs, 2, P)
        members = centre + np.float32(learning.perturbation_std) * self._noise
        everyone = np.concatenate((np.zeros_like(centre), members), axis=1)
        self._explorers.become(everyone.reshape(-1, *everyone.shape[2:]))
        self._slots = 0
        self._square_error = np.zeros((num_seeds, self._members, self._worlds))
        self._timely = np.zeros((num_seeds, self._members))
        self._reward = np.zeros((num_seeds, self._members, NUM_AGENTS))
        return self._explorers

    def watch(self, record: SlotRecord) -> None:
        """As in `Algorithm`: add up what members are judged by."""
        embb = np.s_[:, :, self._num_urllc :]
        self._slots += record.reward_urllc.shape[1]
        error_cm = 100.0 * record.tracking_error_m
        square = (error_cm**2).mean(2).sum(1)  # of a slot: over robots
        self._square_error += square.reshape(self._square_error.shape)
        timely = record.due_packets[embb] - record.late_packets[embb]
        self._timely += timely.reshape(*self._timely.shape, -1).sum(2)
        rewards = np.stack((record.reward_urllc, record.reward_embb), axis=-1)
        self._reward += rewards.sum(1).reshape(*self._timely.shape, -1, NUM_AGENTS).mean(2)

    def _fitness(self) -> NDArray[np.float64]:
        """Fitness of every member for both agents, shape (seeds, M, 2), the start the first."""
        if self._learning.fitness == "reward":
            reward = self._reward / self._slots
            if self._learning.reward == "cooperative":
                reward[:] = reward.mean(-1, keepdims=True)
            return reward
        error_cm = np.maximum(np.sqrt(self._square_error / self._slots), _LEAST_ERROR_CM)
        share = self._timely / np.maximum(self._timely[:, :1], 1.0)
        shortfall = np.maximum(0.0, _TIMELY_SHARE - share)
        fitness = -np.log(error_cm).mean(2) - self._learning.shortfall_price * shortfall
        return np.repeat(fitness[..., None], NUM_AGENTS, axis=2)

    def finish_round(self, done: float) -> Losses:
        """As in `Algorithm`: move along the mean of the disturbances, weighted by their ranks."""
        fitness = self._fitness()[:, 1:]
        ranks = centred_ranks(fitness).astype(np.float32)
        scale = -1.0 / (self._noise.shape[1] * self._learning.perturbation_std)
        descent = scale * np.einsum("sma,smap->sap", ranks, self._noise)
        self._step(torch.from_numpy(descent.astype(np.float32)).flatten(0, 1), 1.0 - done)
        return Losses(critic=None, actor=torch.from_numpy(-fitness.mean(1)))

    def _step(self, gradient: Tensor, share: float) -> None:
        """Move the actors, shape (S 2, P), against a gradient by a share of the rate, in place."""
        self._mean.lerp_(gradient, 1.0 - _MOMENTUM)
        square = gradient.square().mean(1, keepdim=True)
        first = self._square == 0.0
        self._square = torch.where(first, square, self._square.lerp(square, 1.0 - _SQUARE_DECAY))
        rate = self._learning.actor_lr * share
        self.actor -= rate * self._mean / self._square.sqrt().clamp(min=_LEAST_SCALE)

    def state(self) -> dict[str, Any]:
        """As in `Algorithm`, between two rounds."""
        return {"actor": self.actor, "mean": self._mean, "square": self._square}

    def load_state(self, state: dict[str, Any]) -> None:
        """As in `Algorithm`."""
        self.actor = state["actor"]
        self._mean, self._square = state["mean"], state["square"]
