"""Writes the log of a run: blocks of slots in, an ordinary MCAP file out."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from dataclasses import asdict
from functools import lru_cache
from operator import itemgetter
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from hiersched.core.fields import PROFILES, STORED_TOPICS, fields_from_text
from hiersched.log import schema
from hiersched.log.container import MAX_CHUNK_BYTES, Container
from hiersched.log.events import Event, encode_event
from hiersched.log.layout import (
    RecordLayout,
    TopicSchema,
    as_raw,
    empty_record,
    find_message,
    raw_columns,
    record_layout,
    topics_crc32,
)
from hiersched.log.reader import LogReader
from hiersched.log.schema import (
    EVENTS_TOPIC,
    LIBRARY,
    MODEL_FIELDS,
    SCHEMA_VERSION,
    TOPICS_CRC,
    LogDims,
    Topic,
)

PROTO_FILE = "hiersched.proto"
"""Attachment of every log: the schema as text, with units and meanings."""

COMPRESSIONS = ("zstd", "none")
MAX_SLOT = 1 << 32  # the sequence number of a message has 32 bits


@lru_cache(maxsize=64)
def _own_schemas(topics: tuple[Topic, ...], dims: LogDims, profile: str) -> dict[str, TopicSchema]:
    """Schemas of these topics, and of events, in a log of this version."""
    descriptors = schema.descriptors()
    schemas = {}
    for channel_id, topic in enumerate(topics, start=1):
        record = empty_record(topic, dims, profile, channel_id)
        message = find_message(descriptors, topic.message)
        layout = record_layout(topic.name, message, dims, record)
        schemas[topic.name] = TopicSchema(channel_id, topic.message, descriptors, layout)
    events = TopicSchema(len(topics) + 1, schema.EVENTS_SCHEMA, schema.event_descriptors())
    return {**schemas, EVENTS_TOPIC: events}


class _Buffer:
    """Message records of one topic on their way into a chunk."""

    def __init__(
        self, channel_id: int, layout: RecordLayout, slot_ns: int, chunk_bytes: int, stored: bool
    ) -> None:
        self.layout = layout
        self._channel_id, self._slot_ns, self._stored = channel_id, slot_ns, stored
        itemsize = layout.dtype.itemsize
        self._rows = np.repeat(layout.template, max(1, chunk_bytes // itemsize))
        self._columns = raw_columns(self._rows, layout)
        self._offsets = np.arange(len(self._rows), dtype=np.uint64) * itemsize
        self._used = 0

    @property
    def free(self) -> int:
        """Slots that still fit."""
        return len(self._rows) - self._used

    def fill(
        self, first_slot: int, blocks: Mapping[str, NDArray[Any]], start: int, stop: int
    ) -> None:
        """Take the slots `start` to before `stop` of a block, raw bytes of each by name."""
        rows = slice(self._used, self._used + stop - start)
        slots = np.arange(first_slot + start, first_slot + stop, dtype=np.uint64)
        times = slots * np.uint64(self._slot_ns)
        self._rows["header:sequence"][rows] = slots
        self._rows["slot"][rows] = slots
        self._rows["header:log_time"][rows] = times
        self._rows["header:publish_time"][rows] = times
        for name, column in self._columns.items():
            column[rows] = blocks[name][start:stop]
        self._used += stop - start

    def flush(self, container: Container) -> None:
        """Write what there is as a chunk."""
        if self._used:
            rows = self._rows[: self._used]
            container.add_chunk(
                self._channel_id,
                rows.view(np.uint8).data,
                rows["header:log_time"].astype(np.uint64),
                self._offsets[: self._used],
                stored=self._stored,
            )
            self._used = 0


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
        ``full``, ``compact`` with what a study reads of a run, ``decisions`` with those and sums
        alone, or ``robots`` for robots that run alone; what the smaller ones leave out can be
        computed again.
    metadata
        Text about the run: scenario, seed, policy, stage and the like. The schema version, the
        dimensions, the profile and the slot length are added.
    attachments
        Name -> content; ``hiersched.proto`` is added.
    slot_ns
        Slot length [ns] of simulated time, the only clock in the file.
    compression
        ``zstd`` (level 3; topics of random numbers are stored all the same) or ``none``.
    chunk_bytes
        Size of a chunk before compression [bytes]; a chunk has at least one message.
    flush_slots
        After every so many slots all that is buffered goes to the operating system: so many slots
        at most are lost when the process is killed.
    like
        A log whose schema the new one has, of whatever version, with its attachments alone: for
        `recover`.

    Attributes
    ----------
    fields : frozenset of str
        Names of the fields that a block has to have.

    Raises
    ------
    ValueError
        If an argument is none of the allowed.
    """

    def __init__(  # noqa: PLR0913  (what a file is, by keyword; a class of options would hide it)
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
        flush_slots: int = 1 << 12,
        like: LogReader | None = None,
    ) -> None:
        if like is None:
            _check_choice("profile", profile, PROFILES)
        _check_choice("compression", compression, COMPRESSIONS)
        _check_range("slot_ns", slot_ns, 1, 1 << 31)
        _check_range("chunk_bytes", chunk_bytes, 1, MAX_CHUNK_BYTES)
        _check_range("flush_slots", flush_slots, 1, MAX_SLOT)
        self.path, self.profile = Path(path), profile
        self._slot_ns, self._chunk_bytes, self._flush_slots = slot_ns, chunk_bytes, flush_slots
        self._unflushed = 0
        self._next_slot = 0
        self._events: list[tuple[int, bytes]] = []  # slots and records, in the order of calls
        self._event_bytes = 0
        own = {
            "schema_version": like.metadata["schema_version"] if like else str(SCHEMA_VERSION),
            "slot_ns": str(slot_ns),
            **{name: str(size) for name, size in asdict(dims).items()},
            "profile": profile,
        }
        files = dict(attachments or {})
        if like is None:
            files[PROTO_FILE] = schema.proto_source().encode()
        topics = tuple(schema.topics_in(profile, dims.num_model_values).values())
        schemas = like.schemas() if like else _own_schemas(topics, dims, profile)
        own[TOPICS_CRC] = topics_crc32(schemas)
        text = _full_metadata(own, metadata or {})
        self._events_id = schemas[EVENTS_TOPIC].channel_id
        self._buffers = [
            _Buffer(topic.channel_id, topic.layout, slot_ns, chunk_bytes, name in STORED_TOPICS)
            for name, topic in schemas.items()
            if topic.layout is not None
        ]
        self.fields = frozenset(name for b in self._buffers for name in b.layout.values)
        self._part = self.path.with_name(self.path.name + ".part")
        self._stream = open(self._part, "wb")
        library = like.library if like else LIBRARY
        self._container = Container(self._stream, library=library, compression=compression)
        crc = self._container.add_metadata(schema.METADATA_NAME, dict(sorted(text.items())))
        for name, data in sorted(files.items()):
            self._container.add_attachment(name, data)
        # Channels are repeated in the summary, whose checksum thereby covers the metadata.
        note = {"metadata_crc32": f"{crc:08x}"}
        for name, topic in schemas.items():
            self._container.add_channel(
                topic.channel_id, name, topic.message, topic.descriptors, note
            )

    def write_block(self, first_slot: int, fields: Mapping[str, NDArray[Any]]) -> None:
        """Write consecutive slots.

        Parameters
        ----------
        first_slot
            Number of the first slot; after all slots written before.
        fields
            Name -> values, shape (T, ...) with the shape of the table of fields behind T. Fields
            that the profile does not contain may be there: they are left out.

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
            free = min(buffer.free for buffer in self._buffers)
            step = min(count - done, free, self._flush_slots - self._unflushed)
            for buffer in self._buffers:
                buffer.fill(first_slot, blocks, done, done + step)
            for buffer in self._buffers:
                if buffer.free == 0:
                    buffer.flush(self._container)
            done += step
            self._next_slot = first_slot + done
            self._unflushed += step
            if self._unflushed == self._flush_slots:
                self.flush()

    def _prepare(self, fields: Mapping[str, NDArray[Any]]) -> tuple[dict[str, NDArray[Any]], int]:
        """Check a block and turn its fields into arrays of raw bytes, shape (T,)."""
        layouts = [buffer.layout for buffer in self._buffers]
        known = {field.name for topic in schema.TOPICS.values() for field in topic.fields}
        unknown = sorted(set(fields) - known - self.fields)
        missing = sorted(self.fields - set(fields))
        if unknown or missing:
            raise ValueError(f"fields unknown to the log: {unknown}; fields missing: {missing}")
        count = np.shape(fields[next(iter(layouts[0].values))])[0]
        blocks = {}
        for layout in layouts:
            for name, (dtype, shape) in layout.values.items():
                values = np.asarray(fields[name])
                if values.shape != (count, *shape):
                    raise ValueError(f"{name} has shape {values.shape}; allowed: {(count, *shape)}")
                if values.dtype != dtype:
                    _check_lossless(name, values.dtype, dtype)
                    values = values.astype(dtype)
                blocks[name] = as_raw(values)
        return blocks, count

    def event(self, slot: int, level: str, name: str, message: str) -> None:
        """Log something that happens now and then: see `Event`."""
        self._check_open()
        _check_range("slot", slot, 0, MAX_SLOT - 1)
        record = encode_event(Event(slot, level, name, message), self._slot_ns, self._events_id)
        self._event_bytes += len(record)
        self._events.append((slot, record))
        if self._event_bytes >= self._chunk_bytes:
            self._flush_events()

    def _flush_events(self) -> None:
        """Write the events so far as a chunk, by slot, in the order of calls within a slot."""
        if not self._events:
            return
        self._events.sort(key=itemgetter(0))
        records = [record for _, record in self._events]
        times = np.array([slot * self._slot_ns for slot, _ in self._events], np.uint64)
        offsets = np.cumsum([0] + [len(record) for record in records[:-1]]).astype(np.uint64)
        self._container.add_chunk(self._events_id, b"".join(records), times, offsets)
        self._events, self._event_bytes = [], 0

    def flush(self) -> None:
        """Hand all that is buffered to the operating system: a killed process does not lose it."""
        self._check_open()
        for buffer in self._buffers:
            buffer.flush(self._container)
        self._flush_events()
        self._stream.flush()
        self._unflushed = 0

    def close(self) -> None:
        """Complete the file and give it its name."""
        self._check_open()
        with self._stream:
            self.flush()
            self._container.finish()
        os.replace(self._part, self.path)

    def abort(self) -> None:
        """Leave ``<path>.part`` behind, with every slot written so far but no summary."""
        if not self._stream.closed:
            with self._stream, contextlib.suppress(OSError):  # the first error is what matters
                self.flush()

    def _check_open(self) -> None:
        if self._stream.closed:
            raise ValueError(f"{self.path}: the log is closed")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, exc_type: object, *_: object) -> None:
        if exc_type is not None:
            self.abort()
        elif not self._stream.closed:
            self.close()


def _full_metadata(own: dict[str, str], given: Mapping[str, str]) -> dict[str, str]:
    """Join the caller's metadata and our own."""
    for key, value in given.items():
        if not isinstance(value, str):
            raise TypeError(f"metadata {key} is {value!r}; allowed: a string")
        if key != TOPICS_CRC and own.get(key, value) != value:
            raise ValueError(f"metadata {key} is {value!r}, but the log has {own[key]!r}")
    if num_values := int(own["num_model_values"]):
        try:
            fields_from_text(given.get(MODEL_FIELDS, "[]"), num_values)
        except ValueError as error:
            raise ValueError(f"metadata {MODEL_FIELDS}: {error}") from error
    else:
        del own["num_model_values"]  # so that logs without such models stay as they were
    return {**given, **own}


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
