"""A file of MCAP records: reads and checks single ones, wherever they are said to lie."""

from __future__ import annotations

import os
import struct
import zlib
from io import BytesIO
from pathlib import Path
from typing import Any

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, ChunkIndex, Header, Metadata

from hiersched.log.container import CHUNK_START
from hiersched.log.errors import LogError, reading

RECORD_START = struct.Struct("<BQ")
_DATA_OPCODES: dict[Any, int] = {
    Header: Opcode.HEADER,
    Metadata: Opcode.METADATA,
    Attachment: Opcode.ATTACHMENT,
}


class RecordFile:
    """An open file.

    Parameters
    ----------
    path
        The file.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._stream = open(self.path, "rb")
        self.size = os.fstat(self._stream.fileno()).st_size
        self._zstd = zstandard.ZstdDecompressor()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def _fail(self, offset: int, what: str) -> LogError:
        return LogError(self.path, offset, what)

    def read(self, offset: int, length: int) -> bytes:
        """Read bytes that have to be there."""
        if offset < 0 or length < 0 or offset + length > self.size:
            raise self._fail(self.size, f"{length} bytes at {offset} lie outside of the file")
        self._stream.seek(offset)
        data = self._stream.read(length)
        if len(data) != length:
            raise self._fail(offset + len(data), "the file became shorter while it was read")
        return data

    def record(self, offset: int, length: int | None, kind: Any, *, crc_bytes: int = 0) -> Any:
        """Read one record.

        Parameters
        ----------
        offset, length
            Where it lies [bytes]; None takes the length that the record itself names.
        kind
            Header, Metadata or Attachment, of `mcap.records`.
        crc_bytes
            4 if its last four bytes are a checksum of its content.

        Returns
        -------
        McapRecord
            The record.
        """
        opcode, named = RECORD_START.unpack(self.read(offset, RECORD_START.size))
        if opcode != _DATA_OPCODES[kind] or length not in (None, RECORD_START.size + named):
            raise self._fail(offset, f"there is no {kind.__name__} record as announced")
        body = self.read(offset + RECORD_START.size, named)
        if crc_bytes and zlib.crc32(body[:-4]).to_bytes(4, "little") != body[-4:]:
            raise self._fail(offset, f"the {kind.__name__} does not match its checksum")
        with reading(self.path, offset, f"the {kind.__name__}"):
            return kind.read(ReadDataStream(BytesIO(body)))

    def attachment(self, index: AttachmentIndex) -> bytes:
        """Read the content of an attachment."""
        record = self.record(index.offset, index.length, Attachment, crc_bytes=4)
        data: bytes = record.data
        return data

    def chunk_data(self, index: ChunkIndex) -> bytes | memoryview:
        """Read a chunk, check it, and undo its compression.

        Parameters
        ----------
        index
            Its entry in the summary.

        Returns
        -------
        bytes or memoryview
            Its message records.
        """
        offset = index.chunk_start_offset
        record = self.read(offset, index.chunk_length)
        name = index.compression.encode()
        names = struct.pack("<I", len(name)) + name + struct.pack("<Q", index.compressed_size)
        data = memoryview(record)[CHUNK_START.size + len(names) :]
        start = (
            Opcode.CHUNK,
            len(record) - RECORD_START.size,
            index.message_start_time,
            index.message_end_time,
            index.uncompressed_size,
        )
        *head, stored = CHUNK_START.unpack_from(record)
        if (
            tuple(head) != start
            or record[CHUNK_START.size : CHUNK_START.size + len(names)] != names
            or len(data) != index.compressed_size
        ):
            raise self._fail(offset, "a chunk does not match its entry in the summary")
        content = self._decompress(index, data)
        if len(content) != index.uncompressed_size or zlib.crc32(content) != stored:
            raise self._fail(offset, "a chunk does not match its checksum")
        return content

    def _decompress(self, index: ChunkIndex, data: memoryview) -> bytes | memoryview:
        """Undo the compression of a chunk."""
        if index.compression == "":
            return data
        offset = index.chunk_start_offset
        if index.compression != "zstd":
            raise self._fail(offset, f"a chunk has compression {index.compression!r}")
        with reading(self.path, offset, "a chunk"):
            # Its own header says how much memory it wants: do not believe it blindly.
            if zstandard.frame_content_size(data) != index.uncompressed_size:
                raise ValueError("the compressed data have another size")
            return self._zstd.decompress(data)
