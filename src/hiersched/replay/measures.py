"""What one looks at first in a run: late packets, rates, queues, tracking."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.log import LogReader

FloatArray = NDArray[np.float64]

_USER_FIELDS = {
    "due": "due_packets",
    "late": "late_packets",
    "rate": "rate_mbps",
    "backlog": "backlog_packets",
    "wait": "hol_delay_s",
}
_SLICE_FIELDS = {
    "due": "due_{}_packets",
    "late": "late_{}_packets",
    "backlog": "backlog_{}_packets",
    "reward": "reward_{}",
}
_SLICE_MEASURES = (
    ("late", "late packets", "%", 100.0),
    ("rate", "rate", "Mbit/s", 1.0),
    ("backlog", "backlog", "packets", 1.0),
    ("wait", "wait", "ms", 1e3),
    ("reward", "reward", "", 1.0),
)
_ROBOT_MEASURES = (
    ("network_delay_s", "network delay", "ms", 1e3),
    ("tracking_error_m", "tracking error", "cm", 100.0),
    ("dexterity_index", "dexterity index", "", 1.0),
)
_WANTED = {
    *_USER_FIELDS.values(),
    *(name.format(part) for name in _SLICE_FIELDS.values() for part in ("urllc", "embb")),
    *(field for field, *_ in _ROBOT_MEASURES),
}


def batch_means(log: LogReader, count: int, batches: int) -> list[tuple[str, str, FloatArray]]:
    """Average what matters over stretches of time, as far as the log has it.

    The first `count` slots, at least 1, are cut into `batches` stretches of (nearly) the same
    length, at most `count`. Returns name, unit and the mean of each stretch, shape (batches,). Late
    packets are over those that were due in the whole run, so that the mean over stretches is the
    share of the run.
    """
    cut = np.linspace(0, count, batches + 1).astype(np.intp)
    length = np.diff(cut)

    def mean(values: NDArray[Any]) -> FloatArray:
        per_slot = values[:count].reshape(count, -1).mean(axis=1, dtype=np.float64)
        means: FloatArray = np.add.reduceat(per_slot, cut[:-1]) / length
        return means

    found = []
    for name, unit, scale, values, due in _series(log):
        means = mean(values)
        if due is not None:
            # Over the due packets of the whole run: a batch without any counts as one without late.
            overall = float((mean(due) * length).sum() / count)
            means = means / (overall or np.nan)
        found.append((name, unit, scale * means))
    return found


def _series(log: LogReader) -> Iterator[tuple[str, str, float, NDArray[Any], NDArray[Any] | None]]:
    """Yield name, unit, scale, values (T, ...) and, of shares, what they are shares of."""
    fields: dict[str, NDArray[Any]] = {}
    for topic in log.topics:
        if wanted := _WANTED.intersection(log.known_fields(topic)):
            fields |= log.read(topic, wanted)
    n = log.dims.num_urllc
    for name, users in (("URLLC", slice(0, n)), ("eMBB", slice(n, n + log.dims.num_embb))):
        if users.start == users.stop:
            continue
        # The users' own numbers go before sums of the slice.
        names = {key: field.format(name.lower()) for key, field in _SLICE_FIELDS.items()}
        own = {key: fields[f] for key, f in names.items() if f in fields}
        own |= {key: fields[f][:, users] for key, f in _USER_FIELDS.items() if f in fields}
        for key, what, unit, scale in _SLICE_MEASURES:
            if key in own and (key != "late" or "due" in own):
                yield f"{name} {what}", unit, scale, own[key], own["due"] if key == "late" else None
    for field, name, unit, scale in _ROBOT_MEASURES:
        if n and field in fields:
            yield name, unit, scale, fields[field], None
