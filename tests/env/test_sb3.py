from __future__ import annotations

import gymnasium
import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from stable_baselines3 import A2C, PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from hiersched.env import SlicingEnv, SlicingVecEnv


@pytest.fixture
def worlds(scenario, gains):
    """Three worlds, episodes of two slots."""
    return SlicingVecEnv(scenario, gains, 3, num_slots=2)


def test_each_world_is_what_stable_baselines_makes_of_the_single_environment(scenario, gains):
    """Observations, rewards, ends and infos of the first world, whose next one is the second."""
    ours = SlicingVecEnv(scenario, gains, 1, num_slots=2)
    theirs = DummyVecEnv([lambda: SlicingEnv(scenario, gains, num_slots=2)])
    for env in (ours, theirs):
        env.seed(5)
    np.testing.assert_array_equal(ours.reset(), theirs.reset())
    rng = np.random.default_rng(0)
    for slot in range(5):
        actions = rng.uniform(-1, 1, (1, 5)).astype(np.float32)
        *found, infos = ours.step(actions)
        *wanted, wanted_infos = theirs.step(actions)
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_array_equal(one, other)
            assert one.dtype == other.dtype
        assert infos[0].keys() == wanted_infos[0].keys()
        for name, value in wanted_infos[0].items():
            np.testing.assert_array_equal(infos[0][name], value)
        assert ("terminal_observation" in infos[0]) == infos[0]["TimeLimit.truncated"]
        assert found[2].all() == (slot in (1, 3))


def test_worlds_of_a_seed_are_those_of_the_batch(scenario, gains, worlds):
    from hiersched.env import SlicingVectorEnv

    wanted, _ = SlicingVectorEnv(scenario, gains, 3).reset(seed=9)
    worlds.seed(9)
    np.testing.assert_array_equal(worlds.reset(), wanted)
    assert not np.array_equal(worlds.reset(), wanted)  # a seed counts once


def test_attributes_and_methods_are_those_of_all_worlds(worlds):
    assert worlds.env_is_wrapped(Monitor) == [False] * 3
    assert worlds.env_is_wrapped(gymnasium.Wrapper, [0, 2]) == [False] * 2
    assert worlds.get_attr("render_mode", 1) == [None]
    assert not worlds.has_attr("nothing")
    worlds.env_method("reset", seed=4)
    worlds.set_attr("metadata", {}, [2, 0, 1])
    assert worlds.get_attr("metadata") == [{}] * 3
    with pytest.raises(ValueError, match=r"set_attr\('metadata'\): worlds \[0\], must be all"):
        worlds.set_attr("metadata", {}, [0])
    with pytest.raises(ValueError, match=r"env_method\('reset'\): worlds 1, must be all"):
        worlds.env_method("reset", indices=1)


def test_pictures_of_all_worlds_are_tiled(scenario, gains):
    pytest.importorskip("PIL")
    worlds = SlicingVecEnv(scenario, gains, 2, render_mode="rgb_array")
    worlds.reset()
    frames = worlds.get_images()
    image = worlds.render()
    height, width, _ = frames[0].shape
    assert image.shape == (2 * height, width, 3)
    np.testing.assert_array_equal(image[height:], frames[1])


def test_stable_baselines_accepts_the_single_environment(scenario, gains):
    check_env(SlicingEnv(scenario, gains))


@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_stable_baselines_learns_and_evaluates(scenario, gains, algorithm):
    """The mean return that VecMonitor writes down is that of the rewards."""
    worlds = VecMonitor(SlicingVecEnv(scenario, gains, 4))
    options = {"batch_size": 24} if algorithm is PPO else {}
    model = algorithm(
        "MlpPolicy", VecNormalize(worlds), n_steps=12, seed=1, device="cpu", **options
    )
    model.learn(96)
    assert {episode["l"] for episode in model.ep_info_buffer} == {6}
    fresh = VecMonitor(SlicingVecEnv(scenario, gains, 2))
    mean, _ = evaluate_policy(model, fresh, 4)
    assert np.isfinite(mean)
