"""A log as a file of MCAP records: its framing, its checksums, its summary."""

from __future__ import annotations

import os
import re
import struct
import zlib
from dataclasses import MISSING, dataclass, field, fields
from io import BytesIO
from pathlib import Path
from typing import Any, TypeVar

import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.stream_reader import StreamReader

from hiersched.core.fields import fields_from_text
from hiersched.log.container import (
    CHUNK_START,
    DATA_END_BYTES,
    FOOTER_BYTES,
    FOOTER_START,
    MAGIC,
    MAX_CHUNK_BYTES,
    RECORD_START,
    attachment_index,
    chunk_names,
)
from hiersched.log.errors import LogError, reading
from hiersched.log.layout import (
    HEADER,
    RECORD_PREFIX_BYTES,
    TopicSchema,
    find_message,
    topics_crc32,
)
from hiersched.log.schema import (
    EVENTS_SCHEMA,
    EVENTS_TOPIC,
    METADATA_NAME,
    MODEL_FIELDS,
    TOPICS_CRC,
    LogDims,
)

T = TypeVar("T")
_OPCODES: dict[Any, int] = {
    records.Header: Opcode.HEADER,
    records.Metadata: Opcode.METADATA,
    records.Attachment: Opcode.ATTACHMENT,
}
_FREE = frozenset(
    (
        *(Opcode.SCHEMA, Opcode.CHANNEL, Opcode.ATTACHMENT, Opcode.METADATA),
        *(Opcode.CHUNK, Opcode.DATA_END),
    )
)
"""Records of a data section that can stand behind another one, in logs of ours."""
_FOLLOWED_BY = {0: frozenset((Opcode.HEADER,)), Opcode.CHUNK: frozenset((Opcode.MESSAGE_INDEX,))}
"""Those that others have to stand behind; 0 is the start of the file."""
_SUMMARY_RECORDS = (
    *(records.Schema, records.Channel, records.Statistics, records.ChunkIndex),
    *(records.AttachmentIndex, records.MetadataIndex, records.SummaryOffset, records.Footer),
)
_SUMMARY = frozenset(
    (
        *(Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX),
        *(Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET, Opcode.FOOTER),
    )
)


@dataclass(frozen=True)
class TopicIndex:
    """What a file says about a topic, and where its messages lie."""

    schema: TopicSchema
    num_messages: int
    chunks: list[records.ChunkIndex] = field(default_factory=list)


class LogFile:
    """An open log; one of the two ways to load it has to succeed before anything else."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._stream = open(self.path, "rb")
        self.size = os.fstat(self._stream.fileno()).st_size
        self._zstd = zstandard.ZstdDecompressor()
        self._last_chunk: tuple[int, bytes | memoryview] = (-1, b"")

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def load(self, *, whole: bool) -> None:
        """Check framing and checksums, of the data section too if `whole`; read the summary."""
        self._check_start()
        least = len(MAGIC) + RECORD_START.size + 8 + DATA_END_BYTES + FOOTER_BYTES + len(MAGIC)
        if self.size < least or self.read(self.size - len(MAGIC), len(MAGIC)) != MAGIC:
            raise self._truncated()
        summary = self._read_summary()
        self._check_data_end(whole)
        statistics = _of(summary, records.Statistics)
        chunks = len(_of(summary, records.ChunkIndex))
        if len(statistics) != 1 or statistics[0].chunk_count != chunks:
            raise self.fail(self.summary_start, f"the statistics do not fit {chunks} chunks")
        self._take(summary, statistics[0].channel_message_counts)

    def load_without_summary(self) -> list[LogError]:
        """Read what a killed writer left, record by record; return what could not be read."""
        self._check_start()
        self.summary_start = self.size
        found, counts, losses = self._walk()
        self._take(found, counts, losses)
        return losses

    def fail(self, offset: int, what: str) -> LogError:
        """Make the error that something is wrong at a byte offset."""
        return LogError(self.path, offset, what)

    def _truncated(self) -> LogError:
        what = "the file is truncated: it does not end as an MCAP file has to"
        return self.fail(self.size, f"{what} (hiersched recover gets back what there is)")

    def read(self, offset: int, length: int) -> bytes:
        """Read bytes that have to be there."""
        if offset < 0 or length < 0 or offset + length > self.size:
            raise self.fail(self.size, f"{length} bytes at {offset} lie outside of the file")
        self._stream.seek(offset)
        data = self._stream.read(length)
        if len(data) != length:
            raise self.fail(offset + len(data), "the file became shorter while it was read")
        return data

    def _record(self, offset: int, length: int | None, kind: Any, *, has_crc: bool = False) -> Any:
        """Read a Header, Metadata or Attachment; without a length it takes what the record says."""
        opcode, named = RECORD_START.unpack(self.read(offset, RECORD_START.size))
        if opcode != _OPCODES[kind] or length not in (None, RECORD_START.size + named):
            raise self.fail(offset, f"there is no {kind.__name__} record as announced")
        body = self.read(offset + RECORD_START.size, named)
        if has_crc and zlib.crc32(body[:-4]).to_bytes(4, "little") != body[-4:]:
            raise self.fail(offset, f"the {kind.__name__} does not match its checksum")
        with reading(self.path, offset, f"the {kind.__name__}"):
            return kind.read(ReadDataStream(BytesIO(body)))

    def attachment(self, index: records.AttachmentIndex) -> bytes:
        """Read the content of an attachment."""
        data: bytes = self._record(
            index.offset, index.length, records.Attachment, has_crc=True
        ).data
        return data

    def chunk_data(self, index: records.ChunkIndex) -> bytes | memoryview:
        """Read the Message records of a chunk: check it, and undo its compression."""
        offset = index.chunk_start_offset
        if self._last_chunk[0] == offset:
            return self._last_chunk[1]
        if index.uncompressed_size > MAX_CHUNK_BYTES:  # before anything is allocated for it
            raise self.fail(
                offset,
                f"a chunk claims {index.uncompressed_size} bytes, more than {MAX_CHUNK_BYTES}",
            )
        record = self.read(offset, index.chunk_length)
        names = chunk_names(index.compression, index.compressed_size)
        data = memoryview(record)[CHUNK_START.size + len(names) :]
        *start, stored = CHUNK_START.unpack_from(record)
        announced = [
            *(Opcode.CHUNK, len(record) - RECORD_START.size),
            *(index.message_start_time, index.message_end_time, index.uncompressed_size),
        ]
        named = record[CHUNK_START.size : CHUNK_START.size + len(names)]
        if start != announced or named != names or len(data) != index.compressed_size:
            raise self.fail(offset, "a chunk does not match its entry in the summary")
        content = self._decompress(index, data)
        if len(content) != index.uncompressed_size or zlib.crc32(content) != stored:
            raise self.fail(offset, "a chunk does not match its checksum")
        self._last_chunk = offset, content
        return content

    def _decompress(self, index: records.ChunkIndex, data: memoryview) -> bytes | memoryview:
        if index.compression == "":
            return data
        offset = index.chunk_start_offset
        if index.compression != "zstd":
            raise self.fail(offset, f"a chunk has compression {index.compression!r}")
        with reading(self.path, offset, "a chunk"):
            # Its own header says how much memory it wants: do not believe it blindly.
            if zstandard.frame_content_size(data) != index.uncompressed_size:
                raise ValueError("the compressed data have another size")
            return self._zstd.decompress(data)

    def _check_start(self) -> None:
        """Check that this is an MCAP file, complete, and a log of ours."""
        if self.size == 0:
            raise self.fail(0, "the file is empty")
        if self.read(0, min(len(MAGIC), self.size)) != MAGIC[: self.size]:
            raise self.fail(0, "this is not an MCAP file")
        if self.size < len(MAGIC) + RECORD_START.size + 8:
            raise self._truncated()
        self.library: str = self._record(len(MAGIC), None, records.Header).library
        if not re.fullmatch(r"hiersched-log/[1-9][0-9]{0,8}", self.library):
            what = f"this MCAP file is by {self.library!r}, not a log of hiersched"
            raise self.fail(len(MAGIC), what)

    def _read_summary(self) -> list[Any]:
        """Check the footer and the summary's checksum, and read the summary's records."""
        footer = self.size - len(MAGIC) - FOOTER_BYTES
        data = self.read(footer, FOOTER_BYTES)
        opcode, length, self.summary_start, offset_start = FOOTER_START.unpack_from(data)
        least = len(MAGIC) + DATA_END_BYTES
        if (opcode, length) != (Opcode.FOOTER, 20) or not (
            least <= self.summary_start <= offset_start <= footer
        ):
            raise self.fail(footer, "the footer is damaged")
        summary = self.read(self.summary_start, footer - self.summary_start)
        crc = zlib.crc32(data[: FOOTER_START.size], zlib.crc32(summary))
        if data[FOOTER_START.size :] != crc.to_bytes(4, "little"):
            raise self.fail(self.summary_start, "the summary does not match its checksum")
        with reading(self.path, self.summary_start, "the summary"):
            stream = BytesIO(summary + data + MAGIC)
            found = list(StreamReader(stream, skip_magic=True, emit_chunks=True).records)
            if other := [type(r).__name__ for r in found if not isinstance(r, _SUMMARY_RECORDS)]:
                raise ValueError(f"it has {', '.join(sorted(set(other)))} records")
            return found

    def _check_data_end(self, whole: bool) -> None:
        """Check the DataEnd record, and the checksum of all bytes before it if asked."""
        end = self.summary_start - DATA_END_BYTES
        opcode, length, stored = struct.unpack("<BQI", self.read(end, DATA_END_BYTES))
        if (opcode, length) != (Opcode.DATA_END, 4):
            raise self.fail(end, "the end of the data section is damaged")
        crc, step = 0, 1 << 20
        for position in range(0, end if whole else 0, step):
            crc = zlib.crc32(self.read(position, min(step, end - position)), crc)
        if whole and crc != stored:
            raise self.fail(end, "the data section does not match its checksum")

    def _take(
        self, summary: list[Any], counts: dict[int, int], losses: list[LogError] | None = None
    ) -> None:
        """Keep what we need of the summary's records, sorted by topic.

        A chunk that is out of order, or there twice, is an error; where there are `losses` it is
        one of those and left out.
        """

        def out_of_order(chunk: records.ChunkIndex) -> None:
            error = self.fail(chunk.chunk_start_offset, "a chunk is out of order, or there twice")
            if losses is None:
                raise error
            losses.append(error)

        channels = _of(summary, records.Channel)
        self.attachment_indexes = _of(summary, records.AttachmentIndex)
        self._load_metadata(_of(summary, records.MetadataIndex), channels)
        schemas = {schema.id: schema for schema in _of(summary, records.Schema)}
        self.topics: dict[str, TopicIndex] = {}
        with reading(self.path, self.summary_start, "the schemas"):
            for channel in channels:
                name, data = schemas[channel.schema_id].name, schemas[channel.schema_id].data
                find_message(data, name)  # it has to be there
                schema = TopicSchema(channel.id, name, data)
                self.topics[channel.topic] = TopicIndex(schema, counts.get(channel.id, 0))
        crc = topics_crc32({name: topic.schema for name, topic in self.topics.items()})
        if self.metadata.get(TOPICS_CRC, crc) != crc:
            raise self.fail(self.summary_start, "the topics do not match their checksum")
        by_id = {topic.schema.channel_id: topic for topic in self.topics.values()}
        events = self.topics.get(EVENTS_TOPIC)
        if not events or events.schema.message != EVENTS_SCHEMA or len(by_id) != len(channels):
            raise self.fail(self.summary_start, f"the topics are {[c.topic for c in channels]}")
        for chunk in _of(summary, records.ChunkIndex):
            ids = list(chunk.message_index_offsets)
            if len(ids) != 1 or ids[0] not in by_id:
                raise self.fail(chunk.chunk_start_offset, f"a chunk has channels {ids}")
            chunks = by_id[ids[0]].chunks
            last = chunks[-1] if chunks else None
            is_next = last is None or (
                last.chunk_start_offset < chunk.chunk_start_offset
                and (chunks is events.chunks or last.message_end_time < chunk.message_start_time)
            )
            if is_next:
                chunks.append(chunk)
            else:
                out_of_order(chunk)

    def _load_metadata(
        self, places: list[records.MetadataIndex], channels: list[records.Channel]
    ) -> None:
        """Read the metadata record and what it says about sizes."""
        places = [index for index in places if index.name == METADATA_NAME]
        if len(places) != 1:
            raise self.fail(self.summary_start, f"there is no metadata {METADATA_NAME!r}")
        offset, length = places[0].offset, places[0].length
        crc = f"{zlib.crc32(self.read(offset, length)):08x}"
        if any(channel.metadata.get("metadata_crc32") != crc for channel in channels):
            raise self.fail(offset, "the metadata do not match their checksum")
        metadata: dict[str, str] = self._record(offset, length, records.Metadata).metadata
        self.metadata = metadata
        with reading(self.path, offset, "the metadata"):
            self.slot_ns = int(metadata["slot_ns"])
            self.profile = metadata["profile"]
            # Logs of earlier versions do not say what their robots are: unicycles. Those of models
            # that add nothing do not say so.
            sizes = (f.name for f in fields(LogDims) if f.default is MISSING or f.name in metadata)
            self.dims = LogDims(**{name: int(metadata[name]) for name in sizes})
            num_values = self.dims.num_model_values
            text = metadata[MODEL_FIELDS] if num_values else "[]"
            self.model_fields = fields_from_text(text, num_values)
            if self.slot_ns < 1 or int(metadata["schema_version"]) < 1:
                raise ValueError("slot_ns and schema_version have to be 1 at least")

    def _walk(self) -> tuple[list[Any], dict[int, int], list[LogError]]:
        """Go through the data section, record by record, as far as it goes.

        Returns entries as a summary has them, of chunks whose checksum is right alone; messages by
        channel; and what could not be read: records that are damaged or stand where none of their
        kind can, and the place where the walk had to end.
        """
        found: list[Any] = []
        losses: list[LogError] = []
        counts: dict[int, int] = {}
        offset, before = len(MAGIC), 0
        while offset != self.size:
            try:
                opcode, length = RECORD_START.unpack(self.read(offset, RECORD_START.size))
                body = self.read(offset + RECORD_START.size, length)
            except LogError as error:
                end = min(offset, self.size)
                losses.append(self.fail(end, f"the records end here: {error.what}"))
                break
            try:
                if opcode not in _FOLLOWED_BY.get(before, _FREE):
                    raise self.fail(offset, f"a record of kind {opcode} cannot stand here")
                if opcode == Opcode.DATA_END:
                    losses += self._behind(offset + RECORD_START.size + length)
                    break
                with reading(self.path, offset, "a record"):
                    entry = _entry(opcode, body, offset)
                if isinstance(entry, records.ChunkIndex):
                    content = self.chunk_data(entry)
                    with reading(self.path, offset, "a chunk"):
                        _count(entry, content, counts)
                found.append(entry)
            except LogError as error:
                losses.append(self.fail(offset, f"{error.what}; {length} bytes are skipped"))
            offset, before = offset + RECORD_START.size + length, opcode
        return found, counts, losses

    def _behind(self, offset: int) -> list[LogError]:
        """Say what lies behind the data section and is no summary, or a part of one."""
        opcode = 0
        while offset < self.size and opcode != Opcode.FOOTER:
            start = min(RECORD_START.size, self.size - offset)
            if start < RECORD_START.size:
                return []
            opcode, length = RECORD_START.unpack(self.read(offset, start))
            if opcode not in _SUMMARY:
                return [self.fail(offset, f"{self.size - offset} bytes that are no summary")]
            offset += RECORD_START.size + length
        rest = self.size - offset - len(MAGIC)
        return [self.fail(offset, f"{rest} bytes behind the end")] if rest > 0 else []


def _of(summary: list[Any], kind: type[T]) -> list[T]:
    return [record for record in summary if isinstance(record, kind)]


def _entry(opcode: int, body: bytes, offset: int) -> Any:
    """Make of a record what the summary would say about it; None if it would say nothing."""
    bytes_of = BytesIO(body)
    entry = _read_entry(opcode, ReadDataStream(bytes_of), offset, RECORD_START.size + len(body))
    if opcode not in (Opcode.HEADER, Opcode.MESSAGE_INDEX) and bytes_of.tell() != len(body):
        raise ValueError(f"it has {len(body) - bytes_of.tell()} bytes too many")
    return entry


def _read_entry(opcode: int, stream: ReadDataStream, offset: int, length: int) -> Any:
    if opcode == Opcode.SCHEMA:
        return records.Schema.read(stream)
    if opcode == Opcode.CHANNEL:
        return records.Channel.read(stream)
    if opcode == Opcode.METADATA:
        name = records.Metadata.read(stream).name
        return records.MetadataIndex(offset=offset, length=length, name=name)
    if opcode == Opcode.ATTACHMENT:
        return attachment_index(records.Attachment.read(stream), offset, length)
    if opcode == Opcode.CHUNK:
        chunk = records.Chunk.read(stream)
        return records.ChunkIndex(
            chunk_length=length,
            chunk_start_offset=offset,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            message_end_time=chunk.message_end_time,
            message_index_length=0,
            message_index_offsets={},
            message_start_time=chunk.message_start_time,
            uncompressed_size=chunk.uncompressed_size,
        )
    return None


def _count(chunk: records.ChunkIndex, content: bytes | memoryview, counts: dict[int, int]) -> None:
    """Note the channel of a chunk and how many messages it has; ValueError if its times differ."""
    place, times, channels = 0, [], set()
    while place < len(content):
        opcode, length, channel_id, _, log_time, _ = HEADER.unpack_from(content, place)
        if opcode != Opcode.MESSAGE:
            raise ValueError(f"a record of kind {opcode} in a chunk")
        times.append(log_time)
        channels.add(channel_id)
        place += RECORD_PREFIX_BYTES + length
    if place != len(content) or len(channels) != 1:
        raise ValueError(f"messages of channels {sorted(channels)} in a chunk")
    if (chunk.message_start_time, chunk.message_end_time) != (min(times), max(times)):
        raise ValueError("a chunk whose times are not those of its messages")
    (channel_id,) = channels
    counts[channel_id] = counts.get(channel_id, 0) + len(times)
    chunk.message_index_offsets[channel_id] = 0  # all that a reader of ours asks for
