"""References that the robots follow, sampled at the midpoint of every integration step.

A reference is a path at constant speed, given by its curvature over the arc length; the pose
follows by integration.
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
    """Poses (N + 1, 3) in m and rad at the ends of N steps, turn rate (N,) in rad/s within."""

    speed_mps: float
    step_s: float
    pose: NDArray[np.float64]
    turn_rate_radps: NDArray[np.float64]


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
    heading = np.concatenate([[0.0], np.cumsum(turn_rate * step_s)])
    middle_heading = 0.5 * (heading[1:] + heading[:-1])
    # Chord of a circular arc: the reference turns within the step.
    half_turn = 0.5 * turn_rate * step_s
    chord_m = speed_mps * step_s * np.sinc(half_turn / math.pi)
    x = np.concatenate([[0.0], np.cumsum(chord_m * np.cos(middle_heading))])
    y = np.concatenate([[0.0], np.cumsum(chord_m * np.sin(middle_heading))])
    pose = np.stack([x, y, heading], axis=1)
    table = ReferenceTable(speed_mps=speed_mps, step_s=step_s, pose=pose, turn_rate_radps=turn_rate)
    return table, offset
