"""Speed of the slot loop at U = 20, K = 25 (scenario `paper`), on one core.

    python benchmarks/bench_slots.py [rounds]

Slots per CPU-second and per second of wall time: medians of rounds in which the contenders take
turns. The floor is what no policy can avoid: the fading draws and the rates of all user-PRB pairs.
The trial kernel, written before this package, did 250-290 k slots/s beside a floor of 1.13 M.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hiersched.compiled import kernel
from hiersched.randomness import world_keys
from hiersched.scenario import load_scenario
from hiersched.simulator import Simulator, SlotRecord
from hiersched.simulator.gains import LoopGains, plant_of
from hiersched.simulator.kernel import draw_channel

CONFIG = Path(__file__).resolve().parents[1] / "config"
SLOTS = 200
TRIAL_SLOTS_PER_S = (250_000, 290_000)
TRIAL_FLOOR_PER_S = 1_130_000
FLOOR = "floor: fading draws and rates, 64 worlds"


@kernel()
def draw_floor(constants, state, scratch, slots):
    """Draw `slots` slots of every world, and nothing else."""
    for env in range(state.key.shape[0]):
        for _ in range(slots):
            state.slot[env] += 1
            draw_channel(constants, state, scratch, env, state.fading_power[env])


def simulator(num_envs: int, num_slots: int = SLOTS) -> Simulator:
    """Worlds of the scenario `paper` with the nominal gain at every delay."""
    scenario = load_scenario(CONFIG / "scenarios/paper.yaml", defaults=CONFIG / "defaults.yaml")
    network = np.repeat(plant_of(scenario).nominal_gain[None], scenario.max_delay_steps + 1, axis=0)
    gains = LoopGains.memoryless(network)
    return Simulator(scenario, gains, world_keys("bench", 1, num_envs), num_slots)


def episodes(worlds: Simulator, policy: str, count: int, step: int = SLOTS) -> Callable[[], int]:
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
    """CPU and wall time; can be stopped for what is not measured."""

    def __init__(self) -> None:
        self.cpu_s = self.wall_s = 0.0

    def start(self) -> None:
        self._cpu, self._wall = time.process_time(), time.perf_counter()

    def stop(self) -> None:
        self.cpu_s += time.process_time() - self._cpu
        self.wall_s += time.perf_counter() - self._wall


clock = Clock()


def measure(work: Callable[[], int]) -> tuple[float, float]:
    """Slots per CPU-second and per second of wall time of one call."""
    clock.cpu_s = clock.wall_s = 0.0
    clock.start()
    slots = work()
    clock.stop()
    return slots / clock.cpu_s, slots / clock.wall_s


def contenders() -> dict[str, Callable[[], int]]:
    """Work by name, each of a few tens of milliseconds."""
    many, one = simulator(64), simulator(1)

    def floor() -> int:
        draw_floor(many.constants, many.state, many._scratch, SLOTS)
        return 64 * SLOTS

    def robots() -> int:
        clock.stop()
        many.reset(many.state.key)
        clock.start()
        many.run_robots(delay_s)
        return 64 * SLOTS

    delay_s = np.full((64, SLOTS, many.scenario.users.num_urllc), 0.015)
    return {
        FLOOR: floor,
        "the 10 robots alone, 64 worlds": robots,
        "pf, batch of 64, 200 slots": episodes(many, "pf", 1),
        "pf, one world, 200 slots a call": episodes(one, "pf", 40),
        "pf, one world, one slot a call": episodes(one, "pf", 10, step=1),
        "drift_plus_penalty, batch of 64, 200 slots": episodes(many, "drift_plus_penalty", 1),
    }


def batch_is_single(policy: str = "pf") -> bool:
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


def run(rounds: int = 9) -> dict[str, tuple[float, float]]:
    """Print a table and return the medians of slots per CPU-second and wall second by name."""
    works = contenders()
    for work in works.values():  # compile, and fill the caches
        measure(work)
    speeds: dict[str, list[tuple[float, float]]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            speeds[name].append(measure(work))
    result = {
        name: (statistics.median(s[0] for s in seen), statistics.median(s[1] for s in seen))
        for name, seen in speeds.items()
    }
    floor = result[FLOOR][0]
    print(f"slot loop, 20 users, 25 PRBs, 10 robots, one core, medians of {rounds} rounds")
    print(f"  {'':44} {'slots/CPU-s':>12} {'slots/wall-s':>13} {'of the floor':>13}")
    for name, (cpu, wall) in result.items():
        print(f"  {name:44} {cpu:12,.0f} {wall:13,.0f} {cpu / floor:13.1%}")
    low, high = TRIAL_SLOTS_PER_S
    batch = result["pf, batch of 64, 200 slots"][0]
    print(
        f"  trial kernel: {low:,}-{high:,} slots/s beside a floor of {TRIAL_FLOOR_PER_S:,} "
        f"({low / TRIAL_FLOOR_PER_S:.0%}-{high / TRIAL_FLOOR_PER_S:.0%} of it);\n"
        f"  here the batch does {batch / high:.2f}-{batch / low:.2f} times its speed, and the "
        f"floor {floor / TRIAL_FLOOR_PER_S:.2f} times its floor's"
    )
    equal = all(batch_is_single(policy) for policy in ("pf", "drift_plus_penalty"))
    print(
        f"  64 worlds in a batch and one by one: {'the same bits' if equal else 'DIFFERENT BITS'}"
    )
    if not equal:
        raise SystemExit("a batch and its single worlds differ")
    return result


if __name__ == "__main__":
    run(*map(int, sys.argv[1:2]))
