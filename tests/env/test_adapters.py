from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test, parallel_seed_test

from hiersched.core.randomness import world_key
from hiersched.env import SlicingEnv, SlicingParallelEnv, SlicingVectorEnv
from hiersched.simulator import Simulator


def actions_of(shape, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32)


def test_gymnasium_accepts_the_environment(scenario, gains):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # An unbounded observation is meant: a queue has no bound.
        warnings.filterwarnings("ignore", message=".*Box observation space.*infinity")
        check_env(SlicingEnv(scenario, gains), skip_render_check=True)


def test_pettingzoo_accepts_the_environment(scenario, gains):
    parallel_api_test(SlicingParallelEnv(scenario, gains), num_cycles=50)
    parallel_seed_test(lambda: SlicingParallelEnv(scenario, gains))


def test_every_row_of_the_batch_is_the_single_environment(scenario, gains):
    """Row e of the batch in its first episode is the e-th episode of the single environment."""
    batch = SlicingVectorEnv(scenario, gains, 3)
    observation, _ = batch.reset(seed=7)
    single = SlicingEnv(scenario, gains)
    actions = actions_of((6, 3, 5))
    rows = [observation]
    rewards, costs = [], []
    for slot in range(6):
        observation, reward, _, truncated, info = batch.step(actions[slot])
        last = slot == 5
        assert (truncated == last).all()
        rows.append(np.stack(list(info["final_obs"])) if last else observation)
        rewards.append(reward)
        costs.append((info["final_info"] if last else info)["cost"])
    for env in range(3):
        first, _ = single.reset(seed=7 if env == 0 else None)
        np.testing.assert_array_equal(first, rows[0][env])
        for slot in range(6):
            seen, reward, terminated, truncated, info = single.step(actions[slot, env])
            np.testing.assert_array_equal(seen, rows[slot + 1][env])
            assert reward == rewards[slot][env]
            assert info["cost"] == costs[slot][env]
            assert not terminated
            assert truncated == (slot == 5)


def test_the_batch_goes_on_in_new_worlds_in_the_step_that_ends_an_episode(scenario, gains):
    batch = SlicingVectorEnv(scenario, gains, 2, num_slots=1)
    batch.reset(seed=3)
    observation, _, _, truncated, info = batch.step(actions_of((2, 5)))
    assert truncated.all()
    assert info["_final_obs"].all()
    keys = np.array([world_key("env", 3, index) for index in (2, 3)], np.uint64)
    fresh = Simulator(scenario, gains, keys, 1).features(np.zeros((2, 3)))
    np.testing.assert_array_equal(observation, fresh)
    assert not np.array_equal(info["final_obs"][0], observation[0])


def test_both_views_of_a_world_agree(scenario, gains):
    single, pair = SlicingEnv(scenario, gains), SlicingParallelEnv(scenario, gains)
    seen, _ = single.reset(seed=5)
    views, _ = pair.reset(seed=5)
    for slot in range(6):
        np.testing.assert_array_equal(
            np.concatenate((views["urllc"][:, :8], views["embb"][:, :8])), seen
        )
        action = actions_of(5, slot)
        seen, reward, _, _, info = single.step(action)
        views, rewards, _, truncated, infos = pair.step({"urllc": action[:3], "embb": action[3:]})
        assert rewards == {"urllc": pytest.approx(reward), "embb": pytest.approx(reward)}
        assert infos["urllc"]["cost"] == info["cost"]
    assert truncated == {"urllc": True, "embb": True}
    assert pair.agents == []


def test_the_environment_charges_the_robots_tracking_error(scenario, gains):
    priced = replace(scenario, learning=replace(scenario.learning, task_weight=4.0))
    plain, task = (SlicingVectorEnv(one, gains, 2) for one in (scenario, priced))
    for env in (plain, task):
        env.reset(seed=1)
    _, without, *_ = plain.step(np.zeros((2, 5), np.float32))
    _, reward, *_ = task.step(np.zeros((2, 5), np.float32))
    error_cm = 100.0 * task._loop.record.tracking_error_m[:, 0].mean(axis=1)
    cost = 4.0 * error_cm / scenario.learning.reward_scale
    np.testing.assert_allclose(without - reward, 0.5 * cost)
    assert (cost > 0.0).all()


def test_with_equal_actions_the_environment_is_proportional_fair(scenario, gains):
    batch = SlicingVectorEnv(scenario, gains, 2)
    batch.reset(seed=1)
    keys = np.array([world_key("env", 1, index) for index in range(2)], np.uint64)
    record = Simulator(scenario, gains, keys, 6).run("pf")
    for slot in range(6):
        *_, info = batch.step(np.zeros((2, 5), np.float32))
        info = info.get("final_info", info)
        np.testing.assert_array_equal(info["prb_count"], record.num_prb[:, slot])
        np.testing.assert_array_equal(info["cost"], record.late_packets[:, slot, :3].sum(-1))


def test_steps_that_cannot_be_each_say_why(scenario, gains):
    """Before the first reset, of another shape, past the end."""
    users, slots = scenario.num_users, scenario.learning.slots_per_episode
    env = SlicingEnv(scenario, gains)
    with pytest.raises(ResetNeeded, match="the first episode has not begun: call reset first"):
        env.step(np.zeros(users, np.float32))
    env.reset(seed=1)
    for wrong in (np.zeros(users + 1), np.zeros((1, users)), np.float32(0.0)):
        with pytest.raises(ValueError, match=rf"actions: shape \(.*\), must be \(1, {users}\)"):
            env.step(wrong)
    with pytest.raises(ValueError, match=r"actions: must lie in \[-1, 1\]"):
        env.step(np.full(users, np.nan))
    for _ in range(slots):
        *_, truncated, _ = env.step(np.zeros(users))
    assert truncated
    with pytest.raises(ResetNeeded, match=f"the episode of {slots} slots is over: call reset"):
        env.step(np.zeros(users))
    both = SlicingParallelEnv(scenario, gains)
    both.reset(seed=1)
    with pytest.raises(ValueError, match="actions of urllc: must be of urllc, embb"):
        both.step({"urllc": np.zeros(3)})
