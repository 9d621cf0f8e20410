"""Two runs in the same world: paired differences with intervals, and where the runs part."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.log import LogError, LogReader
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
    """Two runs in the same world."""

    baseline: str  # name of the policy
    other: str
    num_slots: int  # that both logs have
    num_batches: int  # stretches of time, which the intervals are over
    measures: tuple[Measure, ...]  # differences: other - baseline
    partings: tuple[Parting, ...]  # topics that differ, none if the logs say the same


def compare_logs(baseline: str | os.PathLike[str], other: str | os.PathLike[str]) -> Comparison:
    """Compare two runs slot by slot.

    The runs share the world, so differences are paired: both are averaged over the same stretches
    of time, at most `MOST_BATCHES`, and the interval is Student's t over these stretches, which are
    long enough to forget each other only if the run is. It says how sure the difference is in this
    world; other worlds need other seeds. What only one of the logs has is left out.

    LogError if a log is damaged, or the worlds are not the same.
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
        partings = [p for topic in a.topics if (p := _parting(a, b, topic, count)) is not None]
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
        first, second = getattr(a, name), getattr(b, name)
        if first != second:
            raise LogError(b.path, 0, f"{name} is {second}, but {first} in {a.path}")
    count = min(a.num_slots, b.num_slots)
    if not count:
        raise LogError(b.path if a.num_slots else a.path, 0, "the log has no slots")
    channel = _shared(a, b, "/channel", count, ["mean_fading_power"])

    def fail(what: str) -> LogError:
        text = f"this is another world than that of {a.path}: {what}, so the runs cannot be paired"
        return LogError(b.path, 0, text)

    for name in ("stage", "seed"):
        own, other = (log.metadata.get(name) for log in (a, b))
        if own != other and not ("mean_fading_power" in channel and None in (own, other)):
            raise fail(f"{name} is {other}, not {own}")
    for topic, fields in (("/channel", channel), ("/world", _shared(a, b, "/world", count))):
        for name, pair in fields.items():
            if (differs := _differs(*pair)).any():
                slot = int(fields["slot"][0][differs.argmax()])
                raise fail(f"{topic} {name} differs from slot {slot} on")
    return count


def _shared(
    a: LogReader, b: LogReader, topic: str, count: int, only: Sequence[str] | None = None
) -> dict[str, tuple[NDArray[Any], NDArray[Any]]]:
    """First slots of a topic, by the names of the fields that both logs have, `slot` among them."""
    if topic not in a.topics or topic not in b.topics:
        return {}
    names = set(a.fields(topic)) & set(b.fields(topic))
    names = names if only is None else names & set(only)
    first, second = a.read(topic, names), b.read(topic, names)
    return {name: (values[:count], second[name][:count]) for name, values in first.items()}


def _differs(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.bool_]:
    """Slots in which any bit differs, shape (T,): all, where logs have other types or sizes."""
    if (a.dtype, a.shape) != (b.dtype, b.shape):
        return np.ones(len(a), np.bool_)
    bits = [np.ascontiguousarray(values).view(f"u{values.itemsize}") for values in (a, b)]
    differs: NDArray[np.bool_] = (bits[0] != bits[1]).reshape(len(a), -1).any(axis=1)
    return differs


def _parting(a: LogReader, b: LogReader, topic: str, count: int) -> Parting | None:
    """Where a topic begins to differ, in the fields that both logs have."""
    fields = _shared(a, b, topic, count)
    differs = np.zeros(count, np.bool_)
    for pair in fields.values():
        differs |= _differs(*pair)
    if not differs.any():
        return None
    return Parting(topic, int(fields["slot"][0][differs.argmax()]), int(differs.sum()))
