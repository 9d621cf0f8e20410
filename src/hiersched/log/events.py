"""Events of a run as `foxglove.Log` messages: sparse, of any length, one at a time."""

from __future__ import annotations

from typing import NamedTuple

from mcap.opcode import Opcode

from hiersched.log.layout import HEADER, RECORD_PREFIX_BYTES
from hiersched.log.schema import EVENTS_SCHEMA, LEVELS, event_descriptors, message_class

NS_PER_S = 1_000_000_000


class Event(NamedTuple):
    """Something worth a line: a violated deadline, an infeasible gain, a capped delay."""

    slot: int  # in which it happened
    level: str  # DEBUG, INFO, WARNING, ERROR or FATAL, as in `foxglove.Log`
    name: str  # of the part of the system that speaks, for example control
    message: str  # the line


def encode_event(event: Event, slot_ns: int, channel_id: int) -> bytes:
    """Encode an event as an MCAP Message record; ValueError if `foxglove.Log` has no such level."""
    if event.level not in LEVELS:
        raise ValueError(f"level is {event.level!r}; allowed: {', '.join(LEVELS)}")
    log = message_class(event_descriptors(), EVENTS_SCHEMA)()
    log_time = event.slot * slot_ns
    log.timestamp.seconds, log.timestamp.nanos = divmod(log_time, NS_PER_S)
    log.level = LEVELS.index(event.level)
    log.name = event.name
    log.message = event.message
    payload: bytes = log.SerializeToString(deterministic=True)
    length = HEADER.size - RECORD_PREFIX_BYTES + len(payload)
    header = HEADER.pack(Opcode.MESSAGE, length, channel_id, event.slot, log_time, log_time)
    return header + payload


def decode_events(data: bytes) -> list[Event]:
    """Decode the Message records of a chunk of ``/events``; ValueError if they are no such."""
    log_class = message_class(event_descriptors(), EVENTS_SCHEMA)
    events = []
    offset = 0
    while offset < len(data):
        opcode, length, _, slot, _, _ = HEADER.unpack_from(data, offset)
        end = offset + RECORD_PREFIX_BYTES + length
        if opcode != Opcode.MESSAGE or end > len(data):
            raise ValueError(f"no message record at byte {offset} of the chunk")
        log = log_class.FromString(data[offset + HEADER.size : end])
        events.append(Event(slot, log_class.Level.Name(log.level), log.name, log.message))
        offset = end
    return events
