from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import cloudpickle
import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

import hiersched
from hiersched.env import SlicingEnv, SlicingVectorEnv
from hiersched.scenario import ScenarioError, load_scenario

ID = "hiersched/Slicing-v0"


def first(env, seed=3):
    observation, _ = env.reset(seed=seed)
    return observation


def test_gymnasium_makes_the_environment_of_a_named_scenario():
    env = gymnasium.make(ID, scenario="smoke", num_slots=3)
    assert isinstance(env.unwrapped, SlicingEnv)
    np.testing.assert_array_equal(first(env), first(SlicingEnv(load_scenario("smoke"))))
    for _ in range(3):
        *_, truncated, _ = env.step(np.zeros(env.action_space.shape, np.float32))
    assert truncated
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    np.testing.assert_array_equal(first(again), first(env))


@pytest.mark.parametrize(
    ("mode", "kind"),
    [(None, SlicingVectorEnv), ("sync", SyncVectorEnv), ("async", AsyncVectorEnv)],
)
def test_gymnasium_makes_a_batch_and_the_native_one_unless_told_otherwise(mode, kind):
    env = gymnasium.make_vec(ID, num_envs=2, vectorization_mode=mode, scenario="smoke")
    assert type(env) is kind
    assert first(env).shape == (2, 8, 8)
    reward = env.step(np.zeros(env.action_space.shape, np.float32))[1]
    assert reward.shape == (2,)
    env.close()


def test_make_takes_a_name_a_path_or_a_scenario(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("extends: smoke\n", encoding="utf-8")
    wanted = first(hiersched.make("smoke"))
    for scenario in (file, str(file), load_scenario("smoke")):
        np.testing.assert_array_equal(first(hiersched.make(scenario)), wanted)
    batch = hiersched.make("smoke", num_envs=2, num_slots=4)
    assert type(batch) is SlicingVectorEnv
    np.testing.assert_array_equal(first(batch)[0], wanted)
    assert hiersched.make().observation_space.shape == (20, 8)  # the scenario paper
    with pytest.raises(ScenarioError, match=r"papre: no such scenario; there are: .*paper"):
        hiersched.make("papre")


NEW_PROCESS = """
import sys
{first}
import gymnasium
assert not {{"numba", "torch", "hiersched.simulator"}} & set(sys.modules)
env = gymnasium.make("{id}", scenario="smoke")
assert env.reset(seed=1)[0].shape == (8, 8)
"""


@pytest.mark.parametrize(
    ("imported", "name"),
    [("import hiersched", ID), ("", f"hiersched:{ID}")],
)
def test_an_import_of_the_package_registers_it_and_loads_no_more(imported, name):
    code = NEW_PROCESS.format(first=imported, id=name)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.nightly
def test_the_first_environment_of_a_machine_says_that_it_compiles(tmp_path):
    code = 'import hiersched; env = hiersched.make("smoke"); env.reset(seed=1)'
    said = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        said.append(done.stderr.count("compiling kernels, once per machine"))
    assert said == [1, 0]


@pytest.mark.parametrize("kind", [SlicingEnv, SlicingVectorEnv])
def test_a_copy_is_made_anew_and_shares_nothing(scenario, gains, kind):
    """The simulator's memory lies behind addresses: copies of those would point into the void."""
    env = kind(scenario, gains, num_slots=2)
    first(env)
    copied = cloudpickle.loads(cloudpickle.dumps(env))
    actions = np.zeros(env.action_space.shape, np.float32)
    with pytest.raises(ResetNeeded, match="the first episode has not begun"):
        copied.step(actions)
    np.testing.assert_array_equal(first(copied), first(env))
    copied.step(actions)
    assert (copied._loop.simulator.slots_left, env._loop.simulator.slots_left) == (1, 2)


def test_frames_come_at_the_rate_of_the_slots(scenario, gains):
    radio = replace(scenario.radio, slot_s=0.005)
    robot = replace(scenario.robot, substep_s=0.005)
    faster = replace(scenario, radio=radio, robot=robot)
    assert SlicingEnv(scenario, gains).metadata["render_fps"] == round(1 / scenario.radio.slot_s)
    assert SlicingEnv(faster, gains).metadata["render_fps"] == 200
    assert SlicingEnv.metadata["render_fps"] == 100
