"""Evolution strategies on made-up episodes whose best policy is known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hiersched.learning.algorithm import Outcome
from hiersched.learning.es import EvolutionStrategy, centred_ranks

SEEDS, USERS, URLLC, PAIRS, WORLDS = 2, 5, 3, 4, 2
MEMBERS = 2 * PAIRS + 1


def learner_for(scenario, **changes):
    settings = {
        "algorithm": "es",
        "network": "linear",
        "seeds": (1, 2),
        "pairs": PAIRS,
        "num_envs": MEMBERS * WORLDS,
        "actor_lr": 0.05,
    }
    learning = replace(scenario.learning, **{**settings, **changes})
    generators = [np.random.default_rng(seed) for seed in learning.seeds]
    return EvolutionStrategy(replace(scenario, learning=learning), generators)


def outcome_of(features, error_m, served, base_reward=None):
    """An outcome; errors (seeds, E, R) and packets served of eMBB users (seeds, E, 2)."""
    seeds, envs = features.shape[:2]
    packets = np.zeros((seeds * envs, 1, USERS))
    packets[:, 0, URLLC:] = served.reshape(-1, 2)
    record = SimpleNamespace(
        tracking_error_m=error_m.reshape(-1, 1, URLLC),
        backlog_packets=np.zeros_like(packets),
        arrivals_packets=packets,
        service_packets=packets + 7.0,
    )
    return Outcome(
        prb_count=np.ones((seeds, envs, USERS), np.uint32),
        base_reward=np.zeros((seeds, envs, USERS)) if base_reward is None else base_reward,
        constraint=np.zeros((seeds, envs, URLLC)),
        next_features=features,
        record=record,
    )


def test_ranks_by_hand():
    fitness = np.array([[3.0, 1.0, 1.0, -np.inf, 9.0]])[..., None]
    wanted = [0.25, -0.125, -0.125, -0.5, 0.5]
    assert centred_ranks(fitness)[0, :, 0].tolist() == wanted
    assert (centred_ranks(np.zeros((1, 4, 2))) == 0.0).all()


def test_fitness_by_hand(scenario):
    """Errors of 3 and 4 cm in two slots of one world; a member serves 98.5 % of the start."""
    learner = learner_for(scenario, shortfall_price=10.0)
    features = np.zeros((SEEDS, MEMBERS * WORLDS, USERS, 8), np.float32)
    learner.start_round(features)
    served = np.full((SEEDS, MEMBERS, WORLDS, 2), 100.0)
    served[:, 4] = 98.5
    served[:, 5] = 99.6
    served[:, 6] = 200.0
    error = np.full((SEEDS, MEMBERS * WORLDS, URLLC), 0.03)
    shape = SEEDS, MEMBERS * WORLDS, 2
    multipliers = np.zeros((SEEDS, URLLC))
    learner.learn(outcome_of(features, error, served.reshape(shape)), multipliers, last=False)
    error[:, 3 * WORLDS] = 0.04
    learner.learn(outcome_of(features, error, served.reshape(shape)), multipliers, last=False)
    fitness = learner._fitness()
    wanted = np.full((SEEDS, MEMBERS), -np.log(3.0))
    wanted[:, 3] = -np.log((np.sqrt(12.5) + 3.0) / 2)
    wanted[:, 4] -= 10.0 * 0.01
    np.testing.assert_allclose(fitness, np.repeat(wanted[..., None], 2, axis=2))


def test_members_are_mirror_images_in_the_same_worlds_beside_the_start(scenario):
    learner = learner_for(scenario)
    rng = np.random.default_rng(3)
    world = rng.normal(size=(SEEDS, WORLDS, USERS, 8)).astype(np.float32)
    features = np.tile(world, (1, MEMBERS, 1, 1))
    learner.start_round(features)
    raw = np.arctanh(learner.explore(features, 0.0).astype(np.float64))
    raw = raw.reshape(SEEDS, MEMBERS, WORLDS, USERS)
    assert (raw[:, 0] == 0.0).all()
    np.testing.assert_allclose(raw[:, 1 : PAIRS + 1], -raw[:, PAIRS + 1 :], rtol=1e-4)
    assert (np.abs(raw[:, 1:]) > 0.0).all()


def test_one_update_by_hand(scenario):
    """The first step goes down the slope, which is as long as the parameters on average.

    A fifth of it: the rest is momentum for later. The slope is that of ranks over disturbances.
    """
    learner = learner_for(scenario, fitness="reward", reward="independent", gradient_clip=1e9)
    rng = np.random.default_rng(5)
    features = rng.normal(size=(SEEDS, MEMBERS * WORLDS, USERS, 8)).astype(np.float32)
    learner.start_round(features)
    noise = learner._noise.astype(np.float64)
    reward = rng.normal(size=(SEEDS, MEMBERS, WORLDS, USERS))
    none = np.ones((SEEDS, MEMBERS * WORLDS, URLLC))
    outcome = outcome_of(features, none, none[..., :2], reward.reshape(SEEDS, -1, USERS))
    losses = learner.learn(outcome, np.zeros((SEEDS, URLLC)), last=True)
    moved = learner.actor.numpy().reshape(SEEDS, 2, -1)
    for seed in range(SEEDS):
        for agent, users in enumerate((slice(0, URLLC), slice(URLLC, USERS))):
            worth = reward[seed, 1:, :, users].mean((1, 2))
            ranks = np.argsort(np.argsort(worth)) / (2 * PAIRS - 1) - 0.5
            slope = (ranks[:, None] * noise[seed, :, agent]).sum(0)
            step = 0.05 * 0.2 * slope / np.sqrt(np.mean(slope**2))
            np.testing.assert_allclose(moved[seed, agent], step, rtol=1e-4, atol=1e-7)
            assert losses.actor[seed, agent] == pytest.approx(-worth.mean())


def evolve(learner, rounds, rng):
    """Robots err by how far their users' actions are from 0.4 x_0 - 0.3; eMBB by rewards."""
    for _ in range(rounds):
        world = rng.normal(size=(SEEDS, WORLDS, USERS, 8)).astype(np.float32)
        features = np.tile(world, (1, MEMBERS, 1, 1))
        learner.start_round(features)
        for slot in range(2):
            actions = learner.explore(features, 0.0)
            error = np.abs(actions - np.tanh(0.4 * features[..., 0] - 0.3))[..., :URLLC]
            served = np.full((*actions.shape[:2], 2), 50.0)
            outcome = outcome_of(features, 0.001 + error, served)
            learner.learn(outcome, np.zeros((SEEDS, URLLC)), last=slot == 1)


def test_a_policy_that_is_known_is_found_and_found_again(scenario):
    learner = learner_for(scenario, actor_lr=0.02)
    evolve(learner, 250, np.random.default_rng(8))
    parameters = learner.actor.numpy().reshape(SEEDS, 2, 9)
    wanted = np.array([-0.3, 0.4, 0, 0, 0, 0, 0, 0, 0])
    assert np.abs(parameters[:, 0] - wanted).max() < 0.12
    again = learner_for(scenario, actor_lr=0.02)
    evolve(again, 250, np.random.default_rng(8))
    np.testing.assert_array_equal(again.actor.numpy(), learner.actor.numpy())


def test_populations_that_do_not_fill_the_environments_are_refused(scenario):
    with pytest.raises(ValueError, match=r"learning\.num_envs = 16: must be a multiple of 2 \*"):
        learner_for(scenario, num_envs=16)
