from __future__ import annotations

import math

import numpy as np
import pytest

from hiersched.env import FEATURES, SlotLoop, agent_views, user_features
from hiersched.randomness import world_keys
from hiersched.simulator import Simulator


def column(features, name):
    return features[..., FEATURES.index(name)]


def test_features_of_a_queue_by_hand(scenario, gains):
    simulator = Simulator(scenario, gains, world_keys("t", 1, 1), 4)
    simulator.state.prb_rate_mbps[0, 1] = 20.0  # 20 packets a slot and PRB
    simulator.state.backlog_packets[0, 1] = 60.0
    simulator.state.hol_delay_s[0, 1] = 0.04  # twice the deadline
    simulator.state.rate_mbps[0, 1] = 30.0
    simulator.state.robots.dexterity_index[0, 1] = 0.25
    features = user_features(simulator, np.array([[0.0, math.e - 1.0, 0.0]]))
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
