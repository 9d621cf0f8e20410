from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hiersched.env import agent_views
from hiersched.learning.a2c import A2c, advantages
from hiersched.learning.algorithm import Outcome

SEEDS, ENVS, SLOTS, USERS, URLLC = 2, 3, 2, 5, 3


def learner_for(scenario, **changes):
    settings = {
        "algorithm": "a2c",
        "seeds": (1, 2),
        "hidden": (3,),
        "num_envs": ENVS,
        "rollout_slots": SLOTS,
        "critic_warmup_updates": 0,
    }
    learning = replace(scenario.learning, **{**settings, **changes})
    generators = [np.random.default_rng(seed) for seed in learning.seeds]
    return A2c(replace(scenario, learning=learning), generators), learning


def random_outcome(rng):
    return Outcome(
        prb_count=np.ones((SEEDS, ENVS, USERS), np.uint32),
        base_reward=rng.normal(size=(SEEDS, ENVS, USERS)),
        constraint=rng.normal(size=(SEEDS, ENVS, URLLC)),
        next_features=rng.normal(size=(SEEDS, ENVS, USERS, 8)).astype(np.float32),
    )


def test_advantages_by_hand():
    """g = 1/2, l = 1/2; the value after the rollout counts: its end is no end of the world."""
    rewards = torch.tensor([1.0, 2.0]).reshape(1, 1, 2, 1, 1)
    values = torch.tensor([4.0, 6.0, 8.0]).reshape(1, 1, 3, 1, 1)
    result = advantages(rewards, values, 0.5, 0.5).flatten().tolist()
    # Errors: 1 + 3 - 4 and 2 + 4 - 6; then with other rewards 3 + 3 - 4 = 2, -2 + 4 - 6 = -4.
    assert result == [0.0, 0.0]
    rewards = torch.tensor([3.0, -2.0]).reshape(1, 1, 2, 1, 1)
    assert advantages(rewards, values, 0.5, 0.5).flatten().tolist() == [2.0 - 0.25 * 4.0, -4.0]


def perceptron(flat, inputs, outputs):
    """One hidden layer of three units, float64."""
    size = len(inputs)
    bias, weight = flat[:3], flat[3 : 3 + 3 * size].reshape(size, 3)
    rest = flat[3 + 3 * size :]
    last_bias, last = rest[:outputs], rest[outputs:].reshape(3, outputs)
    return np.maximum(inputs @ weight + bias, 0.0) @ last + last_bias


def outputs_of(network, flat, agent, features, kind):
    """Raw actions of an agent's users, or its values (one, or one a user), in NumPy."""
    users = range(URLLC) if agent == 0 else range(URLLC, USERS)
    if network == "linear" and kind == "actor":
        return features[users].astype(np.float64) @ flat[1:] + flat[0]
    if network == "mlp":
        seen = features.reshape(-1).astype(np.float64)
        return perceptron(flat, seen, 3 if kind == "actor" else 1)[: len(users)]
    own = agent_views(features.astype(np.float64), URLLC)[agent]
    return np.array([perceptron(flat, row, 1)[0] for row in own])


def slope(function, flat, entry, step=1e-5):
    up, down = flat.copy(), flat.copy()
    up[entry] += step
    down[entry] -= step
    return (function(up) - function(down)) / (2 * step)


def check_signs(loss, flat, moved, rate):
    checked = 0
    for entry in range(0, len(flat), 3):
        gradient = slope(loss, flat, entry)
        if abs(gradient) > 1e-4:
            assert moved[entry] == pytest.approx(-rate * np.sign(gradient), rel=0.02)
            checked += 1
    assert checked >= 3


@pytest.mark.parametrize("network", ["shared", "mlp", "linear"])
@pytest.mark.parametrize("reward", ["cooperative", "independent"])
def test_one_update_against_loops_and_finite_differences(scenario, reward, network):
    """Adam's first step moves a parameter by the learning rate against its gradient's sign.

    Losses are written out in NumPy, user by user; no line is shared with the learner.
    """
    learner, learning = learner_for(
        scenario, reward=reward, network=network, gradient_clip=1e9, action_penalty=0.05
    )
    rng = np.random.default_rng(8)
    for stack in (learner.actor, learner.critic):
        stack.copy_(torch.from_numpy(rng.normal(0, 0.4, stack.shape).astype(np.float32)))
    actor, critic = (
        stack.numpy().astype(np.float64).reshape(SEEDS, 2, -1).copy()
        for stack in (learner.actor, learner.critic)
    )
    multipliers = np.array([[1.0, 0.0, 3.0], [0.5, 2.0, 0.0]])
    first = rng.normal(size=(SEEDS, ENVS, USERS, 8)).astype(np.float32)
    first[:, :, :URLLC, 6] = np.log1p(multipliers)[:, None]
    outcomes = [random_outcome(rng) for _ in range(SLOTS)]
    for outcome in outcomes:
        outcome.next_features[:, :, :URLLC, 6] = np.log1p(multipliers)[:, None]
    learner.start_round(first.copy())
    features, drawn = [first], []
    for slot, outcome in enumerate(outcomes):
        drawn.append(np.arctanh(learner.explore(features[-1], 0.0).astype(np.float64)))
        features.append(outcome.next_features)
        learner.learn(outcome, multipliers, last=slot == SLOTS - 1)

    def values(flat, seed, agent):
        return np.array(
            [
                [outputs_of(network, flat, agent, at[seed, env], "critic") for env in range(ENVS)]
                for at in features
            ]
        )

    def rewards(seed, agent):
        users = slice(0, URLLC) if agent == 0 else slice(URLLC, USERS)
        total = np.array([outcome.base_reward[seed].copy() for outcome in outcomes])
        for slot, outcome in enumerate(outcomes):
            priced = multipliers[seed] * outcome.constraint[seed] / learning.reward_scale
            total[slot, :, :URLLC] += priced
        own = total[..., users]
        return own.mean(-1, keepdims=True) if network == "mlp" else own

    def user_advantages(seed, agent):
        value, reward = values(critic[seed, agent], seed, agent), rewards(seed, agent)
        error = reward + learning.discount * value[1:] - value[:-1]
        decay = learning.discount * learning.gae_decay
        return np.stack([error[0] + decay * error[1], error[1]]), value

    for seed in range(SEEDS):
        means = []
        for agent in range(2):
            advantage, value = user_advantages(seed, agent)
            target = advantage + value[:-1]

            def critic_loss(flat, seed=seed, agent=agent, target=target):
                error = np.abs(values(flat, seed, agent)[:-1] - target)
                return np.where(error < 1, 0.5 * error**2, error - 0.5).mean()

            moved = learner.critic.numpy().reshape(SEEDS, 2, -1)[seed, agent]
            flat = critic[seed, agent]
            check_signs(critic_loss, flat, moved - flat, learning.critic_lr)
            means.append(advantage.mean(-1))
        if reward == "cooperative":
            means = [(means[0] + means[1]) / 2] * 2
        for agent in range(2):
            worth = (means[agent] - means[agent].mean()) / means[agent].std()

            def actor_loss(flat, seed=seed, agent=agent, worth=worth):
                users = slice(0, URLLC) if agent == 0 else slice(URLLC, USERS)
                total, penalty = 0.0, 0.0
                for slot in range(SLOTS):
                    for env in range(ENVS):
                        raw = outputs_of(network, flat, agent, features[slot][seed, env], "actor")
                        u = drawn[slot][seed, env, users]
                        log_density = -0.5 * ((u - raw) / learning.exploration_std) ** 2
                        total -= worth[slot, env] * log_density.sum()
                        penalty += learning.action_penalty * (raw**2).sum() / USERS
                return (total + penalty) / (SLOTS * ENVS)

            moved = learner.actor.numpy().reshape(SEEDS, 2, -1)[seed, agent]
            flat = actor[seed, agent]
            check_signs(actor_loss, flat, moved - flat, learning.actor_lr)


def test_a_short_last_rollout_is_learnt_from_and_the_next_one_begins_anew(scenario):
    learner, _ = learner_for(scenario)
    rng = np.random.default_rng(1)
    losses = []
    for _ in range(2):
        features = random_outcome(rng).next_features
        learner.start_round(features)
        for slot in range(3):
            learner.explore(features, 0.0)
            outcome = random_outcome(rng)
            losses.append(learner.learn(outcome, np.zeros((SEEDS, URLLC)), last=slot == 2))
            features = outcome.next_features
    assert [loss is not None for loss in losses] == [False, True, True] * 2


def test_permuting_users_permutes_shared_actions(scenario):
    learner, _ = learner_for(scenario, exploration_std=0.0)
    rng = np.random.default_rng(1)
    learner.actor.copy_(torch.from_numpy(rng.normal(size=learner.actor.shape)))
    features = random_outcome(rng).next_features
    actions = learner.explore(features, 0.0)
    order = [2, 0, 1, 4, 3]
    np.testing.assert_allclose(
        learner.explore(features[:, :, order], 0.0), actions[..., order], rtol=1e-4, atol=1e-6
    )
    assert np.ptp(actions) > 0.1


@pytest.mark.nightly
@pytest.mark.parametrize("network", ["shared", "mlp"])
def test_a_two_state_problem_is_solved(scenario, network):
    """One user of five is in need, 0 or 4: its action pays, those of the others cost."""
    learner, _ = learner_for(
        scenario,
        network=network,
        hidden=(16,),
        discount=0.0,
        actor_lr=3e-3,
        critic_lr=3e-3,
        num_envs=32,
        rollout_slots=1,
    )
    rng = np.random.default_rng(4)
    states = np.zeros((2, USERS, 8), np.float32)
    states[0, 0, 0] = states[1, 4, 0] = 1.0
    worth = np.array([[1.0, -1, -1, -1, -1], [-1.0, -1, -1, -1, 1]])
    which = rng.integers(2, size=(SEEDS, 32))
    for _ in range(700):
        features = states[which]
        learner.start_round(features)
        reward = worth[which] * learner.explore(features, 0.0)
        which = rng.integers(2, size=(SEEDS, 32))
        outcome = Outcome(
            prb_count=np.ones((SEEDS, 32, USERS), np.uint32),
            base_reward=reward.astype(np.float64),
            constraint=np.zeros((SEEDS, 32, URLLC)),
            next_features=states[which],
        )
        learner.learn(outcome, np.zeros((SEEDS, URLLC)), last=True)
    learner._learning = replace(learner._learning, exploration_std=0.0, exploration_final_std=0.0)
    actions = learner.explore(np.stack([states, states]), 1.0)
    assert (actions * worth > 0.5).all()


def credit(scenario, advantage, *, shared_by_all):
    """How well actions follow what they earn after few updates of a problem of one slot.

    Twenty users; an action earns its user, or all in its slice alike, what the user's first feature
    says. In a slice's mean the others are noise.
    """
    scenario = replace(scenario, users=replace(scenario.users, num_urllc=10, num_embb=10))
    learner, _ = learner_for(
        scenario,
        advantage=advantage,
        reward="independent",
        discount=0.0,
        actor_lr=1e-2,
        critic_lr=1e-2,
        num_envs=4,
        rollout_slots=1,
        hidden=(16,),
        critic_warmup_updates=100,
    )
    rng = np.random.default_rng(4)
    features = rng.normal(size=(SEEDS, 4, 20, 8)).astype(np.float32)
    for _ in range(160):
        learner.start_round(features)
        earned = features[..., 0] * learner.explore(features, 0.0)
        if shared_by_all:
            slices = np.split(earned, 2, axis=-1)
            earned = np.concatenate(
                [np.repeat(part.mean(-1, keepdims=True), 10, axis=-1) for part in slices], axis=-1
            )
        features = rng.normal(size=features.shape).astype(np.float32)
        outcome = Outcome(
            prb_count=np.ones((SEEDS, 4, 20), np.uint32),
            base_reward=(earned + 0.3 * rng.normal(size=earned.shape)).astype(np.float64),
            constraint=np.zeros((SEEDS, 4, 10)),
            next_features=features,
        )
        learner.learn(outcome, np.zeros((SEEDS, 10)), last=True)
    actions = learner.act(features)
    return np.corrcoef(actions.ravel(), np.sign(features[..., 0]).ravel())[0, 1]


@pytest.mark.parametrize("shared_by_all", [False, True])
def test_counterfactual_advantages_find_who_earned(scenario, shared_by_all):
    assert credit(scenario, "counterfactual", shared_by_all=shared_by_all) > 0.75
    assert credit(scenario, "slice", shared_by_all=shared_by_all) < 0.65


def test_a_users_own_advantage_finds_what_it_earns_for_itself_and_no_more(scenario):
    assert credit(scenario, "user", shared_by_all=False) > 0.75
    assert credit(scenario, "user", shared_by_all=True) < 0.5


def test_a_counterfactual_by_hand(scenario):
    """Critics that are sums: a user's action is worth its slope times its way from the mean."""
    learner, _ = learner_for(scenario, advantage="counterfactual", network="shared")
    rng = np.random.default_rng(2)
    learner.actor.copy_(torch.from_numpy(rng.normal(size=learner.actor.shape) * 0.3))
    features = rng.normal(size=(SEEDS, ENVS, USERS, 8)).astype(np.float32)
    learner.start_round(features)
    drawn = learner.explore(features, 0.0)
    mean = learner.act(features)
    # One hidden unit counts: 50 + 2 own + 3 mean of the slice + 4 mean of the other slice.
    critic = learner.action_critic.zero_()
    critic[:, 0] = 50.0
    # After the 24 inputs of the state come an action and its products with 8 features, three times.
    critic[:, 3 + 3 * 24 : 3 + 3 * 51 : 3 * 9] = torch.tensor([2.0, 3.0, 4.0])
    critic[:, 3 + 3 * 51 + 1] = 1.0
    got = learner._counterfactual(torch.from_numpy(features)).numpy()
    counts = np.array([3, 3, 3, 2, 2])
    wanted = (drawn - mean) * 0.5 * (2.0 + 3.0 + 4.0) / counts
    np.testing.assert_allclose(got, wanted, atol=2e-5)
