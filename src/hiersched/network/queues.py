"""One user's queue over one slot, with the exact first-in-first-out time of every packet.

Packets of slot t arrive at its start and are served as a fluid over the slot, the oldest first. The
packet in service counts as waiting until its last bit is out.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hiersched.compiled import kernel


@kernel()
def serve_slot(
    slot: int,
    backlog: float,
    arrivals: int,
    service: float,
    deadline_slots: float,
    arrived: NDArray[np.int64],
    head: int,
) -> tuple[float, int, float, float, int, int]:
    """Serve one user for one slot.

    Parameters
    ----------
    slot
        Index t of the slot.
    backlog
        F(t), packets at the start of the slot.
    arrivals
        A(t), packets.
    service
        mu(t), offered service, packets.
    deadline_slots
        Deadline in slots (any positive number).
    arrived
        Packets that arrived before each slot, shape (T + 1,); entry t + 1 is written.
    head
        Slot in which the oldest waiting packet arrived, or any earlier slot.

    Returns
    -------
    backlog, head
        F(t+1) = max(0, F + A - mu) and the slot of the oldest waiting packet (t + 1 if none waits).
    sojourn_slots
        Time from arrival to completion of the last packet completed in this slot; without one, the
        age of the oldest packet at the end of the slot; 0 for an empty queue.
    hol_delay_slots
        Age of the oldest waiting packet at the start of the next slot, 0 if none waits.
    due, late
        Packets whose deadline fell into this slot, and how many of them had not been completed by
        then.
    """
    total = arrived[slot] + arrivals
    arrived[slot + 1] = total
    load = backlog + arrivals
    after = max(0.0, load - service)
    done_before = arrived[slot] - np.int64(math.ceil(backlog))
    done = total - np.int64(math.ceil(after))
    if done > done_before:
        while arrived[head + 1] < done:
            head += 1
        waiting = np.float64(total - done)
        sojourn = float((slot - head) + (load - waiting) / service)
    else:
        sojourn = 0.0
        if total > done:
            while arrived[head + 1] <= done:
                head += 1
            sojourn = slot + 1.0 - head
    while head <= slot and arrived[head + 1] <= done:
        head += 1
    hol = slot + 1.0 - head if total > done else 0.0
    whole = math.ceil(deadline_slots)
    origin = slot + 1 - np.int64(whole)
    due = 0
    late = 0
    if origin >= 0:
        due = arrived[origin + 1] - arrived[origin]
        fraction = deadline_slots - (whole - 1.0)
        left = max(0.0, load - fraction * service)
        done_in_time = total - np.int64(math.ceil(left))
        late = due - min(due, max(np.int64(0), done_in_time - arrived[origin]))
    return after, head, sojourn, hol, due, late
