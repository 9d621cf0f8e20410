"""Growth of the second moments of a scenario's loops over the delays that a run had."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.control import (
    DelayedPlant,
    GainSchedule,
    Lqg,
    chain_of_counts,
    count_transitions,
    second_moment_growth,
)
from hiersched.scenario import Scenario
from hiersched.simulator.gain_source import BELIEVED
from hiersched.simulator.loop_gains import plant_of


class LoopGrowth(NamedTuple):
    """Factors a sample; below 1 the second moment of the linear loop shrinks; NaN: not known."""

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
    return np.asarray(delay_steps[slots], dtype=np.int64)


def true_plant(scenario: Scenario) -> DelayedPlant:
    """Return the linear plant that runs, whatever the controller believes of it.

    ValueError if not all of its feedback crosses the network.
    """
    truth = replace(scenario, control=replace(scenario.control, believed_lag_s=None))
    plant = plant_of(truth)
    if plant.kind != "network":
        raise ValueError(f"control.loop = {scenario.control.loop!r}: must be 'network'")
    return plant


def separates(scenario: Scenario) -> bool:
    """Whether a filter's inputs, stamps and beliefs are right, so that separation holds."""
    control = scenario.control
    return (
        control.link == "measurements"
        and control.stamp_error_samples == 0
        and all(scenario.believed(key) == getattr(scenario.robot, key) for key in BELIEVED)
    )


def filter_growth(scenario: Scenario, lqg: Lqg) -> float:
    """Return that of a loop with a filter where separation holds, else NaN."""
    return lqg.growth if separates(scenario) else math.nan


def loop_growth(
    scenario: Scenario, schedule: GainSchedule, counts: NDArray[np.float64]
) -> LoopGrowth:
    """Return the growth over a robot's delays, as counted by `count_transitions`.

    At delays beyond the longest with a gain that one is in force, on the measurement that there is.
    ValueError if not all feedback crosses the network.
    """
    control, plant = scenario.control, true_plant(scenario)
    nominal = _growth(plant, counts, _nominal_table(schedule))
    if schedule.lqg is not None:
        followed = in_force = filter_growth(scenario, schedule.lqg)
    else:
        tables = schedule.gains, schedule.input_gains
        followed = in_force = _growth(plant, counts, *tables)
        if control.hold_samples:
            in_force = _growth(plant, counts, *tables, hold_samples=control.hold_samples)
    return LoopGrowth(nominal, followed, nominal if control.gain == "nominal" else in_force)


def _nominal_table(schedule: GainSchedule) -> NDArray[np.float64]:
    return np.repeat(schedule.nominal[None], len(schedule.gains), axis=0)


def _growth(
    plant: DelayedPlant,
    counts: NDArray[np.float64],
    gains: NDArray[np.float64],
    input_gains: NDArray[np.float64] | None = None,
    *,
    hold_samples: int = 0,
) -> float:
    try:
        chain = chain_of_counts(counts, hold_samples=hold_samples, max_entry=len(gains) - 1)
        return second_moment_growth(plant.A, plant.B, gains, chain, input_gains)
    except ValueError:  # no delay recurs, or they are too long
        return math.nan


def unheld_growths(
    scenario: Scenario, schedule: GainSchedule, counts: Sequence[NDArray[np.float64]]
) -> list[float]:
    """Return the growth of every robot's loop in force, but for a hold of its gains.

    `counts` are those of `count_transitions` for every robot. Errors as of `loop_growth`.
    """
    plant = true_plant(scenario)
    if scenario.control.gain == "nominal":
        return [_growth(plant, own, _nominal_table(schedule)) for own in counts]
    if schedule.lqg is not None:
        return [filter_growth(scenario, schedule.lqg)] * len(counts)
    return [_growth(plant, own, schedule.gains, schedule.input_gains) for own in counts]


def worst_growth(
    scenario: Scenario, schedule: GainSchedule, counts: Sequence[NDArray[np.float64]]
) -> tuple[int, LoopGrowth]:
    """Return the robot of the greatest of `unheld_growths`, one that is not known first, and how.

    Arguments and errors as there.
    """
    growths = unheld_growths(scenario, schedule, counts)
    robot = int(np.argmax(np.nan_to_num(growths, nan=np.inf)))
    return robot, loop_growth(scenario, schedule, counts[robot])


def transitions(
    delay_steps: NDArray[Any], scenario: Scenario, slot_s: float
) -> list[NDArray[np.float64]]:
    """Count the transitions of every robot's delay from sample to sample (`count_transitions`).

    `delay_steps` (T, R) are those of slots.
    """
    delays = sampled_delays(delay_steps, scenario, slot_s)
    return [count_transitions(own[:, None]) for own in delays.T]
