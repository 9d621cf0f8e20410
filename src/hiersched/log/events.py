"""Events of a run as `foxglove.Log` messages: sparse, of any length, one at a time."""

from __future__ import annotations

import struct
from functools import cache
from typing import Any, NamedTuple

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.opcode import Opcode

from hiersched.log.schema import EVENTS_SCHEMA, descriptor_set

NS_PER_S = 1_000_000_000
_HEADER = struct.Struct("<BQHIQQ")  # of a Message record, see schema.MESSAGE_HEADER


class Event(NamedTuple):
    """Something worth a line: a violated deadline, an infeasible gain, a capped delay.

    Parameters
    ----------
    slot
        Slot in which it happened.
    level
        Name of a level of `foxglove.Log`: DEBUG, INFO, WARNING, ERROR or FATAL.
    name
        Part of the system that speaks, for example ``control``.
    message
        The line.
    """

    slot: int
    level: str
    name: str
    message: str


@cache
def _log_class() -> Any:
    """Build the `foxglove.Log` message class in a pool of its own, apart from a viewer's."""
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptor_set(EVENTS_SCHEMA)).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(EVENTS_SCHEMA))


def encode_event(event: Event, slot_ns: int, channel_id: int) -> bytes:
    """Encode an event as an MCAP Message record.

    Parameters
    ----------
    event
        The event.
    slot_ns
        Slot length [ns].
    channel_id
        MCAP channel id of ``/events``.

    Returns
    -------
    bytes
        The whole record.

    Raises
    ------
    ValueError
        If the level is none of `foxglove.Log`.
    """
    log = _log_class()()
    levels = log.Level.DESCRIPTOR.values_by_name
    if event.level not in levels:
        raise ValueError(f"level is {event.level!r}; allowed: {', '.join(levels)}")
    log_time = event.slot * slot_ns
    log.timestamp.seconds, log.timestamp.nanos = divmod(log_time, NS_PER_S)
    log.level = levels[event.level].number
    log.name = event.name
    log.message = event.message
    payload: bytes = log.SerializeToString(deterministic=True)
    length = _HEADER.size - 9 + len(payload)
    header = _HEADER.pack(Opcode.MESSAGE, length, channel_id, event.slot, log_time, log_time)
    return header + payload


def decode_events(data: bytes) -> list[Event]:
    """Decode the Message records of an uncompressed chunk of ``/events``.

    Parameters
    ----------
    data
        Message records, one after the other.

    Returns
    -------
    list of Event
        In file order.

    Raises
    ------
    ValueError
        If the bytes are no such records.
    """
    log_class = _log_class()
    events = []
    offset = 0
    while offset < len(data):
        opcode, length, _, slot, _, _ = _HEADER.unpack_from(data, offset)
        end = offset + 9 + length
        if opcode != Opcode.MESSAGE or end > len(data):
            raise ValueError(f"no message record at byte {offset} of the chunk")
        log = log_class.FromString(data[offset + _HEADER.size : end])
        level = log.Level.Name(log.level)
        events.append(Event(slot, level, log.name, log.message))
        offset = end
    return events
