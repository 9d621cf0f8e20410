"""Writes the log of a run: blocks of slots in, an ordinary MCAP file out."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from hiersched.log.buffer import TopicBuffer
from hiersched.log.container import Container
from hiersched.log.events import Event, encode_event
from hiersched.log.layout import as_raw, record_layout
from hiersched.log.schema import (
    EVENTS_SCHEMA,
    EVENTS_TOPIC,
    LIBRARY,
    METADATA_NAME,
    PROFILES,
    SCHEMA_VERSION,
    TOPICS,
    LogDims,
    channel_ids,
    descriptor_set,
    proto_source,
)

COMPRESSIONS = ("zstd", "none")
MAX_CHUNK_BYTES = 1 << 28  # a viewer holds whole chunks in memory
MAX_SLOT = 1 << 32  # the sequence number of a message has 32 bits
_MEDIA_TYPES = {
    ".yaml": "application/yaml",
    ".json": "application/json",
    ".csv": "text/csv",
    ".proto": "text/plain",
}


class LogWriter:
    """Log of one run, written to ``<path>.part`` and renamed when it is complete.

    The bytes depend on the arguments alone: not on the clock, nor on how the slots were cut
    into blocks (but on the version of zstandard, if it compresses).

    Parameters
    ----------
    path
        The file to be; its folder must exist.
    dims
        Numbers of users and PRBs.
    profile
        ``full``, or ``compact`` without what the random streams can regenerate.
    metadata
        Text about the run: scenario, seed, policy, stage and the like. The schema version, the
        dimensions, the profile and the slot length are added.
    attachments
        Name -> content; ``hiersched.proto`` is added.
    slot_ns
        Slot length [ns] of simulated time, the only clock in the file.
    compression
        ``zstd`` (level 1) or ``none``.
    chunk_bytes
        Size of a chunk before compression [bytes]; a chunk has at least one message.

    Raises
    ------
    ValueError
        If an argument is none of the allowed.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        dims: LogDims,
        profile: str = "full",
        metadata: Mapping[str, str] | None = None,
        attachments: Mapping[str, bytes] | None = None,
        *,
        slot_ns: int,
        compression: str = "zstd",
        chunk_bytes: int = 1 << 20,
    ) -> None:
        _check_choice("profile", profile, PROFILES)
        _check_choice("compression", compression, COMPRESSIONS)
        _check_range("slot_ns", slot_ns, 1, 1 << 31)
        _check_range("chunk_bytes", chunk_bytes, 1, MAX_CHUNK_BYTES)
        self.path = Path(path)
        self._part = self.path.with_name(self.path.name + ".part")
        self._slot_ns = slot_ns
        self._chunk_bytes = chunk_bytes
        self._profile = profile
        self._next_slot = 0
        self._events: list[Event] = []
        self._event_bytes = 0
        ids = channel_ids(profile)
        self._events_id = ids[EVENTS_TOPIC]
        self._buffers = [
            TopicBuffer(layout, slot_ns, chunk_bytes, ids[topic.name])
            for topic in TOPICS.values()
            if (layout := record_layout(topic, dims, profile, ids.get(topic.name, 0)))
        ]
        text = self._full_metadata(dims, metadata or {})
        files = dict(sorted({**(attachments or {}), "hiersched.proto": proto_source()}.items()))
        self._stream = open(self._part, "wb")
        self._container = Container(self._stream, library=LIBRARY, compression=compression)
        self._write_preamble(text, files, ids)

    def _full_metadata(self, dims: LogDims, given: Mapping[str, str]) -> dict[str, str]:
        """Join the caller's metadata and our own, sorted by key."""
        own = {
            "schema_version": str(SCHEMA_VERSION),
            "slot_ns": str(self._slot_ns),
            "num_urllc": str(dims.num_urllc),
            "num_embb": str(dims.num_embb),
            "num_prb": str(dims.num_prb),
            "profile": self._profile,
        }
        for key, value in given.items():
            if not isinstance(value, str):
                raise TypeError(f"metadata {key} is {value!r}; allowed: a string")
            if own.get(key, value) != value:
                raise ValueError(f"metadata {key} is {value!r}, but the log has {own[key]!r}")
        return dict(sorted({**given, **own}.items()))

    def _write_preamble(
        self, metadata: Mapping[str, str], attachments: Mapping[str, bytes], ids: dict[str, int]
    ) -> None:
        """Write all that precedes the chunks."""
        crc = self._container.add_metadata(METADATA_NAME, metadata)
        for name, data in attachments.items():
            media_type = _MEDIA_TYPES.get(Path(name).suffix, "application/octet-stream")
            self._container.add_attachment(name, media_type, data)
        # Channels are repeated in the summary, whose checksum thereby covers the metadata.
        note = {"metadata_crc32": f"{crc:08x}"}
        for name, channel_id in ids.items():
            message = EVENTS_SCHEMA if name == EVENTS_TOPIC else TOPICS[name].message
            self._container.add_channel(channel_id, name, message, descriptor_set(message), note)

    def write_block(self, first_slot: int, fields: Mapping[str, NDArray[Any]]) -> None:
        """Write consecutive slots.

        Parameters
        ----------
        first_slot
            Number of the first slot; after all slots written before.
        fields
            Name -> values, shape (T, ...) with the shape of `TOPICS` behind T. A field of the
            ``full`` profile may be there when the profile is ``compact``: it is left out.

        Raises
        ------
        TypeError
            If a type cannot become the logged one without a risk for its bits.
        ValueError
            If a field is missing or unknown, a shape is wrong, or slots run backwards. Nothing
            of the block is written then.
        """
        self._check_open()
        blocks, count = self._prepare(fields)
        if first_slot < self._next_slot or first_slot + count > MAX_SLOT:
            raise ValueError(
                f"slots {first_slot} to {first_slot + count - 1}; "
                f"allowed: {self._next_slot} to {MAX_SLOT - 1}"
            )
        done = 0
        while done < count:
            # All topics advance together, so that the order of chunks does not depend on blocks.
            stop = min(count, *(done + buffer.free for buffer in self._buffers))
            for buffer in self._buffers:
                buffer.fill(first_slot, blocks, done, stop)
            for buffer in self._buffers:
                if buffer.free == 0:
                    buffer.flush(self._container)
            done = stop
        self._next_slot = first_slot + count

    def _prepare(self, fields: Mapping[str, NDArray[Any]]) -> tuple[dict[str, NDArray[Any]], int]:
        """Check a block and turn its fields into arrays of raw bytes, shape (T,)."""
        known = {field.name for topic in TOPICS.values() for field in topic.fields} - {"slot"}
        expected = {name for buffer in self._buffers for name in buffer.layout.values}
        unknown, missing = sorted(set(fields) - known), sorted(expected - set(fields))
        if unknown or missing:
            raise ValueError(f"fields unknown to the log: {unknown}; fields missing: {missing}")
        count = np.shape(fields[next(iter(self._buffers[0].layout.values))])[0]
        blocks = {}
        for buffer in self._buffers:
            for name, (dtype, shape) in buffer.layout.values.items():
                values = np.asarray(fields[name])
                if values.shape != (count, *shape):
                    raise ValueError(f"{name} has shape {values.shape}; allowed: {(count, *shape)}")
                _check_lossless(name, values.dtype, dtype)
                blocks[name] = as_raw(np.ascontiguousarray(values, dtype))
        return blocks, count

    def event(self, slot: int, level: str, name: str, message: str) -> None:
        """Log something that happens now and then.

        Parameters
        ----------
        slot
            Slot in which it happened.
        level
            DEBUG, INFO, WARNING, ERROR or FATAL.
        name
            Part of the system that speaks.
        message
            One line.
        """
        self._check_open()
        _check_range("slot", slot, 0, MAX_SLOT - 1)
        event = Event(slot, level, name, message)
        self._event_bytes += len(encode_event(event, self._slot_ns, self._events_id))
        self._events.append(event)
        if self._event_bytes >= self._chunk_bytes:
            self._flush_events()

    def _flush_events(self) -> None:
        """Write the events so far as a chunk, by slot, in the order of calls within a slot."""
        if not self._events:
            return
        events = sorted(self._events, key=lambda event: event.slot)
        records = [encode_event(event, self._slot_ns, self._events_id) for event in events]
        times = np.array([event.slot * self._slot_ns for event in events], np.uint64)
        offsets = np.cumsum([0] + [len(record) for record in records[:-1]]).astype(np.uint64)
        self._container.add_chunk(self._events_id, b"".join(records), times, offsets)
        self._events, self._event_bytes = [], 0

    def _flush(self) -> None:
        """Write all that is buffered."""
        for buffer in self._buffers:
            buffer.flush(self._container)
        self._flush_events()

    def close(self) -> None:
        """Complete the file and give it its name."""
        self._check_open()
        with self._stream:
            self._flush()
            self._container.finish()
        os.replace(self._part, self.path)

    def abort(self) -> None:
        """Leave ``<path>.part`` behind, with every slot written so far but no summary."""
        if self._stream.closed:
            return
        with self._stream, contextlib.suppress(OSError):  # the first error is what matters
            self._flush()

    def _check_open(self) -> None:
        if self._stream.closed:
            raise ValueError(f"{self.path}: the log is closed")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if exc_type is not None:
            self.abort()
        elif not self._stream.closed:
            self.close()


def _check_lossless(name: str, given: np.dtype[Any], wanted: np.dtype[Any]) -> None:
    """Refuse a conversion that can lose bits (NumPy calls int64 to float64 safe)."""
    wide_integer = given.kind in "iu" and given.itemsize == 8 and wanted.kind == "f"
    if wide_integer or not np.can_cast(given, wanted, "safe"):
        raise TypeError(
            f"{name} has type {given}; allowed: {wanted}, or what converts to it without loss"
        )


def _check_choice(name: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise ValueError(f"{name} is {value!r}; allowed: {', '.join(allowed)}")


def _check_range(name: str, value: int, least: int, most: int) -> None:
    if not least <= value <= most:
        raise ValueError(f"{name} is {value}; allowed: {least} to {most}")
