"""Growth of the second moments of a scenario's loops over the delays that a run had."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.control import GainSchedule
from hiersched.control.second_moments import (
    chain_of_counts,
    count_transitions,
    second_moment_growth,
)
from hiersched.scenario import Scenario
from hiersched.simulator.loop_gains import plant_of


class LoopGrowth(NamedTuple):
    """Factors a sample; below 1 the second moment of the linear loop shrinks."""

    nominal: float  # of the nominal gain
    followed: float  # of the scenario's gains, each delay's at once
    in_force: float  # of the scenario's loop as it runs


def sampled_delays(
    delay_steps: NDArray[Any], scenario: Scenario, slot_s: float
) -> NDArray[np.int64]:
    """Return the delays at the control samples, (samples, R), from those of slots, (T, R)."""
    per_sample = scenario.control.sampling_s / slot_s
    count = int(len(delay_steps) / per_sample + 1e-9)
    slots = np.floor(np.arange(count) * per_sample + 1e-9).astype(np.int64)
    steps: NDArray[np.int64] = np.asarray(delay_steps, dtype=np.int64)
    return np.asarray(steps[slots], dtype=np.int64)


def loop_growth(
    scenario: Scenario, schedule: GainSchedule, counts: NDArray[np.float64]
) -> LoopGrowth:
    """Return the growth over a robot's delays, as counted by `count_transitions`.

    ValueError if not all feedback crosses the network, or nothing was counted.
    """
    plant, control = plant_of(scenario), scenario.control
    if plant.kind != "network":
        raise ValueError(f"control.loop = {control.loop!r}: must be 'network'")
    chain = chain_of_counts(counts)
    fixed = np.repeat(schedule.nominal[None], len(schedule.gains), axis=0)
    nominal = second_moment_growth(plant.A, plant.B, fixed, chain)
    if schedule.lqg is not None:
        followed = in_force = schedule.lqg.growth
    else:
        tables = plant.A, plant.B, schedule.gains
        followed = in_force = second_moment_growth(*tables, chain, schedule.input_gains)
        if control.hold_samples:
            held = chain_of_counts(counts, hold_samples=control.hold_samples)
            in_force = second_moment_growth(*tables, held, schedule.input_gains)
    return LoopGrowth(nominal, followed, nominal if control.gain == "nominal" else in_force)


def worst_robot(
    scenario: Scenario, schedule: GainSchedule, delay_steps: NDArray[Any], slot_s: float
) -> tuple[int, LoopGrowth]:
    """Return the robot whose loop in force grows most over the delays (T, R) of slots, and how."""
    delays = sampled_delays(delay_steps, scenario, slot_s)
    growths = [
        loop_growth(scenario, schedule, count_transitions(own[:, None], scenario.max_delay_steps))
        for own in delays.T
    ]
    worst = int(np.argmax([growth.in_force for growth in growths]))
    return worst, growths[worst]
