"""Evolution strategies on made-up episodes whose best policy is known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hiersched.learning.es import EvolutionStrategy, centred_ranks

SEEDS, USERS, URLLC, PAIRS, WORLDS, FEATURES = 2, 5, 3, 4, 2, 8
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


def record_of(error_m, served, reward=None):
    """Slots with errors (seeds, E, T, R), timely packets of eMBB users (seeds, E, T, 2), rewards.

    Rewards are (2, seeds, E, T), of the URLLC and the eMBB agent.
    """
    envs, slots = np.prod(error_m.shape[:2]), error_m.shape[2]
    due, late = np.zeros((2, envs, slots, USERS))
    late[:, :, URLLC:] = 7.0
    due[:, :, URLLC:] = served.reshape(envs, slots, 2) + 7.0
    reward = np.zeros((2, envs, slots)) if reward is None else reward.reshape(2, envs, slots)
    return SimpleNamespace(
        tracking_error_m=error_m.reshape(envs, slots, URLLC),
        due_packets=due,
        late_packets=late,
        reward_urllc=reward[0],
        reward_embb=reward[1],
    )


def test_ranks_by_hand():
    fitness = np.array([[3.0, 1.0, 1.0, -np.inf, 9.0]])[..., None]
    wanted = [0.25, -0.125, -0.125, -0.5, 0.5]
    assert centred_ranks(fitness)[0, :, 0].tolist() == wanted
    assert (centred_ranks(np.zeros((1, 4, 2))) == 0.0).all()


def test_fitness_by_hand(scenario):
    """Errors of 3 and 4 cm in two slots of one world; a member serves 98 % of the start in time."""
    learner = learner_for(scenario, shortfall_price=10.0)
    learner.population(explores=True)
    served = np.full((SEEDS, MEMBERS, WORLDS, 2), 100.0)
    served[:, 4] = 98.0
    served[:, 5] = 99.1
    served[:, 6] = 200.0
    error = np.full((SEEDS, MEMBERS * WORLDS, 1, URLLC), 0.03)
    shape = SEEDS, MEMBERS * WORLDS, 1, 2
    learner.watch(record_of(error, served.reshape(shape)))
    error[:, 3 * WORLDS] = 0.04
    learner.watch(record_of(error, served.reshape(shape)))
    fitness = learner._fitness()
    wanted = np.full((SEEDS, MEMBERS), -np.log(3.0))
    wanted[:, 3] = -0.5 * (np.log(np.sqrt(12.5)) + np.log(3.0))
    wanted[:, 4] -= 10.0 * 0.01
    np.testing.assert_allclose(fitness, np.repeat(wanted[..., None], 2, axis=2))


def test_slots_may_come_one_by_one_or_together(scenario):
    rng = np.random.default_rng(2)
    error = rng.random((SEEDS, MEMBERS * WORLDS, 6, URLLC))
    served = rng.random((SEEDS, MEMBERS * WORLDS, 6, 2))
    rewards = rng.random((2, SEEDS, MEMBERS * WORLDS, 6))
    for fitness in ("tracking", "reward"):
        found = []
        for size in (1, 2, 6):
            learner = learner_for(scenario, fitness=fitness)
            learner.population(explores=True)
            for first in range(0, 6, size):
                part = np.s_[:, :, first : first + size]
                own = rewards[..., first : first + size]
                learner.watch(record_of(error[part], served[part], own))
            found.append(learner._fitness())
        np.testing.assert_allclose(found[1], found[0], rtol=1e-12)
        np.testing.assert_allclose(found[2], found[0], rtol=1e-12)


def test_members_are_mirror_images_beside_the_start_and_centres_stand_alone(scenario):
    learner = learner_for(scenario)
    centre = np.random.default_rng(4).normal(size=learner.actor.shape).astype(np.float32)
    learner.actor[:] = learner.actor.new_tensor(centre)
    centre = centre.reshape(SEEDS, 2, -1)
    members = learner.population(explores=True).parameters.reshape(SEEDS, MEMBERS, 2, -1)
    assert (members[:, 0] == 0.0).all()
    moved = members[:, 1:] - centre[:, None]
    np.testing.assert_allclose(moved[:, :PAIRS], -moved[:, PAIRS:], atol=1e-6)
    assert (np.abs(moved) > 0.0).all()
    assert not np.array_equal(moved[0], moved[1])
    np.testing.assert_array_equal(learner.population(explores=False).parameters, centre)


def test_one_update_by_hand(scenario):
    """The first step goes down the slope, which is as long as the parameters on average.

    A fifth of it: the rest is momentum for later; and at half of the training half the rate. The
    slope is that of ranks over disturbances.
    """
    learner = learner_for(scenario, fitness="reward", reward="independent", gradient_clip=1e9)
    rng = np.random.default_rng(5)
    learner.population(explores=True)
    noise = learner._noise.astype(np.float64)
    reward = rng.normal(size=(2, SEEDS, MEMBERS, WORLDS, 3))
    none = np.ones((SEEDS, MEMBERS * WORLDS, 3, URLLC))
    learner.watch(record_of(none, none[..., :2], reward))
    losses = learner.finish_round(0.5)
    moved = learner.actor.numpy().reshape(SEEDS, 2, -1)
    for seed in range(SEEDS):
        for agent in range(2):
            worth = reward[agent, seed, 1:].mean((1, 2))
            ranks = np.argsort(np.argsort(worth)) / (2 * PAIRS - 1) - 0.5
            slope = (ranks[:, None] * noise[seed, :, agent]).sum(0)
            step = 0.5 * 0.05 * 0.2 * slope / np.sqrt(np.mean(slope**2))
            np.testing.assert_allclose(moved[seed, agent], step, rtol=1e-4, atol=1e-7)
            assert losses.actor[seed, agent] == pytest.approx(-worth.mean())


def evolve(learner, rounds, rng):
    """Robots err by how far their users' actions are from 0.4 x_0 - 0.3; eMBB does not matter."""
    for _ in range(rounds):
        world = rng.normal(size=(WORLDS, URLLC, FEATURES))
        actors = learner.population(explores=True).parameters[:, 0].astype(np.float64)
        actions = np.tanh(np.einsum("wrf,mf->mwr", world, actors[:, 1:]) + actors[:, :1, None])
        error = 0.001 + np.abs(actions - np.tanh(0.4 * world[..., 0] - 0.3))
        served = np.full((SEEDS, MEMBERS * WORLDS, 1, 2), 50.0)
        learner.watch(record_of(error.reshape(SEEDS, MEMBERS * WORLDS, 1, URLLC), served))
        learner.finish_round(0.0)


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
