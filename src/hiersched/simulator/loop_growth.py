"""Growth of the second moments of a scenario's loops over the delays that a run had."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

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
from hiersched.scenario import Scenario, kinds_of_robots
from hiersched.simulator.gain_source import BELIEVED
from hiersched.simulator.loop_gains import plant_of

GAINS: frozenset[Literal["nominal", "adjusted"]] = frozenset(("nominal", "adjusted"))
"""What `control.gain` may be."""


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

    ValueError if nothing of its loop crosses the network.
    """
    if scenario.loop_kind == "local":
        raise ValueError("control.loop = 'local': must be one that crosses the network")
    return plant_of(replace(scenario, control=replace(scenario.control, believed_lag_s=None)))


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


def growth_in_force(
    scenario: Scenario,
    schedule: GainSchedule,
    counts: NDArray[np.float64],
    *,
    is_held: bool = True,
) -> float:
    """Return the growth of the loop as it runs, or as it were without a hold of its gains.

    `counts` and errors as for `loop_growth`.
    """
    control, plant = scenario.control, true_plant(scenario)
    if control.gain == "nominal":
        gains = np.repeat(schedule.nominal[None], len(schedule.gains), axis=0)
        return _growth(plant, counts, gains)
    if schedule.lqg is not None:
        return filter_growth(scenario, schedule.lqg)
    hold_samples = control.hold_samples if is_held else 0
    tables = schedule.gains, schedule.input_gains
    return _growth(plant, counts, *tables, hold_samples=hold_samples)


def loop_growth(
    scenario: Scenario,
    schedule: GainSchedule,
    counts: NDArray[np.float64],
    *,
    unheld: float | None = None,
) -> LoopGrowth:
    """Return the growth over a robot's delays, as counted by `count_transitions`.

    At delays beyond the longest with a gain that one is in force, on the measurement that there is.
    `unheld`: that of the loop in force without a hold, where it is known already. ValueError if
    nothing of the loop crosses the network.
    """
    control = scenario.control
    of_gain = {} if unheld is None else {control.gain: unheld}
    for gain in GAINS - of_gain.keys():
        variant = replace(scenario, control=replace(control, gain=gain))
        of_gain[gain] = growth_in_force(variant, schedule, counts, is_held=False)
    in_force = of_gain[control.gain]
    if control.gain == "adjusted" and control.hold_samples:
        in_force = growth_in_force(scenario, schedule, counts)
    return LoopGrowth(of_gain["nominal"], of_gain["adjusted"], in_force)


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
        return second_moment_growth(plant.A, plant.B, gains, chain, input_gains, A_d=plant.A_d)
    except ValueError:  # no delay recurs, or they are too long
        return math.nan


def of_robot(
    scenario: Scenario, schedule: GainSchedule, robot: int
) -> tuple[Scenario, GainSchedule]:
    """Return the scenario of a robot's kind, in which all are of that kind, and their gains."""
    kind = scenario.kind_of_robot[robot]
    return kinds_of_robots(scenario)[kind], (schedule, *schedule.kinds)[kind]


def greatest_growth(
    scenario: Scenario, schedule: GainSchedule, counts: NDArray[np.float64]
) -> float:
    """Return the growth of the kind of robots whose loop grows most; all have the same delays.

    NaN where one is not known. Arguments and errors as for `loop_growth`.
    """
    of_kinds = dict.fromkeys(scenario.kind_of_robot)
    robots = [scenario.kind_of_robot.index(kind) for kind in of_kinds]
    growths = [growth_in_force(*of_robot(scenario, schedule, r), counts) for r in robots]
    return float(np.max(growths))


def worst_unheld(
    scenario: Scenario, schedule: GainSchedule, counts: Sequence[NDArray[np.float64]]
) -> tuple[int, float]:
    """Return the robot whose loop in force, but for a hold, grows most, and its growth.

    `counts` are those of `count_transitions` for every robot. One that is not known comes first:
    the others are not followed then. Errors as of `loop_growth`.
    """
    worst, greatest = 0, -math.inf
    # Those whose delays are too long are told at once: they count as the longest.
    sizes = [len(own) if own.any() else math.inf for own in counts]
    for robot in sorted(range(len(counts)), key=lambda robot: (-sizes[robot], robot)):
        own = of_robot(scenario, schedule, robot)
        growth = growth_in_force(*own, counts[robot], is_held=False)
        if math.isnan(growth):
            return robot, growth
        if growth > greatest:
            worst, greatest = robot, growth
    return worst, greatest


def worst_growth(
    scenario: Scenario, schedule: GainSchedule, counts: Sequence[NDArray[np.float64]]
) -> tuple[int, LoopGrowth]:
    """Return the robot of `worst_unheld`, and its growth with all gains."""
    robot, unheld = worst_unheld(scenario, schedule, counts)
    own = of_robot(scenario, schedule, robot)
    return robot, loop_growth(*own, counts[robot], unheld=unheld)


def transitions(
    delay_steps: NDArray[Any], scenario: Scenario, slot_s: float
) -> list[NDArray[np.float64]]:
    """Count the transitions of every robot's delay from sample to sample (`count_transitions`).

    `delay_steps` (T, R) are those of slots.
    """
    delays = sampled_delays(delay_steps, scenario, slot_s)
    return [count_transitions(own[:, None]) for own in delays.T]
