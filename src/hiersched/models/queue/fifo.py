"""All users' queues over one slot, with the exact first-in-first-out time of every packet.

Packets of slot t arrive at its start and are served as a fluid over the slot, the oldest first. The
packet in service counts as waiting until its last bit is out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hiersched.core.compiled import kernel
from hiersched.core.parameters import Note
from hiersched.models.model import QUEUE, Model


@QUEUE.model
@dataclass(frozen=True, kw_only=True)
class Fifo(Model):
    """Every user's packets leave in the order in which they came."""

    model: Annotated[Literal["fifo"], Note("model", "paper", "fifo (first in, first out)")] = "fifo"


LANES = 32
"""Users side by side. A block of them is one flat array, field after field: with offsets that the
compiler knows, it proves that fields do not overlap, and uses whole vectors. All values are
doubles, counts too: they are exact to 2^53."""

(
    BACKLOG,
    ARRIVALS,
    SERVICE,
    WHOLE_DEADLINE,
    LAST_FRACTION,
    ARRIVED,
    AFTER,
    DONE,
    COMPLETING,
    HEAD,
    ORIGIN,
    DUE,
    SOJOURN,
    HOL_DELAY,
    LATE,
    NUM_QUEUE_LANES,
) = (LANES * place for place in range(16))


@njit(inline="always")
def set_deadline(lanes: NDArray[np.float64], lane: int, deadline_slots: float) -> None:
    """Note one user's deadline in slots (any positive number)."""
    whole = np.ceil(deadline_slots)
    lanes[WHOLE_DEADLINE + lane] = whole
    lanes[LAST_FRACTION + lane] = deadline_slots - (whole - 1.0)


@kernel(forceinline=True)
def serve_users(
    slot: int,
    count: int,
    lanes: NDArray[np.float64],
    arrived: NDArray[np.float64],
    head: NDArray[np.int64],
) -> None:
    """Serve a block of users for one slot.

    Parameters
    ----------
    slot
        Index t of the slot.
    count
        Users in the block, at most LANES.
    lanes
        Read: `BACKLOG` F(t), `ARRIVALS` A(t) and `SERVICE` mu(t), the offered service, in packets,
        and the deadline from `set_deadline`. Written: `AFTER`, F(t+1) = max(0, F + A - mu);
        `SOJOURN`, slots from arrival to completion of the last packet completed in this slot
        (without one, the age of the oldest packet at the end of the slot; 0 for an empty queue);
        `HOL_DELAY`, age in slots of the oldest waiting packet at the start of the next slot, 0 if
        none waits; `DUE`, packets whose deadline fell into this slot, and `LATE`, how many of them
        had not been completed by then.
    arrived
        Packets that arrived before each slot, shape (T + 1, count); row t + 1 is written.
    head
        Slot in which the oldest waiting packet arrived, or any earlier slot, shape (count,); moves
        on (t + 1 if none waits).
    """
    for user in range(count):
        lanes[ARRIVED + user] = arrived[slot, user]
    for lane in range(LANES):
        backlog = lanes[BACKLOG + lane]
        load = backlog + lanes[ARRIVALS + lane]
        total = lanes[ARRIVED + lane] + lanes[ARRIVALS + lane]
        after = max(0.0, load - lanes[SERVICE + lane])
        done = total - np.ceil(after)
        lanes[COMPLETING + lane] = done - (lanes[ARRIVED + lane] - np.ceil(backlog))
        lanes[ARRIVED + lane] = total
        lanes[AFTER + lane] = after
        lanes[DONE + lane] = done
    for user in range(count):
        arrived[slot + 1, user] = lanes[ARRIVED + user]
    _find_packets(slot, count, lanes, arrived, head)
    end = np.float64(slot) + 1.0
    for lane in range(LANES):
        service = lanes[SERVICE + lane]
        load = lanes[BACKLOG + lane] + lanes[ARRIVALS + lane]
        total = lanes[ARRIVED + lane]
        done = lanes[DONE + lane]
        hol = end - lanes[HOL_DELAY + lane] if total > done else 0.0
        sojourn = (np.float64(slot) - lanes[HEAD + lane]) + (load - (total - done)) / service
        lanes[SOJOURN + lane] = sojourn if lanes[COMPLETING + lane] > 0.0 else hol
        lanes[HOL_DELAY + lane] = hol
        left = max(0.0, load - lanes[LAST_FRACTION + lane] * service)
        in_time = max(0.0, (total - np.ceil(left)) - lanes[ORIGIN + lane])
        due = lanes[DUE + lane]
        lanes[LATE + lane] = due - min(due, in_time)


@kernel(forceinline=True)
def _find_packets(
    slot: int,
    count: int,
    lanes: NDArray[np.float64],
    arrived: NDArray[np.float64],
    head: NDArray[np.int64],
) -> None:
    """Find the slots in which the packets arrived that matter now.

    `HEAD` becomes that of the last packet completed, `HOL_DELAY` that of the oldest waiting one;
    `DUE` packets have their deadline in this slot, `ORIGIN` came before them.
    """
    for user in range(count):
        done = lanes[DONE + user]
        at = head[user]
        while arrived[at + 1, user] < done:
            at += 1
        lanes[HEAD + user] = np.float64(at)
        while at <= slot and arrived[at + 1, user] <= done:
            at += 1
        lanes[HOL_DELAY + user] = np.float64(at)
        head[user] = at
        origin = slot + 1 - np.int64(lanes[WHOLE_DEADLINE + user])
        before = arrived[origin, user] if origin >= 0 else 0.0
        lanes[ORIGIN + user] = before
        lanes[DUE + user] = arrived[origin + 1, user] - before if origin >= 0 else 0.0
