from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from hiersched.core.randomness import world_keys
from hiersched.env import FEATURES, SlotLoop, agent_views
from hiersched.env.core import control_weights, task_costs
from hiersched.env.vector import SlicingVectorEnv
from hiersched.learning.rewards import user_rewards
from hiersched.policies.features import num_features
from hiersched.simulator import Simulator


def column(features, name):
    return features[..., FEATURES.index(name)]


def test_features_of_a_queue_by_hand(scenario, gains):
    simulator = Simulator(scenario, gains, world_keys("t", 1, 1), 4)
    simulator.state.prb_rate_mbps[0, 1] = 20.0  # 20 packets a slot and PRB
    simulator.state.backlog_packets[0, 1] = 60.0
    simulator.state.hol_delay_s[0, 1] = 0.04  # twice the deadline
    simulator.state.rate_mbps[0, 1] = 30.0
    simulator.state.dexterity_index[0, 1] = 0.25
    features = simulator.features(np.array([[0.0, math.e - 1.0, 0.0]]))
    assert column(features, "need")[0, 1] == pytest.approx(3.0 / 4.0)
    assert column(features, "log_need")[0, 1] == pytest.approx(math.log(4.0))
    assert column(features, "log_wait")[0, 1] == pytest.approx(math.log(3.0))
    assert column(features, "log_prb_rate")[0, 1] == pytest.approx(math.log(2.0))
    assert column(features, "served")[0, 1] == pytest.approx(1.5 / 4.0)
    assert column(features, "dexterity")[0, 1] == pytest.approx(0.25)
    assert column(features, "log_multiplier")[0, 1] == pytest.approx(1.0)
    assert column(features, "load")[0, 1] == pytest.approx(16.0 * 1.1 / 20.0 / 4.0)
    for name in ("dexterity", "log_multiplier"):
        assert (column(features, name)[0, 3:] == 0.0).all()


def test_each_agent_sees_its_users_and_both_means():
    rng = np.random.default_rng(1)
    features = rng.normal(size=(2, 5, 8)).astype(np.float32)
    urllc, embb = agent_views(features, 3)
    for env in range(2):
        mean = [features[env, :3].mean(0), features[env, 3:].mean(0)]
        for user in range(5):
            agent, place = (0, user) if user < 3 else (1, user - 3)
            wanted = np.concatenate((features[env, user], mean[agent], mean[1 - agent]))
            np.testing.assert_allclose((urllc, embb)[agent][env, place], wanted, rtol=1e-6)


@pytest.mark.parametrize("bad", [1.5, -1.01, np.nan])
def test_an_action_out_of_range_is_refused(scenario, gains, bad):
    loop = SlotLoop(scenario, gains, world_keys("t", 1, 1), 4)
    actions = np.zeros((1, 5))
    actions[0, 2] = bad
    with pytest.raises(ValueError, match="actions"):
        loop.step(actions)


def test_features_of_a_robot_by_hand(scenario, gains):
    """A robot 5 cm off; 21 ms at the head of the line and the core latency make two samples."""
    simulator = Simulator(scenario, gains, world_keys("t", 1, 2), 4)
    state = np.zeros((2, 3, 5))
    state[1, 2, :2] = 0.03, -0.04
    simulator.state.robot_state[:] = state
    simulator.state.hol_delay_s[1, 2] = 0.021
    simulator.state.gain_delay_steps[1, 2] = 4
    features = simulator.features(np.zeros((2, 3)), observe_robots=True)
    assert features.shape == (2, 5, 8 + 3) == (2, 5, num_features(True, False))
    largest = scenario.max_delay_steps
    assert features[1, 2, 8:].tolist() == pytest.approx([math.log(6.0), 2 / largest, 4 / largest])
    assert features[0, 2, 8:].tolist() == pytest.approx([0.0, 1 / largest, 0.0])
    assert (features[:, 3:, 8:] == 0.0).all()
    simulator.state.hol_delay_s[1, 2] = 1e3
    assert simulator.features(np.zeros((2, 3)), observe_robots=True)[1, 2, 9] == 1.0


def test_features_of_a_demand_by_hand(scenario, gains):
    """A set-point at half a metre a second, one deadline old, 1 cm from the newest."""
    traffic = replace(scenario.traffic, urllc_offered_mbps=(2.0, 4.0, 6.0))
    simulator = Simulator(replace(scenario, traffic=traffic), gains, world_keys("t", 1, 2), 4)
    state = simulator.state
    state.set_point_speed_mps[1, 0] = 0.5
    state.set_point_gap_m[1, 0] = 0.01
    state.set_point_acceleration_mps2[1, 0] = 2.0
    state.set_point_age_s[1, 0] = scenario.traffic.deadline_s
    state.reported_error_m[1, 0] = 0.04
    features = simulator.features(np.zeros((2, 3)), observe_demand=True)
    assert features.shape == (2, 5, 8 + 6) == (2, 5, num_features(False, True))
    wanted = [6.0, 2.0, 3.0, 2.0, 5.0, 2.0]
    assert features[1, 0, 8:].tolist() == pytest.approx(np.log(wanted).tolist())
    assert features[1, 2, 8:].tolist() == pytest.approx([0.0] * 5 + [math.log(2.0 / 3.0)])
    assert (features[:, 3:, 8:] == 0.0).all()
    cost = 0.05 * np.exp(features[1, 0, 8]) * np.exp(features[1, 0, 13]) ** 2
    assert cost == pytest.approx((0.05 + 0.5**2) * 2.0**2)
    loop = SlotLoop(
        replace(scenario, learning=replace(scenario.learning, observe_demand=True)),
        gains,
        world_keys("t", 1, 2),
        4,
    )
    assert loop.features().shape == (2, 5, 14)


def test_the_task_costs_each_robot_its_error_in_centimetres(scenario, gains):
    learning = replace(scenario.learning, task_weight=3.0, reward_scale=50.0)
    loop = SlotLoop(replace(scenario, learning=learning), gains, world_keys("t", 1, 2), 4)
    loop.step(np.zeros((2, 5)))
    error_cm = 100.0 * loop.record.tracking_error_m[:, 0]
    np.testing.assert_allclose(task_costs(loop.record, learning), 3.0 * error_cm / 50.0)
    assert (error_cm > 0.0).all()


def test_the_drift_of_a_control_cost_by_hand(scenario, gains):
    """Robots at 0, 0.5 and 1 m/s whose users have 2, 4 and 6 of the packets; v is the old one."""
    traffic = replace(scenario.traffic, urllc_offered_mbps=(40.0, 80.0, 120.0))
    learning = replace(scenario.learning, reward_terms="control_drift", reward_scale=50.0)
    cell = replace(scenario, traffic=traffic, learning=learning)
    loop = SlotLoop(cell, gains, world_keys("t", 1, 2), 4)
    state = loop.simulator.state
    state.set_point_speed_mps[:] = 0.0, 0.5, 1.0
    wanted = 16.0 * np.array([0.05 * 4.0, 0.3, 1.05 * 4.0 / 9.0])
    np.testing.assert_allclose(control_weights(loop.simulator), np.tile(wanted, (2, 1)))
    before = state.backlog_packets[:, :3].copy()
    loop.step(np.zeros((2, 5)))
    drift = 0.5 * (state.backlog_packets[:, :3] ** 2 - before**2)
    rewards = user_rewards(loop.record, state.backlog_packets, loop.task_costs, cell)
    penalty = 1.0 / (loop.record.rate_mbps[:, 0] ** 2 + cell.objective.epsilon)
    cost = wanted * drift + cell.objective.penalty_weight * penalty[:, :3]
    np.testing.assert_allclose(rewards[:, :3], -cost / 50.0)
    assert (np.abs(drift) > 0.1).any()


def test_an_environment_pays_the_drift_of_the_control_cost(scenario, gains):
    traffic = replace(scenario.traffic, urllc_offered_mbps=40.0)
    scenario = replace(scenario, traffic=traffic)
    learning = replace(scenario.learning, reward_terms="control_drift")
    env = SlicingVectorEnv(replace(scenario, learning=learning), gains, 2)
    plain = SlicingVectorEnv(scenario, gains, 2)
    for one in (env, plain):
        one.reset(seed=1)
    info, other = (one.step(np.zeros((2, 5)))[4] for one in (env, plain))
    record = env._loop.record
    drift = record.drift_urllc[:, 0] / 3.0
    # All robots stand and all users have the same load: 16 times 0.05, less 1.
    wanted = other["reward_urllc"] - (0.8 - 1.0) * drift / learning.reward_scale
    np.testing.assert_allclose(info["reward_urllc"], wanted)
    np.testing.assert_array_equal(info["reward_embb"], other["reward_embb"])


@pytest.mark.parametrize("start", ["max_weight", "drift_plus_penalty"])
def test_no_action_is_the_scheduler_that_learning_starts_from(scenario, gains, start):
    learning = replace(scenario.learning, start=start)
    loop = SlotLoop(replace(scenario, learning=learning), gains, world_keys("t", 1, 3), 6)
    wanted = Simulator(scenario, gains, world_keys("t", 1, 3), 6).run(start)
    for slot in range(6):
        loop.step(np.zeros((3, 5)))
        np.testing.assert_array_equal(loop.record.prb_owner[:, 0], wanted.prb_owner[:, slot])
    loop.reset(world_keys("t", 1, 3))
    favoured = np.tile([-1.0, -1.0, -1.0, -1.0, 1.0], (3, 1))
    given = []
    for _ in range(6):
        loop.step(favoured)
        given.append(loop.record.prb_owner[:, 0].copy())
    assert not np.array_equal(np.stack(given, axis=1), wanted.prb_owner)
