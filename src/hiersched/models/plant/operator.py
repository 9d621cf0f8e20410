"""What the operators of all worlds drive: a table of references, and where robots are in it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.core.compiled import kernel
from hiersched.core.numerics import sincos
from hiersched.core.randomness import STREAM_REFERENCE, draw_uniforms
from hiersched.models.plant.reference import (
    ReferenceTable,
    integrated,
    task_table,
    tasks_of,
)

if TYPE_CHECKING:
    from hiersched.models.model import Setup

_DURATION, _LENGTH, _TURN, _PAUSE, _FIRST_PAUSE, _SHUFFLE = range(6)
"""Lanes of `STREAM_REFERENCE`."""


TABLE_WIDTH = 10
"""Numbers of a step in the tables of `OperatorWords`."""


class OperatorWords(NamedTuple):
    """References of R operators, a robot each, in E worlds; tables have a row a step."""

    path: NDArray[np.float64]  # (N, 5) motion within a step: `ReferenceTable.rows`
    pose: NDArray[np.float64]  # (N, 3) at its start [m, m, rad]
    direction: NDArray[np.float64]  # (N, 2) cosine and sine of the heading there
    offset: NDArray[np.int64]  # (E, R) row in which each robot starts
    first: NDArray[np.int64]  # (E, R) row in which each operator's reference starts
    drawn: NDArray[np.bool_]  # (R,) whether an operator reaches: worlds draw that
    world: NDArray[np.uint64]  # (E, 2) key whose reaches lie in the tables, and whether any do
    scale: NDArray[np.float64]  # (R,)
    pace: NDArray[np.float64]  # (R,)
    shuffles: bool  # whether each world deals the operators to its robots anew
    reach: NDArray[np.float64]  # (3, 2) bounds of duration [s], length [m] and pause [s]
    reach_turn_rad: float
    step_s: float
    num_steps: int  # of a run, and one more row follows


def operator_words(setup: Setup) -> OperatorWords:
    """Return the references of a run; what worlds draw is not there yet (`draw_references`)."""
    scenario, num_envs = setup.scenario, setup.num_envs
    robot, num_robots = scenario.robot, scenario.users.num_urllc
    num_steps = setup.num_slots * scenario.steps_per_slot
    tasks = tasks_of(robot, num_robots)
    first = np.zeros((num_envs, num_robots), np.int64)
    tables: list[ReferenceTable] = []
    rows = 0
    for task in dict.fromkeys(tasks):
        if task.reference == "reach":
            continue
        own = [number for number, other in enumerate(tasks) if other == task]
        table, offset = task_table(robot, task, num_steps, len(own))
        first[:, own] = rows + offset
        tables.append(table)
        rows += len(table.pose)
    drawn = np.array([task.reference == "reach" for task in tasks])
    block = num_steps + 1
    of_world = rows + np.arange(num_envs * drawn.sum()).reshape(num_envs, -1) * block
    first[:, drawn] = of_world
    size = rows + of_world.size * block
    is_late = robot.set_point != "present"
    words = OperatorWords(
        path=np.zeros((size, 5)),
        pose=np.zeros((size, 3)),
        direction=np.zeros((size if is_late else 0, 2)),
        offset=first.copy(),
        first=first,
        drawn=drawn,
        world=np.zeros((num_envs, 2), np.uint64),
        scale=np.array([task.scale for task in tasks]),
        pace=np.array([task.pace for task in tasks]),
        shuffles=robot.reference_shuffle,
        reach=np.array([robot.reach_duration_s, robot.reach_length_m, robot.reach_pause_s]),
        reach_turn_rad=robot.reach_turn_rad,
        step_s=robot.substep_s,
        num_steps=num_steps,
    )
    at = 0
    for table in tables:
        _put(words, slice(at, at + len(table.pose)), table)
        at += len(table.pose)
    return words


def _put(words: OperatorWords, rows: slice, table: ReferenceTable) -> None:
    """Write a table; its last pose is the start of a step in which it goes on as before."""
    motion = table.rows()
    words.path[rows] = np.concatenate([motion, motion[-1:]])
    words.pose[rows] = table.pose
    if len(words.direction):
        heading = table.pose[:, 2]
        sine, cosine = sincos(heading)
        words.direction[rows] = np.stack([cosine, sine], axis=1)


def draw_references(words: OperatorWords, keys: NDArray[np.uint64]) -> None:
    """Draw the reaches of the worlds `keys` (E,), and deal the operators to their robots.

    It takes as long as hundreds of slots: what is there already stays, and equal worlds share it.
    """
    uniform = np.empty(len(words.drawn))
    _, distinct, which = np.unique(keys, return_index=True, return_inverse=True)
    for env in distinct:
        key = keys[env]
        if words.world[env, 0] != key or not words.world[env, 1]:
            _draw_world(words, env, key, uniform)
        if words.shuffles:
            draw_uniforms(key, STREAM_REFERENCE, 0, _SHUFFLE, uniform)
            words.offset[env] = words.first[env, np.argsort(uniform)]
        else:
            words.offset[env] = words.first[env]
    words.offset[:] = words.offset[distinct[which]]


def _draw_world(
    words: OperatorWords, env: int, key: np.uint64, scratch: NDArray[np.float64]
) -> None:
    """Draw the reaches of a world into the rows of an environment."""
    speed, turn_rate = np.zeros(words.num_steps), np.zeros(words.num_steps)
    for operator in np.flatnonzero(words.drawn):
        draw_reaches(words, key, operator, scratch, speed, turn_rate)
        start = words.first[env, operator]
        table = integrated(speed, turn_rate, words.step_s, np.zeros(3))
        _put(words, slice(start, start + words.num_steps + 1), table)
    words.world[env, 0], words.world[env, 1] = key, 1


@kernel()
def _uniform(
    key: np.uint64, reach: int, lane: int, operator: int, scratch: NDArray[np.float64]
) -> float:
    draw_uniforms(key, STREAM_REFERENCE, reach, lane, scratch)
    return float(scratch[operator])


@kernel()
def _between(bounds: NDArray[np.float64], uniform: float) -> float:
    return float(bounds[0] + (bounds[1] - bounds[0]) * uniform)


@kernel()
def draw_reaches(
    me: OperatorWords,
    key: np.uint64,
    operator: int,
    scratch: NDArray[np.float64],
    speed: NDArray[np.float64],
    turn_rate: NDArray[np.float64],
) -> None:
    """Draw speed and turn rate (T,), in m/s and rad/s, of one operator who reaches and pauses.

    A reach of duration T, length L and turn a has least jerk: speed 30 L/T (s^2 - 2 s^3 + s^4) with
    s = t/T, and likewise turn rate (Flash and Hogan 1985). Duration, length, turn and pause are
    uniform; before the first reach is a pause of up to the mean one. `scratch` has shape (R,).
    """
    speed[:] = 0.0
    turn_rate[:] = 0.0
    num_steps = speed.shape[0]
    step_s = me.step_s * me.pace[operator]
    pause = 0.5 * (me.reach[2, 0] + me.reach[2, 1])
    pause *= _uniform(key, 0, _FIRST_PAUSE, operator, scratch)
    at = np.int64(np.rint(pause / step_s))
    reach = 0
    while at < num_steps:
        duration = _between(me.reach[0], _uniform(key, reach, _DURATION, operator, scratch))
        length = _between(me.reach[1], _uniform(key, reach, _LENGTH, operator, scratch))
        pause = _between(me.reach[2], _uniform(key, reach, _PAUSE, operator, scratch))
        turn = me.reach_turn_rad * (2.0 * _uniform(key, reach, _TURN, operator, scratch) - 1.0)
        count = np.int64(np.rint(duration / step_s))
        if count < 1:
            count = np.int64(1)
        for step in range(count):
            if at + step >= num_steps:
                break
            s = (step + 0.5) / count
            rate = 30.0 / (count * me.step_s) * (s * s - 2.0 * s * s * s + s * s * s * s)
            speed[at + step] = me.scale[operator] * length * rate
            turn_rate[at + step] = turn * rate
        at += count + np.int64(np.rint(pause / step_s))
        reach += 1
