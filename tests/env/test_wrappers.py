"""Wrappers and adapters of other packages, around our environments as a user puts them there."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.wrappers import vector as vector_wrappers

import hiersched  # noqa: F401  # registers the environment
from hiersched.env import SlicingEnv, SlicingParallelEnv

MODES = ["SameStep", "NextStep", "Disabled"]


@pytest.fixture
def make(scenario, gains):
    """One world by `gymnasium.make`, episodes of three slots."""
    return lambda **options: gymnasium.make(
        "hiersched/Slicing-v0", scenario=scenario, gains=gains, num_slots=3, **options
    )


@pytest.fixture
def make_vec(scenario, gains):
    """Two worlds by `gymnasium.make_vec`, episodes of three slots."""
    return lambda mode="NextStep", **options: gymnasium.make_vec(
        "hiersched/Slicing-v0", num_envs=2, scenario=scenario, gains=gains, num_slots=3,
        autoreset_mode=mode, **options,
    )  # fmt: skip


def steps(env, count, actions=None):
    """Go on under equal weights, with a reset first; what each step has returned."""
    env.reset(seed=1)
    actions = np.zeros(env.action_space.shape, np.float32) if actions is None else actions
    return [env.step(actions) for _ in range(count)]


def test_observations_are_flattened(make, make_vec):
    flat, plain = steps(wrappers.FlattenObservation(make()), 3), steps(make(), 3)
    np.testing.assert_array_equal(flat[2][0], plain[2][0].ravel())
    flat = steps(vector_wrappers.FlattenObservation(make_vec()), 8)
    plain = steps(make_vec(), 8)
    for one, other in zip(flat, plain, strict=True):
        np.testing.assert_array_equal(one[0], other[0].reshape(2, -1))


def test_observations_are_normalised(make, make_vec):
    steps(wrappers.NormalizeObservation(make()), 3)
    env, plain = vector_wrappers.NormalizeObservation(make_vec()), make_vec()
    seen = [plain.reset(seed=1)[0], *(out[0] for out in steps(plain, 40))]
    last = steps(env, 40)[-1][0]
    spread = np.sqrt(env.obs_rms.var + 1e-8)
    np.testing.assert_allclose(env.obs_rms.mean, np.mean(seen, axis=(0, 1)), atol=1e-3)
    np.testing.assert_allclose(last, (seen[-1] - env.obs_rms.mean) / spread, rtol=1e-5)


@pytest.mark.parametrize("mode", MODES)
def test_infos_become_a_list(make_vec, mode):
    *_, infos = steps(vector_wrappers.DictInfoToList(make_vec(mode)), 3)[-1]
    observation, *_, last = steps(make_vec(mode), 3)[-1]
    for world, info in enumerate(infos):
        if mode == "SameStep":
            np.testing.assert_array_equal(info["final_obs"], last["final_obs"][world])
            assert not np.array_equal(info["final_obs"], observation[world])
            info, found = info["final_info"], last["final_info"]
        else:
            found = last
        assert set(info) == {"cost", "due_packets", "reward_urllc", "reward_embb", "prb_count"}
        assert info["reward_urllc"] == found["reward_urllc"][world]
        np.testing.assert_array_equal(info["prb_count"], found["prb_count"][world])


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_statistics_are_those_of_each_episode(make_vec, mode):
    env = vector_wrappers.RecordEpisodeStatistics(make_vec(mode))
    recorded = [out[4]["episode"] for out in steps(env, 8) if "episode" in out[4]]
    rewards = np.array([out[1] for out in steps(make_vec(mode), 8)])
    starts = (0, 3) if mode == "SameStep" else (0, 4)
    assert len(recorded) == 2
    for episode, start in zip(recorded, starts, strict=True):
        assert episode["l"].tolist() == [3, 3]
        np.testing.assert_allclose(episode["r"], rewards[start : start + 3].sum(axis=0))


def test_statistics_of_one_world(make):
    env = wrappers.RecordEpisodeStatistics(make())
    outs = steps(env, 3)
    assert outs[2][4]["episode"]["l"] == 3
    assert outs[2][4]["episode"]["r"] == pytest.approx(sum(out[1] for out in outs))


@pytest.mark.parametrize("mode", MODES)
def test_all_that_is_returned_becomes_tensors(make, make_vec, mode):
    torch = pytest.importorskip("torch")
    pytest.importorskip("array_api_compat")  # Gymnasium's extra torch has it

    def tensors(value):
        if isinstance(value, dict):
            return all(tensors(part) for part in value.values())
        return isinstance(value, torch.Tensor)

    for env in (wrappers.NumpyToTorch(make()), vector_wrappers.NumpyToTorch(make_vec(mode))):
        outs = steps(env, 3, torch.zeros(env.action_space.shape))
        observation, *_, info = outs[-1]
        assert observation.dtype == torch.float32
        assert tensors(info)
        assert info


def test_frames_are_recorded(make, make_vec):
    pytest.importorskip("PIL")
    env = wrappers.RenderCollection(make(render_mode="rgb_array"))
    steps(env, 3)
    frames = env.render()
    assert len(frames) == 4
    assert not np.array_equal(frames[0], frames[3])
    assert len(make_vec(render_mode="rgb_array").metadata["render_modes"]) == 1


@pytest.mark.parametrize("name", ["flatten", "stack", "clip", "dtype", "skip", "delay", "sticky"])
def test_supersuit_wraps_one_world_and_both_agents(make, scenario, gains, name):
    supersuit = pytest.importorskip("supersuit")
    wrap, shape = {
        "flatten": (supersuit.flatten_v0, lambda shape: (np.prod(shape),)),
        "stack": (lambda env: supersuit.frame_stack_v1(env, 2), lambda shape: (*shape, 2)),
        "clip": (supersuit.clip_actions_v0, None),
        "dtype": (lambda env: supersuit.dtype_v0(env, np.float64), None),
        "skip": (lambda env: supersuit.frame_skip_v0(env, 3), None),
        "delay": (lambda env: supersuit.delay_observations_v0(env, 1), None),
        "sticky": (lambda env: supersuit.sticky_actions_v0(env, 0.5), None),
    }[name]
    shape = shape or (lambda shape: shape)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of bounds without precision in float64
        env = wrap(make())
        (observation, *_), *_ = steps(env, 1)
        assert observation.shape == shape((5, 8))
        both = wrap(SlicingParallelEnv(scenario, gains, num_slots=3))
        both.reset()
        observations, _, _, truncated, _ = both.step(
            {agent: np.zeros(both.action_space(agent).shape, np.float32) for agent in both.agents}
        )
    assert observations["urllc"].shape == shape((3, 24))
    assert observations["embb"].shape == shape((2, 24))
    assert truncated["urllc"] == (name == "skip")


@pytest.mark.parametrize("base", ["gymnasium", "stable_baselines3"])
def test_supersuit_makes_a_batch_of_both_agents(scenario, gains, base):
    """Copies of an environment, which have to be environments of their own."""
    supersuit = pytest.importorskip("supersuit")
    pytest.importorskip(base)
    env = supersuit.pad_action_space_v0(
        supersuit.pad_observations_v0(SlicingParallelEnv(scenario, gains, num_slots=3))
    )
    worlds = supersuit.concat_vec_envs_v1(
        supersuit.pettingzoo_env_to_vec_env_v1(env), 2, base_class=base
    )
    worlds.reset()
    actions = np.zeros((4, *worlds.action_space.shape[-1:]), np.float32)
    for _ in range(4):
        observation, reward, *_ = worlds.step(actions)
    assert observation.shape == (4, 3, 24)
    assert reward.shape == (4,)


def rollout(env):
    """Seven steps of TorchRL: where episodes end, and whether each step begins where one ended."""
    done = env.rollout(7, break_when_any_done=False)
    ends = done["next", "done"][..., 0].numpy()
    gaps = done["next", "observation"][..., :-1, :, :] - done["observation"][..., 1:, :, :]
    return ends, abs(gaps.numpy()).max(axis=(-2, -1)) == 0.0


@pytest.mark.parametrize("mode", [None, "SameStep", "Disabled"])
def test_torchrl_rolls_out(make, make_vec, mode):
    """A step begins with the observation that the one before returned, but where episodes begin."""
    torchrl = pytest.importorskip("torchrl.envs")
    if mode is None:
        env = torchrl.GymWrapper(make())
    else:
        env = torchrl.GymWrapper(make_vec(mode))
    torchrl.check_env_specs(env)
    env.set_seed(1)
    ends, joined = rollout(env)
    wanted = [False, False, True, False, False, True, False]
    assert (ends == np.array(wanted)).all()
    assert (joined == ~np.array(wanted[:-1])).all()


def test_torchrl_makes_the_environment_by_name_and_reads_infos():
    torchrl = pytest.importorskip("torchrl.envs")
    env = torchrl.GymEnv("hiersched/Slicing-v0", scenario="smoke", num_slots=3)
    env = env.auto_register_info_dict()
    env.set_seed(1)
    done = env.rollout(3, lambda *_: env.action_spec.zero())
    plain = SlicingEnv("smoke", num_slots=3)
    plain.reset(seed=1)  # as `set_seed` does
    plain.reset()
    for slot in range(3):
        observation, *_, info = plain.step(np.zeros(8, np.float32))
        np.testing.assert_array_equal(done["next", "observation"][slot], observation)
        assert float(done["next", "reward_urllc"][slot]) == info["reward_urllc"]
