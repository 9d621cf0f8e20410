"""What one looks at first in a run: late packets, rates, queues, tracking."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.log import TOPICS, LogReader

FloatArray = NDArray[np.float64]

_SLICE_KINDS = ("due", "late", "backlog")
_ROBOT_MEASURES = (
    ("network_delay_s", "network delay", "ms", 1e3),
    ("tracking_error_m", "tracking error", "cm", 100.0),
    ("dexterity_index", "dexterity index", "", 1.0),
)
_WANTED = {
    *("rate_mbps", "hol_delay_s", "reward_urllc", "reward_embb"),
    *(f"{kind}_packets" for kind in _SLICE_KINDS),
    *(f"{kind}_{name}_packets" for kind in _SLICE_KINDS for name in ("urllc", "embb")),
    *(field for field, *_ in _ROBOT_MEASURES),
}


def batch_means(log: LogReader, count: int, batches: int) -> list[tuple[str, str, FloatArray]]:
    """Average what matters over stretches of time, as far as the log's profile has it.

    Parameters
    ----------
    log
        The log.
    count
        Slots to take, from the first on; at least 1.
    batches
        Stretches of (nearly) the same length, at most `count`.

    Returns
    -------
    list of tuple
        Name, unit and the mean of each stretch, shape (batches,). Late packets are over those that
        were due in the whole run, so that the mean over stretches is the share of the run.
    """
    fields = {name: values[:count] for name, values in _read(log).items()}
    cut = np.linspace(0, count, batches + 1).astype(np.intp)
    length = np.diff(cut)
    n = log.dims.num_urllc

    def mean(values: NDArray[Any]) -> FloatArray:
        per_slot = values.reshape(count, -1).mean(axis=1, dtype=np.float64)
        means: FloatArray = np.add.reduceat(per_slot, cut[:-1]) / length
        return means

    def late(due: NDArray[np.uint32], packets: NDArray[np.uint32]) -> FloatArray:
        # Over the due packets of the whole run: a batch without any counts as one without late.
        overall = float((mean(due) * length).sum() / count)
        share = mean(packets) / (overall or np.nan)
        return 100.0 * share

    found = []
    for name, users in (("URLLC", slice(0, n)), ("eMBB", slice(n, n + log.dims.num_embb))):
        if users.start == users.stop:
            continue
        due, packets, backlog = (_of_slice(fields, k, name, users) for k in _SLICE_KINDS)
        found.append((f"{name} late packets", "%", late(due, packets)))
        if "rate_mbps" in fields:
            found.append((f"{name} rate", "Mbit/s", mean(fields["rate_mbps"][:, users])))
        found.append((f"{name} backlog", "packets", mean(backlog)))
        if "hol_delay_s" in fields:
            found.append((f"{name} wait", "ms", 1e3 * mean(fields["hol_delay_s"][:, users])))
        found.append((f"{name} reward", "", mean(fields[f"reward_{name.lower()}"])))
    for field, name, unit, scale in _ROBOT_MEASURES:
        if n and field in fields:
            found.append((name, unit, scale * mean(fields[field])))
    return found


def _read(log: LogReader) -> dict[str, NDArray[Any]]:
    """Read the fields that count, of those that the log has."""
    fields: dict[str, NDArray[Any]] = {}
    for topic in log.topics:
        names = {field.name for field in TOPICS[topic].fields_in(log.profile)}
        if wanted := names & _WANTED:
            fields |= log.read(topic, wanted)
    return fields


def _of_slice(fields: dict[str, NDArray[Any]], kind: str, name: str, users: slice) -> NDArray[Any]:
    """Numbers of a slice's users, or those of the slice where the log has no others."""
    if f"{kind}_packets" in fields:
        return fields[f"{kind}_packets"][:, users]
    return fields[f"{kind}_{name.lower()}_packets"]
