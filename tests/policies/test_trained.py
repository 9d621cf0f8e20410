from __future__ import annotations

from base64 import b64encode
from dataclasses import replace

import numpy as np
import pytest

from hiersched.core.randomness import world_keys
from hiersched.core.sealed import seal_json, unseal_json
from hiersched.env import SlotLoop
from hiersched.learning.trainer import Trainer
from hiersched.policies.trained import PolicyError, TrainedPolicy
from hiersched.simulator import Simulator


def some_policy(scenario, network="shared", start="pf", weighs="utility"):
    rng = np.random.default_rng(1)
    size = {"shared": (24 + 1) * 6 + 7, "mlp": (5 * 8 + 1) * 6 + 7 * 3, "linear": 9}[network]
    return TrainedPolicy(
        parameters=rng.normal(size=(2, size)).astype(np.float32),
        network=network,
        hidden=() if network == "linear" else (6,),
        rule=start,
        weighs=weighs,
        observe_robots=False,
        observe_demand=False,
        num_embb=2,
        weight_exponent=scenario.learning.weight_exponent,
        multipliers=np.array([0.1, 2.0, 0.0]),
        seed=9,
        scenario_sha256="ab" * 32,
    )


@pytest.mark.parametrize("network", ["shared", "mlp", "linear"])
@pytest.mark.parametrize("start", ["pf", "max_weight", "drift_plus_penalty"])
def test_an_untrained_policy_is_the_scheduler_it_starts_from(scenario, gains, start, network):
    learning = replace(
        scenario.learning, seeds=(1, 2), algorithm="a2c", start=start, network=network
    )
    for policy in Trainer(replace(scenario, learning=learning), gains).policies():
        simulator = Simulator(scenario, gains, world_keys("t", 1, 3), 20)
        record = simulator.run(policy)
        simulator.reset(world_keys("t", 1, 3))
        wanted = simulator.run(start, multipliers=np.zeros((3, 3)))
        for name, value in record._asdict().items():
            np.testing.assert_array_equal(value, getattr(wanted, name), err_msg=name)


@pytest.mark.parametrize("start", ["pf", "max_weight"])
@pytest.mark.parametrize("network", ["shared", "mlp", "linear"])
def test_a_policy_decides_and_its_multipliers_are_observed(
    scenario, gains, torch_weights, network, start
):
    policy = some_policy(scenario, network, start)
    simulator = Simulator(scenario, gains, world_keys("t", 1, 2), 8)
    first = torch_weights(policy, simulator.features(np.tile(policy.multipliers, (2, 1))))
    record = simulator.run(policy)
    logged = record.weight[:, 0].astype(np.float64)
    # The weight is exp(c a): an action that is off by 1e-6 moves it by c times as much.
    np.testing.assert_allclose(logged, first, rtol=4e-6)
    assert (record.multiplier == policy.multipliers).all()
    assert not np.array_equal(first, np.ones_like(first))
    simulator.reset(world_keys("t", 1, 2))
    again = simulator.run(start, 1, weights=logged, multipliers=record.multiplier[:, 0].copy())
    np.testing.assert_array_equal(again.prb_owner[:, 0], record.prb_owner[:, 0])


def test_a_policy_on_the_drift_is_that_of_its_logged_weights(scenario, gains):
    """Compiled, in training and from a log: the weight is the policy's in the record of all."""
    scenario = replace(scenario, objective=replace(scenario.objective, penalty_weight=1e5))
    policy = some_policy(scenario, start="drift_plus_penalty", weighs="drift")
    keys = world_keys("t", 1, 2)
    record = Simulator(scenario, gains, keys, 8).run(policy)
    learning = replace(scenario.learning, start="drift_plus_penalty", weighs="drift")
    loop = SlotLoop(replace(scenario, learning=learning), gains, keys, 8)
    loop.multipliers[:] = policy.multipliers
    utility = some_policy(scenario, start="drift_plus_penalty")
    other = Simulator(scenario, gains, keys, 8).run(utility)
    for slot in range(8):
        logged = record.weight[:, slot].astype(np.float64)
        loop.step(np.log(logged) / learning.weight_exponent)
        np.testing.assert_array_equal(loop.record.prb_owner[:, 0], record.prb_owner[:, slot])
        np.testing.assert_allclose(loop.record.weight[:, 0], logged, rtol=1e-6)
    np.testing.assert_array_equal(other.weight[:, 0], record.weight[:, 0])
    assert not np.array_equal(other.prb_owner, record.prb_owner)


def test_an_mlp_runs_on_the_users_of_its_training_only(scenario, gains):
    policy = some_policy(scenario, "mlp")
    for users in ((4, 2), (3, 3)):
        with pytest.raises(ValueError, match=rf"{users[0]} URLLC and {users[1]} eMBB.*mlp"):
            policy.for_users(*users)
    assert policy.for_users(3, 2) is policy


def test_a_run_in_two_parts_is_the_run(scenario, gains):
    policy = some_policy(scenario)
    whole = Simulator(scenario, gains, world_keys("t", 1, 2), 8).run(policy)
    simulator = Simulator(scenario, gains, world_keys("t", 1, 2), 8)
    parts = [simulator.run(policy, 3), simulator.run(policy)]
    for name, value in whole._asdict().items():
        joined = np.concatenate([getattr(part, name) for part in parts], axis=1)
        np.testing.assert_array_equal(value, joined, err_msg=name)


@pytest.mark.parametrize("network", ["shared", "linear"])
def test_a_saved_policy_comes_back_bit_for_bit(scenario, tmp_path, network):
    policy = some_policy(scenario, network)
    policy.save(tmp_path / "policy.json")
    loaded = TrainedPolicy.load(tmp_path / "policy.json")
    for name, value in vars(policy).items():
        np.testing.assert_array_equal(value, getattr(loaded, name), err_msg=name)
    assert [path.name for path in tmp_path.iterdir()] == ["policy.json"]


def test_a_policy_of_format_3_says_less_and_is_the_same(scenario, tmp_path):
    path = tmp_path / "policy.json"
    policy = some_policy(scenario)
    policy.save(path)
    document = unseal_json(path.read_bytes())
    assert document.pop("format") == "hiersched policy 4"
    assert document.pop("observe_demand") is False
    assert document.pop("weighs") == "utility"
    path.write_text(seal_json({"format": "hiersched policy 3", **document}))
    loaded = TrainedPolicy.load(path)
    for name, value in vars(policy).items():
        np.testing.assert_array_equal(value, getattr(loaded, name), err_msg=name)
    path.write_text(seal_json({"format": "hiersched policy 4", **document}))
    with pytest.raises(PolicyError, match="weighs: Field required"):
        TrainedPolicy.load(path)


def test_files_that_are_no_policy_are_refused(scenario, tmp_path):
    path = tmp_path / "policy.json"
    path.write_bytes(b"nothing")
    with pytest.raises(PolicyError, match=r"policy\.json: not a policy: its first line"):
        TrainedPolicy.load(path)
    with pytest.raises(FileNotFoundError):
        TrainedPolicy.load(tmp_path / "missing.json")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "hiersched policy 2"}, "its format is another than 'hiersched policy 4' or"),
        ({"observe_demand": None}, "observe_demand: Input should be a valid boolean"),
        ({"feature_version": 99}, "feature_version = 99: must be 1 "),
        ({"hidden": [6, 6]}, "314 parameters: must be 2 x 199 "),
        ({"hidden": [0]}, "hidden.0: Input should be greater than or equal to 1"),
        ({"hidden": [10**9] * 9}, "hidden.0: Input should be less than or equal to 10000"),
        ({"network": "transformer"}, "network: Input should be 'shared', 'mlp' or 'linear'"),
        ({"hidden": []}, "must be one layer or more with network = 'shared'"),
        ({"network": "linear"}, "must be no layer with network = 'linear'"),
        ({"multipliers": [-1.0]}, "multipliers.0: Input should be greater than or equal to 0"),
        ({"weighs": "speed"}, "weighs: Input should be 'utility' or 'drift'"),
        ({"weighs": "drift"}, "weighs = 'drift': must be 'utility' with rule = 'pf'"),
        ({"parameters": "*"}, "base64"),
        (
            {"parameters": b64encode(b"\x00\x00\xc0\x7f" * 314).decode()},
            "its parameters are not all finite",
        ),
        ({"parameters": None}, "parameters: Input should be a valid string"),
        ({"more": 1}, "more: Unexpected keyword argument"),
    ],
)
def test_content_that_is_no_policy_is_refused_though_its_checksum_is_right(
    scenario, tmp_path, change, words
):
    path = tmp_path / "policy.json"
    some_policy(scenario).save(path)
    path.write_text(seal_json(unseal_json(path.read_bytes()) | change))
    with pytest.raises(PolicyError, match=rf"policy\.json: not a policy: .*{words}"):
        TrainedPolicy.load(path)


def test_a_policy_runs_on_another_number_of_users(scenario, gains):
    """Whose order does not matter: users change places, and so do their weights."""
    users = replace(scenario.users, num_urllc=4, num_embb=16)
    traffic = replace(scenario.traffic, urllc_offered_mbps=15.0, embb_offered_mbps=15.0)
    radio = replace(scenario.radio, num_prb=25)
    cell = replace(scenario, users=users, traffic=traffic, radio=radio)
    policy = some_policy(scenario).for_users(4, 16)
    assert (policy.multipliers == np.mean([0.1, 2.0, 0.0])).all()
    simulator = Simulator(cell, gains, world_keys("t", 1, 1), 12)
    simulator.run("pf", 10)
    state, order = simulator.state, np.array([3, 1, 2, 0, *range(19, 3, -1)])
    weights = []
    for _ in range(2):
        simulator.decide(policy)
        weights.append(state.weight[0].copy())
        for values in (state.reported_rate_mbps, state.backlog_packets, state.hol_delay_s,
                       state.rate_mbps):  # fmt: skip
            values[0] = values[0][order]
        state.dexterity_index[0] = state.dexterity_index[0][order[:4]]
    np.testing.assert_allclose(weights[1], weights[0][order], rtol=1e-4)
    assert len(np.unique(weights[0])) > 10


def test_a_policy_for_other_users_is_refused(scenario, gains):
    simulator = Simulator(scenario, gains, world_keys("t", 1, 1), 2)
    with pytest.raises(ValueError, match="multipliers of 4 URLLC users: must be of 3"):
        simulator.run(some_policy(scenario).for_users(4, 2))
    with pytest.raises(ValueError, match="policy for 3 URLLC and 5 eMBB users: must be for 3 and"):
        simulator.run(some_policy(scenario).for_users(3, 5))
