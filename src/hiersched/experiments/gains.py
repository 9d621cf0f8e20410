"""Gain schedules: designed once, then read and checked by every stage that runs robots."""

from __future__ import annotations

import hashlib
import json
from functools import lru_cache
from pathlib import Path
from typing import Any

from hiersched.control import GainSchedule, load_or_build
from hiersched.experiments.points import Experiment, experiments, value_text
from hiersched.scenario import Scenario
from hiersched.simulator.gain_source import design_arguments, design_values, read_gains
from hiersched.simulator.loop_gains import Gains, loop_gains


@lru_cache(maxsize=8)
def designs(scenario: Scenario) -> dict[str, Scenario]:
    """Return the gain schedules of a study: name of the file -> a scenario it is designed for.

    ``schedule`` is the scenario's own; the others are named after what differs from it.
    """
    found = {design_values(scenario): ("schedule", scenario)}
    own = json.loads(design_values(scenario))
    for experiment in experiments(scenario).values():
        for point in experiment.points:
            values = design_values(point.scenario)
            if values not in found:
                name = f"schedule_{_difference(own, values)}"
                if name in {taken for taken, _ in found.values()}:
                    name = f"schedule_{_digest(values)}"
                found[values] = (name, point.scenario)
    return dict(found.values())


def _difference(own: dict[str, Any], values: str) -> str:
    """Name a design by what differs of what both depend on."""
    text = "_".join(
        f"{key.rpartition('.')[2]}_{value_text(value)}"
        for key, value in json.loads(values).items()
        if key in own and own[key] != value
    )
    return text if 0 < len(text) <= 60 else _digest(values)


def _digest(values: str) -> str:
    return hashlib.sha256(values.encode()).hexdigest()[:12]


def design_of(scenario: Scenario, variant: Scenario) -> str:
    """Return the name of the schedule, among `designs`, that a variant needs."""
    wanted = design_values(variant)
    return next(name for name, own in designs(scenario).items() if design_values(own) == wanted)


def experiment_designs(scenario: Scenario, experiment: Experiment) -> list[str]:
    """List the schedules that the points of an experiment need, each once."""
    return list(dict.fromkeys(design_of(scenario, p.scenario) for p in experiment.points))


def design_gains(scenario: Scenario, design: str, path: Path) -> GainSchedule:
    """Design one of the schedules of `designs`; a file that holds it already is kept.

    ValueError if the study has no such design.
    """
    known = designs(scenario)
    if design not in known:
        raise ValueError(f"design = {design!r}: must be one of {', '.join(known)}")
    path.parent.mkdir(parents=True, exist_ok=True)
    return load_or_build(path, **design_arguments(known[design]))


def load_gains(path: Path, scenario: Scenario) -> tuple[GainSchedule, Gains]:
    """Read the schedule of a scenario and form the gains of its loop.

    GainsError if the file is damaged or holds other gains.
    """
    schedule = read_gains(path, scenario)
    return schedule, loop_gains(schedule, scenario.control.gain)
