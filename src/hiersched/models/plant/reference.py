"""References that the robots follow, sampled at the midpoint of every integration step.

A reference is a path, given by its curvature over the arc length and driven at constant speed; or
by points of a file; or an operator's reaches and pauses, which each world draws for itself. The
pose follows by integration.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.core.numerics import sinc, sincos

if TYPE_CHECKING:
    from hiersched.scenario.schema import Reference, Robot

FloatArray = NDArray[np.float64]

_LEMNISCATE_LENGTH = 5.244115108584239
"""Length of Bernoulli's lemniscate of half width 1."""


@dataclass(frozen=True, kw_only=True)
class ReferenceTable:
    """Poses (N + 1, 3) in m and rad at the ends of N steps, speed and turn rate (N,) within."""

    step_s: float
    pose: FloatArray
    speed_mps: FloatArray
    turn_rate_radps: FloatArray

    def rows(self) -> FloatArray:
        """Return what the motion needs of each step, shape (N, 5): see `UnicycleWords.path`."""
        half_turn = 0.5 * self.step_s * self.turn_rate_radps
        sine, cosine = sincos(half_turn)
        return np.stack(
            [
                self.turn_rate_radps,
                cosine,
                sine,
                self.speed_mps * self.step_s * sinc(half_turn),
                self.speed_mps,
            ],
            axis=1,
        )


def _figure_eight(robot: Robot, arc_m: FloatArray) -> FloatArray:
    """Bernoulli's lemniscate x = a cos p / (1 + sin² p), y = x sin p.

    ds/dp = a / sqrt(1 + sin² p), from which the arc length follows by quadrature.
    """
    a = robot.eight_half_width_m
    grid = np.linspace(0.0, 2.0 * math.pi, 20_001)
    speed = a / np.sqrt(1.0 + sincos(grid)[0] ** 2)
    step = grid[1] - grid[0]
    length = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * step)])
    parameter = np.interp(arc_m % length[-1], length, grid)
    sine, cosine = sincos(parameter)
    return 3.0 * cosine / (a * np.sqrt(1.0 + sine**2))


def _zigzag(robot: Robot, arc_m: FloatArray) -> FloatArray:
    """Swing: the heading goes to and fro between two bounds along a sine of the arc length."""
    wave = 2.0 * math.pi / robot.zigzag_period_m
    return math.radians(robot.zigzag_heading_deg) * wave * sincos(wave * arc_m)[1]


class _Path(NamedTuple):
    """What a path is, from a scenario's robot."""

    period_m: Callable[[Robot], float]  # after which it repeats itself [m], 0 for never
    curvature: Callable[[Robot, FloatArray], FloatArray]  # by way [1/m]
    greatest: Callable[[Robot], float]  # curvature [1/m]
    keys: tuple[str, ...] = ()  # that decide over it


_PATHS: dict[str, _Path] = {
    "straight": _Path(lambda _: 0.0, lambda _, arc_m: np.zeros_like(arc_m), lambda _: 0.0),
    "arc": _Path(
        lambda robot: 2.0 * math.pi * robot.arc_radius_m,
        lambda robot, arc_m: np.full_like(arc_m, 1.0 / robot.arc_radius_m),
        lambda robot: 1.0 / robot.arc_radius_m,
        ("arc_radius_m",),
    ),
    "figure_eight": _Path(
        lambda robot: _LEMNISCATE_LENGTH * robot.eight_half_width_m,
        _figure_eight,
        lambda robot: 3.0 / robot.eight_half_width_m,
        ("eight_half_width_m",),
    ),
    "zigzag": _Path(
        lambda robot: robot.zigzag_period_m,
        _zigzag,
        lambda robot: (
            2.0 * math.pi * math.radians(robot.zigzag_heading_deg) / robot.zigzag_period_m
        ),
        ("zigzag_heading_deg", "zigzag_period_m"),
    ),
}


@dataclass(frozen=True, kw_only=True)
class Task:
    """What an operator drives: a reference by name, with its own scale and pace."""

    reference: Reference
    scale: float
    pace: float


def tasks_of(robot: Robot, num_robots: int) -> tuple[Task, ...]:
    """Return the task of each robot, before worlds shuffle them.

    ValueError if a list has another length.
    """
    columns = []
    for name in ("reference", "reference_scale", "reference_pace"):
        value = getattr(robot, name)
        values = value if isinstance(value, tuple) else (value,) * num_robots
        if len(values) != num_robots:
            raise ValueError(
                f"robot.{name} has {len(values)} entries: must be one for all robots, or "
                f"{num_robots} of them"
            )
        columns.append(values)
    return tuple(
        Task(reference=name, scale=scale, pace=pace)
        for name, scale, pace in zip(*columns, strict=True)
    )


def references_of(robot: Robot) -> tuple[Reference, ...]:
    """Return the references of a scenario's robots, each once."""
    value = robot.reference
    return tuple(dict.fromkeys(value if isinstance(value, tuple) else (value,)))


def period_s(robot: Robot) -> float:
    """Return how long the longest reference takes until it repeats itself [s]; 0 if none does.

    A pace is not counted.
    """
    longest = 0.0
    for name in references_of(robot):
        if name == "file" and robot.reference_repeat and robot.reference_points:
            longest = max(longest, float(robot.reference_points[-1][0]))
        elif name in _PATHS:
            longest = max(longest, _PATHS[name].period_m(robot) / robot.speed_mps)
    return longest


def greatest_turn_rate(robot: Robot, task: Task) -> tuple[float, tuple[str, ...]]:
    """Return the turn rate [rad/s] that a task may reach, and the keys of `robot` that decide.

    Of reaches, which worlds draw, it is the bound. A scale changes no turn rate.
    """
    if task.reference == "reach":
        # As `operator.draw_reaches` rounds durations; its rate is greatest in the middle.
        shortest_s = robot.reach_duration_s[0] / task.pace
        steps = max(1, round(shortest_s / robot.substep_s))
        rate = 30.0 / 16.0 * robot.reach_turn_rad / (steps * robot.substep_s)
        return rate, ("reach_turn_rad", "reach_duration_s", "reference_pace")
    if task.reference == "file":
        points = np.array(robot.reference_points, dtype=np.float64)
        rates = np.abs(turns(points)) / np.diff(points[:, 0])
        return task.pace * float(rates.max()), ("reference_file", "reference_pace")
    path = _PATHS[task.reference]
    rate = robot.speed_mps * task.pace * path.greatest(robot)
    return rate, (*path.keys, "speed_mps", "reference_pace")


def task_table(
    robot: Robot, task: Task, num_steps: int, count: int
) -> tuple[ReferenceTable, NDArray[np.int64]]:
    """Return the reference of `count` robots with the same task, which no world draws.

    As `reference_table`, with the task's scale and pace.
    """
    points = robot.reference_points
    if points is not None:
        points = tuple((t / task.pace, x, y, theta) for t, x, y, theta in points)
    own = replace(
        robot,
        reference=task.reference,
        reference_points=points,
        speed_mps=robot.speed_mps * task.pace,
    )
    table, offset = reference_table(own, num_steps, count)
    if task.scale == 1.0:
        return table, offset
    pose = table.pose.copy()
    pose[:, :2] = pose[0, :2] + task.scale * (pose[:, :2] - pose[0, :2])
    return replace(table, pose=pose, speed_mps=task.scale * table.speed_mps), offset


def reference_table(
    robot: Robot, num_steps: int, num_robots: int
) -> tuple[ReferenceTable, NDArray[np.int64]]:
    """Sample the reference of a scenario's robots and say where in it each of them starts.

    Robots start evenly spread over a period of the path, so that they do not meet the same curve at
    once; the table is longer than `num_steps`, which the last one has before it, by one period.
    Returns the table and the first step of each robot, shape (num_robots,). ValueError on an
    unknown name, or if a reference from a file ends too early.
    """
    name, step_s, speed_mps = str(robot.reference), robot.substep_s, robot.speed_mps
    if name == "file":
        points = np.array(robot.reference_points, dtype=np.float64)
        return driven_table(
            points[:, 0],
            np.concatenate([[0.0], np.cumsum(arc_lengths(points))]),
            points[0, 3] + np.concatenate([[0.0], np.cumsum(turns(points))]),
            points[0, 1:3],
            repeat=robot.reference_repeat,
            step_s=step_s,
            num_steps=num_steps,
            num_robots=num_robots,
        )
    if name not in _PATHS:
        raise ValueError(f"reference = {name!r}: must be one of {', '.join(_PATHS)}")
    path = _PATHS[name]
    period_steps = path.period_m(robot) / (speed_mps * step_s)
    offset = np.array(
        [round(period_steps * number / num_robots) for number in range(num_robots)], dtype=np.int64
    )
    total = num_steps + int(offset.max(initial=0))
    middle_m = (np.arange(total, dtype=np.float64) + 0.5) * (step_s * speed_mps)
    turn_rate = speed_mps * path.curvature(robot, middle_m)
    return integrated(np.full(total, speed_mps), turn_rate, step_s, np.zeros(3)), offset


def driven_table(
    time_s: FloatArray,
    arc_m: FloatArray,
    heading_rad: FloatArray,
    start_m: FloatArray,
    *,
    repeat: bool,
    step_s: float,
    num_steps: int,
    num_robots: int,
) -> tuple[ReferenceTable, NDArray[np.int64]]:
    """Sample a reference that is given by points, with arcs of circles at constant speed between.

    `time_s`, from 0 on, the way so far and the heading at each point have shape (P,); it starts at
    x and y. With `repeat` the motion starts over after the last point, from where it ends, and
    robots start evenly spread over it; else all at its beginning. A step that holds a point takes
    the mean speed and turn rate. Result and `num_steps` as for `reference_table`; ValueError if the
    reference ends too early.
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
    return integrated(np.diff(arc) / step_s, np.diff(heading) / step_s, step_s, start), offset


def integrated(
    speed_mps: FloatArray,
    turn_rate: FloatArray,
    step_s: float,
    start: FloatArray,
) -> ReferenceTable:
    """Poses from a start (x, y, heading) on, from the speed and turn rate of every step."""
    heading = start[2] + np.concatenate([[0.0], np.cumsum(turn_rate * step_s)])
    middle_heading = 0.5 * (heading[1:] + heading[:-1])
    # Chord of a circular arc: the reference turns within the step.
    half_turn = 0.5 * turn_rate * step_s
    chord_m = speed_mps * step_s * sinc(half_turn)
    sine, cosine = sincos(middle_heading)
    x = start[0] + np.concatenate([[0.0], np.cumsum(chord_m * cosine)])
    y = start[1] + np.concatenate([[0.0], np.cumsum(chord_m * sine)])
    pose = np.stack([x, y, heading], axis=1)
    return ReferenceTable(step_s=step_s, pose=pose, speed_mps=speed_mps, turn_rate_radps=turn_rate)


def turns(points: FloatArray) -> FloatArray:
    """Change of heading from row to row, shape (N - 1,), in [-pi, pi): unwrapped."""
    change: FloatArray = (np.diff(points[:, 3]) + math.pi) % (2.0 * math.pi) - math.pi
    return change


def displacements(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Displacement from row to row along and across the chord of an arc, shape (N - 1,) each."""
    middle = points[:-1, 3] + 0.5 * turns(points)
    dx, dy = np.diff(points[:, 1]), np.diff(points[:, 2])
    sine, cosine = sincos(middle)
    return dx * cosine + dy * sine, dy * cosine - dx * sine


def arc_lengths(points: FloatArray) -> FloatArray:
    """Length of the arc from row to row, shape (N - 1,): its chord by sinc(half the turn)."""
    along, _ = displacements(points)
    length: FloatArray = np.maximum(along, 0.0) / sinc(0.5 * turns(points))
    return length
