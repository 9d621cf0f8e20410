"""Reads logs into NumPy arrays, and nothing that a checksum does not vouch for."""

from __future__ import annotations

import hashlib
import os
import struct
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cached_property
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from hiersched.core.memory import physical_memory_bytes
from hiersched.log.errors import LogError, reading
from hiersched.log.events import Event, decode_events, encode_event
from hiersched.log.layout import (
    HEADER,
    RECORD_PREFIX_BYTES,
    RecordLayout,
    TopicSchema,
    as_raw,
    find_message,
    raw_columns,
    record_layout,
)
from hiersched.log.logfile import LogFile
from hiersched.log.schema import EVENTS_TOPIC, MODELS_TOPIC, topics_in

_TIMED = struct.Struct("<QI")  # log time [ns], bytes of the payload


class TopicContent(NamedTuple):
    """What a topic takes in a file [bytes]."""

    topic: str
    messages: int
    chunks: int
    plain_bytes: int
    stored_bytes: int


class LogReader:
    """A complete log; opening it checks it.

    It is read by the schema in the file: logs of older and newer versions too. What fields they
    have, `fields` says; those that this version does not know have shape (T, n).

    Parameters
    ----------
    path
        The file.
    verify
        ``file`` checks all bytes when the log is opened, and chunks again when they are read.
        ``chunks`` checks the summary and the metadata when the log is opened, and the rest when
        it is read: then reading a topic touches only that topic's chunks.

    Attributes
    ----------
    metadata : dict of str
        What `LogWriter` was told about the run, and the dimensions.
    dims, profile, slot_ns : LogDims, str, int
        As `LogWriter` had them.
    topics : tuple of str
        Topics that `read` knows; events have a method of their own.
    model_fields : tuple of ModelField
        What models add: the columns of ``model_values`` in ``/models``. Small profiles know of them
        too, but leave them out.

    Raises
    ------
    LogError
        If the file is not a complete and undamaged log; OSError if it cannot be opened.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, verify: Literal["file", "chunks"] = "file"
    ) -> None:
        if verify not in ("file", "chunks"):
            raise ValueError(f"verify is {verify!r}; allowed: file, chunks")
        file = LogFile(path)
        try:
            file.load(whole=verify == "file")
            self._take(file)
            self._check_counts()
        except BaseException:
            file.close()
            raise

    @classmethod
    def of(cls, file: LogFile) -> Self:
        """Read a file that is loaded, perhaps without its summary: for `recover` alone."""
        reader = cls.__new__(cls)
        reader._take(file)
        return reader

    def _take(self, file: LogFile) -> None:
        self._file = file
        self.path = file.path
        self.metadata, self.library = file.metadata, file.library
        self.dims, self.profile, self.slot_ns = file.dims, file.profile, file.slot_ns
        self.model_fields = file.model_fields
        self.topics = tuple(name for name in file.topics if name != EVENTS_TOPIC)
        self._layouts: dict[str, RecordLayout] = {}

    def _check_counts(self) -> None:
        """Check that the messages of each topic, all of one size, fill its chunks."""
        numbers = {name: self._file.topics[name].num_messages for name in self.topics}
        if len(set(numbers.values())) > 1:
            raise self._fail(f"topics have different numbers of messages: {numbers}")
        for name in self.topics:
            count = self._file.topics[name].num_messages
            sizes = [chunk.uncompressed_size for chunk in self._file.topics[name].chunks]
            record = sum(sizes) // count if count else 1
            if record < 1 or record * count != sum(sizes) or any(size % record for size in sizes):
                raise self._fail(
                    f"the chunks of {name} have {sum(sizes)} bytes, which do not make {count} "
                    "messages of one size"
                )

    def _fail(self, what: str) -> LogError:
        return LogError(self.path, self._file.summary_start, what)

    @property
    def num_slots(self) -> int:
        """Slots in the log."""
        return self._file.topics[self.topics[0]].num_messages if self.topics else 0

    @cached_property
    def attachments(self) -> dict[str, bytes]:
        """Attached files by name."""
        return {index.name: self._file.attachment(index) for index in self._file.attachment_indexes}

    def fields(self, topic: str) -> tuple[str, ...]:
        """Names of a topic's fields, without ``slot``, in the order of the file.

        A topic without messages does not say which it has: none. LogError if there is no such
        topic.
        """
        layout = self.layout(topic)
        return tuple(layout.values) if layout else ()

    def known_fields(self, topic: str) -> tuple[str, ...]:
        """Those of `fields` that this version knows, in this type and size."""
        layout = self.layout(topic)
        return tuple(n for n in layout.values if n not in layout.unknown) if layout else ()

    @property
    def unknown_fields(self) -> tuple[str, ...]:
        """The other fields of the log: ``/robots jerk``."""
        return tuple(
            f"{topic} {name}"
            for topic in self.topics
            for name in self.fields(topic)
            if name not in self.known_fields(topic)
        )

    @property
    def missing_fields(self) -> tuple[str, ...]:
        """Fields that this version logs in this profile, and this log does not have."""
        own = topics_in(self.profile, self.dims.num_model_values)
        return tuple(
            f"{name} {field.name}"
            for name, topic in own.items()
            for field in topic.fields_in(self.profile)
            if self.num_slots and not (name in self.topics and field.name in self.fields(name))
        )

    def read(
        self,
        topic: str,
        fields: Iterable[str] | None = None,
        start_slot: int | None = None,
        stop_slot: int | None = None,
    ) -> dict[str, NDArray[Any]]:
        """Read a topic.

        Parameters
        ----------
        topic
            One of `topics`.
        fields
            Names of the fields; all of the topic by default.
        start_slot, stop_slot
            Read slots from `start_slot` to before `stop_slot`; all by default.

        Returns
        -------
        dict of ndarray
            Name -> values, shape (T, ...) with the shape of the table of fields behind T, and
            always ``slot``, uint64, shape (T,). The arrays are the caller's own.

        Raises
        ------
        LogError
            If the log has no such topic or field, or is damaged.
        ValueError
            If the slots run backwards.
        """
        layout = self.layout(topic)
        names = self._wanted(topic, layout.values if layout else (), fields)
        start = 0 if start_slot is None else start_slot
        stop = 1 << 32 if stop_slot is None else stop_slot
        if not 0 <= start <= stop:
            raise ValueError(f"slots {start} to {stop}; allowed: 0 <= start_slot <= stop_slot")
        if layout is None:
            return {"slot": np.empty(0, np.uint64)}
        chunks = [
            chunk
            for chunk in self._file.topics[topic].chunks
            if chunk.message_end_time >= start * self.slot_ns
            and chunk.message_start_time < stop * self.slot_ns
        ]
        claimed = sum(chunk.uncompressed_size for chunk in chunks)
        if claimed > (there := physical_memory_bytes()):
            raise self._fail(f"{topic} claims {claimed} bytes, this machine has {there}")
        count = claimed // layout.dtype.itemsize
        slots = np.empty(count, np.uint64)
        values = {
            name: np.empty((count, *layout.values[name][1]), layout.values[name][0])
            for name in names
        }
        raw = {name: as_raw(array) for name, array in values.items()}
        done = 0
        for chunk in chunks:
            rows = self._rows(topic, chunk, layout)
            first, last = np.searchsorted(rows["slot"], np.array([start, stop], np.uint64))
            end = done + int(last - first)
            slots[done:end] = rows["slot"][first:last]
            for name, column in raw_columns(rows, layout).items():
                if name in raw:
                    raw[name][done:end] = column[first:last]
            done = end
        return {"slot": slots[:done], **{name: array[:done] for name, array in values.items()}}

    def read_models(
        self,
        fields: Iterable[str] | None = None,
        start_slot: int | None = None,
        stop_slot: int | None = None,
    ) -> dict[str, NDArray[Any]]:
        """Read what models add, by the names of `model_fields`: ``/models``, cut into its fields.

        Parameters and errors are those of `read`; the values have shape (T, count).
        """
        read = self.read(MODELS_TOPIC, ["model_values"], start_slot, stop_slot)
        places = {f.name: slice(f.start, f.start + f.count) for f in self.model_fields}
        names = self._wanted(MODELS_TOPIC, places, fields)
        cut = {name: read["model_values"][:, places[name]] for name in names}
        return {"slot": read["slot"], **cut}

    def layout(self, topic: str) -> RecordLayout | None:
        """Lay out a topic's messages by its schema and the first of them; None without messages."""
        if topic not in self.topics:
            raise self._fail(
                f"there is no topic {topic!r} in this log of {self._kind}; "
                f"allowed: {', '.join(self.topics)}"
            )
        index = self._file.topics[topic]
        if topic not in self._layouts and index.chunks:
            chunk = index.chunks[0]
            data = self._file.chunk_data(chunk)
            with reading(self.path, chunk.chunk_start_offset, f"a message of {topic}"):
                opcode, length, channel_id, *_ = HEADER.unpack_from(data)
                if (opcode, channel_id) != (Opcode.MESSAGE, index.schema.channel_id):
                    raise ValueError(f"opcode {opcode}, channel {channel_id}")
                record = bytes(data[: RECORD_PREFIX_BYTES + length])
                message = find_message(index.schema.descriptors, index.schema.message)
                self._layouts[topic] = record_layout(topic, message, self.dims, record)
        return self._layouts.get(topic)

    def schemas(self) -> dict[str, TopicSchema]:
        """Schemas of all topics, events included, for a log that is to have the same."""
        return {
            name: replace(topic.schema, layout=None if name == EVENTS_TOPIC else self.layout(name))
            for name, topic in self._file.topics.items()
        }

    @property
    def _kind(self) -> str:
        return f"profile {self.profile}, schema version {self.metadata['schema_version']}"

    def _wanted(self, topic: str, known: Iterable[str], fields: Iterable[str] | None) -> list[str]:
        """Names of the fields to read, in the order of the known ones, without ``slot``."""
        known = list(known)
        if fields is None:
            return known
        wanted = {fields} if isinstance(fields, str) else set(fields)
        unknown = sorted(wanted - {*known, "slot"})
        if unknown:
            raise self._fail(
                f"{topic} has no field {', '.join(unknown)} in this log of {self._kind}; "
                f"allowed: {', '.join(known)}"
            )
        return [name for name in known if name in wanted]

    def _rows(self, topic: str, chunk: ChunkIndex, layout: RecordLayout) -> NDArray[Any]:
        """Decode a chunk into message records, shape (T,), and check what must be constant."""
        data = self._file.chunk_data(chunk)
        with reading(self.path, chunk.chunk_start_offset, f"a chunk of {topic}"):
            rows = np.frombuffer(data, layout.dtype)
        for name in layout.constants:
            if not (rows[name] == layout.template[name]).all():
                what = f"a chunk of {topic} has messages that do not follow the schema ({name})"
                raise LogError(self.path, chunk.chunk_start_offset, what)
        times = rows["header:log_time"]
        ends = chunk.message_start_time, chunk.message_end_time
        in_order = (times[1:] > times[:-1]).all() and (int(times[0]), int(times[-1])) == ends
        with np.errstate(over="ignore"):
            at_slot = rows["slot"] * np.uint64(self.slot_ns) == times
        if not (in_order and at_slot.all() and int(rows["slot"][-1]) < 1 << 32):
            what = f"a chunk of {topic} has slots that are out of order, or not of their times"
            raise LogError(self.path, chunk.chunk_start_offset, what)
        return rows

    def check_chunk(self, topic: str, chunk: ChunkIndex) -> None:
        """Decode a chunk of a topic; LogError if it is not what the topic has: for `recover`."""
        layout = self.layout(topic)
        if layout is not None:
            self._rows(topic, chunk, layout)

    def contents(self) -> list[TopicContent]:
        """Say what each topic takes, events included, in the order of their channels."""
        found = []
        for name, topic in self._file.topics.items():
            plain = sum(chunk.uncompressed_size for chunk in topic.chunks)
            stored = sum(chunk.compressed_size for chunk in topic.chunks)
            numbers = topic.num_messages, len(topic.chunks), plain, stored
            found.append(TopicContent(name, *numbers))
        return found

    def events(self) -> list[Event]:
        """Read the events, by slot; those of one slot in the order in which they were logged."""
        events: list[Event] = []
        for chunk in self._file.topics[EVENTS_TOPIC].chunks:
            data = self._file.chunk_data(chunk)
            with reading(self.path, chunk.chunk_start_offset, "an event"):
                events += decode_events(bytes(data))
        return sorted(events, key=lambda event: event.slot)

    def timed_payloads(self, topic: str) -> Iterator[bytes]:
        """Yield the messages of a topic as `log_digest` takes them, many at once."""
        if topic == EVENTS_TOPIC:
            for event in self.events():
                payload = encode_event(event, self.slot_ns, 0)[HEADER.size :]
                yield _TIMED.pack(event.slot * self.slot_ns, len(payload)) + payload
        elif (layout := self.layout(topic)) is not None:
            raw = f"V{layout.dtype.itemsize - HEADER.size}"
            whole = np.dtype([("header", f"V{HEADER.size}"), ("payload", raw)])
            wanted = np.dtype([("time", "<u8"), ("length", "<u4"), ("payload", raw)])
            for chunk in self._file.topics[topic].chunks:
                rows = self._rows(topic, chunk, layout)
                timed = np.empty(len(rows), wanted)
                timed["time"] = rows["header:log_time"]
                timed["length"] = wanted["payload"].itemsize
                timed["payload"] = rows.view(whole)["payload"]
                yield timed.tobytes()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def log_digest(path: str | os.PathLike[str]) -> str:
    """Hash topic, time and payload of every message, whatever compression, chunks and metadata.

    Topics come in the order of their names. Of each, the hash takes the name, a zero byte, and by
    time, then in the order in which they were logged, its messages: log time (uint64), length of
    the payload (uint32), both little-endian, and the payload. A topic without messages is left
    out. So any MCAP library can compute it. Returns SHA-256, hexadecimal; LogError on damage.
    """
    digest = hashlib.sha256()
    with LogReader(path) as log:
        for topic in sorted([*log.topics, EVENTS_TOPIC]):
            for number, messages in enumerate(log.timed_payloads(topic)):
                digest.update(messages if number else topic.encode() + b"\0" + messages)
    return digest.hexdigest()
