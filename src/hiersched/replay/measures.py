"""What one looks at first in a run: late packets, rates, queues, tracking."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.log import LogReader

FloatArray = NDArray[np.float64]

_READ = {
    "/allocation": ("rate_mbps",),
    "/queue": ("backlog_packets",),
    "/delay": ("hol_delay_s", "due_packets", "late_packets", "reward_urllc", "reward_embb"),
    "/robots": ("tracking_error_m", "dexterity_index", "network_delay_s"),
}


def batch_means(log: LogReader, count: int, batches: int) -> list[tuple[str, str, FloatArray]]:
    """Average what matters over stretches of time.

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
    fields: dict[str, NDArray[Any]] = {}
    for topic, names in _READ.items():
        fields |= log.read(topic, names)
    fields = {name: values[:count] for name, values in fields.items()}
    cut = np.linspace(0, count, batches + 1).astype(np.intp)
    length = np.diff(cut)
    n = log.dims.num_urllc

    def mean(values: NDArray[Any]) -> FloatArray:
        per_slot = values.reshape(count, -1).mean(axis=1, dtype=np.float64)
        means: FloatArray = np.add.reduceat(per_slot, cut[:-1]) / length
        return means

    def late(users: slice) -> FloatArray:
        due = mean(fields["due_packets"][:, users])
        # Over the due packets of the whole run: a batch without any counts as one without late.
        overall = float((due * length).sum() / count)
        share = mean(fields["late_packets"][:, users]) / (overall or np.nan)
        return 100.0 * share

    urllc, embb = slice(0, n), slice(n, None)
    found = []
    for name, users in (("URLLC", urllc), ("eMBB", embb)):
        if fields["rate_mbps"][:, users].size:
            found += [
                (f"{name} late packets", "%", late(users)),
                (f"{name} rate", "Mbit/s", mean(fields["rate_mbps"][:, users])),
                (f"{name} backlog", "packets", mean(fields["backlog_packets"][:, users])),
                (f"{name} wait", "ms", 1e3 * mean(fields["hol_delay_s"][:, users])),
                (f"{name} reward", "", mean(fields[f"reward_{name.lower()}"])),
            ]
    if n:
        found += [
            ("network delay", "ms", 1e3 * mean(fields["network_delay_s"])),
            ("tracking error", "cm", 100.0 * mean(fields["tracking_error_m"])),
            ("dexterity index", "", mean(fields["dexterity_index"])),
        ]
    return found
