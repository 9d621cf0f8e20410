"""Where the gains of a scenario come from: the package ships some, others are designed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from hiersched.control import DelayedPlant, FilterModel, GainSchedule, build_schedule
from hiersched.control.gain_schedule import DESIGN_VERSION
from hiersched.core.extras import naming_extras
from hiersched.core.faults import InputError
from hiersched.scenario import Scenario, kinds_of_robots, scenario_to_dict
from hiersched.scenario.plugins import CONFIG
from hiersched.simulator.loop_gains import Gains, filter_model_of, loop_gains, plant_of

SHIPPED = CONFIG / "gains"

DESIGN_KEYS = (
    "control.sampling_s",
    "control.weight",
    "control.max_delay_s",
    "control.loop",
    "control.operator_share",
    "control.method",
    "control.decay_rate",
    "robot.speed_mps",
    "robot.actuator_lag_s",
    "plant.model",
)
"""What every design reads; `design_values` adds the keys of the plant."""
FILTER_KEYS = (
    "robot.slip_speed_mps",
    "robot.slip_turn_rate_radps",
    "robot.slip_time_s",
    "robot.noise_position_m",
    "robot.noise_heading_rad",
    "plant",
)
"""What the design of a filter reads besides."""
BELIEVED = ("actuator_lag_s", "slip_speed_mps", "slip_turn_rate_radps", "slip_time_s")
"""Keys of the robot of which a design reads what `control` believes."""


@lru_cache(maxsize=1024)
def design_values(scenario: Scenario) -> str:
    """Return what a gain schedule depends on, as canonical JSON."""
    own, *kinds = map(_design_values, kinds_of_robots(scenario))
    return json.dumps({**own, "robot_kinds": kinds} if kinds else own, sort_keys=True)


def _design_values(scenario: Scenario) -> dict[str, Any]:
    """Pick those of robots that are all alike."""
    own = scenario.plant.design_keys
    plant = ("plant",) if own is None else tuple(f"plant.{name}" for name in own)
    data = scenario_to_dict(scenario)
    values: dict[str, Any] = {}
    of_filter = FILTER_KEYS if scenario.control.method == "lqg" else ()
    for key in dict.fromkeys((*DESIGN_KEYS, *plant, *of_filter)):
        value: Any = data
        for part in key.split("."):
            value = value[part]
        values[key] = value
    for name in BELIEVED:
        if f"robot.{name}" in values:
            values[f"robot.{name}"] = scenario.believed(name)
    return values


def scenario_key(scenario: Scenario) -> str:
    """Return the key of a scenario's gains: a hash of the values that a design depends on.

    The matrices that follow from them differ in their last bits from one processor to another.
    """
    text = f"{DESIGN_VERSION} {design_values(scenario)}"
    return hashlib.sha256(text.encode()).hexdigest()


def shipped_file(scenario: Scenario) -> Path:
    """Path of a scenario's schedule among those that the package ships, there or not."""
    return SHIPPED / f"{scenario_key(scenario)[:16]}.json"


def check_gains(schedule: GainSchedule, scenario: Scenario) -> None:
    """Check that a schedule is one for a scenario: its method, its plant, all that it says.

    ValueError if it is not.
    """
    control = scenario.control
    rate = control.decay_rate if control.method == "razumikhin" else None
    for name, wanted in (
        ("method", control.method),
        ("max_delay_steps", scenario.max_delay_steps),
        ("decay_rate", rate),
    ):
        found = getattr(schedule, name)
        if found != wanted:
            raise ValueError(f"{name} is {found!r}; it must be {wanted!r}, as in the scenario")
    own, *kinds = kinds_of_robots(scenario)
    schedule.verify(plant_of(own), filter_model_of(own), _plants(kinds))


class GainsError(InputError, ValueError):
    """A file that does not hold the gains of the scenario: the message says why."""


def read_gains(path: Path, scenario: Scenario) -> GainSchedule:
    """Read the schedule of a scenario, and check that it is one.

    GainsError if the file is damaged or holds other gains.
    """
    try:
        schedule = GainSchedule.from_json(path.read_text(encoding="utf-8"))
        if schedule.key != scenario_key(scenario):
            raise ValueError("its key is that of another design than the scenario's")
        check_gains(schedule, scenario)
    except ValueError as error:
        raise GainsError(f"{path}: not the gains of scenario {scenario.name}: {error}") from error
    return schedule


def design_arguments(scenario: Scenario) -> dict[str, Any]:
    """Return what `build_schedule` designs the gains of a scenario from."""
    own, *kinds = kinds_of_robots(scenario)
    return {
        "plant": plant_of(own),
        "max_delay_steps": scenario.max_delay_steps,
        "method": scenario.control.method,
        "decay_rate": scenario.control.decay_rate,
        "model": filter_model_of(own),
        "key": scenario_key(scenario),
        "kinds": _plants(kinds),
    }


def _plants(kinds: Sequence[Scenario]) -> list[tuple[DelayedPlant, FilterModel | None]]:
    return [(plant_of(kind), filter_model_of(kind)) for kind in kinds]


def design_schedule(scenario: Scenario) -> GainSchedule:
    """Design the gains of a scenario; MissingExtraError without the extra `control`, the solver."""
    with naming_extras():
        return build_schedule(**design_arguments(scenario))


def scenario_schedule(scenario: Scenario) -> GainSchedule:
    """Return the gain schedule of a scenario: a shipped one, else as `design_schedule` says."""
    path = shipped_file(scenario)
    if path.is_file():
        return read_gains(path, scenario)
    return design_schedule(scenario)


def scenario_gains(scenario: Scenario) -> Gains:
    """Return the gains of a scenario's loop, from `scenario_schedule`."""
    return loop_gains(scenario_schedule(scenario), scenario.control.gain)
