"""Speed of the environments, beside others: slots per CPU-second under random actions.

python benchmarks/bench_env.py [--short]

Ours are of the scenario `paper` (20 users, 25 PRBs), with episodes of 200 slots whose beginnings
count; medians of rounds in which the contenders take turns. CartPole's native vector environment is
what a step of Gymnasium costs with next to no physics. stable-baselines3 (hiersched[sb3]) and
mobile-env, whose cell has 15 users and 4 stations (hiersched[wrappers]), are compared where they
are installed.
"""

from __future__ import annotations

import importlib.util
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

from common import Figure, main, speed_figures

# isort: split
import gymnasium

import hiersched
from hiersched.env import SlicingParallelEnv

MANY = 64
SINGLE = "environment, one world"
BATCH = f"environment, {MANY} worlds"
PAIR = "environment, PettingZoo, one world"
VEC = f"environment, stable-baselines3's VecEnv, {MANY} worlds"
DUMMY = f"environment, {MANY} single ones in stable-baselines3's DummyVecEnv"
CARTPOLE = f"CartPole, Gymnasium's native {MANY} worlds"
MOBILE = "mobile-env, one world"
MAKE = "hiersched.make('paper') and the first slot, in a new process"
MAKE_CODE = """
import hiersched
env = hiersched.make("paper")
env.reset(seed=1)
env.step(env.action_space.sample())
"""
COMPARED = {
    BATCH: (SINGLE, 3.0),
    PAIR: (SINGLE, 0.4),
    VEC: (BATCH, 0.4),
    DUMMY: (VEC, None),
    CARTPOLE: (BATCH, None),
    MOBILE: (SINGLE, None),
}
"""Contender -> with whose speed its own is compared, and the least ratio of ours."""


def one_world(env: Any, slots: int) -> Callable[[], int]:
    """Steps of a Gymnasium environment; the actions are drawn beforehand."""
    actions = [env.action_space.sample() for _ in range(slots)]
    env.reset(seed=1)

    def work() -> int:
        for action in actions:
            *_, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return slots

    return work


def two_agents(env: Any, slots: int) -> Callable[[], int]:
    """Steps of a PettingZoo environment."""
    spaces = {agent: env.action_space(agent) for agent in env.possible_agents}
    actions = [{agent: space.sample() for agent, space in spaces.items()} for _ in range(slots)]
    env.reset(seed=1)

    def work() -> int:
        for action in actions:
            env.step(action)
            if not env.agents:
                env.reset()
        return slots

    return work


def many_worlds(env: Any, slots: int) -> Callable[[], int]:
    """Steps of a vector environment that begins episodes by itself."""
    space = env.action_space
    batched = isinstance(env, gymnasium.vector.VectorEnv)
    actions = [
        space.sample() if batched else [space.sample() for _ in range(MANY)]
        for _ in range(max(1, slots // MANY))
    ]
    env.reset()

    def work() -> int:
        for action in actions:
            env.step(action)
        return len(actions) * MANY

    return work


def contenders(slots: int) -> dict[str, Callable[[], int]]:
    """Work by name."""
    cartpole = gymnasium.make_vec("CartPole-v1", MANY, vectorization_mode="vector_entry_point")
    works = {
        SINGLE: one_world(hiersched.make("paper"), slots),
        BATCH: many_worlds(hiersched.make("paper", MANY), 8 * slots),
        PAIR: two_agents(SlicingParallelEnv("paper"), slots),
    }
    if importlib.util.find_spec("stable_baselines3") is not None:
        from stable_baselines3.common.vec_env import DummyVecEnv

        from hiersched.env import SlicingVecEnv

        dummy = DummyVecEnv([lambda: hiersched.make("paper")] * MANY)
        works[VEC] = many_worlds(SlicingVecEnv("paper", num_envs=MANY), 8 * slots)
        works[DUMMY] = many_worlds(dummy, slots)
    works[CARTPOLE] = many_worlds(cartpole, 64 * slots)
    if importlib.util.find_spec("mobile_env") is not None:
        import mobile_env  # noqa: F401  # registers its environments

        works[MOBILE] = one_world(gymnasium.make("mobile-medium-central-v0"), slots // 8)
    return works


def speed(work: Callable[[], int]) -> float:
    """Slots per CPU-second of one call."""
    start = time.process_time()
    slots = work()
    return slots / (time.process_time() - start)


def process_seconds(code: str, rounds: int) -> float:
    """Median CPU-seconds of a new Python process that runs `code`."""
    seconds = []
    for _ in range(rounds):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-c", code], check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return statistics.median(seconds)


def run(short: bool) -> list[Figure]:
    """Slots per CPU-second, and what a new process takes to its first slot, once compiled."""
    works = contenders(200 if short else 2000)
    speeds: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(2 if short else 6):
        for name, work in works.items():
            seen = speed(work)
            if turn:  # the first one compiles, and fills the caches
                speeds[name].append(seen)
    rounds = 1 if short else 5
    make_s, import_s = (process_seconds(code, rounds) for code in (MAKE_CODE, "import gymnasium"))
    return [
        Figure(
            name=MAKE,
            value=make_s,
            unit="s",
            reference="import gymnasium",
            ratio=make_s / import_s,
            at_most=25.0,
        ),
        *speed_figures(speeds, COMPARED),
    ]


if __name__ == "__main__":
    main(run, __doc__)
