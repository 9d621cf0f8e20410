"""What is worth a line in a log: where a trouble begins, not every slot in which it lasts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.control import GainSchedule, hold_delays
from hiersched.log import Event
from hiersched.scenario import Scenario

_UNPROVEN = {"infeasible": "nominal gain", "uncertified": "a gain without certificate"}
"""Status of an entry of the schedule without certificate -> the gain that it puts into force."""


def slot_events(
    scenario: Scenario,
    schedule: GainSchedule,
    fields: Mapping[str, NDArray[Any]],
    first_slot: int = 0,
) -> list[Event]:
    """Events of a block of slots of one world: one for every stretch of slots of the same trouble.

    `fields` are those of `SlotRecord`, leading axis (T,), from `first_slot` on; `schedule` says at
    which delays the gain in force is not certified. They are ordered by slot.
    """
    events = [
        *_late_users(scenario, fields),
        *_capped_delays(scenario, fields),
        *_unproven_gains(scenario, schedule, fields),
        *_saturated_controls(fields),
    ]
    events.sort(key=lambda event: event.slot)
    return [event._replace(slot=event.slot + first_slot) for event in events]


def stretches(mask: NDArray[np.bool_]) -> Iterator[tuple[int, int, int]]:
    """Yield the runs of True in the columns of a mask (T, N): column, first row, row after."""
    padded = np.zeros((mask.shape[1], mask.shape[0] + 2), np.int8)
    padded[:, 1:-1] = mask.T
    change = np.diff(padded, axis=1)
    columns, starts = np.nonzero(change == 1)
    stops = np.nonzero(change == -1)[1]
    yield from zip(columns.tolist(), starts.tolist(), stops.tolist(), strict=True)


def _late_users(scenario: Scenario, fields: Mapping[str, NDArray[Any]]) -> Iterator[Event]:
    traffic, users = scenario.traffic, scenario.users
    deadline_s = np.repeat(
        [traffic.deadline_s, traffic.embb_deadline_s], [users.num_urllc, users.num_embb]
    )
    wait_s = fields["hol_delay_s"]
    # A wait is a multiple of the slot up to rounding: the deadline itself is not yet late.
    for user, start, stop in stretches(wait_s > deadline_s * (1.0 + 1e-9)):
        most = 1e3 * wait_s[start:stop, user].max()
        text = (
            f"user {user}: head-of-line delay past {1e3 * deadline_s[user]:g} ms "
            f"for {stop - start} slots, up to {most:.6g} ms"
        )
        yield Event(start, "WARNING", "queue", text)


def _capped_delays(scenario: Scenario, fields: Mapping[str, NDArray[Any]]) -> Iterator[Event]:
    for robot, start, stop in stretches(fields["delay_capped"] > 0):
        text = (
            f"robot {robot}: measurements up to {fields['delay_steps'][start:stop, robot].max()} "
            f"samples old for {stop - start} slots: beyond the {scenario.max_delay_steps} samples "
            "that gains are designed for"
        )
        yield Event(start, "WARNING", "delay", text)


def _unproven_gains(
    scenario: Scenario, schedule: GainSchedule, fields: Mapping[str, NDArray[Any]]
) -> Iterator[Event]:
    of_robots = [(schedule, *schedule.kinds)[kind].status for kind in scenario.kind_of_robot]
    unproven = {kind for status in of_robots for kind in status} & _UNPROVEN.keys()
    if scenario.control.gain == "nominal":
        unproven -= {"uncertified"}  # that gain is not in force
    if not unproven:
        return
    steps = entries_in_force(scenario, fields["delay_steps"])
    status = np.take_along_axis(np.array(of_robots).T, steps, axis=0)
    for kind, what in _UNPROVEN.items():
        if kind not in unproven:
            continue
        for robot, start, stop in stretches(status == kind):
            text = (
                f"robot {robot}: no certified gain for T = {steps[start, robot]}, {what} in force "
                f"for {stop - start} slots"
            )
            yield Event(start, "WARNING", "gain", text)


def entries_in_force(scenario: Scenario, delay_steps: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Entry of the schedule in force at the end of each slot, shape (T, R), from the first on.

    A slot takes it from its last control sample; one without a sample keeps the last slot's.
    """
    slot_s, sampling_s = scenario.radio.slot_s, scenario.control.sampling_s
    slots = np.arange(len(delay_steps))
    # Start and end of a slot in samples; 1e-9 as for delays: a ratio near an integer is that one.
    last = np.ceil((slots + 1) * slot_s / sampling_s - 1e-9).astype(int) - 1
    sample = np.arange(last[-1] + 1)
    slot_of_sample = np.floor(sample * sampling_s / slot_s + 1e-9).astype(int)
    wanted = np.minimum(delay_steps[slot_of_sample], scenario.max_delay_steps)
    entries: NDArray[np.int64] = hold_delays(wanted, scenario.control.hold_samples)[last]
    return entries


def _saturated_controls(fields: Mapping[str, NDArray[Any]]) -> Iterator[Event]:
    count = fields["control_saturated"]
    until = np.zeros((len(count) + 1, count.shape[1]), np.int64)
    np.cumsum(count, axis=0, out=until[1:])
    for robot, start, stop in stretches(count > 0):
        commands = until[stop, robot] - until[start, robot]
        text = f"robot {robot}: {commands} saturated commands in {stop - start} slots"
        yield Event(start, "INFO", "control", text)
