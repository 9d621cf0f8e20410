"""Walks through the records of a file that has no summary, or none to be trusted."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from hiersched.log.container import MAGIC
from hiersched.log.errors import LogError, reading
from hiersched.log.recordfile import RECORD_START

_END_OF_DATA = (Opcode.DATA_END, Opcode.FOOTER)


@dataclass
class Walk:
    """What a walk found: entries as a summary has them, and what it could not read."""

    records: dict[Any, list[Any]]
    losses: list[LogError] = field(default_factory=list)


def walk(
    path: Any,
    size: int,
    read: Callable[[int, int], bytes],
    chunk_data: Callable[[ChunkIndex], bytes | memoryview],
) -> Walk:
    """Walk through the data section, record by record, as far as it goes.

    Parameters
    ----------
    path
        The file, for messages.
    size
        Its size [bytes].
    read
        Returns the bytes at (offset, length).
    chunk_data
        Returns the content of a chunk, checked.

    Returns
    -------
    Walk
        Chunks whose checksum is right; the others are among the losses, as is the place where the
        walk had to end.
    """
    found = Walk({kind: [] for kind in (Schema, Channel, ChunkIndex, AttachmentIndex)})
    found.records[MetadataIndex] = []
    counts: dict[int, int] = {}
    offset = len(MAGIC)
    while offset != size:
        try:
            opcode, length = RECORD_START.unpack(read(offset, RECORD_START.size))
            if opcode in _END_OF_DATA:
                break
            if not Opcode.HEADER <= opcode <= Opcode.DATA_END:
                raise LogError(path, offset, f"there is no record of kind {opcode}")
            body = read(offset + RECORD_START.size, length)
            with reading(path, offset, "a record"):
                entry = _entry(opcode, body, offset)
        except LogError as error:
            end = min(offset, size)
            found.losses.append(LogError(path, end, f"the records end here: {error.what}"))
            break
        if isinstance(entry, ChunkIndex):
            try:
                _count(entry, chunk_data(entry), counts)
            except LogError as error:
                found.losses.append(error)
                entry = None
        if entry is not None:
            found.records[type(entry)].append(entry)
        offset += RECORD_START.size + length
    found.records[Statistics] = [_statistics(found.records[ChunkIndex], counts)]
    return found


def _entry(opcode: int, body: bytes, offset: int) -> Any:
    """Make of a record what the summary would say about it; None if it would say nothing."""
    stream = ReadDataStream(BytesIO(body))
    length = RECORD_START.size + len(body)
    if opcode == Opcode.SCHEMA:
        return Schema.read(stream)
    if opcode == Opcode.CHANNEL:
        return Channel.read(stream)
    if opcode == Opcode.METADATA:
        return MetadataIndex(offset=offset, length=length, name=Metadata.read(stream).name)
    if opcode == Opcode.ATTACHMENT:
        attachment = Attachment.read(stream)
        return AttachmentIndex(
            offset=offset,
            length=length,
            log_time=attachment.log_time,
            create_time=attachment.create_time,
            data_size=len(attachment.data),
            name=attachment.name,
            media_type=attachment.media_type,
        )
    if opcode == Opcode.CHUNK:
        chunk = Chunk.read(stream)
        return ChunkIndex(
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


def _count(chunk: ChunkIndex, content: bytes | memoryview, counts: dict[int, int]) -> None:
    """Note the channel of a chunk and, where messages have one size, how many it has."""
    _, length, channel_id = struct.unpack_from("<BQH", content)
    counts[channel_id] = counts.get(channel_id, 0) + len(content) // (RECORD_START.size + length)
    chunk.message_index_offsets[channel_id] = 0  # all that a reader of ours asks for


def _statistics(chunks: list[ChunkIndex], counts: dict[int, int]) -> Statistics:
    return Statistics(
        attachment_count=0,
        channel_count=0,
        channel_message_counts=counts,
        chunk_count=len(chunks),
        message_count=sum(counts.values()),
        message_end_time=0,
        message_start_time=0,
        metadata_count=0,
        schema_count=0,
    )
