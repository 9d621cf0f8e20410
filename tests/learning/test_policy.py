from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from hiersched.core.randomness import world_keys
from hiersched.env import user_features
from hiersched.learning.policy import Policy, PolicyError, rollout
from hiersched.learning.trainer import Trainer
from hiersched.simulator import Simulator


def some_policy(scenario, network="shared", start="pf"):
    rng = np.random.default_rng(1)
    size = {"shared": (24 + 1) * 6 + 7, "mlp": (5 * 8 + 1) * 6 + 7 * 3}[network]
    return Policy(
        parameters=rng.normal(size=(2, size)).astype(np.float32),
        network=network,
        hidden=(6,),
        start=start,
        observe_robots=False,
        num_embb=2,
        weight_exponent=scenario.learning.weight_exponent,
        multipliers=np.array([0.1, 2.0, 0.0]),
        seed=9,
        scenario_sha256="ab" * 32,
    )


@pytest.mark.parametrize("network", ["shared", "mlp"])
@pytest.mark.parametrize("start", ["pf", "max_weight", "drift_plus_penalty"])
def test_an_untrained_policy_is_the_scheduler_it_starts_from(scenario, gains, start, network):
    learning = replace(
        scenario.learning, seeds=(1, 2), algorithm="a2c", start=start, network=network
    )
    for policy in Trainer(replace(scenario, learning=learning), gains).policies():
        simulator = Simulator(scenario, gains, world_keys("t", 1, 3), 20)
        record = rollout(simulator, policy)
        simulator.reset(world_keys("t", 1, 3))
        wanted = simulator.run(start, multipliers=np.zeros((3, 3)))
        for name, value in record._asdict().items():
            np.testing.assert_array_equal(value, getattr(wanted, name), err_msg=name)


@pytest.mark.parametrize("start", ["pf", "max_weight"])
@pytest.mark.parametrize("network", ["shared", "mlp"])
def test_a_policy_decides_and_its_multipliers_are_observed(scenario, gains, network, start):
    policy = some_policy(scenario, network, start)
    simulator = Simulator(scenario, gains, world_keys("t", 1, 2), 8)
    first = policy.act(user_features(simulator, np.tile(policy.multipliers, (2, 1))))
    record = rollout(simulator, policy)
    np.testing.assert_array_equal(record.weight[:, 0].astype(np.float64), first)
    assert (record.multiplier == policy.multipliers).all()
    assert not np.array_equal(first, np.ones_like(first))
    simulator.reset(world_keys("t", 1, 2))
    again = simulator.run(start, 1, weights=first, multipliers=record.multiplier[:, 0].copy())
    np.testing.assert_array_equal(again.prb_owner[:, 0], record.prb_owner[:, 0])


def test_an_mlp_runs_on_the_users_of_its_training_only(scenario):
    policy = some_policy(scenario, "mlp")
    with pytest.raises(ValueError, match=r"num_urllc = 4: must be 3.*mlp"):
        policy.for_users(4)
    assert policy.for_users(3).act(np.zeros((1, 5, 8), np.float32)).shape == (1, 5)
    with pytest.raises(ValueError, match="features of 3 eMBB users: must be of 2"):
        policy.act(np.zeros((1, 6, 8), np.float32))


def test_a_rollout_in_two_parts_is_the_rollout(scenario, gains):
    policy = some_policy(scenario)
    whole = rollout(Simulator(scenario, gains, world_keys("t", 1, 2), 8), policy)
    simulator = Simulator(scenario, gains, world_keys("t", 1, 2), 8)
    parts = [rollout(simulator, policy, 3), rollout(simulator, policy)]
    for name, value in whole._asdict().items():
        joined = np.concatenate([getattr(part, name) for part in parts], axis=1)
        np.testing.assert_array_equal(value, joined, err_msg=name)


def test_a_saved_policy_comes_back_bit_for_bit(scenario, tmp_path):
    policy = some_policy(scenario)
    policy.save(tmp_path / "policy.pt")
    loaded = Policy.load(tmp_path / "policy.pt")
    for name, value in vars(policy).items():
        np.testing.assert_array_equal(value, getattr(loaded, name), err_msg=name)
    assert [path.name for path in tmp_path.iterdir()] == ["policy.pt"]


def test_files_that_are_no_policy_are_refused(scenario, tmp_path):
    path = tmp_path / "policy.pt"
    path.write_bytes(b"nothing")
    with pytest.raises(PolicyError, match=r"policy\.pt: not a policy file"):
        Policy.load(path)
    some_policy(scenario).save(path)
    saved = torch.load(path, weights_only=True)
    torch.save({**saved, "feature_version": 99}, path)
    with pytest.raises(PolicyError, match="feature_version = 99: must be"):
        Policy.load(path)
    with pytest.raises(FileNotFoundError):
        Policy.load(tmp_path / "missing.pt")


def test_a_policy_runs_on_another_number_of_users(scenario):
    policy = some_policy(scenario).for_users(4)
    features = np.random.default_rng(1).normal(size=(2, 20, 8)).astype(np.float32)
    weights = policy.act(features)
    order = [3, 1, 2, 0, *range(19, 3, -1)]
    np.testing.assert_allclose(policy.act(features[:, order]), weights[:, order], rtol=1e-4)


def test_a_policy_for_other_users_is_refused(scenario, gains):
    simulator = Simulator(scenario, gains, world_keys("t", 1, 1), 2)
    with pytest.raises(ValueError, match="policy for 4 URLLC users: must be for 3"):
        rollout(simulator, some_policy(scenario).for_users(4))
