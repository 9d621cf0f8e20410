from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hiersched.env import agent_views
from hiersched.learning.ddpg import Ddpg
from hiersched.learning.replay_buffer import Transitions
from hiersched.learning.stack import StackedAdam

PRBS = 8
REPLAYED = ("features", "prb_count", "base_reward", "constraint", "next_features")


def learner_for(scenario, **changes):
    learning = replace(
        scenario.learning,
        **{"seeds": (1, 2), "hidden": (3,), "critic_warmup_updates": 0, **changes},
    )
    generators = [np.random.default_rng(seed) for seed in learning.seeds]
    return Ddpg(replace(scenario, learning=learning), generators), learning


def random_batch(size=4, seeds=2, users=5, urllc=3):
    rng = np.random.default_rng(5)
    fields = {
        "features": rng.normal(size=(seeds, size, users, 8)),
        "prb_count": rng.integers(1, 4, size=(seeds, size, users)),
        "base_reward": rng.normal(size=(seeds, size, users)),
        "constraint": rng.normal(size=(seeds, size, urllc)),
        "next_features": rng.normal(size=(seeds, size, users, 8)),
    }
    return Transitions(**{name: fields[name].astype(np.float32) for name in REPLAYED})


def copied(batch):
    return Transitions(*(field.copy() for field in batch))


def perceptron(flat, inputs, outputs=1):
    """One hidden layer of three units, float64."""
    size = len(inputs)
    bias, weight = flat[:3], flat[3 : 3 + 3 * size].reshape(size, 3)
    rest = flat[3 + 3 * size :]
    last_bias, last = rest[:outputs], rest[outputs:].reshape(3, outputs)
    return np.maximum(inputs @ weight + bias, 0.0) @ last + last_bias


def water_filled(weights):
    low, high = 1e-12, weights.sum()
    for _ in range(200):
        level = (low + high) / 2
        low, high = (level, high) if np.maximum(1, weights / level).sum() > PRBS else (low, level)
    return np.maximum(1.0, weights / high)


def views(features):
    urllc, embb = agent_views(features.astype(np.float64), 3)
    return [*((0, u) for u in urllc), *((1, u) for u in embb)]


def counts_under(actors, features, exponent, network):
    if network == "mlp":
        seen = features.reshape(-1).astype(np.float64)
        raw = np.append(perceptron(actors[0], seen, 3), perceptron(actors[1], seen, 3)[:2])
    else:
        raw = np.array([perceptron(actors[agent], seen)[0] for agent, seen in views(features)])
    return water_filled(np.exp(exponent * np.tanh(raw))), np.square(raw).mean()


def user_values(critics, features, counts, network):
    """Value of each user; that of the flat critic stands for all users of its slice."""
    if network == "mlp":
        seen = np.append(features.reshape(-1).astype(np.float64), counts / 4.0)
        urllc, embb = (perceptron(critic, seen)[0] for critic in critics)
        return np.array([urllc] * 3 + [embb] * 2)
    return np.array(
        [
            perceptron(critics[agent], np.append(seen, count / 4.0))[0]
            for (agent, seen), count in zip(views(features), counts, strict=True)
        ]
    )


def slope(function, flat, entry, step=1e-5):
    up, down = flat.copy(), flat.copy()
    up[entry] += step
    down[entry] -= step
    return (function(up) - function(down)) / (2 * step)


@pytest.mark.parametrize("network", ["shared", "mlp"])
@pytest.mark.parametrize("reward", ["cooperative", "independent"])
def test_one_update_against_loops_and_finite_differences(scenario, reward, network):
    """Adam's first step moves a parameter by the learning rate against its gradient's sign.

    The losses are written out user by user in NumPy and differentiated numerically; no line is
    shared with the learner.
    """
    learner, learning = learner_for(
        scenario,
        reward=reward,
        network=network,
        gradient_clip=1e9,
        floor_slope=0.0,
        action_penalty=0.05,
    )
    rng = np.random.default_rng(8)
    for name in ("actor", "critic", "target_actor", "target_critic"):
        parameters = getattr(learner, name)
        parameters.copy_(torch.from_numpy(rng.normal(0, 0.4, parameters.shape).astype(np.float32)))
    before = {
        name: getattr(learner, name).numpy().astype(np.float64).reshape(2, 2, -1)
        for name in ("actor", "critic", "target_actor", "target_critic")
    }
    batch = random_batch()
    multipliers = np.array([[1.0, 0.0, 3.0], [0.5, 2.0, 0.0]])
    learner.update(copied(batch), multipliers)

    for seed in range(2):
        seen = batch.features[seed].copy()
        following = batch.next_features[seed].copy()
        seen[:, :3, 6] = following[:, :3, 6] = np.log1p(multipliers[seed])

        def critic_loss(flat, agent, seed=seed, seen=seen, following=following):
            users = slice(0, 3) if agent == 0 else slice(3, 5)
            critics = [flat, flat]
            total = 0.0
            for k in range(4):
                reward = batch.base_reward[seed, k].astype(np.float64)
                reward[:3] += multipliers[seed] * batch.constraint[seed, k] / learning.reward_scale
                if network == "mlp":
                    reward[:3], reward[3:] = reward[:3].mean(), reward[3:].mean()
                counts, _ = counts_under(
                    before["target_actor"][seed], following[k], learning.weight_exponent, network
                )
                later = user_values(before["target_critic"][seed], following[k], counts, network)
                error = (
                    user_values(critics, seen[k], batch.prb_count[seed, k], network)
                    - reward
                    - learning.discount * later
                )[users]
                huber = np.where(np.abs(error) < 1, 0.5 * error**2, np.abs(error) - 0.5)
                total += huber.mean() / 4
            return total

        for agent in range(2):
            flat = before["critic"][seed, agent]
            moved = learner.critic.numpy().reshape(2, 2, -1)[seed, agent] - flat
            check_signs(lambda p, a=agent: critic_loss(p, a), flat, moved, learning.critic_lr)

        price = 1.0 + multipliers[seed].mean()

        def actor_loss(flat, agent, seed=seed, seen=seen, price=price):
            critics = learner.critic.numpy().astype(np.float64).reshape(2, 2, -1)[seed]
            actors = [flat if agent == a else before["actor"][seed, a] for a in range(2)]
            total = 0.0
            for k in range(4):
                counts, size = counts_under(actors, seen[k], learning.weight_exponent, network)
                values = user_values(critics, seen[k], counts, network)
                parts = values[:3].mean(), values[3:].mean()
                value = sum(parts) if reward == "cooperative" else parts[agent]
                total += (learning.action_penalty * size - value / price) / 4
            return total

        for agent in range(2):
            flat = before["actor"][seed, agent]
            moved = learner.actor.numpy().reshape(2, 2, -1)[seed, agent] - flat
            check_signs(lambda p, a=agent: actor_loss(p, a), flat, moved, learning.actor_lr)

    for name in ("actor", "critic"):
        old, new = before[f"target_{name}"], getattr(learner, name).numpy().reshape(2, 2, -1)
        wanted = old + learning.target_rate * (new - old)
        now = getattr(learner, f"target_{name}").numpy().reshape(2, 2, -1)
        np.testing.assert_allclose(now, wanted, rtol=1e-4, atol=1e-6)


def check_signs(loss, flat, moved, rate):
    checked = 0
    for entry in range(0, len(flat), 3):
        gradient = slope(loss, flat, entry)
        if abs(gradient) > 2e-5:
            assert moved[entry] == pytest.approx(-rate * np.sign(gradient), rel=0.02)
            checked += 1
    assert checked >= 3


def test_adam_by_hand_with_each_row_clipped_on_its_own():
    parameters = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    adam = StackedAdam(parameters, learning_rate=0.1, gradient_clip=5.0)
    first = torch.tensor([[30.0, 40.0], [0.3, 0.4]])  # norms 50 (clipped to 3, 4) and 0.5
    second = torch.tensor([[3.0, -4.0], [0.3, 0.4]])
    for gradient in (first, second):
        adam.step(parameters, gradient)
    # First row, second entry: means 0.4 and then -0.04, unbiased by 0.19; squares 16, unbiased 16.
    assert parameters[0, 0] == pytest.approx(1.0 - 0.1 - 0.1, rel=1e-5)
    assert parameters[0, 1] == pytest.approx(2.0 - 0.1 + 0.1 * (0.04 / 0.19) / 4.0, rel=1e-5)
    np.testing.assert_allclose(parameters[1].numpy(), [2.8, 3.8], rtol=1e-5)


def test_permuting_users_permutes_actions(scenario):
    learner, _ = learner_for(scenario)
    learner.actor.copy_(torch.from_numpy(np.random.default_rng(1).normal(size=learner.actor.shape)))
    features = random_batch().features
    actions = learner.act(features)
    order = [2, 0, 1, 4, 3]
    np.testing.assert_allclose(
        learner.act(features[:, :, order]), actions[:, :, order], rtol=1e-4, atol=1e-6
    )
    assert np.ptp(actions) > 0.1


def test_before_learning_every_action_is_zero(scenario):
    learner, _ = learner_for(scenario)
    assert (learner.act(random_batch().features) == 0.0).all()


@pytest.mark.nightly
def test_a_two_state_problem_is_solved(scenario):
    """One user of five is in need, URLLC user 0 or eMBB user 4; PRBs pay there and nowhere else."""
    learner, _ = learner_for(
        scenario,
        hidden=(16,),
        discount=0.0,
        actor_lr=3e-3,
        critic_lr=3e-3,
        critic_warmup_updates=200,
    )
    rng = np.random.default_rng(4)
    states = np.zeros((2, 5, 8), np.float32)
    states[0, 0, 0] = states[1, 4, 0] = 1.0
    for _ in range(800):
        which = rng.integers(2, size=(2, 32))
        counts = 1 + rng.multinomial(PRBS - 5, np.full(5, 0.2), size=(2, 32))
        needy = np.where(which == 0, 0, 4)
        reward = np.zeros((2, 32, 5), np.float32)
        got = np.take_along_axis(counts, needy[..., None], 2)
        np.put_along_axis(reward, needy[..., None], got.astype(np.float32), 2)
        batch = Transitions(
            features=states[which],
            prb_count=counts.astype(np.float32),
            base_reward=reward,
            constraint=np.zeros((2, 32, 3), np.float32),
            next_features=states[which],
        )
        learner.update(batch, np.zeros((2, 3)))
    actions = learner.act(np.stack([states, states]))
    for seed in range(2):
        for state, needy in ((0, 0), (1, 4)):
            # Four of the eight PRBs is the most that one of five users can have.
            assert water_filled(np.exp(3.0 * actions[seed, state]))[needy] > 3.8
