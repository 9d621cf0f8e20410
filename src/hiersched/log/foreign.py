"""MCAP files of others, by the stock reader, but with every checksum looked at."""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Callable, Collection
from io import BytesIO
from typing import TYPE_CHECKING, Any

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader
from mcap.records import Channel, Chunk, McapRecord, Schema
from mcap.stream_reader import StreamReader, get_chunk_data_stream

from hiersched.log.container import FOOTER_BYTES, MAGIC
from hiersched.log.errors import LogError, reading
from hiersched.log.recordfile import RECORD_START, RecordFile

if TYPE_CHECKING:
    from pandas import DataFrame

Decoder = Callable[[bytes], dict[str, Any]]


def read_foreign(
    path: str | os.PathLike[str],
    topics: Collection[str] | None = None,
    start_ns: int | None = None,
    stop_ns: int | None = None,
) -> dict[str, DataFrame]:
    """Read any MCAP file into tables, one a topic.

    Protobuf and JSON messages are decoded, their nested fields into columns ``pose.position.x``;
    of other encodings the column ``data`` holds the bytes.

    Parameters
    ----------
    path
        The file; it has to be complete.
    topics
        Topics to read; all by default.
    start_ns, stop_ns
        Messages with a log time from `start_ns` to before `stop_ns`; all by default.

    Returns
    -------
    dict of DataFrame
        Topic -> ``log_time``, ``publish_time`` [ns], ``sequence`` and the fields, one row a
        message in the order of log times.

    Raises
    ------
    LogError
        If the file is no complete MCAP file, or does not match one of its checksums. The format
        lets writers leave checksums out; what has none cannot be checked.
    """
    import pandas as pd

    check_foreign(path)
    rows: dict[str, list[dict[str, Any]]] = {}
    decoders: dict[int, Decoder] = {}
    with open(path, "rb") as stream, reading(path, 0, "the file"):
        # Not by the summary's indexes: the format lets writers leave any part of them out.
        messages = NonSeekingReader(stream, validate_crcs=True).iter_messages(
            topics, starting_at=start_ns, ending_before=stop_ns
        )
        for schema, channel, message in messages:
            if channel.id not in decoders:
                decoders[channel.id] = _decoder(schema, channel)
            rows.setdefault(channel.topic, []).append(
                {
                    "log_time": message.log_time,
                    "publish_time": message.publish_time,
                    "sequence": message.sequence,
                    **decoders[channel.id](message.data),
                }
            )
    return {topic: pd.DataFrame(table) for topic, table in rows.items()}


def foreign_records(path: str | os.PathLike[str]) -> list[McapRecord]:
    """Read all records of any MCAP file, in order, those in chunks in place of the chunks.

    Parameters
    ----------
    path
        The file; it has to be complete.

    Returns
    -------
    list of McapRecord
        Of `mcap.records`.

    Raises
    ------
    LogError
        If the file is no complete MCAP file, or does not match one of its checksums.
    """
    check_foreign(path)
    with open(path, "rb") as stream, reading(path, 0, "the file"):
        return list(StreamReader(stream, validate_crcs=True).records)


def check_foreign(path: str | os.PathLike[str]) -> int:
    """Check the framing and all checksums of an MCAP file.

    Returns
    -------
    int
        Number of checksums that there were.

    Raises
    ------
    LogError
        At the first thing that is wrong.
    """
    file = RecordFile(path)
    try:
        return _check(file)
    finally:
        file.close()


def _check(file: RecordFile) -> int:
    """Walk through all records."""
    if file.size == 0:
        raise LogError(file.path, 0, "the file is empty")
    if file.read(0, min(len(MAGIC), file.size)) != MAGIC[: file.size]:
        raise LogError(file.path, 0, "this is not an MCAP file")
    if file.size < 2 * len(MAGIC) or file.read(file.size - len(MAGIC), len(MAGIC)) != MAGIC:
        raise LogError(file.path, file.size, "the file is truncated")
    end = file.size - len(MAGIC)
    offset, data_crc, checked, opcode, data_end = len(MAGIC), zlib.crc32(MAGIC), 0, 0, 0
    while offset < end:
        start = file.read(offset, RECORD_START.size)
        opcode, length = RECORD_START.unpack(start)
        body = file.read(offset + RECORD_START.size, length)
        with reading(file.path, offset, "a record"):
            stored, actual = _checksum(file, offset, opcode, body, data_crc)
        checked += stored != 0
        if stored not in (0, actual):
            kind = Opcode(opcode).name
            raise LogError(file.path, offset, f"the {kind} record does not match its checksum")
        if opcode == Opcode.FOOTER and data_end != (_summary_start(body) or offset):
            raise LogError(file.path, offset, "the summary does not follow the data section")
        data_crc = zlib.crc32(body, zlib.crc32(start, data_crc))
        offset += RECORD_START.size + length
        if opcode == Opcode.DATA_END:
            data_end = offset
    if opcode != Opcode.FOOTER or offset != end:
        raise LogError(file.path, end, "the file does not end with a footer")
    return checked


def _checksum(
    file: RecordFile, offset: int, opcode: int, body: bytes, data_crc: int
) -> tuple[int, int]:
    """Return the checksum that a record carries and what it should be; 0, 0 if it has none."""
    if opcode == Opcode.CHUNK:
        chunk = Chunk.read(ReadDataStream(BytesIO(body)))
        get_chunk_data_stream(chunk, validate_crc=True)
        return chunk.uncompressed_crc, chunk.uncompressed_crc
    if opcode == Opcode.ATTACHMENT:
        return int.from_bytes(body[-4:], "little"), zlib.crc32(body[:-4])
    if opcode == Opcode.DATA_END:
        return int.from_bytes(body[:4], "little"), data_crc
    if opcode == Opcode.FOOTER:
        start = _summary_start(body) or offset
        summary = file.read(start, offset + FOOTER_BYTES - 4 - start)
        return int.from_bytes(body[16:20], "little"), zlib.crc32(summary)
    return 0, 0


def _summary_start(footer: bytes) -> int:
    """Where a footer says that the summary starts; 0 where there is none."""
    return int.from_bytes(footer[:8], "little")


def _decoder(schema: Schema | None, channel: Channel) -> Decoder:
    """Make the function that turns a channel's messages into columns."""
    if channel.message_encoding == "json":
        return lambda data: _flat_json(json.loads(data))
    if channel.message_encoding == "protobuf" and schema is not None:
        pool = DescriptorPool()
        for file in FileDescriptorSet.FromString(schema.data).file:
            pool.Add(file)
        message = GetMessageClass(pool.FindMessageTypeByName(schema.name))
        return lambda data: _flat_protobuf(message.FromString(data))
    return lambda data: {"data": data}


def _flat_json(value: Any) -> dict[str, Any]:
    """Nested objects as names with dots."""
    if not isinstance(value, dict):
        return {"value": value}
    flat: dict[str, Any] = {}
    for name, inner in value.items():
        if isinstance(inner, dict):
            flat |= {f"{name}.{key}": item for key, item in _flat_json(inner).items()}
        else:
            flat[name] = inner
    return flat


def _flat_protobuf(message: Any) -> dict[str, Any]:
    """Nested messages as names with dots; repeated fields as lists, of messages as dicts."""
    flat: dict[str, Any] = {}
    for field in message.DESCRIPTOR.fields:
        value = getattr(message, field.name)
        nested = field.message_type is not None
        if nested and field.message_type.GetOptions().map_entry:
            flat[field.name] = dict(value)
        elif field.is_repeated:
            flat[field.name] = [_flat_protobuf(item) if nested else item for item in value]
        elif nested:
            inner = _flat_protobuf(value)
            flat |= {f"{field.name}.{key}": item for key, item in inner.items()}
        else:
            flat[field.name] = value
    return flat
