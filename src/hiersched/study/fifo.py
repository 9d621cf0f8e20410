"""First-in-first-out times of every packet, recomputed from logged arrivals and offered service.

Nothing is shared with the simulator's queue: this is a second computation of the same model.
Packets of slot t arrive at its start, the service of a slot is a fluid, and a packet is out when
its last bit is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def backlog_path(arrivals_packets: NDArray[np.uint32], service_packets: FloatArray) -> FloatArray:
    """Return the backlogs that follow from arrivals and offered service, from empty queues.

    Of arrivals A(t) and service mu(t), shape (T, U), they are F(0) = 0 to F(T), shape (T + 1, U):
    F(t+1) = max(0, F(t) + A(t) - mu(t)), all in packets.
    """
    backlog = np.zeros((len(arrivals_packets) + 1, arrivals_packets.shape[1]))
    arrivals = arrivals_packets.astype(np.float64)
    for slot, service in enumerate(service_packets):
        after = backlog[slot + 1]
        np.add(backlog[slot], arrivals[slot], out=after)
        after -= service
        np.maximum(0.0, after, out=after)
    return backlog


def sojourn_slots(
    arrivals_packets: NDArray[np.uint32], service_packets: FloatArray, backlog: FloatArray
) -> FloatArray:
    """Return the time from arrival to completion of every completed packet of one user.

    Arrivals and service have shape (T,), backlogs (T + 1,), as of `backlog_path`; the times are in
    slots (fractions included), in the order of arrival, shape (packets completed,).
    """
    arrived = _arrived(arrivals_packets)
    completed = arrived - np.ceil(backlog).astype(np.int64)
    slots, count = np.arange(len(arrivals_packets)), int(completed[-1])
    out = np.diff(completed)  # packets that a slot completes; each packet has the slot it is among
    origin = np.repeat(slots, arrivals_packets)[:count]
    slot, served = np.repeat(slots, out), np.repeat(service_packets, out)
    load = np.repeat(backlog[:-1] + arrivals_packets, out)
    # Packets after this one that have arrived.
    behind = np.repeat(arrived[1:], out) - np.arange(1, count + 1)
    result: FloatArray = (slot - origin) + (load - behind) / served
    return result


def late_packets(
    arrivals_packets: NDArray[np.uint32],
    service_packets: FloatArray,
    backlog: FloatArray,
    deadline_slots: float,
) -> tuple[IntArray, IntArray]:
    """Count one user's packets whose deadline falls into each slot, and those not out by then.

    Arguments are as of `sojourn_slots`; the deadline in slots is any positive number. Both counts
    have shape (T,).
    """
    arrived = _arrived(arrivals_packets)
    whole = int(np.ceil(deadline_slots))
    part = deadline_slots - (whole - 1)  # of its last slot, the part that the deadline allows
    count = len(arrivals_packets)
    origins = max(0, count - whole + 1)  # slots of arrival whose deadline falls into the run
    due = np.zeros(count, np.int64)
    due[count - origins :] = arrivals_packets[:origins]
    before = np.zeros(count, np.int64)
    before[count - origins :] = arrived[:origins]
    left = np.maximum(0.0, backlog[:-1] + arrivals_packets - part * service_packets)
    out = arrived[1:] - np.ceil(left).astype(np.int64)
    return due, due - np.clip(out - before, 0, due)


def deadline_in_slots(deadline_s: float, slot_s: float) -> float:
    """Return a deadline in slots; a quotient within rounding error of an integer is exact."""
    slots = deadline_s / slot_s
    return float(round(slots)) if abs(slots - round(slots)) < 1e-9 * max(1.0, slots) else slots


def _arrived(arrivals_packets: NDArray[np.uint32]) -> IntArray:
    """Count the packets that have arrived before each slot and in all, shape (T + 1,)."""
    return np.concatenate([[0], np.cumsum(arrivals_packets, dtype=np.int64)])
