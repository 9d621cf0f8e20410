"""Gain schedules: designed once, then read and checked by every stage that runs robots."""

from __future__ import annotations

from pathlib import Path

from hiersched.control import GainSchedule, load_or_build
from hiersched.control.gain_schedule import design_key
from hiersched.runs.variants import gain_designs
from hiersched.scenario import Scenario
from hiersched.simulator.loop_gains import Gains, loop_gains, plant_of


def design_gains(scenario: Scenario, design: str, path: Path) -> GainSchedule:
    """Design one of the schedules of `gain_designs`; a file that holds it already is kept.

    Parameters
    ----------
    scenario
        The study's scenario.
    design
        Name of the schedule.
    path
        The JSON file to be.

    Raises
    ------
    ValueError
        If the study has no such design.
    """
    designs = gain_designs(scenario)
    if design not in designs:
        raise ValueError(f"design = {design!r}: must be one of {', '.join(designs)}")
    variant = designs[design]
    control = variant.control
    path.parent.mkdir(parents=True, exist_ok=True)
    return load_or_build(
        path,
        plant_of(variant),
        variant.max_delay_steps,
        control.method,
        decay_rate=control.decay_rate,
    )


def load_gains(path: Path, scenario: Scenario) -> tuple[GainSchedule, Gains]:
    """Read the schedule of a scenario and form the gains of its loop.

    Raises
    ------
    ValueError
        If the file holds the gains of another design.
    """
    schedule = GainSchedule.from_json(path.read_text(encoding="utf-8"))
    plant, control = plant_of(scenario), scenario.control
    key = design_key(plant, scenario.max_delay_steps, control.method, control.decay_rate)
    if schedule.key != key:
        raise ValueError(
            f"{path}: gains of another design ({schedule.method}, {schedule.kind} plant, sampling "
            f"{schedule.sampling_s:g} s, T_max {schedule.max_delay_steps}) than the scenario's "
            f"({control.method}, {scenario.plant_name} plant, sampling {control.sampling_s:g} s, "
            f"T_max {scenario.max_delay_steps})"
        )
    return schedule, loop_gains(schedule, control.gain)
