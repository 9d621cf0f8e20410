"""The sweeps of the gain study: which loop runs under which delays at every point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from hiersched.runs.variants import (
    Gain,
    robots_alone,
    swept_scenario,
    value_text,
    weighted_scenario,
)
from hiersched.scenario import Scenario


@dataclass(frozen=True)
class GainPoint:
    """A point of a sweep.

    Attributes
    ----------
    value
        Its name, in paths and metadata.
    scenario
        The study's scenario with the values of the point in place.
    violation_delay_s
        Bounds of the delays in its violated windows.
    """

    value: str
    scenario: Scenario
    violation_delay_s: tuple[float, float]

    def variant(self, gain: Gain) -> Scenario:
        """Return the scenario that is run: the robots alone, with nominal or adjusted gains.

        Raises
        ------
        ScenarioError
            If the values of the point do not fit the rest of the scenario.
        """
        variant = replace(self.scenario, control=replace(self.scenario.control, gain=gain))
        robots = variant.gain_study.sweep_robots
        return robots_alone(variant, robots, f"gain_study, {self.value}")


def _grid(scenario: Scenario) -> list[GainPoint]:
    return [
        GainPoint(
            f"q{value_text(weight)}_{value_text(delay_s)}",
            weighted_scenario(scenario, weight),
            (delay_s, delay_s),
        )
        for weight in scenario.gain_study.weight
        for delay_s in scenario.gain_study.fixed_delay_s
    ]


def _sampling(scenario: Scenario) -> list[GainPoint]:
    return [
        GainPoint(
            value_text(value),
            swept_scenario(scenario, "sampling_s", value),
            scenario.gain_study.violation_delay_s,
        )
        for value in scenario.sweeps.sampling_s
    ]


def _noise(scenario: Scenario) -> list[GainPoint]:
    study, points = scenario.gain_study, []
    for position, heading in zip(study.noise_position_m, study.noise_heading_rad, strict=True):
        robot = replace(scenario.robot, noise_position_m=position, noise_heading_rad=heading)
        name = f"{value_text(position)}_{value_text(heading)}"
        points.append(GainPoint(name, replace(scenario, robot=robot), study.violation_delay_s))
    return points


GAIN_SWEEPS: dict[str, Callable[[Scenario], list[GainPoint]]] = {
    "grid": _grid,
    "sampling_s": _sampling,
    "noise": _noise,
}
"""Axis of a sweep of the gain study -> its points: weight and delay, sampling, measurement noise.

All have the scenario's own method and plant.
"""


def gain_points(scenario: Scenario, axis: str) -> list[GainPoint]:
    """Return the points of a sweep of the gain study.

    Raises
    ------
    ValueError
        On an unknown axis.
    """
    if axis not in GAIN_SWEEPS:
        raise ValueError(f"axis = {axis!r}: must be one of {', '.join(GAIN_SWEEPS)}")
    return GAIN_SWEEPS[axis](scenario)
