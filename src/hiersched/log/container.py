"""The MCAP container around the messages: chunks, indexes, checksums, summary.

Written out here rather than with `mcap.writer.Writer`, which takes one message at a time and is
an order of magnitude slower. The records themselves are those of the ``mcap`` package, all but
Chunk and MessageIndex, which are too large to be copied about.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from numpy.typing import NDArray

MAX_CHUNK_BYTES = 1 << 28  # a viewer holds whole chunks in memory
MAGIC = b"\x89MCAP0\r\n"
RECORD_START = struct.Struct("<BQ")  # opcode, length of what follows
CHUNK_START = struct.Struct("<BQQQQI")  # opcode, length, first time, last time, size, CRC
FOOTER_START = struct.Struct("<BQQQ")  # opcode, length, summary start, summary offset start
DATA_END_BYTES = 13
FOOTER_BYTES = FOOTER_START.size + 4
_MESSAGE_INDEX_START = struct.Struct("<BQHI")  # opcode, length, channel id, bytes of entries
_MEDIA_TYPES = {
    ".yaml": "application/yaml",
    ".json": "application/json",
    ".csv": "text/csv",
    ".proto": "text/plain",
}
_POLYNOMIAL = 0xEDB88320  # of CRC-32, bits reversed: bit 31 is x^0
_ONE = 1 << 31


def _compressor() -> zstandard.ZstdCompressor:
    """Make the compressor: level 3, whose logs of decisions are 3 % smaller than those of level 1.

    It compresses for a quarter longer; higher levels take twice as long and more for 1 %.
    """
    parameters = zstandard.ZstdCompressionParameters.from_level(
        3, write_content_size=1, write_checksum=0, threads=0
    )
    return zstandard.ZstdCompressor(compression_params=parameters)


def _bytes_of(*parts: records.McapRecord) -> bytes:
    """Serialise MCAP records one after the other."""
    builder = RecordBuilder()
    for record in parts:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def attachment_index(
    attachment: records.Attachment, offset: int, length: int
) -> records.AttachmentIndex:
    """Return the entry of the summary for an attachment whose record lies at these bytes."""
    return records.AttachmentIndex(
        offset=offset,
        length=length,
        log_time=attachment.log_time,
        create_time=attachment.create_time,
        data_size=len(attachment.data),
        name=attachment.name,
        media_type=attachment.media_type,
    )


def chunk_names(compression: str, nbytes: int) -> bytes:
    """Part of a Chunk record between its start and its data."""
    name = compression.encode()
    return struct.pack("<I", len(name)) + name + struct.pack("<Q", nbytes)


class Container:
    """Writes an MCAP file in order, preamble, chunks, summary; compression is zstd or none."""

    def __init__(self, stream: IO[bytes], *, library: str, compression: str) -> None:
        self._stream = stream
        self._zstd = _compressor() if compression == "zstd" else None
        self._offset = 0
        self._data_crc = 0
        self._schemas: list[records.Schema] = []
        self._channels: list[records.Channel] = []
        self._chunks: list[records.ChunkIndex] = []
        self._attachments: list[records.AttachmentIndex] = []
        self._metadata: list[records.MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._write(MAGIC + _bytes_of(records.Header(profile="", library=library)))

    def _write(self, data: Any, crc: int | None = None) -> None:
        """Append bytes, of known CRC-32 perhaps, to the data section."""
        if crc is None:
            self._data_crc = zlib.crc32(data, self._data_crc)
        else:
            self._data_crc = crc32_combine(self._data_crc, crc, len(data))
        self._stream.write(data)
        self._offset += len(data)

    def add_metadata(self, name: str, metadata: Mapping[str, str]) -> int:
        """Write a Metadata record and return its CRC-32."""
        record = _bytes_of(records.Metadata(name=name, metadata=dict(metadata)))
        place = {"offset": self._offset, "length": len(record)}
        self._metadata.append(records.MetadataIndex(name=name, **place))
        self._write(record)
        return zlib.crc32(record)

    def add_attachment(self, name: str, data: bytes) -> None:
        """Write an Attachment, dated to the start of the simulation."""
        media_type = _MEDIA_TYPES.get(Path(name).suffix, "application/octet-stream")
        attachment = records.Attachment(
            create_time=0, log_time=0, name=name, media_type=media_type, data=data
        )
        record = _bytes_of(attachment)
        self._attachments.append(attachment_index(attachment, self._offset, len(record)))
        self._write(record)

    def add_channel(
        self, channel_id: int, topic: str, message: str, descriptors: bytes, note: dict[str, str]
    ) -> None:
        """Write the Schema and the Channel of a topic; both get the same id."""
        schema = records.Schema(id=channel_id, name=message, encoding="protobuf", data=descriptors)
        channel = records.Channel(
            id=channel_id,
            topic=topic,
            message_encoding="protobuf",
            metadata=note,
            schema_id=channel_id,
        )
        self._schemas.append(schema)
        self._channels.append(channel)
        self._counts[channel_id] = 0
        self._write(_bytes_of(schema, channel))

    def add_chunk(
        self,
        channel_id: int,
        data: Any,
        times: NDArray[np.uint64],
        offsets: NDArray[np.uint64],
        *,
        stored: bool = False,
    ) -> None:
        """Write a Chunk of one channel and its MessageIndex.

        `data` are the Message records; `times` [ns], ascending, and `offsets` [bytes] of each have
        shape (n,). A `stored` chunk is not compressed, whatever the others are.
        """
        zstd = None if stored else self._zstd
        packed = data if zstd is None else zstd.compress(data)
        compression = "" if zstd is None else "zstd"
        names = chunk_names(compression, len(packed))
        first, last = int(times[0]), int(times[-1])
        length = CHUNK_START.size - RECORD_START.size + len(names) + len(packed)
        crc = zlib.crc32(data)
        start = self._offset
        self._write(CHUNK_START.pack(Opcode.CHUNK, length, first, last, len(data), crc) + names)
        self._write(packed, crc if packed is data else None)
        index_start = self._offset
        entries = np.stack((times, offsets), axis=1).astype("<u8", copy=False).tobytes()
        head = Opcode.MESSAGE_INDEX, 6 + len(entries), channel_id, len(entries)
        self._write(_MESSAGE_INDEX_START.pack(*head) + entries)
        self._counts[channel_id] += len(times)
        self._chunks.append(
            records.ChunkIndex(
                chunk_length=index_start - start,
                chunk_start_offset=start,
                compression=compression,
                compressed_size=len(packed),
                message_end_time=last,
                message_index_length=self._offset - index_start,
                message_index_offsets={channel_id: index_start},
                message_start_time=first,
                uncompressed_size=len(data),
            )
        )

    def finish(self) -> None:
        """Write the end of the data section, the summary and the footer."""
        data_end = _bytes_of(records.DataEnd(data_section_crc=self._data_crc))
        start = self._offset + len(data_end)
        summary, offsets = b"", []
        for group in self._summary_groups():
            if group:
                data = _bytes_of(*group)
                place = {"group_start": start + len(summary), "group_length": len(data)}
                offsets.append(records.SummaryOffset(group_opcode=data[0], **place))
                summary += data
        offset_start = start + len(summary)
        summary += _bytes_of(*offsets)
        summary += FOOTER_START.pack(Opcode.FOOTER, 20, start, offset_start)
        self._stream.write(data_end + summary + zlib.crc32(summary).to_bytes(4, "little") + MAGIC)

    def _summary_groups(self) -> list[list[records.McapRecord]]:
        """Group the records of the summary by opcode, as the specification asks."""
        statistics = records.Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max((c.message_end_time for c in self._chunks), default=0),
            message_start_time=min((c.message_start_time for c in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        chunks, attachments, metadata = self._chunks, self._attachments, self._metadata
        groups = self._schemas, self._channels, [statistics], chunks, attachments, metadata
        return [[*group] for group in groups]


def crc32_combine(first: int, second: int, second_bytes: int) -> int:
    """Return the CRC-32 of two joined pieces from theirs, as zlib's function that Python lacks.

    crc(a b) = crc(a)·x^(8·len(b)) + crc(b) modulo the polynomial, over GF(2). A stored chunk has a
    checksum of its own and is part of that of the data section: this saves a pass over its bytes.
    """
    return _multiply(_power_of_x(8 * second_bytes), first) ^ second


@lru_cache(maxsize=64)
def _power_of_x(exponent: int) -> int:
    """Raise x to a power modulo the polynomial, by squaring."""
    result, square = _ONE, _ONE >> 1
    while exponent:
        if exponent & 1:
            result = _multiply(square, result)
        square = _multiply(square, square)
        exponent >>= 1
    return result


def _multiply(a: int, b: int) -> int:
    """Multiply two polynomials over GF(2) modulo the polynomial."""
    product = 0
    while a:
        if a & _ONE:
            product ^= b
        a = (a << 1) & 0xFFFFFFFF
        b = (b >> 1) ^ (_POLYNOMIAL if b & 1 else 0)
    return product
