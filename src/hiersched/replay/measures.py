"""What one looks at first in a run: late packets, rates, queues, tracking."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

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
_LATE = ("tracking_error_m", "network_delay_s", "reference", "set_point_age_s")
"""What says how far off a robot of the present model would be if its set-points were late."""
LOOP_TIME_S = 0.1
"""About how fast a robot follows a set-point: its loop smooths a lag that changes faster."""
_WANTED = {
    *_USER_FIELDS.values(),
    *(name.format(part) for name in _SLICE_FIELDS.values() for part in ("urllc", "embb")),
    *(field for field, *_ in _ROBOT_MEASURES),
    *_LATE,
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


def late_set_point_error_m(
    error_m: FloatArray, speed_mps: FloatArray, delay_s: FloatArray, slot_s: float
) -> FloatArray:
    """Tracking errors of robots that know their reference, had their set-points been late.

    sqrt(e^2 + (v D)^2) of each slot and robot, shape (T, R), with the delay D behind a first-order
    filter of `LOOP_TIME_S`: at a constant delay that is what a robot that holds its set-points
    loses, and its loop smooths what changes faster.
    """
    gain = 1.0 - np.exp(-slot_s / LOOP_TIME_S)
    first = (1.0 - gain) * delay_s[:1]  # as if the first delay had been in force before
    lag_s, _ = lfilter([gain], [1.0, gain - 1.0], delay_s, axis=0, zi=first)
    error: FloatArray = np.hypot(error_m, speed_mps * lag_s)
    return error


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
    if n and all(name in fields for name in _LATE) and not fields["set_point_age_s"].any():
        error, delay, reference = (fields[name] for name in _LATE[:3])
        values = late_set_point_error_m(error, reference[..., 3], delay, log.slot_ns * 1e-9)
        yield "tracking error, set-points late", "cm", 100.0, values, None
