"""Speed of the gain table: its design, its way from the cache, its switching report, a look-up.

python benchmarks/bench_gains.py [--short]
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from common import Figure, cpu_seconds, main, paper

# isort: split
import numpy as np

from hiersched.control import GainDesigner, GainSchedule, load_or_build, switching_report
from hiersched.simulator.loop_gains import plant_of

ALTERNATIVES = {"h2": 3.0, "latency_compensated": 0.1, "predictor": 0.02}
"""Method -> most CPU time of its table, as a multiple of the default's."""
SHORT_STEPS = 4
"""Delays of the short form: up to the first one whose gain is adjusted."""


def look_up(schedule: GainSchedule, delays: list[int]) -> None:
    for delay in delays:
        schedule.gain(delay)


def index(table: np.ndarray, delays: list[int]) -> None:
    for delay in delays:
        table[delay]


def run(short: bool) -> list[Figure]:
    """CPU time of tables for the delays 0 … T_max of the scenario `paper`."""
    scenario = paper()
    plant, steps = plant_of(scenario), SHORT_STEPS if short else scenario.max_delay_steps
    rounds = 1 if short else 5
    delays = np.random.default_rng(1).integers(0, steps + 1, 10_000).tolist()
    what = f"gain table of {steps + 1} delays"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "schedule.json")
        GainDesigner(plant)  # imports the solver, which is not the design's time
        design_s = cpu_seconds(lambda: load_or_build(path, plant, steps))
        cache_s = cpu_seconds(lambda: load_or_build(path, plant, steps), rounds)
        schedule = load_or_build(path, plant, steps)
        others_s = {
            method: cpu_seconds(
                lambda method=method: load_or_build(
                    Path(folder, f"{method}.json"), plant, steps, method
                )
            )
            for method in ALTERNATIVES
        }
    switching_s = cpu_seconds(lambda: switching_report(plant, schedule))
    look_up_s = cpu_seconds(lambda: look_up(schedule, delays), rounds) / len(delays)
    index_s = cpu_seconds(lambda: index(schedule.network_gains, delays), rounds) / len(delays)
    by_design = f"design by {schedule.method}"
    return [
        Figure(name=f"{what}, {by_design}", value=design_s, unit="s"),
        *(
            Figure(
                name=f"{what}, design by {method}",
                value=seconds,
                unit="s",
                reference=by_design,
                ratio=seconds / design_s,
                at_most=ALTERNATIVES[method],
            )
            for method, seconds in others_s.items()
        ),
        Figure(
            name=f"{what}, from the cache, every certificate checked",
            value=1e3 * cache_s,
            unit="ms",
            reference=by_design,
            ratio=cache_s / design_s,
            at_most=0.004,
        ),
        Figure(
            name=f"{what}, switching report of all its gains",
            value=switching_s,
            unit="s",
            reference=by_design,
            ratio=switching_s / design_s,
            at_most=4.0,
        ),
        Figure(
            name="look-up of a gain, schedule.gain(T)",
            value=1e9 * look_up_s,
            unit="ns",
            reference="network_gains[T]",
            ratio=look_up_s / index_s,
            at_most=10.0,
        ),
    ]


if __name__ == "__main__":
    main(run, __doc__)
