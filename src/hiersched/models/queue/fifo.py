"""First in, first out: the exact time of every packet in its queue.

Packets of slot t arrive at its start and are served as a fluid over the slot, the oldest first. The
packet in service counts as waiting until its last bit is out. All counts are doubles: exact to
2^53.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.core.compiled import kernel
from hiersched.core.parameters import Note
from hiersched.models.model import QUEUE, Model, Setup
from hiersched.models.seams import SERVE


class FifoWords(NamedTuple):
    """What the queues of U users remember."""

    arrived: NDArray[np.float64]  # (E, T + 1, U) packets that arrived before each slot
    head: NDArray[np.int64]  # (E, U) slot of the oldest waiting packet's arrival, or any earlier


@QUEUE.model
@dataclass(frozen=True, kw_only=True)
class Fifo(Model):
    """Every user's packets leave in the order in which they came."""

    model: Annotated[Literal["fifo"], Note("model", "paper", "fifo (first in, first out)")] = "fifo"

    def words(self, setup: Setup) -> FifoWords:
        """As in `Model`."""
        num_envs, num_users = setup.num_envs, setup.scenario.num_users
        return FifoWords(
            arrived=np.zeros((num_envs, setup.num_slots + 1, num_users)),
            head=np.zeros((num_envs, num_users), np.int64),
        )

    def reset(self, words: FifoWords, keys: NDArray[np.uint64]) -> None:
        """As in `Model`: empty queues."""
        words.arrived[...] = 0.0
        words.head[...] = 0


@kernel()
def serve_user(
    slot: int,
    backlog: float,
    arrivals: float,
    service: float,
    deadline_slots: float,
    head: int,
    arrived: NDArray[np.float64],
) -> tuple[float, float, float, float, float, int]:
    """Serve one user for slot t, with F(t), A(t) and mu(t), the offered service, in packets.

    The deadline is any positive number of slots. `head` and `arrived` (T + 1,) are those of
    `FifoWords`; entry t + 1 is written. Returns, in slots and packets:

    - F(t+1) = max(0, F + A - mu);
    - sojourn, from arrival to completion of the last packet completed in this slot; without one,
      the age of the oldest packet at the end of the slot, and 0 for an empty queue;
    - age of the oldest waiting packet at the start of the next slot, 0 if none waits;
    - due and late: packets whose deadline fell into this slot, and how many of them had not been
      completed by then;
    - head for the next slot.
    """
    before, load = arrived[slot], backlog + arrivals
    total = before + arrivals
    after = max(0.0, load - service)
    done = total - np.ceil(after)
    arrived[slot + 1] = total
    # Completed packets are whole: the slot of the last one, and that of the oldest one waiting.
    at = head
    while arrived[at + 1] < done:
        at += 1
    last = at
    while at <= slot and arrived[at + 1] <= done:
        at += 1
    hol = np.float64(slot) + 1.0 - np.float64(at) if total > done else 0.0
    sojourn = hol
    if done > before - np.ceil(backlog):
        # The fluid reaches the end of that packet after the work that lies before it.
        sojourn = (np.float64(slot) - np.float64(last)) + (load - (total - done)) / service
    due = late = 0.0
    whole = np.ceil(deadline_slots)
    origin = slot + 1 - np.int64(whole)
    if origin >= 0:
        # A deadline within the slot: what is left when it falls.
        left = max(0.0, load - (deadline_slots - (whole - 1.0)) * service)
        due = arrived[origin + 1] - arrived[origin]
        in_time = max(0.0, (total - np.ceil(left)) - arrived[origin])
        late = due - min(due, in_time)
    return after, sojourn, hol, due, late, at


@SERVE.kernel(FifoWords)
def serve(me: FifoWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Serve all users of a world."""
    for user in range(slot.rate_mbps.shape[0]):
        after, sojourn, hol, due, late, head = serve_user(
            state.slot[env],
            state.backlog_packets[env, user],
            np.float64(slot.arrivals_packets[user]),
            slot.service_packets[user],
            constants.deadline_slots[user],
            me.head[env, user],
            me.arrived[env, :, user],
        )
        me.head[env, user] = head
        state.backlog_packets[env, user] = after
        state.hol_delay_s[env, user] = hol * constants.slot_s
        slot.delay_s[user] = sojourn * constants.slot_s
        slot.due_packets[user] = np.uint32(due)
        slot.late_packets[user] = np.uint32(late)
