from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hiersched.study.fifo import backlog_path, deadline_in_slots, late_packets, sojourn_slots


def twin(
    arrivals: list[int], service: list[Fraction], deadline: Fraction
) -> tuple[list[Fraction], list[int], list[int]]:
    """Packet by packet, in exact fractions: completion times, then who was due and who late."""
    work = [(slot, Fraction(1)) for slot, count in enumerate(arrivals) for _ in range(count)]
    born = [slot for slot, _ in work]
    done: list[Fraction | None] = [None] * len(work)
    head = 0
    left = [Fraction(1)] * len(work)
    for slot, capacity in enumerate(service):
        clock = Fraction(0)  # service used in this slot
        while head < len(work) and born[head] <= slot and clock < capacity:
            step = min(left[head], capacity - clock)
            clock += step
            left[head] -= step
            if left[head] == 0:
                done[head] = slot + clock / capacity
                head += 1
    sojourns = [end - start for end, start in zip(done, born, strict=True) if end is not None]
    due, late = [0] * len(arrivals), [0] * len(arrivals)
    for start, end in zip(born, done, strict=True):
        limit = start + deadline
        slot = math.ceil(limit) - 1  # the slot in which, or at whose end, the deadline falls
        if slot < len(arrivals):
            due[slot] += 1
            late[slot] += end is None or end > limit
    return sojourns, due, late


# Multiples of 1/16: sums and differences are then exact in floating point too.
services = st.integers(0, 64).map(lambda n: Fraction(n, 16))
slots = st.lists(st.tuples(st.integers(0, 5), services), min_size=1, max_size=40)


@given(slots, st.sampled_from([Fraction(1, 2), Fraction(1), Fraction(2), Fraction(5, 2)]))
def test_times_and_late_counts_are_those_of_the_packet_by_packet_twin(
    path: list[tuple[int, Fraction]], deadline: Fraction
) -> None:
    counts, capacities = [count for count, _ in path], [mu for _, mu in path]
    expected, due, late = twin(counts, capacities, deadline)
    arrivals = np.array(counts, np.uint32)
    service = np.array([float(mu) for mu in capacities])
    backlog = backlog_path(arrivals[:, None], service[:, None])[:, 0]
    times = sojourn_slots(arrivals, service, backlog)
    assert times == pytest.approx([float(time) for time in expected], abs=1e-12)
    counted = late_packets(arrivals, service, backlog, float(deadline))
    assert [list(numbers) for numbers in counted] == [due, late]


def test_backlog_of_a_hand_computed_queue() -> None:
    arrivals = np.array([[3], [0], [2], [0]], np.uint32)
    service = np.array([[1.5], [1.0], [0.25], [9.0]])
    assert backlog_path(arrivals, service)[:, 0].tolist() == [0.0, 1.5, 0.5, 2.25, 0.0]


def test_sojourn_of_a_hand_computed_queue() -> None:
    arrivals = np.array([3, 0, 2, 0], np.uint32)
    service = np.array([1.5, 1.0, 0.25, 9.0])
    backlog = backlog_path(arrivals[:, None], service[:, None])[:, 0]
    # Out after 1/1.5 of slot 0, half of slot 1, then 0.25 of 0.5 in slot 2 and 0.25 of 9 in slot 3.
    expected = [2 / 3, 1.5, 3 + 0.25 / 9, 1 + 1.25 / 9, 1 + 2.25 / 9]
    assert sojourn_slots(arrivals, service, backlog) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("deadline_s", "slot_s", "expected"), [(0.02, 0.01, 2.0), (0.3, 0.1, 3.0), (0.025, 0.01, 2.5)]
)
def test_deadline_in_slots_is_exact(deadline_s: float, slot_s: float, expected: float) -> None:
    assert deadline_in_slots(deadline_s, slot_s) == expected
