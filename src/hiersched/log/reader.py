"""Reads logs into NumPy arrays, and nothing that a checksum does not vouch for."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from functools import cached_property
from types import TracebackType
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from hiersched.log.errors import LogError, reading
from hiersched.log.events import Event, decode_events
from hiersched.log.layout import RecordLayout, as_raw, raw_columns, record_layout
from hiersched.log.logfile import LogFile
from hiersched.log.schema import EVENTS_TOPIC, MODELS_TOPIC, TOPICS

_OLDER_COMPACT = " (compact logs of earlier versions had more fields: they have to be written anew)"


class TopicContent(NamedTuple):
    """What a topic takes in a file [bytes]."""

    topic: str
    messages: int
    chunks: int
    plain_bytes: int
    stored_bytes: int


class LogReader:
    """A complete log of `LogWriter`; opening it checks it.

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
    dims : LogDims
        Numbers of users and PRBs.
    profile : str
        ``full``, ``compact`` or ``decisions``.
    slot_ns : int
        Slot length [ns].
    topics : tuple of str
        Topics that `read` knows; events have a method of their own.
    model_fields : tuple of ModelField
        What models add: the columns of ``model_values`` in ``/models``. Small profiles know of them
        too, but leave them out.

    Raises
    ------
    LogError
        If the file is not a complete and undamaged log of a schema version that we know. A file
        that cannot be opened raises OSError.
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
        """Read a file whose summary was put together by hand: for `recover` alone."""
        reader = cls.__new__(cls)
        reader._take(file)
        return reader

    def _take(self, file: LogFile) -> None:
        """Lay out the records of each topic."""
        self._file = file
        self.path = file.path
        self.metadata = file.metadata
        self.dims, self.profile, self.slot_ns = file.dims, file.profile, file.slot_ns
        self.model_fields = file.model_fields
        self._layouts: dict[str, RecordLayout] = {}
        for name, channel_id in file.channel_ids.items():
            if name != EVENTS_TOPIC:
                self._layouts[name] = record_layout(
                    TOPICS[name], self.dims, self.profile, channel_id
                )
        self.topics = tuple(self._layouts)

    def _check_counts(self) -> None:
        """Check that the messages of each topic fill its chunks."""
        for name, layout in self._layouts.items():
            itemsize = layout.dtype.itemsize
            sizes = [chunk.uncompressed_size for chunk in self._file.chunks[name]]
            if any(size % itemsize for size in sizes) or sum(sizes) != itemsize * self._count(name):
                raise LogError(
                    self.path,
                    self._file.summary_start,
                    f"the chunks of {name} have {sum(sizes)} bytes, "
                    f"its {self._count(name)} messages of {itemsize} bytes need another number"
                    + (_OLDER_COMPACT if self.profile == "compact" else ""),
                )

    def _count(self, name: str) -> int:
        return self._file.message_counts[self._file.channel_ids[name]]

    @property
    def num_slots(self) -> int:
        """Slots in the log."""
        return self._count(self.topics[0])

    @cached_property
    def attachments(self) -> dict[str, bytes]:
        """Attached files by name."""
        return {index.name: self._file.attachment(index) for index in self._file.attachment_indexes}

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
            Name -> values, shape (T, ...) with the shape of `TOPICS` behind T, and always
            ``slot``, uint64, shape (T,). The arrays are the caller's own.

        Raises
        ------
        LogError
            If the log has no such topic or field, or is damaged.
        ValueError
            If the slots run backwards.
        """
        layout = self._layout(topic)
        names = self._wanted(topic, layout.values, fields)
        start = 0 if start_slot is None else start_slot
        stop = 1 << 32 if stop_slot is None else stop_slot
        if not 0 <= start <= stop:
            raise ValueError(f"slots {start} to {stop}; allowed: 0 <= start_slot <= stop_slot")
        chunks = [
            chunk
            for chunk in self._file.chunks[topic]
            if chunk.message_end_time >= start * self.slot_ns
            and chunk.message_start_time < stop * self.slot_ns
        ]
        count = sum(chunk.uncompressed_size for chunk in chunks) // layout.dtype.itemsize
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
        read = self.read(MODELS_TOPIC, None, start_slot, stop_slot)
        places = {f.name: slice(f.start, f.start + f.count) for f in self.model_fields}
        names = self._wanted(MODELS_TOPIC, places, fields)
        cut = {name: read["model_values"][:, places[name]] for name in names}
        return {"slot": read["slot"], **cut}

    def _layout(self, topic: str) -> RecordLayout:
        if topic not in self._layouts:
            raise LogError(
                self.path,
                self._file.summary_start,
                f"there is no topic {topic!r} in this log of profile {self.profile}; "
                f"allowed: {', '.join(self.topics)}",
            )
        return self._layouts[topic]

    def _wanted(self, topic: str, known: Iterable[str], fields: Iterable[str] | None) -> list[str]:
        """Names of the fields to read, in the order of the known ones, without ``slot``."""
        known = list(known)
        if fields is None:
            return known
        wanted = {fields} if isinstance(fields, str) else set(fields)
        unknown = sorted(wanted - {*known, "slot"})
        if unknown:
            raise LogError(
                self.path,
                self._file.summary_start,
                f"{topic} has no field {', '.join(unknown)} in this log of profile "
                f"{self.profile}; allowed: {', '.join(known)}",
            )
        return [name for name in known if name in wanted]

    def _rows(self, topic: str, chunk: ChunkIndex, layout: RecordLayout) -> NDArray[Any]:
        """Decode a chunk into message records, shape (T,), and check what must be constant."""
        rows = np.frombuffer(self._file.chunk_data(chunk), layout.dtype)
        for name in layout.constants:
            if not (rows[name] == layout.template[name]).all():
                raise LogError(
                    self.path,
                    chunk.chunk_start_offset,
                    f"a chunk of {topic} has messages that do not follow the schema ({name})",
                )
        return rows

    def contents(self) -> list[TopicContent]:
        """Say what each topic takes, events included, in the order of their channels."""
        file = self._file
        return [
            TopicContent(
                topic,
                file.message_counts[channel_id],
                len(chunks := file.chunks[topic]),
                sum(chunk.uncompressed_size for chunk in chunks),
                sum(chunk.compressed_size for chunk in chunks),
            )
            for topic, channel_id in file.channel_ids.items()
        ]

    def records(self, topic: str) -> Iterator[NDArray[Any]]:
        """Yield a topic's Message records as they lie in the file, one array a chunk.

        Raises
        ------
        LogError
            If the log has no such topic, or is damaged.
        """
        layout = self._layout(topic)
        for chunk in self._file.chunks[topic]:
            yield self._rows(topic, chunk, layout)

    def events(self) -> list[Event]:
        """Read the events, by slot.

        Returns
        -------
        list of Event
            Events of one slot are in the order in which they were logged.

        Raises
        ------
        LogError
            If the log is damaged.
        """
        events: list[Event] = []
        for chunk in self._file.chunks[EVENTS_TOPIC]:
            data = self._file.chunk_data(chunk)
            with reading(self.path, chunk.chunk_start_offset, "an event"):
                events += decode_events(bytes(data))
        return sorted(events, key=lambda event: event.slot)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
