"""How long a delay each loop of the gain study survives, and what each condition certifies."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hiersched.control import (
    DelayedPlant,
    GainSchedule,
    analyse_delay_razumikhin,
    analyse_krasovskii,
    analyse_razumikhin,
    certify,
    input_memory_radii,
    spectral_radius_by_delay,
)
from hiersched.core.files import write_bytes
from hiersched.experiments import files
from hiersched.experiments.gains import design_of, load_gains
from hiersched.experiments.points import experiments
from hiersched.scenario import Scenario
from hiersched.scenario.schema import delay_steps
from hiersched.simulator.loop_gains import plant_of

PLANTS: tuple[Literal["network", "split"], ...] = ("network", "split")
STABILITY_RATE = 1e-3
"""Decay that C1 has to certify here: next to none, so that its region is that of stability."""


def longest_delay(holds: Callable[[int], bool], cap: int) -> int | None:
    """Return the longest delay 0 … cap for which a condition holds, None if it does for none.

    The condition must be one that holds for every shorter delay too, such as a certificate for all
    delays up to T: it is searched by bisection.
    """
    if holds(cap):
        return cap
    certified, refuted = -1, cap
    while refuted - certified > 1:
        middle = (certified + refuted) // 2
        certified, refuted = (middle, refuted) if holds(middle) else (certified, middle)
    return certified if certified >= 0 else None


def last_stable(radii: NDArray[np.float64]) -> int | None:
    """Return the last delay before the first one whose loop is unstable, None if that is 0."""
    unstable = np.flatnonzero(radii >= 1.0)
    last = int(unstable[0]) - 1 if unstable.size else len(radii) - 1
    return last if last >= 0 else None


def certified_delays(plant: DelayedPlant, cap: int) -> dict[str, int | None]:
    """Return the longest delay 0 … cap of the nominal gain: exact, and by C1, C2 and C3.

    Exact is for constant delays, from the lifted system; the conditions cover delays that vary.
    """
    A_c, A_d = plant.closed_loop(plant.nominal_gain)
    exact = last_stable(spectral_radius_by_delay(A_c, A_d, cap))

    def certified(analyse: Callable[[int], Any]) -> int | None:
        def holds(T: int) -> bool:
            witness = analyse(T)
            return witness is not None and certify(A_c, A_d, T, witness).certified

        # No condition can certify a constant delay that is unstable.
        return None if exact is None else longest_delay(holds, exact)

    return {
        "exact": exact,
        "c1": certified(lambda T: analyse_razumikhin(A_c, A_d, T, STABILITY_RATE)),
        "c2": certified(lambda T: analyse_delay_razumikhin(A_c, A_d, T)),
        "c3": certified(lambda T: analyse_krasovskii(A_c, A_d, T)),
    }


def adjusted_delay(plant: DelayedPlant, schedule: GainSchedule, steps: int) -> int | None:
    """Return the longest constant delay that the gain made for `steps` survives, up to T_max."""
    gain, inputs, cap = schedule.gain(steps), schedule.input_gains[steps], schedule.max_delay_steps
    if inputs.any():
        return last_stable(input_memory_radii(plant.A, plant.B, gain, inputs, cap))
    return last_stable(spectral_radius_by_delay(*plant.closed_loop(gain), cap))


def write_stability(scenario: Scenario, results: Path) -> Path:
    """Compute the stability regions of the gain study and write them as JSON.

    Against the weight q: each nominal loop on both plants, and the scenario's own after adjustment
    to the longest delay of the grid. Against the sampling interval: the scenario's own loop, exact.
    Delays go up to T_max of `control`; the gain schedules lie in `results`, the study's folder.

    Returns the file, a list of rows: axis, value, plant, sampling_s, criterion, max_delay_steps
    (the longest that was looked at), delay_steps (null: not even 0).
    """
    rows = [*_weight_rows(scenario, results), *_sampling_rows(scenario)]
    text = json.dumps(rows, sort_keys=True, indent=1) + "\n"
    return write_bytes(results / files.STABILITY, text.encode())


def _weight_rows(scenario: Scenario, results: Path) -> list[dict[str, Any]]:
    rows = []
    loops = PLANTS if scenario.plant.chooses_loop else (scenario.control.loop,)
    for weight in scenario.gain_study.weight:
        own = replace(scenario, control=replace(scenario.control, weight=weight))
        cap = own.max_delay_steps
        for loop in loops:
            variant = replace(own, control=replace(own.control, loop=loop))
            for criterion, longest in certified_delays(plant_of(variant), cap).items():
                rows.append(_row("weight", weight, variant, criterion, longest))
        schedule, _ = load_gains(results / files.gain_file(design_of(scenario, own)), own)
        longest_s = max(scenario.gain_study.fixed_delay_s)
        steps = min(delay_steps(longest_s, own.control.sampling_s), cap)
        longest = adjusted_delay(plant_of(own), schedule, steps)
        rows.append(_row("weight", weight, own, "adjusted", longest))
        print(f"stability q = {weight:g}", flush=True)
    return rows


def _sampling_rows(scenario: Scenario) -> list[dict[str, Any]]:
    rows = []
    swept = experiments(scenario).get("gain_sampling_s")
    for own in () if swept is None else (point.scenario for point in swept.points):
        plant = plant_of(own)
        loop = plant.closed_loop(plant.nominal_gain)
        longest = last_stable(spectral_radius_by_delay(*loop, own.max_delay_steps))
        rows.append(_row("sampling_s", own.control.sampling_s, own, "exact", longest))
    return rows


def _row(
    axis: str, value: float, scenario: Scenario, criterion: str, longest: int | None
) -> dict[str, Any]:
    return {
        "axis": axis,
        "value": value,
        "plant": scenario.plant_name,
        "sampling_s": scenario.control.sampling_s,
        "criterion": criterion,
        "delay_steps": longest,
        "max_delay_steps": scenario.max_delay_steps,
    }
