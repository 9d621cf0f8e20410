"""Variants of a scenario: the points of its sweeps, the loops of its gain study."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from hiersched.scenario import Scenario, ScenarioError
from hiersched.scenario.consistency import inconsistencies
from hiersched.scenario.schema import Users

SWEPT_KEYS = {
    "rayleigh_scale": "radio.rayleigh_scale",
    "sampling_s": "control.sampling_s",
    "reference": "robot.reference",
    "load": "traffic.load",
}
"""Axis of a sweep -> the key that it varies."""

Method = Literal["krasovskii", "razumikhin"]
Gain = Literal["nominal", "adjusted"]

STUDY_PLANTS: dict[Method, Literal["network", "split"]] = {
    "krasovskii": "network",
    "razumikhin": "split",
}
"""Method of the gain study -> the plant that it is for."""

CLASSICAL_GROUP = "classical"
LEARNED_GROUP = "ddpg"
STUDY_GAINS: tuple[Gain, ...] = ("nominal", "adjusted")

GROUPS = (CLASSICAL_GROUP, LEARNED_GROUP)
"""Policies that share a job: those that need no training, and the learned one."""


def value_text(value: float | str) -> str:
    """Return a swept value as it stands in file names: ``0.005``, ``1``, ``zigzag``."""
    return value if isinstance(value, str) else format(value, ".12g")


def swept_values(scenario: Scenario, axis: str) -> tuple[float | str, ...]:
    """Values of a sweep.

    Raises
    ------
    ValueError
        On an unknown axis.
    """
    if axis not in SWEPT_KEYS:
        raise ValueError(f"axis = {axis!r}: must be one of {', '.join(SWEPT_KEYS)}")
    values: tuple[float | str, ...] = getattr(scenario.sweeps, axis)
    return values


def swept_scenario(scenario: Scenario, axis: str, value: float | str) -> Scenario:
    """Return the scenario with one value of a sweep in place.

    Raises
    ------
    ScenarioError
        If the value does not fit the rest of the scenario.
    """
    section, key = SWEPT_KEYS[axis].split(".")
    changed = replace(getattr(scenario, section), **{key: value})
    return _checked(replace(scenario, **{section: changed}), f"sweeps.{axis} = {value_text(value)}")


def study_scenario(scenario: Scenario, method: Method, gain: Gain) -> Scenario:
    """Return the scenario of the gain study: its robots and a cell just large enough for them.

    Raises
    ------
    ScenarioError
        If the method does not fit the rest of the scenario.
    """
    robots = scenario.gain_study.num_robots
    control = replace(scenario.control, method=method, plant=STUDY_PLANTS[method], gain=gain)
    traffic = replace(scenario.traffic, urllc_offered_mbps=1.0, embb_offered_mbps=1.0)
    variant = replace(
        scenario,
        users=Users(num_urllc=robots, num_embb=1),
        radio=replace(scenario.radio, num_prb=robots + 1),
        traffic=traffic,
        control=control,
    )
    return _checked(variant, f"gain_study with {method}")


def gain_designs(scenario: Scenario) -> dict[str, Scenario]:
    """Return the gain schedules of a study: name of the file -> the scenario it is designed for.

    ``schedule`` is the scenario's own; ``schedule_<h>`` are those of the other sampling intervals
    of the sweep; ``schedule_<method>`` those of the gain study that are not the scenario's own.
    """
    designs = {"schedule": scenario}
    for value in scenario.sweeps.sampling_s:
        if value != scenario.control.sampling_s:
            designs[f"schedule_{value_text(value)}"] = swept_scenario(scenario, "sampling_s", value)
    for method, plant in STUDY_PLANTS.items():
        if (method, plant) != (scenario.control.method, scenario.control.plant):
            control = replace(scenario.control, method=method, plant=plant)
            designs[f"schedule_{method}"] = _checked(
                replace(scenario, control=control), f"gain_study with {method}"
            )
    return designs


def design_of(scenario: Scenario, variant: Scenario) -> str:
    """Return the name of the schedule, among `gain_designs`, that a variant needs."""
    wanted = replace(variant.control, gain="adjusted")
    for name, design in gain_designs(scenario).items():
        if replace(design.control, gain="adjusted") == wanted:
            return name
    raise ValueError(f"no gain schedule of this study is designed for {variant.control}")


def group_policies(policies: tuple[str, ...], group: str) -> tuple[str, ...]:
    """Return the policies of a list that belong to a group, in their order."""
    return tuple(
        policy for policy in policies if (policy == LEARNED_GROUP) == (group == LEARNED_GROUP)
    )


def check_variants(scenario: Scenario) -> None:
    """Check everything that a study derives from a scenario, before anything runs.

    Raises
    ------
    ScenarioError
        If a swept value does not fit the rest of the scenario; all faults are listed.
    """
    faults = []
    for axis in SWEPT_KEYS:
        for value in swept_values(scenario, axis):
            try:
                swept_scenario(scenario, axis, value)
            except ScenarioError as error:
                faults.append(str(error))
    if faults:
        raise ScenarioError("\n".join(faults))


def _checked(variant: Scenario, what: str) -> Scenario:
    faults = inconsistencies(variant)
    if faults:
        raise ScenarioError(
            "\n".join(f"scenario {variant.name}: {what}: {fault}" for fault in faults)
        )
    return variant
