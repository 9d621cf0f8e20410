"""Speed of learning at the paper's size, beside stable-baselines3's DDPG on the same environment.

python benchmarks/bench_learning.py
"""

from __future__ import annotations

import importlib.util
import logging
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from hiersched.env import SlicingEnv
from hiersched.learning.policy import single_thread
from hiersched.learning.trainer import Trainer
from hiersched.runs.gains import design_gains
from hiersched.scenario import Scenario, load_scenario
from hiersched.simulator import Gains
from hiersched.simulator.gains import loop_gains

CONFIG = Path(__file__).resolve().parents[1] / "config"
SEEDS = tuple(range(1, 11))
SB3_SLOTS = 2000

VARIANTS = {
    "ddpg, shared 64-64": {},
    "ddpg, mlp 64-64": {"network": "mlp"},
    "a2c, shared 64-64": {"algorithm": "a2c"},
    "a2c, shared 32-32": {"algorithm": "a2c", "hidden": (32, 32)},
    "a2c, mlp 64-64": {"algorithm": "a2c", "network": "mlp"},
    "a2c, mlp, 38 worlds": {"algorithm": "a2c", "network": "mlp", "num_envs": 38},
}


def paper() -> tuple[Scenario, Gains]:
    """The paper's scenario with ten seeds, and its gains."""
    logging.getLogger("hiersched").setLevel(logging.ERROR)
    scenario = load_scenario(CONFIG / "scenarios/paper.yaml", defaults=CONFIG / "defaults.yaml")
    scenario = replace(scenario, learning=replace(scenario.learning, seeds=SEEDS))
    with tempfile.TemporaryDirectory() as folder:
        schedule = design_gains(scenario, "schedule", Path(folder, "schedule.json"))
    return scenario, loop_gains(schedule, scenario.control.gain)


def round_seconds(scenario: Scenario, gains: Gains) -> float:
    """CPU-seconds of a round of all seeds; the first one, in which DDPG warms up, is left out."""
    trainer = Trainer(scenario, gains)
    with single_thread():
        trainer.run_round(lambda record, slot: None)
        start = time.process_time()
        trainer.run_round(lambda record, slot: None)
        return time.process_time() - start


def stable_baselines_seconds(scenario: Scenario, gains: Gains) -> float | None:
    """CPU-seconds a slot of stable-baselines3's DDPG, one update of one agent a slot, or None."""
    if importlib.util.find_spec("stable_baselines3") is None:
        return None
    from gymnasium.wrappers import FlattenObservation
    from stable_baselines3 import DDPG
    from stable_baselines3.common.noise import NormalActionNoise

    learning = scenario.learning
    size = scenario.num_users
    with single_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = DDPG(
            "MlpPolicy",
            FlattenObservation(SlicingEnv(scenario, gains)),
            batch_size=learning.batch_size,
            learning_starts=learning.batch_size,
            buffer_size=learning.replay_capacity,
            policy_kwargs={"net_arch": list(learning.hidden)},
            action_noise=NormalActionNoise(np.zeros(size), np.full(size, 0.4)),
            device="cpu",
            seed=SEEDS[0],
        )
        model.learn(10 * learning.batch_size)
        start = time.process_time()
        model.learn(SB3_SLOTS, reset_num_timesteps=False)
        return (time.process_time() - start) / SB3_SLOTS


def run() -> dict[str, tuple[float, float]]:
    """Print a table; return slots/s and CPU-minutes of the whole training by name."""
    scenario, gains = paper()
    result = {}
    print(f"learning, {len(SEEDS)} seeds side by side, two agents each, CPU time")
    for name, changes in VARIANTS.items():
        learning = replace(scenario.learning, **changes)
        seconds = round_seconds(replace(scenario, learning=learning), gains)
        slots = len(SEEDS) * learning.num_envs * learning.slots_per_episode
        minutes = seconds * (learning.episodes // learning.num_envs) / 60.0
        result[name] = (slots / seconds, minutes)
        print(f"  {name:22s} {slots / seconds:8,.0f} slots/s, {minutes:6.2f} min")
    per_slot = stable_baselines_seconds(scenario, gains)
    if per_slot is None:
        print("  stable-baselines3      skipped: not installed (pip install 'hiersched[sb3]')")
        return result
    learning = scenario.learning
    slots = len(SEEDS) * learning.episodes * learning.slots_per_episode
    minutes = slots * per_slot / 60.0
    result["stable-baselines3"] = (1.0 / per_slot, minutes)
    print(
        f"  stable-baselines3      {1.0 / per_slot:8,.0f} slots/s, {minutes:6.1f} min "
        f"(one agent, seed after seed, one update of {learning.batch_size} a slot; extrapolated "
        f"from {SB3_SLOTS} slots.\n   Ours: one update of {learning.batch_size} every "
        f"{learning.num_envs} slots, of two agents with every user's rows)"
    )
    return result


if __name__ == "__main__":
    run()
