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
    chain = chain_of_counts(counts)
    fixed = np.repeat(schedule.nominal[None], len(schedule.gains), axis=0)
    nominal = second_moment_growth(plant.A, plant.B, fixed, chain)
    followed = in_force = _followed(scenario, schedule, counts)
    if control.gain == "nominal":
        in_force = nominal
    elif control.hold_samples and schedule.lqg is None:
        held = chain_of_counts(counts, hold_samples=control.hold_samples)
        tables = schedule.gains, held, schedule.input_gains
        in_force = second_moment_growth(plant.A, plant.B, *tables)
    return LoopGrowth(nominal, followed, in_force)


def worst_growth(
    scenario: Scenario, schedule: GainSchedule, counts: NDArray[np.float64]
) -> tuple[int, LoopGrowth]:
    """Return the robot whose loop grows most with gains that follow its delays, and how.

    `counts` (R, T + 1, T + 1) are those of `count_transitions`. Errors as of `loop_growth`.
    """
    growths = [_followed(scenario, schedule, own) for own in counts]
    robot = int(np.argmax(growths))
    return robot, loop_growth(scenario, schedule, counts[robot])


def _followed(scenario: Scenario, schedule: GainSchedule, counts: NDArray[np.float64]) -> float:
    plant = plant_of(scenario)
    if plant.kind != "network":
        raise ValueError(f"control.loop = {scenario.control.loop!r}: must be 'network'")
    if schedule.lqg is not None:
        return schedule.lqg.growth
    tables = schedule.gains, chain_of_counts(counts), schedule.input_gains
    return second_moment_growth(plant.A, plant.B, *tables)


def transitions(
    delay_steps: NDArray[Any], scenario: Scenario, slot_s: float
) -> NDArray[np.float64]:
    """Count the transitions of every robot's delay from sample to sample: (R, T + 1, T + 1).

    `delay_steps` (T, R) are those of slots.
    """
    longest = scenario.max_delay_steps
    delays = sampled_delays(delay_steps, scenario, slot_s)
    return np.stack([count_transitions(own[:, None], longest) for own in delays.T])
