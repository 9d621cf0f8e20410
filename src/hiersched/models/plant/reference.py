"""References that the robots follow, sampled at the midpoint of every integration step.

A reference is a path, given by its curvature over the arc length and driven at constant speed, or
by points of a file; the pose follows by integration.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_LEMNISCATE_LENGTH = 5.244115108584239
"""Length of Bernoulli's lemniscate of half width 1."""


@dataclass(frozen=True, kw_only=True)
class PathShape:
    """Sizes of the reference paths: radius and half width in m, heading in rad, period in m."""

    arc_radius_m: float
    eight_half_width_m: float
    zigzag_heading_rad: float
    zigzag_period_m: float


@dataclass(frozen=True, kw_only=True)
class ReferenceTable:
    """Poses (N + 1, 3) in m and rad at the ends of N steps, speed and turn rate (N,) within."""

    step_s: float
    pose: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    turn_rate_radps: NDArray[np.float64]

    def rows(self) -> NDArray[np.float64]:
        """Return what the motion needs of each step, shape (N, 5): see `UnicycleWords.path`."""
        half_turn = 0.5 * self.step_s * self.turn_rate_radps
        return np.stack(
            [
                self.turn_rate_radps,
                np.cos(half_turn),
                np.sin(half_turn),
                self.speed_mps * self.step_s * np.sinc(half_turn / math.pi),
                self.speed_mps,
            ],
            axis=1,
        )


def _straight(arc_m: NDArray[np.float64], shape: PathShape) -> NDArray[np.float64]:
    return np.zeros_like(arc_m)


def _arc(arc_m: NDArray[np.float64], shape: PathShape) -> NDArray[np.float64]:
    return np.full_like(arc_m, 1.0 / shape.arc_radius_m)


def _figure_eight(arc_m: NDArray[np.float64], shape: PathShape) -> NDArray[np.float64]:
    """Bernoulli's lemniscate x = a cos p / (1 + sin² p), y = x sin p.

    ds/dp = a / sqrt(1 + sin² p), from which the arc length follows by quadrature.
    """
    a = shape.eight_half_width_m
    grid = np.linspace(0.0, 2.0 * math.pi, 20_001)
    speed = a / np.sqrt(1.0 + np.sin(grid) ** 2)
    step = grid[1] - grid[0]
    length = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * step)])
    parameter = np.interp(arc_m % length[-1], length, grid)
    curvature: NDArray[np.float64] = (
        3.0 * np.cos(parameter) / (a * np.sqrt(1.0 + np.sin(parameter) ** 2))
    )
    return curvature


def _zigzag(arc_m: NDArray[np.float64], shape: PathShape) -> NDArray[np.float64]:
    """Swing: the heading goes to and fro between two bounds along a sine of the arc length."""
    wave = 2.0 * math.pi / shape.zigzag_period_m
    curvature: NDArray[np.float64] = shape.zigzag_heading_rad * wave * np.cos(wave * arc_m)
    return curvature


_CURVATURE: dict[str, Callable[[NDArray[np.float64], PathShape], NDArray[np.float64]]] = {
    "straight": _straight,
    "arc": _arc,
    "figure_eight": _figure_eight,
    "zigzag": _zigzag,
}


def _period_m(name: str, shape: PathShape) -> float:
    """Length after which a path repeats itself; 0 for a straight line."""
    return {
        "straight": 0.0,
        "arc": 2.0 * math.pi * shape.arc_radius_m,
        "figure_eight": _LEMNISCATE_LENGTH * shape.eight_half_width_m,
        "zigzag": shape.zigzag_period_m,
    }[name]


def reference_table(
    name: str,
    shape: PathShape,
    speed_mps: float,
    step_s: float,
    num_steps: int,
    num_robots: int,
) -> tuple[ReferenceTable, NDArray[np.int64]]:
    """Sample a reference and say where in it each robot starts.

    Parameters
    ----------
    name
        ``straight``, ``arc``, ``figure_eight`` or ``zigzag``.
    shape
        Sizes of the paths.
    speed_mps, step_s
        Speed along the path and integration step.
    num_steps
        Steps that the last robot has before it; the table is longer by one period.
    num_robots
        Robots start evenly spread over a period, so that they do not meet the same curve at once.

    Returns
    -------
    table, offset
        The table and the first step of each robot, shape (num_robots,).

    Raises
    ------
    ValueError
        On an unknown name.
    """
    if name not in _CURVATURE:
        raise ValueError(f"reference = {name!r}: must be one of {', '.join(_CURVATURE)}")
    period_steps = _period_m(name, shape) / (speed_mps * step_s)
    offset = np.array(
        [round(period_steps * robot / num_robots) for robot in range(num_robots)], dtype=np.int64
    )
    total = num_steps + int(offset.max(initial=0))
    middle_m = (np.arange(total, dtype=np.float64) + 0.5) * (step_s * speed_mps)
    turn_rate = speed_mps * _CURVATURE[name](middle_m, shape)
    return _integrated(np.full(total, speed_mps), turn_rate, step_s, np.zeros(3)), offset


def driven_table(
    time_s: NDArray[np.float64],
    arc_m: NDArray[np.float64],
    heading_rad: NDArray[np.float64],
    start_m: NDArray[np.float64],
    *,
    repeat: bool,
    step_s: float,
    num_steps: int,
    num_robots: int,
) -> tuple[ReferenceTable, NDArray[np.int64]]:
    """Sample a reference that is given by points, with arcs of circles at constant speed between.

    Parameters
    ----------
    time_s, arc_m, heading_rad
        Time from 0 on, way so far and heading at each point, shape (P,).
    start_m
        Where it starts: x and y.
    repeat
        Whether the motion starts over after the last point, from where it ends. Robots then start
        evenly spread over it, else all at its beginning.
    step_s, num_steps, num_robots
        As for `reference_table`. A step that holds a point takes the mean speed and turn rate.

    Returns
    -------
    table, offset
        As for `reference_table`.

    Raises
    ------
    ValueError
        If the reference ends too early.
    """
    period_s = float(time_s[-1])
    spread = period_s / step_s / num_robots if repeat else 0.0
    offset = np.array([round(spread * robot) for robot in range(num_robots)], dtype=np.int64)
    ends_s = np.arange(num_steps + int(offset.max(initial=0)) + 1) * step_s
    if not repeat and ends_s[-1] > period_s * (1.0 + 1e-9):
        raise ValueError(f"the reference ends after {period_s:.12g} s, before {ends_s[-1]:.12g} s")
    rounds = np.floor(ends_s / period_s) if repeat else np.zeros_like(ends_s)
    within_s = ends_s - rounds * period_s
    arc = np.interp(within_s, time_s, arc_m) + rounds * (arc_m[-1] - arc_m[0])
    heading = np.interp(within_s, time_s, heading_rad) + rounds * (heading_rad[-1] - heading_rad[0])
    start = np.array([*start_m, heading_rad[0]])
    return _integrated(np.diff(arc) / step_s, np.diff(heading) / step_s, step_s, start), offset


def _integrated(
    speed_mps: NDArray[np.float64],
    turn_rate: NDArray[np.float64],
    step_s: float,
    start: NDArray[np.float64],
) -> ReferenceTable:
    """Poses from a start (x, y, heading) on, from the speed and turn rate of every step."""
    heading = start[2] + np.concatenate([[0.0], np.cumsum(turn_rate * step_s)])
    middle_heading = 0.5 * (heading[1:] + heading[:-1])
    # Chord of a circular arc: the reference turns within the step.
    half_turn = 0.5 * turn_rate * step_s
    chord_m = speed_mps * step_s * np.sinc(half_turn / math.pi)
    x = start[0] + np.concatenate([[0.0], np.cumsum(chord_m * np.cos(middle_heading))])
    y = start[1] + np.concatenate([[0.0], np.cumsum(chord_m * np.sin(middle_heading))])
    pose = np.stack([x, y, heading], axis=1)
    return ReferenceTable(step_s=step_s, pose=pose, speed_mps=speed_mps, turn_rate_radps=turn_rate)


def turns(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Change of heading from row to row, shape (N - 1,), in [-pi, pi): unwrapped."""
    change: NDArray[np.float64] = (np.diff(points[:, 3]) + math.pi) % (2.0 * math.pi) - math.pi
    return change


def displacements(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Displacement from row to row along and across the chord of an arc, shape (N - 1,) each."""
    middle = points[:-1, 3] + 0.5 * turns(points)
    dx, dy = np.diff(points[:, 1]), np.diff(points[:, 2])
    return (
        dx * np.cos(middle) + dy * np.sin(middle),
        dy * np.cos(middle) - dx * np.sin(middle),
    )


def arc_lengths(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Length of the arc from row to row, shape (N - 1,): its chord by sinc(half the turn)."""
    along, _ = displacements(points)
    length: NDArray[np.float64] = np.maximum(along, 0.0) / np.sinc(0.5 * turns(points) / math.pi)
    return length
