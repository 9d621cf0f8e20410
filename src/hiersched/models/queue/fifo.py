"""First in, first out: the exact time of every packet in its queue.

Packets of slot t arrive at its start and are served as a fluid over the slot, the oldest first. The
packet in service counts as waiting until its last bit is out. All counts are doubles: exact to
2^53.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.core.compiled import kernel
from hiersched.core.parameters import Note
from hiersched.models.model import QUEUE, Model, Setup
from hiersched.models.seams import SERVE

SUPERSEDING = ("none", "packet", "batch")
"""What newer set-points replace; the place of a name is its code in `SlotConstants`."""
BY_BATCH = SUPERSEDING.index("batch")


class FifoWords(NamedTuple):
    """What the queues of U users remember."""

    arrived: NDArray[np.float64]  # (E, T + 1, U) packets that arrived before each slot
    head: NDArray[np.int64]  # (E, U) slot of the oldest waiting packet's arrival, or any earlier
    # (E, R, M + S) slot of the newest set-point completed by M steps before each step of a slot and
    # the M steps behind it; M steps are the core latency, rounded up.
    completed: NDArray[np.int64]
    late_steps: int  # M
    steps_per_slot: int  # S
    phase: float  # by how much of a slot M steps are longer than the core latency


@QUEUE.model
@dataclass(frozen=True, kw_only=True)
class Fifo(Model):
    """Every user's packets leave in the order in which they came."""

    model: Annotated[Literal["fifo"], Note("model", "paper", "fifo (first in, first out)")] = "fifo"
    tracks_packets: ClassVar[bool] = True

    def words(self, setup: Setup) -> FifoWords:
        """As in `Model`."""
        scenario = setup.scenario
        num_envs, num_users, steps = setup.num_envs, scenario.num_users, scenario.steps_per_slot
        latency_s, slot_s = scenario.robot.core_latency_s, scenario.radio.slot_s
        late_steps = math.ceil(latency_s / scenario.robot.substep_s - 1e-9)
        tracked = (num_envs, scenario.users.num_urllc if scenario.tracks_age else 0)
        return FifoWords(
            arrived=np.zeros((num_envs, setup.num_slots + 1, num_users)),
            head=np.zeros((num_envs, num_users), np.int64),
            completed=np.zeros((*tracked, late_steps + steps), np.int64),
            late_steps=late_steps,
            steps_per_slot=steps,
            phase=max(0.0, late_steps / steps - latency_s / slot_s),
        )

    def reset(self, words: FifoWords, keys: NDArray[np.uint64]) -> None:
        """As in `Model`: empty queues."""
        words.arrived[...] = 0.0
        words.head[...] = 0
        words.completed[...] = 0


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


@kernel()
def supersede(
    slot: int, backlog: float, by_batch: bool, arrived: NDArray[np.float64]
) -> tuple[float, float]:
    """Drop the waiting packets of one user, since newer ones come in slot t.

    What is in service stays: a packet, or all of its batch. `backlog` F(t) in packets, `arrived`
    (T + 1,) as in `FifoWords`, from which the dropped ones go. Returns what is left of the backlog
    and how many packets were dropped.
    """
    before = arrived[slot]
    begun = backlog - np.floor(backlog)
    kept = before - np.ceil(backlog)
    left = begun
    if by_batch:
        row = slot
        while row > 0 and arrived[row - 1] > kept:
            row -= 1
        # The oldest waiting packet is of the batch of slot row - 1.
        if begun > 0.0 or (row > 0 and arrived[row - 1] < kept):
            left = begun + (arrived[row] - kept - np.ceil(begun))
            kept = arrived[row]
    elif begun > 0.0:
        kept += 1.0
    row = slot
    while row >= 0 and arrived[row] > kept:
        arrived[row] = kept
        row -= 1
    return left, before - kept


@kernel()
def follow_set_points(
    me: FifoWords,
    slot: int,
    load: float,
    service: float,
    by_batch: bool,
    arrived: NDArray[np.float64],
    completed: NDArray[np.int64],
) -> None:
    """Bring the newest completed set-point of one robot up to date, step by step of slot t.

    `load` F(t) + A(t) and `service` mu(t) in packets; row `completed` (M + S,) is that of
    `FifoWords`. A packet is a set-point, stamped with its slot's start; with `by_batch` a slot's
    packets are one, which counts when the last of them is completed.
    """
    late, steps = me.late_steps, me.steps_per_slot
    at = completed[late + steps - 1]
    for step in range(late):
        completed[step] = completed[step + steps]
    total = arrived[slot + 1]
    for step in range(steps):
        done = total - np.ceil(max(0.0, load - (step / steps + me.phase) * service))
        if by_batch:
            look = at + 1
            while look <= slot and arrived[look + 1] <= done:
                if arrived[look + 1] > arrived[look]:
                    at = look
                look += 1
        else:
            while arrived[at + 1] < done:
                at += 1
        completed[late + step] = at


@SERVE.kernel(FifoWords)
def serve(me: FifoWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Serve all users of a world."""
    for user in range(slot.rate_mbps.shape[0]):
        slot.superseded_packets[user] = 0
    if constants.superseding > 0:
        for user in range(constants.num_urllc):
            if slot.arrivals_packets[user] > 0 and state.backlog_packets[env, user] > 0.0:
                left, dropped = supersede(
                    state.slot[env],
                    state.backlog_packets[env, user],
                    constants.superseding == BY_BATCH,
                    me.arrived[env, :, user],
                )
                state.backlog_packets[env, user] = left
                slot.superseded_packets[user] = np.uint32(dropped)
    for user in range(slot.rate_mbps.shape[0]):
        load = state.backlog_packets[env, user] + np.float64(slot.arrivals_packets[user])
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
        if user < me.completed.shape[1]:
            completed = me.completed[env, user]
            follow_set_points(
                me,
                state.slot[env],
                load,
                slot.service_packets[user],
                constants.superseding == BY_BATCH,
                me.arrived[env, :, user],
                completed,
            )
            for step in range(me.steps_per_slot):
                state.held_step[env, user, step] = completed[step] * me.steps_per_slot
