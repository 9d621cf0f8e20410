"""One file of a log that is being written: preamble, buffers, events, end."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hiersched.log.buffer import TopicBuffer
from hiersched.log.container import CHUNK_OVERHEAD_BYTES, Container
from hiersched.log.events import Event, encode_event
from hiersched.log.layout import record_layout
from hiersched.log.schema import (
    EVENTS_SCHEMA,
    EVENTS_TOPIC,
    LIBRARY,
    METADATA_NAME,
    TOPICS,
    LogDims,
    channel_ids,
    descriptor_set,
    topics_in,
)

_MEDIA_TYPES = {
    ".yaml": "application/yaml",
    ".json": "application/json",
    ".csv": "text/csv",
    ".proto": "text/plain",
}


@dataclass(frozen=True, kw_only=True)
class PartSettings:
    """What all files of a log share; see `LogWriter`."""

    dims: LogDims
    profile: str
    slot_ns: int
    compression: str
    chunk_bytes: int
    attachments: Mapping[str, bytes]


class LogPart:
    """A file of a log, written to ``<path>.part`` and renamed when it is complete.

    Parameters
    ----------
    path
        The file to be.
    settings
        What the log's files share.
    metadata
        All of the metadata.
    """

    def __init__(self, path: Path, settings: PartSettings, metadata: Mapping[str, str]) -> None:
        self.path = path
        self._part = path.with_name(path.name + ".part")
        self._slot_ns, self._chunk_bytes = settings.slot_ns, settings.chunk_bytes
        self._events: list[Event] = []
        self._event_bytes = 0
        num_values = settings.dims.num_model_values
        ids = channel_ids(settings.profile, num_values)
        self._events_id = ids[EVENTS_TOPIC]
        self.buffers = [
            TopicBuffer(
                record_layout(topic, settings.dims, settings.profile, ids[name]),
                settings.slot_ns,
                settings.chunk_bytes,
                ids[name],
                stored=topic.stored,
            )
            for name, topic in topics_in(settings.profile, num_values).items()
        ]
        self._stream = open(self._part, "wb")
        self._container = Container(self._stream, library=LIBRARY, compression=settings.compression)
        self._write_preamble(metadata, settings.attachments, ids)
        self.most_bytes = self._most_bytes()

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

    def _most_bytes(self) -> int:
        """Bound the size of the file if every topic adds one chunk more, and the events do."""
        # An event takes 41 bytes at least, and 16 more in the index; zstd adds 1/256 at worst.
        chunks = sum(b.capacity_bytes for b in self.buffers) + 2 * self._chunk_bytes
        overhead = (len(self.buffers) + 1) * CHUNK_OVERHEAD_BYTES
        return self._container.finished_bytes() + chunks + chunks // 256 + overhead

    @property
    def closed(self) -> bool:
        """Whether nothing can be written any more."""
        return self._stream.closed

    @property
    def free(self) -> int:
        """Slots that fit before a chunk is full."""
        return min(buffer.free for buffer in self.buffers)

    def fill(
        self, first_slot: int, blocks: Mapping[str, NDArray[Any]], start: int, stop: int
    ) -> None:
        """Take slots of a block, at most `free`, and write the chunks that are full."""
        for buffer in self.buffers:
            buffer.fill(first_slot, blocks, start, stop)
        if not self.free:
            for buffer in self.buffers:
                if buffer.free == 0:
                    buffer.flush(self._container)
            self.most_bytes = self._most_bytes()

    def add_event(self, event: Event) -> None:
        """Take an event."""
        self._event_bytes += len(encode_event(event, self._slot_ns, self._events_id))
        self._events.append(event)
        if self._event_bytes >= self._chunk_bytes:
            self._flush_events()
            self.most_bytes = self._most_bytes()

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

    def flush(self) -> None:
        """Hand all that is buffered to the operating system: a killed process does not lose it."""
        for buffer in self.buffers:
            buffer.flush(self._container)
        self._flush_events()
        self._stream.flush()
        self.most_bytes = self._most_bytes()

    def finish(self) -> None:
        """Complete the file and give it its name."""
        with self._stream:
            self.flush()
            self._container.finish()
        os.replace(self._part, self.path)

    def abort(self) -> None:
        """Leave ``<path>.part`` behind, with every slot written so far but no summary."""
        with self._stream, contextlib.suppress(OSError):  # the first error is what matters
            self.flush()

    def discard(self) -> None:
        """Remove what there is of the file."""
        self._stream.close()
        self._part.unlink()
