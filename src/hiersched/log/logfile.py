"""A log as a file of MCAP records: its framing, its checksums, its summary."""

from __future__ import annotations

import re
import struct
import zlib
from dataclasses import MISSING, fields
from io import BytesIO
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from hiersched.core.model_fields import fields_from_text
from hiersched.log.container import (
    DATA_END_BYTES,
    FOOTER_BYTES,
    FOOTER_START,
    MAGIC,
)
from hiersched.log.errors import LogError, reading
from hiersched.log.recordfile import RECORD_START, RecordFile
from hiersched.log.schema import (
    EVENTS_SCHEMA,
    EVENTS_TOPIC,
    METADATA_NAME,
    MODEL_FIELDS,
    PROFILES,
    SCHEMA_VERSION,
    TOPICS,
    LogDims,
    channel_ids,
    describes,
)
from hiersched.log.walk import walk

_SUMMARY_TYPES: dict[int, Any] = {
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.STATISTICS: Statistics,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
}


class LogFile(RecordFile):
    """An open log; `load` has to succeed before anything else is asked of it.

    Parameters
    ----------
    path
        The file.
    """

    def load(self, *, whole: bool) -> None:
        """Check the framing, the checksums and the versions, and read the summary.

        Parameters
        ----------
        whole
            Check the bytes of the data section too.
        """
        self._check_start()
        self._check_end()
        self._load_summary()
        self._check_data_end(whole)
        self._load_metadata()
        self._load_channels()

    def load_without_summary(self) -> list[LogError]:
        """Read what a writer left that never came to write the summary, record by record.

        Returns
        -------
        list of LogError
            What could not be read.
        """
        self._check_start()
        self.summary_start = self.size
        found = walk(self.path, self.size, self.read, self.chunk_data)
        self._take_summary(found.records)
        self._load_metadata()
        self._load_channels()
        return found.losses

    def _check_start(self) -> None:
        """Check that this is an MCAP file, complete, and a log of a version that we know."""
        if self.size == 0:
            raise self._fail(0, "the file is empty")
        if self.read(0, min(len(MAGIC), self.size)) != MAGIC[: self.size]:
            raise self._fail(0, "this is not an MCAP file")
        if self.size < len(MAGIC) + RECORD_START.size + 8:
            raise self._truncated()
        header = self.record(len(MAGIC), None, Header)
        match = re.fullmatch(r"hiersched-log/([1-9][0-9]{0,8})", header.library)
        if match is None:
            raise self._fail(
                len(MAGIC), f"this MCAP file is by {header.library!r}, not a log of hiersched"
            )
        self._check_version(int(match[1]), len(MAGIC))

    def _truncated(self) -> LogError:
        return self._fail(
            self.size,
            "the file is truncated: it does not end as an MCAP file has to "
            "(hiersched recover gets back what there is)",
        )

    def _check_end(self) -> None:
        """Check that the file is complete."""
        least = len(MAGIC) + RECORD_START.size + 8 + DATA_END_BYTES + FOOTER_BYTES + len(MAGIC)
        if self.size < least or self.read(self.size - len(MAGIC), len(MAGIC)) != MAGIC:
            raise self._truncated()

    def _check_version(self, version: int, offset: int) -> None:
        if version != SCHEMA_VERSION:
            age = "newer" if version > SCHEMA_VERSION else "older"
            raise self._fail(
                offset,
                f"the log has schema version {version}, {age} than version {SCHEMA_VERSION} "
                "that this hiersched reads",
            )

    def _load_summary(self) -> None:
        """Check the footer and the summary's checksum and read the summary."""
        footer = self.size - len(MAGIC) - FOOTER_BYTES
        data = self.read(footer, FOOTER_BYTES)
        opcode, length, self.summary_start, offset_start = FOOTER_START.unpack_from(data)
        least = len(MAGIC) + DATA_END_BYTES
        if (opcode, length) != (Opcode.FOOTER, 20) or not (
            least <= self.summary_start <= offset_start <= footer
        ):
            raise self._fail(footer, "the footer is damaged")
        summary = self.read(self.summary_start, footer - self.summary_start)
        crc = zlib.crc32(data[: FOOTER_START.size], zlib.crc32(summary))
        if data[FOOTER_START.size :] != crc.to_bytes(4, "little"):
            raise self._fail(self.summary_start, "the summary does not match its checksum")
        records: dict[Any, list[Any]] = {kind: [] for kind in _SUMMARY_TYPES.values()}
        with reading(self.path, self.summary_start, "the summary"):
            position = 0
            while position < offset_start - self.summary_start:
                opcode, length = RECORD_START.unpack_from(summary, position)
                position += RECORD_START.size
                body = summary[position : position + length]
                if kind := _SUMMARY_TYPES.get(opcode):
                    records[kind].append(kind.read(ReadDataStream(BytesIO(body))))
                position += length
        self._take_summary(records)

    def _take_summary(self, records: dict[Any, list[Any]]) -> None:
        """Keep what we need of the summary."""
        if len(records[Statistics]) != 1:
            raise self._fail(self.summary_start, "the summary has no statistics")
        statistics = records[Statistics][0]
        self.message_counts: dict[int, int] = statistics.channel_message_counts
        self.attachment_indexes: list[AttachmentIndex] = records[AttachmentIndex]
        self._metadata_indexes: list[MetadataIndex] = records[MetadataIndex]
        self._chunk_indexes: list[ChunkIndex] = records[ChunkIndex]
        self._schemas = {schema.id: schema for schema in records[Schema]}
        self._channels = {channel.topic: channel for channel in records[Channel]}
        if statistics.chunk_count != len(self._chunk_indexes):
            raise self._fail(
                self.summary_start,
                f"the summary has {len(self._chunk_indexes)} of {statistics.chunk_count} chunks",
            )

    def _check_data_end(self, whole: bool) -> None:
        """Check the DataEnd record, and the checksum of all bytes before it if asked."""
        end = self.summary_start - DATA_END_BYTES
        opcode, length, stored = struct.unpack("<BQI", self.read(end, DATA_END_BYTES))
        if (opcode, length) != (Opcode.DATA_END, 4):
            raise self._fail(end, "the end of the data section is damaged")
        if not whole:
            return
        crc, position, step = 0, 0, 1 << 20
        while position < end:
            data = self.read(position, min(step, end - position))
            crc = zlib.crc32(data, crc)
            position += len(data)
        if crc != stored:
            raise self._fail(end, "the data section does not match its checksum")

    def _load_metadata(self) -> None:
        """Read the metadata record and what it says about the layout."""
        places = [index for index in self._metadata_indexes if index.name == METADATA_NAME]
        if len(places) != 1:
            raise self._fail(self.summary_start, f"there is no metadata {METADATA_NAME!r}")
        offset, length = places[0].offset, places[0].length
        record = self.read(offset, length)
        crc = f"{zlib.crc32(record):08x}"
        if any(c.metadata.get("metadata_crc32") != crc for c in self._channels.values()):
            raise self._fail(offset, "the metadata do not match their checksum")
        self.metadata: dict[str, str] = self.record(offset, length, Metadata).metadata
        with reading(self.path, offset, "the metadata"):
            self._check_version(int(self.metadata["schema_version"]), offset)
            self.slot_ns = int(self.metadata["slot_ns"])
            self.profile = self.metadata["profile"]
            self.dims = LogDims(
                **{
                    field.name: int(self.metadata[field.name])
                    for field in fields(LogDims)
                    # Logs of earlier versions do not say what their robots are: unicycles. Those
                    # of models that add nothing do not say so.
                    if field.default is MISSING or field.name in self.metadata
                }
            )
            num_values = self.dims.num_model_values
            text = self.metadata[MODEL_FIELDS] if num_values else "[]"
            self.model_fields = fields_from_text(text, num_values)
        if self.profile not in PROFILES or self.slot_ns < 1:
            raise self._fail(
                offset, f"the metadata have profile {self.profile!r}, slot_ns {self.slot_ns}"
            )

    def _load_channels(self) -> None:
        """Check that channels and schemas are ours, and sort the chunks by topic."""
        self.channel_ids = channel_ids(self.profile, self.dims.num_model_values)
        if {t: c.id for t, c in self._channels.items()} != self.channel_ids:
            raise self._fail(self.summary_start, f"the topics are {sorted(self._channels)}")
        for topic, channel in self._channels.items():
            message = EVENTS_SCHEMA if topic == EVENTS_TOPIC else TOPICS[topic].message
            schema = self._schemas.get(channel.schema_id)
            if schema is None or schema.name != message or not describes(schema.data, message):
                raise self._fail(
                    self.summary_start,
                    f"the schema of {topic} is not {message} of version {SCHEMA_VERSION}",
                )
        self.chunks: dict[str, list[ChunkIndex]] = {topic: [] for topic in self.channel_ids}
        topics = {channel_id: topic for topic, channel_id in self.channel_ids.items()}
        for chunk in self._chunk_indexes:
            ids = list(chunk.message_index_offsets)
            if len(ids) != 1 or ids[0] not in topics:
                raise self._fail(chunk.chunk_start_offset, f"a chunk has channels {ids}")
            self.chunks[topics[ids[0]]].append(chunk)
