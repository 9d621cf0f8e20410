"""Reference paths of the user: a CSV file with the columns t, x, y, theta.

The points become part of the scenario. Between two of them the robot drives an arc of a circle at
constant speed, so they have to be what a unicycle can drive.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hiersched.models.plant.reference import arc_lengths, displacements, references_of, turns
from hiersched.scenario.schema import Scenario

COLUMNS = ("t", "x", "y", "theta")
LEAST_ROWS, MOST_ROWS = 2, 100_000
MOST_BYTES = 20_000_000
GREATEST = 1e9
"""Of a time [s], a place [m] or a heading [rad]."""
SIDEWAYS_SHARE = 0.05
SIDEWAYS_M = 0.001
"""A row may lie beside the arc to it by this share of the distance, plus this much for rounding."""
MAX_TURN_RAD = 0.5 * math.pi
"""Heading may change by this much from row to row, beyond which its sense would be a guess."""
DRIFT_M = 0.05
DRIFT_SHARE = 0.01
"""The path that is driven may leave the rows by this much, plus this share of the way so far."""

Point = tuple[float, float, float, float]
Floats = NDArray[np.float64]


class ReferenceFileError(ValueError):
    """A file that is no reference: the message names file, row, column, value, what is allowed."""


def read_reference(path: Path) -> tuple[Point, ...]:
    """Read the points of a reference file; row 1 is the header.

    ReferenceFileError if it cannot be read, its header is another, or a value is no finite number.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise ValueError(f"it has more than {MOST_BYTES} bytes")
        rows = list(csv.reader(data.decode("utf-8-sig").splitlines()))
        if len(rows) > MOST_ROWS + 1:
            raise ValueError(f"it has {len(rows) - 1} rows, must have {MOST_ROWS} or fewer")
    except (OSError, ValueError, csv.Error) as error:
        raise ReferenceFileError(f"{path}: cannot be read: {error}") from error
    header = tuple(cell.strip() for cell in rows[0]) if rows else ()
    if header != COLUMNS:
        raise ReferenceFileError(
            f"{path}: row 1: {','.join(header)!r}: the header must be {','.join(COLUMNS)!r}"
        )
    return tuple(_point(path, number, row) for number, row in enumerate(rows[1:], start=2))


def _point(path: Path, number: int, row: Sequence[str]) -> Point:
    if len(row) != len(COLUMNS):
        raise ReferenceFileError(
            f"{path}: row {number}: {len(row)} values, must be {len(COLUMNS)}: {','.join(COLUMNS)}"
        )
    values = []
    for column, cell in zip(COLUMNS, row, strict=True):
        try:
            value = float(cell)
        except ValueError:
            value = math.nan
        if not abs(value) <= GREATEST:  # no number either
            raise ReferenceFileError(
                f"{path}: row {number}, column {column}: {cell!r:.60}: must be a finite number "
                f"within {GREATEST:g}"
            )
        values.append(value)
    t, x, y, theta = values
    return t, x, y, theta


def reference_faults(scenario: Scenario, *, swept: bool = False) -> list[str]:
    """Say what is wrong with the points of a scenario whose robots follow them, if anything.

    In a `swept` one, a point of a sweep, they follow them for as long as the sweep's worlds are.
    """
    robot = scenario.robot
    if "file" not in references_of(robot):
        return []
    if robot.reference_points is None:
        return ["robot.reference = 'file': needs robot.reference_file"]
    name = f"robot.reference_file = {robot.reference_file}"
    points = np.array(robot.reference_points, dtype=np.float64).reshape(-1, len(COLUMNS))
    if len(points) < LEAST_ROWS:
        return [f"{name}: {len(points)} rows below the header, must be {LEAST_ROWS} or more"]
    limit_mps = robot.speed_mps + robot.max_speed_mps
    # Each check relies on those before it.
    fault = (
        _time_fault(points)
        or _motion_fault(points)
        or _speed_fault(points, limit_mps)
        or _drift_fault(points)
    )
    if fault:
        return [f"{name}: {fault}"]
    key, longest_s = max(_runs_s(scenario, swept).items(), key=lambda item: item[1])
    if not robot.reference_repeat and longest_s > points[-1, 0] * (1.0 + 1e-9):
        return [
            f"{name}: ends after {points[-1, 0]:.12g} s, but {key} asks for {longest_s:.12g} s: "
            "add rows or set robot.reference_repeat: true"
        ]
    return []


def _runs_s(scenario: Scenario, swept: bool) -> dict[str, float]:
    """Durations of the runs whose robots follow the file, by the key that decides."""
    parts = ["sweeps"] if swept else ["evaluate", "sweeps"]
    parts += ["generalise"] if scenario.generalise.cells and not swept else []
    worlds = {name: getattr(scenario, name) for name in parts}
    runs: dict[str, float] = {
        f"{name}.warmup_s + {name}.duration_s": own.warmup_s + own.duration_s
        for name, own in worlds.items()
    }
    if swept:
        return runs
    slot_s, window_s = scenario.radio.slot_s, scenario.robot.window_s
    runs["learning.slots_per_episode"] = scenario.learning.slots_per_episode * slot_s
    if scenario.gain_study.methods:
        for key in ("num_windows", "sweep_windows"):
            runs[f"gain_study.{key}"] = getattr(scenario.gain_study, key) * window_s
    return runs


def _row(index: int) -> str:
    return f"row {index + 2}"  # the header is row 1


def _time_fault(points: Floats) -> str:
    t = points[:, 0]
    if t[0] != 0.0:
        return f"{_row(0)}, column t: {t[0]:.12g}: the first time must be 0"
    (late,) = np.nonzero(np.diff(t) <= 0.0)
    if not late.size:
        return ""
    i = int(late[0]) + 1
    return (
        f"{_row(i)}, column t: {t[i]:.12g}: must be greater than {t[i - 1]:.12g} of the row above"
    )


def _motion_fault(points: Floats) -> str:
    change = turns(points)
    along, across = displacements(points)
    for i, (turn, forward, sideways) in enumerate(zip(change, along, across, strict=True), start=1):
        if abs(turn) > MAX_TURN_RAD:
            return (
                f"{_row(i)}, column theta: {points[i, 3]:.12g}: turns by {turn:.6g} rad from the "
                f"row above, must be at most {MAX_TURN_RAD:.6g} rad (give more rows)"
            )
        allowed = SIDEWAYS_M + SIDEWAYS_SHARE * abs(forward)
        if abs(sideways) > allowed:
            return (
                f"{_row(i)}, columns x, y: {points[i, 1]:.12g}, {points[i, 2]:.12g}: "
                f"{abs(sideways):.6g} m sideways of its heading, must be at most {allowed:.6g} m "
                f"({SIDEWAYS_SHARE:.0%} of the way from the row above and 1 mm): a unicycle cannot "
                "move sideways"
            )
        if forward < -SIDEWAYS_M:
            return (
                f"{_row(i)}, columns x, y: {points[i, 1]:.12g}, {points[i, 2]:.12g}: "
                f"{-forward:.6g} m backwards from the row above, must be forward"
            )
    return ""


def _speed_fault(points: Floats, limit_mps: float) -> str:
    speed = arc_lengths(points) / np.diff(points[:, 0])
    (fast,) = np.nonzero(speed > limit_mps * (1.0 + 1e-9))
    if not fast.size:
        return ""
    i = int(fast[0])
    return (
        f"{_row(i + 1)}: {speed[i]:.6g} m/s from the row above, must be at most "
        f"{limit_mps:.6g} m/s (robot.speed_mps + robot.max_speed_mps)"
    )


def _drift_fault(points: Floats) -> str:
    heading = points[0, 3] + np.concatenate([[0.0], np.cumsum(turns(points))])
    middle = 0.5 * (heading[1:] + heading[:-1])
    along = np.maximum(displacements(points)[0], 0.0)
    driven = np.cumsum(along[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=1), axis=0)
    off_m = np.hypot(*(points[0, 1:3] + driven - points[1:, 1:3]).T)
    allowed_m = DRIFT_M + DRIFT_SHARE * np.cumsum(along)
    (far,) = np.nonzero(off_m > allowed_m)
    if not far.size:
        return ""
    i = int(far[0])
    return (
        f"{_row(i + 1)}, columns x, y: {points[i + 1, 1]:.12g}, {points[i + 1, 2]:.12g}: following "
        f"the headings of all rows so far ends {off_m[i]:.6g} m away, must be at most "
        f"{allowed_m[i]:.6g} m"
    )
