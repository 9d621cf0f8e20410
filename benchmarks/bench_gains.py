"""Speed of the gain table: its design, its way from the cache, its switching report, a look-up.

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

from hiersched.control import GainSchedule, load_or_build, switching_report
from hiersched.scenario import load_scenario
from hiersched.simulator.gains import plant_of

CONFIG = Path(__file__).resolve().parents[1] / "config"
ALTERNATIVES = ("h2", "latency_compensated", "predictor")


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


def index(table: np.ndarray, delays: list[int]) -> None:
    for delay in delays:
        table[delay]


def run() -> dict[str, float]:
    """Print a table and return CPU-seconds by name."""
    logging.getLogger("hiersched").setLevel(logging.ERROR)
    scenario = load_scenario(CONFIG / "scenarios/paper.yaml", defaults=CONFIG / "defaults.yaml")
    plant, steps = plant_of(scenario), scenario.max_delay_steps
    delays = np.random.default_rng(1).integers(0, steps + 1, 10_000).tolist()
    result = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "schedule.json")
        result["design"] = cpu_seconds(lambda: load_or_build(path, plant, steps), 1)
        result["from the cache"] = cpu_seconds(lambda: load_or_build(path, plant, steps), 5)
        schedule = load_or_build(path, plant, steps)
        for method in ALTERNATIVES:
            other = Path(folder, f"{method}.json")
            result[method] = cpu_seconds(
                lambda other=other, method=method: load_or_build(other, plant, steps, method), 1
            )
    result["switching"] = cpu_seconds(lambda: switching_report(plant, schedule), 1)
    result["look-up"] = cpu_seconds(lambda: look_up(schedule, delays), 5) / len(delays)
    table = schedule.network_gains
    result["index"] = cpu_seconds(lambda: index(table, delays), 5) / len(delays)
    print(f"gain table, T = 0..{steps}, {schedule.method}, CPU time")
    print(f"  design          {result['design']:10.2f} s (goal 15; solver's import included)")
    for method in ALTERNATIVES:
        print(f"    {method:19s} {result[method]:4.2f} s")
    print(
        f"  from the cache  {result['from the cache'] * 1e3:10.1f} ms (every certificate checked)"
    )
    print(f"  switching       {result['switching']:10.2f} s (goal 60; every pair of gains)")
    print(f"  look-up         {result['look-up'] * 1e9:10.0f} ns (goal 1000; schedule.gain)")
    print(f"    by index          {result['index'] * 1e9:6.0f} ns (network_gains[delay])")
    return result


if __name__ == "__main__":
    run()
