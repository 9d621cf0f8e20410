"""A hash of what a log says, whatever its compression, chunks, metadata and attachments."""

from __future__ import annotations

import hashlib
import os
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.log.events import encode_event
from hiersched.log.reader import LogReader
from hiersched.log.schema import EVENTS_TOPIC

_HEADER_BYTES = 31  # of a Message record: all before the payload
_MESSAGE = struct.Struct("<QI")  # log time [ns], bytes of the payload


def log_digest(path: str | os.PathLike[str]) -> str:
    """Hash topic, time and payload of every message.

    Topics come in the order of their names. Of each, the hash takes the name, a zero byte, and by
    time, then in the order in which they were logged, its messages: log time (uint64), length of
    the payload (uint32), both little-endian, and the payload. A topic without messages is left
    out. So any MCAP library can compute it.

    Parameters
    ----------
    path
        The log.

    Returns
    -------
    str
        SHA-256, hexadecimal.

    Raises
    ------
    LogError
        If the log is damaged.
    """
    digest = hashlib.sha256()
    with LogReader(path) as log:
        for topic in sorted([*log.topics, EVENTS_TOPIC]):
            pieces = _events(log) if topic == EVENTS_TOPIC else map(_timed, log.records(topic))
            for number, piece in enumerate(pieces):
                if number == 0:
                    digest.update(topic.encode() + b"\0")
                digest.update(piece)
    return digest.hexdigest()


def _timed(rows: NDArray[Any]) -> bytes:
    """Put time and length before the payload of every record of a chunk."""
    payload = f"V{rows.dtype.itemsize - _HEADER_BYTES}"
    wanted = np.empty(len(rows), [("time", "<u8"), ("length", "<u4"), ("payload", payload)])
    wanted["time"] = rows["log_time"]
    wanted["length"] = wanted.dtype["payload"].itemsize
    whole = np.dtype([("header", f"V{_HEADER_BYTES}"), ("payload", payload)])
    wanted["payload"] = rows.view(whole)["payload"]
    return wanted.tobytes()


def _events(log: LogReader) -> Iterator[bytes]:
    for event in log.events():
        payload = encode_event(event, log.slot_ns, 0)[_HEADER_BYTES:]
        yield _MESSAGE.pack(event.slot * log.slot_ns, len(payload)) + payload
