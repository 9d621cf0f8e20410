"""Speed of the slot loop at U = 20, K = 25 (scenario `paper`), on one core.

python benchmarks/bench_slots.py [--short]

Slots per CPU-second: medians of rounds in which the contenders take turns. The floor is what no
policy can avoid: the fading draws and the rates of all user-PRB pairs. The trial kernel, written
before this package, did 22 to 26 % of its floor under proportional fair, on another machine.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from common import Figure, main, paper, some_policy, speed_figures

# isort: split
import numpy as np

from hiersched.core.compiled import kernel
from hiersched.core.pointer import Pointer
from hiersched.core.randomness import world_keys
from hiersched.policies.policy import View, Weights
from hiersched.scenario import Scenario, load_scenario
from hiersched.simulator import Simulator, SlotRecord
from hiersched.simulator.gain_source import scenario_gains
from hiersched.simulator.loop import draw_channel
from hiersched.simulator.loop_gains import nominal_gains
from hiersched.simulator.simulator import AnyPolicy

SLOTS = 200
FLOOR = "fading draws and rates alone, 64 worlds"
BATCH = "pf, 64 worlds, 200 slots a call"
CALL = "pf, one world, 200 slots a call"
TEN = "pf, 10 worlds, 200 slots a call"
PYTHON = "a policy in Python, 10 worlds"
PRESENT = "teleop_fading, robots know their reference, 64 worlds"
SCHEDULE = "paper, drift_plus_penalty, gains of every delay, 64 worlds"
COMPARED = {
    "the 10 robots alone, 64 worlds": (FLOOR, 0.3),
    BATCH: (FLOOR, 0.11),
    "drift_plus_penalty, 64 worlds, 200 slots a call": (FLOOR, 0.08),
    CALL: (BATCH, 0.5),
    TEN: (BATCH, 0.7),
    "pf, one world, one slot a call": (CALL, 0.2),
    "a trained policy (shared, 64-64), 64 worlds": (BATCH, 0.2),
    "a trained policy (mlp, 64-64), 64 worlds": (BATCH, 0.3),
    PYTHON: (TEN, 0.45),
    PRESENT: (FLOOR, 0.05),
    "teleop_fading, set-points held, 64 worlds": (PRESENT, 0.85),
    "teleop_fading, set-points extrapolated, 64 worlds": (PRESENT, 0.7),
    SCHEDULE: (FLOOR, 0.08),
    "paper, filters in the loops, 64 worlds": (SCHEDULE, 0.72),
    "paper, filters that know the motion, 64 worlds": (SCHEDULE, 0.72),
}
"""Contender -> with whose speed its own is compared, and the least ratio."""


@kernel()
def draw_floor(plugs, constants, state, slot, slots):
    """Draw `slots` slots of every world, and nothing else."""
    for env in range(state.key.shape[0]):
        for _ in range(slots):
            state.slot[env] += 1
            draw_channel(plugs, constants, state, slot, env)


def simulator(num_envs: int, num_slots: int = SLOTS, scenario: Scenario | None = None) -> Simulator:
    """Worlds of a scenario, `paper` unless given; without one with the nominal gain throughout."""
    gains = nominal_gains(paper()) if scenario is None else scenario_gains(scenario)
    scenario = paper() if scenario is None else scenario
    return Simulator(scenario, gains, world_keys("bench", 1, num_envs), num_slots)


class Waits:
    """A policy in Python: users weigh the more the longer they wait."""

    def decide(self, view: View) -> Weights:
        return Weights(1.0 + view.hol_delay_s)


def episodes(
    worlds: Simulator, policy: AnyPolicy, count: int, step: int = SLOTS
) -> Callable[[], int]:
    """Run `count` episodes of SLOTS slots, `step` slots a call; only the calls are timed."""
    keys = worlds.state.key.copy()
    record = worlds.new_record(step)

    def work() -> int:
        for _ in range(count):
            clock.stop()
            worlds.reset(keys)
            clock.start()
            for _ in range(SLOTS // step):
                worlds.run(policy, record=record)
        return count * SLOTS * worlds.num_envs

    return work


class Clock:
    """CPU time; can be stopped for what is not measured."""

    def __init__(self) -> None:
        self.cpu_s = 0.0

    def start(self) -> None:
        self._cpu = time.process_time()

    def stop(self) -> None:
        self.cpu_s += time.process_time() - self._cpu


clock = Clock()


def measure(work: Callable[[], int]) -> float:
    """Slots per CPU-second of one call."""
    clock.cpu_s = 0.0
    clock.start()
    slots = work()
    clock.stop()
    return slots / clock.cpu_s


def contenders() -> dict[str, Callable[[], int]]:
    """Work by name, each of a few tens of milliseconds."""
    many, ten, one = simulator(64), simulator(10), simulator(1)

    def floor() -> int:
        where = Pointer(many._plugs), many._constants, many._state, many._slot
        draw_floor(*where, SLOTS)
        return 64 * SLOTS

    def robots() -> int:
        clock.stop()
        many.reset(many.state.key)
        clock.start()
        many.run_robots(delay_s)
        return 64 * SLOTS

    delay_s = np.full((64, SLOTS, many.scenario.users.num_urllc), 0.015)
    teleop = load_scenario("teleop_fading")
    late = [
        simulator(64, scenario=replace(teleop, robot=replace(teleop.robot, set_point=name)))
        for name in ("present", "hold", "extrapolate")
    ]
    lqg = {"method": "lqg", "hold_samples": 0}
    looped = [
        simulator(64, scenario=replace(paper(), control=replace(paper().control, **keys)))
        for keys in ({}, lqg, {**lqg, "known_motion": True})
    ]
    shared, flat = (some_policy(many.scenario, learner) for learner in ("ddpg", "ddpg_mlp"))
    works = (
        robots,
        episodes(many, "pf", 1),
        episodes(many, "drift_plus_penalty", 1),
        episodes(one, "pf", 40),
        episodes(ten, "pf", 4),
        episodes(one, "pf", 10, step=1),
        episodes(many, shared, 1),
        episodes(many, flat, 1),
        episodes(ten, Waits(), 4),
        *(episodes(worlds, "drift_plus_penalty", 1) for worlds in (*late, *looped)),
    )
    return {FLOOR: floor, **dict(zip(COMPARED, works, strict=True))}


def batch_is_single(policy: str) -> bool:
    """Whether every row of a batch of 64 has the bits of the world run alone, in all fields."""
    batch = simulator(64)
    keys = batch.state.key.copy()
    together, one = batch.run(policy), simulator(1)
    for env in range(64):
        one.reset(keys[env : env + 1])
        alone = one.run(policy)
        for name in SlotRecord._fields:
            if getattr(together, name)[env].tobytes() != getattr(alone, name)[0].tobytes():
                return False
    return True


def run(short: bool) -> list[Figure]:
    """Slots per CPU-second; raises if a batch has other bits than its worlds one by one."""
    for policy in ("pf", "drift_plus_penalty"):
        if not batch_is_single(policy):
            raise RuntimeError(f"{policy}: 64 worlds in a batch and one by one differ")
    works = contenders()
    for work in works.values():  # compile, and fill the caches
        measure(work)
    speeds: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(3 if short else 9):
        for name, work in works.items():
            speeds[name].append(measure(work))
    return speed_figures(speeds, COMPARED)


if __name__ == "__main__":
    main(run, __doc__)
