"""Two runs in the same world: paired differences with intervals, and where the runs part."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.log import TOPICS, LogError, LogReader
from hiersched.replay.measures import batch_means
from hiersched.study.statistics import Interval, paired_difference

MOST_BATCHES = 20
"""Stretches of time over which differences are averaged for an interval."""


@dataclass(frozen=True)
class Measure:
    """One measure of two runs: both means, and their difference with its interval."""

    name: str
    unit: str
    baseline: float
    other: float
    difference: Interval


@dataclass(frozen=True)
class Parting:
    """Where a topic of two logs begins to differ, and in how many slots it does."""

    topic: str
    first_slot: int
    num_slots: int


@dataclass(frozen=True)
class Comparison:
    """Two runs in the same world.

    Attributes
    ----------
    baseline, other
        Policies.
    num_slots
        Slots that both logs have.
    num_batches
        Stretches of time that the intervals are over.
    measures
        Differences, other - baseline.
    partings
        Topics that differ; empty if the logs say the same.
    """

    baseline: str
    other: str
    num_slots: int
    num_batches: int
    measures: tuple[Measure, ...]
    partings: tuple[Parting, ...]


def compare_logs(baseline: str | os.PathLike[str], other: str | os.PathLike[str]) -> Comparison:
    """Compare two runs slot by slot.

    The runs share the world, so differences are paired: both are averaged over the same stretches
    of time, at most `MOST_BATCHES`, and the interval is Student's t over these stretches, which are
    long enough to forget each other only if the run is. It says how sure the difference is in this
    world; other worlds need other seeds.

    Parameters
    ----------
    baseline, other
        Logs.

    Raises
    ------
    LogError
        If a log is damaged, or the worlds are not the same.
    """
    with LogReader(baseline) as a, LogReader(other) as b:
        count = _check_same_world(a, b)
        batches = min(MOST_BATCHES, count)
        others = {name: y for name, _, y in batch_means(b, count, batches)}
        measures = [
            Measure(name, unit, float(x.mean()), float(y.mean()), paired_difference(y, x))
            for name, unit, x in batch_means(a, count, batches)
            if (y := others.get(name)) is not None  # their profiles may differ
        ]
        partings = [p for topic in TOPICS if (p := _parting(a, b, topic, count)) is not None]
        return Comparison(
            baseline=a.metadata.get("policy", ""),
            other=b.metadata.get("policy", ""),
            num_slots=count,
            num_batches=batches,
            measures=tuple(measures),
            partings=tuple(partings),
        )


def _check_same_world(a: LogReader, b: LogReader) -> int:
    """Check that the runs can be paired; return how many slots they share.

    A log of the profile ``decisions`` has nothing of the world: stage and seed have to say it.
    """
    for name in ("dims", "slot_ns"):
        if getattr(a, name) != getattr(b, name):
            raise LogError(
                b.path, 0, f"{name} is {getattr(b, name)}, but {getattr(a, name)} in {a.path}"
            )
    for name in ("stage", "seed"):
        texts = [log.metadata.get(name) for log in (b, a)]
        has_world = "/channel" in a.topics and "/channel" in b.topics
        if texts[0] != texts[1] and not (has_world and None in texts):
            raise LogError(
                b.path,
                0,
                f"this is another world than that of {a.path}: {name} is {texts[0]}, not "
                f"{texts[1]}, so the runs cannot be paired",
            )
    count = min(a.num_slots, b.num_slots)
    if not count:
        raise LogError(b.path if a.num_slots else a.path, 0, "the log has no slots")
    for topic, names in (("/channel", ["mean_fading_power"]), ("/world", None)):
        if topic in a.topics and topic in b.topics:
            first, second = (log.read(topic, names, 0, None) for log in (a, b))
            for name, values in first.items():
                differs = _differs(values[:count], second[name][:count])
                if differs.any():
                    slot = int(first["slot"][differs.argmax()])
                    raise LogError(
                        b.path,
                        0,
                        f"this is another world than that of {a.path}: {topic} {name} differs "
                        f"from slot {slot} on, so the runs cannot be paired",
                    )
    return count


def _differs(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.bool_]:
    """Slots in which any bit differs, shape (T,)."""
    bits = [np.ascontiguousarray(values).view(f"u{values.itemsize}") for values in (a, b)]
    differs: NDArray[np.bool_] = (bits[0] != bits[1]).reshape(len(a), -1).any(axis=1)
    return differs


def _parting(a: LogReader, b: LogReader, topic: str, count: int) -> Parting | None:
    """Where a topic that both logs have begins to differ."""
    if topic not in a.topics or topic not in b.topics:
        return None
    first, second = a.read(topic), b.read(topic)
    differs = np.zeros(count, np.bool_)
    for name in first.keys() & second.keys():
        differs |= _differs(first[name][:count], second[name][:count])
    if not differs.any():
        return None
    return Parting(topic, int(first["slot"][differs.argmax()]), int(differs.sum()))
