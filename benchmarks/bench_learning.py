"""Speed of learning at the paper's size, beside stable-baselines3's DDPG on the same environment.

python benchmarks/bench_learning.py [--short]

A round is one episode in every world of every seed; the first one, in which DDPG warms up, is left
out. stable-baselines3 is an extra (pip install 'hiersched[sb3]'); without it there is no such line.
"""

from __future__ import annotations

import importlib.util
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path

from common import Figure, cpu_seconds, main, paper

# isort: split
import numpy as np

from hiersched.core.randomness import world_keys
from hiersched.env import SlicingEnv
from hiersched.experiments.gains import design_gains
from hiersched.learning.trainer import Trainer, single_thread
from hiersched.scenario import Scenario
from hiersched.simulator import Gains, Simulator
from hiersched.simulator.loop_gains import loop_gains

SEEDS = tuple(range(1, 11))
VARIANTS = {
    "ddpg, shared 64-64": ({}, 0.011),
    "ddpg, mlp 64-64": ({"network": "mlp"}, 0.025),
    "a2c, shared 64-64": ({"algorithm": "a2c"}, 0.07),
    "a2c, shared 32-32": ({"algorithm": "a2c", "hidden": (32, 32)}, 0.1),
    "a2c, mlp 64-64": ({"algorithm": "a2c", "network": "mlp"}, 0.15),
    "a2c, mlp, 38 worlds": ({"algorithm": "a2c", "network": "mlp", "num_envs": 38}, 0.15),
    "es, linear, 3 worlds": (
        {
            "algorithm": "es",
            "network": "linear",
            "start": "drift_plus_penalty",
            "weighs": "drift",
            "num_envs": 39,
            "episodes": 390,
        },
        0.4,
    ),
}
"""Name -> keys of `learning` that differ from the scenario's, and the least speed as a multiple of
the speed of the same worlds under proportional fair, with nobody who learns."""


def learners(short: bool) -> tuple[Scenario, Gains]:
    """The scenario `paper` with ten seeds (short: two, and episodes of 50 slots), and its gains."""
    scenario = paper()
    learning = replace(scenario.learning, seeds=SEEDS)
    if short:
        learning = replace(learning, seeds=SEEDS[:2], slots_per_episode=50)
    scenario = replace(scenario, learning=learning)
    with tempfile.TemporaryDirectory() as folder:
        schedule = design_gains(scenario, "schedule", Path(folder, "schedule.json"))
    return scenario, loop_gains(schedule, scenario.control.gain)


def round_seconds(scenario: Scenario, gains: Gains) -> float:
    """CPU-seconds of a round of all seeds, the second one."""
    trainer = Trainer(scenario, gains)
    with single_thread():
        trainer.run_round(lambda record, slot: None)
        return cpu_seconds(lambda: trainer.run_round(lambda record, slot: None))


def simulator_seconds(scenario: Scenario, gains: Gains) -> float:
    """CPU-seconds of the same worlds under proportional fair."""
    learning = scenario.learning
    keys = world_keys("bench", 1, len(learning.seeds) * learning.num_envs)
    simulator = Simulator(scenario, gains, keys, learning.slots_per_episode)
    record = simulator.run("pf")  # compiles
    simulator.reset(keys)
    return cpu_seconds(lambda: simulator.run("pf", record=record))


def stable_baselines_seconds(scenario: Scenario, gains: Gains, slots: int) -> float:
    """CPU-seconds a slot of stable-baselines3's DDPG: one agent, one update a slot."""
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
        model.learn(2 * learning.batch_size)
        start = time.process_time()
        model.learn(slots, reset_num_timesteps=False)
        return (time.process_time() - start) / slots


def run(short: bool) -> list[Figure]:
    """Slots per CPU-second of a round."""
    scenario, gains = learners(short)
    figures = []
    speeds = {}
    for name, (changes, least) in VARIANTS.items():
        own = replace(scenario, learning=replace(scenario.learning, **changes))
        learning = own.learning
        seconds, alone = round_seconds(own, gains), simulator_seconds(own, gains)
        worlds = len(learning.seeds) * learning.num_envs
        speeds[name] = worlds * learning.slots_per_episode / seconds
        minutes = seconds * (learning.episodes // learning.num_envs) / 60.0
        figures.append(
            Figure(
                name=f"learning, {name}, {len(learning.seeds)} seeds "
                f"({minutes:.2f} CPU-min for all episodes, extrapolated)",
                value=speeds[name],
                unit="slots/s",
                reference=f"pf in the same {worlds} worlds",
                ratio=alone / seconds,
                at_least=least,
            )
        )
    if importlib.util.find_spec("stable_baselines3") is None:
        return figures
    per_slot = stable_baselines_seconds(scenario, gains, 200 if short else 2000)
    ours = next(iter(VARIANTS))
    learning = scenario.learning
    figures.append(
        Figure(
            name="learning, ddpg of stable-baselines3, one seed (one agent, an update a slot; ours "
            f"two agents, one every {learning.num_envs} slots)",
            value=1.0 / per_slot,
            unit="slots/s",
            reference=f"ours, {ours}",
            ratio=1.0 / (per_slot * speeds[ours]),
            at_most=0.13,
        )
    )
    return figures


if __name__ == "__main__":
    main(run, __doc__)
