"""The queues: a packet-by-packet twin, conservation, closed forms."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from hiersched.core.compiled import kernel
from hiersched.core.pointer import Pointer
from hiersched.models.queue.fifo import FifoWords, serve, serve_user

# Quarters and eighths: exact in doubles, so that the twin's fractions must agree to the bit.
COUNTS = st.integers(0, 6)
SERVICES = st.integers(0, 40).map(lambda eighths: eighths / 8)
SLOTS = st.lists(st.tuples(COUNTS, SERVICES), min_size=1, max_size=40)
DEADLINES = st.integers(1, 24).map(lambda quarters: quarters / 4)


def library(slots, deadline_slots):
    """Run the library's queue; one (backlog, sojourn, hol, due, late) a slot."""
    arrived, head, backlog, rows = np.zeros(len(slots) + 1), 0, 0.0, []
    for slot, (arrivals, service) in enumerate(slots):
        *row, head = serve_user(
            slot, backlog, float(arrivals), float(service), float(deadline_slots), head, arrived
        )
        backlog = row[0]
        rows.append(tuple(row))
    return rows


class Constants(NamedTuple):
    deadline_slots: Any
    slot_s: float
    num_urllc: int
    superseding: int


class State(NamedTuple):
    slot: Any
    backlog_packets: Any
    hol_delay_s: Any
    held_step: Any


class Slot(NamedTuple):
    rate_mbps: Any
    arrivals_packets: Any
    service_packets: Any
    delay_s: Any
    due_packets: Any
    late_packets: Any
    superseded_packets: Any


@kernel()
def serve_world(me, constants, state, slot, env):
    serve(me, constants, state, slot, env)


STEPS = 4


def library_users(users, deadlines, superseding=0, latency=None):
    """The same for users side by side in a world beside another, who all have as many slots.

    With a core latency [slots], a multiple of an eighth, behind each row the packets that were
    superseded and the slots of the set-points in force.
    """
    count, num_slots = len(users), len(users[0])
    late = math.ceil((latency or 0) * STEPS)
    tracked = 0 if latency is None else count
    words = FifoWords(
        arrived=np.zeros((2, num_slots + 1, count)),
        head=np.zeros((2, count), np.int64),
        completed=np.zeros((2, tracked, late + STEPS), np.int64),
        late_steps=late,
        steps_per_slot=STEPS,
        phase=late / STEPS - float(latency or 0),
    )
    held = np.zeros((2, count, STEPS), np.int64)
    state = State(np.zeros(2, np.int64), np.zeros((2, count)), np.zeros((2, count)), held)
    of_user, whole = np.zeros(count), np.zeros(count, np.uint32)
    slot = Slot(
        of_user, whole, *(x.copy() for x in (of_user, of_user, whole, whole, np.ones_like(whole)))
    )
    constants = Constants(np.array(deadlines, float), 1.0, count, superseding)
    pointers = [Pointer(part) for part in (words, constants, state, slot)]
    rows = [[] for _ in users]
    for now in range(num_slots):
        state.slot[1] = now
        for user, slots in enumerate(users):
            slot.arrivals_packets[user], slot.service_packets[user] = slots[now]
        serve_world(*pointers, 1)
        of_slot = (state.backlog_packets[1], slot.delay_s, state.hol_delay_s[1])
        for user in range(count):
            fields = (*of_slot, slot.due_packets, slot.late_packets)
            row = tuple(field[user] for field in fields)
            if latency is not None:
                in_force = (held[1, user] // STEPS).tolist()
                row = (*row, int(slot.superseded_packets[user]), in_force)
            rows[user].append(row)
    arrays = (words.arrived, words.head, words.completed, held)
    for part in (*arrays, state.backlog_packets, state.hol_delay_s):
        assert not part[0].any()  # the other world
    return rows


def set_point_twin(slots, superseding, latency):
    """Backlog, packets superseded and set-points in force, packet by packet, in fractions."""
    packets, rows = [], []  # [arrival slot, work left, completion time or None]
    for slot, (arrivals, service) in enumerate(slots):
        waiting = [p for p in packets if p[2] is None]
        dropped = []
        if arrivals and superseding:
            begun = [p for p in packets if p[1] < 1]
            in_service = {p[0] for p in waiting if any(q[0] == p[0] for q in begun)}
            for p in waiting:
                stays = p[0] in in_service if superseding == 2 else p[1] < 1
                dropped += [] if stays else [p]
            packets = [p for p in packets if all(p is not d for d in dropped)]
        packets += [[slot, Fraction(1), None] for _ in range(arrivals)]
        budget = mu = Fraction(service)
        for packet in packets:
            if packet[2] is None and budget > 0:
                work = min(packet[1], budget)
                packet[1] -= work
                budget -= work
                if packet[1] == 0:
                    packet[2] = slot + (mu - budget) / mu
        in_force = []
        for step in range(STEPS):
            now = slot + Fraction(step, STEPS) - latency
            done = [p for p in packets if p[2] is not None and p[2] <= now]
            if superseding == 2:
                whole = [q for q in packets if q[2] is None or q[2] > now]
                done = [p for p in done if all(q[0] != p[0] for q in whole)]
            in_force.append(max((p[0] for p in done), default=0))
        rows.append((sum(p[1] for p in packets if p[2] is None), len(dropped), in_force))
    return rows


@settings(max_examples=300)
@given(SLOTS, st.integers(0, 2), st.integers(0, 12).map(lambda eighths: Fraction(eighths, 8)))
def test_set_points_in_force_are_those_of_single_packets(slots, superseding, latency):
    (rows,) = library_users([slots], [3.0], superseding, latency)
    for got, expected in zip(rows, set_point_twin(slots, superseding, latency), strict=True):
        assert (got[0], got[5], got[6]) == expected


def test_a_new_set_point_replaces_those_that_wait():
    """Three packets, a service of 1.5, then two packets more and services of 1.

    By packets: the second is in service, the third is dropped; then 0.5 + 2 - 1. By batches: the
    first batch is in service as a whole, nothing is dropped until slot 2 brings another.
    """
    slots = [(3, 1.5), (2, 1.0), (1, 1.0)]
    (packet,) = library_users([slots], [3.0], 1, Fraction(0))
    (batch,) = library_users([slots], [3.0], 2, Fraction(0))
    assert [(row[0], row[5]) for row in packet] == [(1.5, 0), (1.5, 1), (0.5, 1)]
    assert [(row[0], row[5]) for row in batch] == [(1.5, 0), (2.5, 0), (0.5, 2)]
    # The second packet is whole at 1.5: a newer one of the same slot does not count as newer.
    assert [row[6] for row in packet] == [[0] * 4, [0] * 4, [0, 0, 1, 1]]


def twin(slots, deadline_slots):
    """The same, packet by packet, in fractions."""
    packets = []  # [arrival slot, work left, completion time or None]
    rows = []
    for slot, (arrivals, service) in enumerate(slots):
        packets += [[slot, Fraction(1), None] for _ in range(arrivals)]
        budget, mu = Fraction(service), Fraction(service)
        sojourn = None
        for packet in packets:
            if packet[2] is not None:
                continue
            work = min(packet[1], budget)
            packet[1] -= work
            budget -= work
            if packet[1] > 0:
                break
            packet[2] = slot + (mu - budget) / mu
            sojourn = packet[2] - packet[0]
        waiting = [p for p in packets if p[2] is None]
        hol = slot + 1 - waiting[0][0] if waiting else 0
        due_at = [(p, p[0] + Fraction(deadline_slots)) for p in packets]
        due = [(p, at) for p, at in due_at if slot < at <= slot + 1]
        late = sum(p[2] is None or p[2] > at for p, at in due)
        rows.append(
            (sum(p[1] for p in waiting), hol if sojourn is None else sojourn, hol, len(due), late)
        )
    return rows


@settings(max_examples=300)
@given(SLOTS, DEADLINES)
def test_queue_is_that_of_single_packets(slots, deadline_slots):
    for got, expected in zip(
        library(slots, deadline_slots), twin(slots, deadline_slots), strict=True
    ):
        backlog, sojourn, hol, due, late = got
        assert (backlog, hol, due, late) == (expected[0], *expected[2:])
        assert sojourn == pytest.approx(float(expected[1]), abs=1e-12)


@given(SLOTS, DEADLINES)
def test_backlog_follows_its_equation_and_packets_are_conserved(slots, deadline_slots):
    backlog, delivered, due_total = 0.0, 0, 0
    arrived = np.cumsum([arrivals for arrivals, _ in slots])
    rows = library(slots, deadline_slots)
    for slot, ((arrivals, service), (after, _, hol, due, late)) in enumerate(
        zip(slots, rows, strict=True)
    ):
        assert after == max(0.0, backlog + arrivals - service)
        done = arrived[slot] - math.ceil(after)
        assert done >= delivered
        assert (hol > 0) == (after > 0)
        assert 0 <= late <= due
        backlog, delivered = after, done
        due_total += due
    whole = math.ceil(deadline_slots)
    assert due_total == (arrived[len(slots) - whole] if len(slots) >= whole else 0)


def test_hand_computed_slots():
    """Deadline 2 slots; two packets in slot 0, services 0.5, 0.5, 2.

    Slot 0 finishes nothing. Slot 1 finishes the first packet at its very end: sojourn 2, in time;
    the second is late then, and finishes half way through slot 2: sojourn 2.5.
    """
    rows = library([(2, 0.5), (0, 0.5), (0, 2.0)], 2.0)
    assert rows[0] == (1.5, 1.0, 1.0, 0, 0)
    assert rows[1] == (1.0, 2.0, 2.0, 2, 1)
    assert rows[2] == (0.0, 2.5, 0.0, 0, 0)


@given(st.lists(st.tuples(SLOTS, DEADLINES), min_size=2, max_size=5))
def test_users_side_by_side_do_not_touch_each_other(users):
    shortest = min(len(slots) for slots, _ in users)
    cut = [slots[:shortest] for slots, _ in users]
    deadlines = [deadline for _, deadline in users]
    together = library_users(cut, deadlines)
    assert together == [library(*user) for user in zip(cut, deadlines, strict=True)]


@kernel()
def long_run(arrivals, service, deadline_slots, arrived, backlogs, sojourns):
    backlog, head = 0.0, 0
    for slot in range(arrivals.shape[0]):
        backlogs[slot] = backlog
        backlog, sojourns[slot], _, _, _, head = serve_user(
            slot, backlog, arrivals[slot], service, deadline_slots, head, arrived
        )


@pytest.mark.parametrize(("load", "batch"), [(0.5, 1), (0.8, 1), (0.8, 4)])
def test_unit_service_has_its_closed_mean(load, batch):
    """Mean of F(t+1) = [F + A − 1]^+ with Poisson batches of b, E[A] = rho.

    Squaring L' = (L − 1)^+ + A for L = F + A, with P(L > 0) = rho, gives
    E[L] = rho + E[A(A−1)] / (2 (1−rho)); F' = (L − 1)^+ has rho less. For batches of b,
    E[A(A−1)] = rho² + (b − 1) rho. Each slot with L > 0 delivers one packet, so Little's law gives
    the mean sojourn: E[L] / rho slots (whole slots in the system, service included).
    """
    slots = 400_000
    backlogs, sojourns = np.empty(slots), np.empty(slots)
    uniform = np.random.default_rng(5).uniform(size=slots)
    arrivals = batch * stats.poisson.ppf(uniform, load / batch)
    long_run(arrivals, 1.0, 2.0, np.zeros(slots + 1), backlogs, sojourns)
    expected = (load**2 + (batch - 1) * load) / (2 * (1 - load))
    means = backlogs.reshape(40, -1).mean(axis=1)
    error = means.std(ddof=1) / np.sqrt(40)
    assert error < 0.05 * expected
    assert backlogs.mean() == pytest.approx(expected, abs=4 * error)
    served = sojourns[sojourns > 0]
    assert served.mean() == pytest.approx((expected + load) / load, abs=4 * error / load)
