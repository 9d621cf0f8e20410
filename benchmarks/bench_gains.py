"""Speed of the gain table: its design, its way from the cache, and the look-up of one gain.

python benchmarks/bench_gains.py
"""

from __future__ import annotations

import logging
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hiersched.control.schedule import GainSchedule, load_or_build
from hiersched.scenario import load_scenario
from hiersched.simulator.gains import plant_of

CONFIG = Path(__file__).resolve().parents[1] / "config"


def cpu_seconds(work: Callable[[], object], rounds: int) -> float:
    """Median CPU-seconds of a call."""
    seconds = []
    for _ in range(rounds):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return statistics.median(seconds)


def look_up(schedule: GainSchedule, delays: list[int]) -> None:
    for delay in delays:
        schedule.gain(delay)


def run() -> dict[str, float]:
    """Print a table and return CPU-seconds by name."""
    logging.getLogger("hiersched").setLevel(logging.ERROR)
    scenario = load_scenario(CONFIG / "scenarios/paper.yaml", defaults=CONFIG / "defaults.yaml")
    plant, steps = plant_of(scenario), scenario.max_delay_steps
    delays = np.random.default_rng(1).integers(0, steps + 1, 10_000).tolist()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "schedule.json")
        result = {"design": cpu_seconds(lambda: load_or_build(path, plant, steps), 1)}
        result["from the cache"] = cpu_seconds(lambda: load_or_build(path, plant, steps), 5)
        schedule = load_or_build(path, plant, steps)
    result["look-up"] = cpu_seconds(lambda: look_up(schedule, delays), 5) / len(delays)
    print(f"gain table, T = 0..{steps}, {schedule.method}, CPU time")
    print(f"  design          {result['design']:10.2f} s (solver's first import included)")
    print(
        f"  from the cache  {result['from the cache'] * 1e3:10.1f} ms (every certificate checked)"
    )
    print(f"  look-up         {result['look-up'] * 1e9:10.0f} ns")
    return result


if __name__ == "__main__":
    run()
