"""Every shape that the MCAP specification allows a file to have, read to the same records.

The cases are those of the MCAP project's conformance suite, restated: six contents, each with every
combination of what a writer may do or leave out. Files are built byte by byte from the
specification, by nothing of the library nor of the mcap package.
"""

from __future__ import annotations

import itertools
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Message,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from hiersched.log import LogError, foreign_records, read_foreign

MAGIC = b"\x89MCAP0\r\n"
SCHEMA = Schema(id=1, name="Example", encoding="c", data=bytes([4, 5, 6]))
CHANNEL = Channel(id=1, topic="example", message_encoding="a", metadata={"foo": "bar"}, schema_id=1)
SCHEMALESS = Channel(
    id=1, topic="example", message_encoding="a", metadata={"foo": "bar"}, schema_id=0
)
ATTACHMENT = Attachment(
    create_time=1, log_time=2, name="myFile", media_type="application/octet-stream",
    data=bytes([1, 2, 3]),
)  # fmt: skip
METADATA = Metadata(name="myMetadata", metadata={"foo": "bar"})


def message(i: int) -> Message:
    return Message(
        channel_id=1, sequence=10 + i, log_time=2 + i, publish_time=1 + i, data=bytes([1, 2, 3 + i])
    )


CONTENTS: dict[str, list[Any]] = {
    "no data": [],
    "one message": [SCHEMA, CHANNEL, message(0)],
    "one schemaless message": [SCHEMALESS, message(0)],
    "ten messages": [SCHEMA, CHANNEL, *map(message, range(10))],
    "one attachment": [ATTACHMENT],
    "one metadata": [METADATA],
}
CHUNKS = [(), ("ch",), ("ch", "chx"), ("ch", "mx"), ("ch", "chx", "mx")]


def features(content: str) -> Iterator[frozenset[str]]:
    """Combinations that make sense for a content."""
    flags = ["st", "sum", "pad"]
    flags += {"one attachment": ["ax"], "one metadata": ["mdx"]}.get(content, [])
    flags += ["rch", "rsh"] if "message" in content else []
    for chosen in itertools.product([False, True], repeat=len(flags)):
        on = {flag for flag, wanted in zip(flags, chosen, strict=True) if wanted}
        for chunk in CHUNKS if "message" in content else [()]:
            yield frozenset(on | set(chunk))


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def mapping(value: dict[str, str]) -> bytes:
    body = b"".join(text(k) + text(v) for k, v in value.items())
    return struct.pack("<I", len(body)) + body


class Case:
    """Builds one file, and the records that a reader has to find in it."""

    def __init__(self, content: list[Any], on: frozenset[str]) -> None:
        self.on = on
        self.data = MAGIC
        self.expected: list[Any] = []
        self._record(1, text("") + text(""))
        chunked = [r for r in content if isinstance(r, Schema | Channel | Message)]
        rest = [r for r in content if r not in chunked]
        self.summary: list[tuple[int, Any, bytes]] = []
        chunk = self._chunk(chunked) if "ch" in on and chunked else None
        for item in [*([] if chunk else chunked), *rest]:
            self._item(item)
        self._record(15, struct.pack("<I", zlib.crc32(self.data)))
        self._end(content, chunk)

    def _record(self, opcode: int, body: bytes) -> int:
        """Append a record; returns where."""
        start = len(self.data)
        self.data += self._framed(opcode, body)
        return start

    def _framed(self, opcode: int, body: bytes) -> bytes:
        # Records that end with a list or with raw data cannot be padded.
        if "pad" in self.on and opcode not in (2, 5, 9):
            body += b"\1\2\3"
        return struct.pack("<BQ", opcode, len(body)) + body

    def _body(self, item: Any) -> tuple[int, bytes]:
        if isinstance(item, Schema):
            data = struct.pack("<I", len(item.data)) + item.data
            return 3, struct.pack("<H", item.id) + text(item.name) + text(item.encoding) + data
        if isinstance(item, Channel):
            start = struct.pack("<HH", item.id, item.schema_id)
            names = text(item.topic) + text(item.message_encoding)
            return 4, start + names + mapping(item.metadata)
        if isinstance(item, Message):
            times = item.channel_id, item.sequence, item.log_time, item.publish_time
            return 5, struct.pack("<HIQQ", *times) + item.data
        if isinstance(item, Attachment):
            body = struct.pack("<QQ", item.log_time, item.create_time) + text(item.name)
            body += text(item.media_type) + struct.pack("<Q", len(item.data)) + item.data
            return 9, body + struct.pack("<I", zlib.crc32(body))
        return 12, text(item.name) + mapping(item.metadata)

    def _item(self, item: Any) -> None:
        opcode, body = self._body(item)
        start = self._record(opcode, body)
        length = len(self.data) - start
        self.expected.append(item)
        if isinstance(item, Attachment) and "ax" in self.on:
            size = len(item.data)
            index = AttachmentIndex(
                offset=start, length=length, log_time=item.log_time, create_time=item.create_time,
                data_size=size, name=item.name, media_type=item.media_type,
            )  # fmt: skip
            numbers = start, length, item.log_time, item.create_time, size
            body = struct.pack("<QQQQQ", *numbers) + text(item.name) + text(item.media_type)
            self.summary.append((10, index, body))
        if isinstance(item, Metadata) and "mdx" in self.on:
            index = MetadataIndex(offset=start, length=length, name=item.name)
            self.summary.append((13, index, struct.pack("<QQ", start, length) + text(item.name)))

    def _chunk(self, items: list[Any]) -> tuple[ChunkIndex, bytes]:
        inner, entries = b"", []
        for item in items:
            if isinstance(item, Message):
                entries.append((item.log_time, len(inner)))
            opcode, body = self._body(item)  # not padded: the stock reader cannot read that
            inner += struct.pack("<BQ", opcode, len(body)) + body
        self.expected += items
        times = [time for time, _ in entries]
        head = struct.pack("<QQQI", min(times), max(times), len(inner), zlib.crc32(inner))
        start = self._record(6, head + text("") + struct.pack("<Q", len(inner)) + inner)
        length = len(self.data) - start
        offsets = {}
        if "mx" in self.on:
            body = b"".join(struct.pack("<QQ", *entry) for entry in entries)
            offsets[1] = self._record(7, struct.pack("<HI", 1, len(body)) + body)
        index = ChunkIndex(
            chunk_length=length, chunk_start_offset=start, compression="",
            compressed_size=len(inner), message_end_time=max(times),
            message_index_length=len(self.data) - start - length,
            message_index_offsets=offsets, message_start_time=min(times),
            uncompressed_size=len(inner),
        )  # fmt: skip
        places = b"".join(struct.pack("<HQ", *pair) for pair in offsets.items())
        body = struct.pack("<QQQQI", min(times), max(times), start, length, len(places)) + places
        body += struct.pack("<Q", index.message_index_length) + text("")
        return index, body + struct.pack("<QQ", len(inner), len(inner))

    def _end(self, content: list[Any], chunk: tuple[ChunkIndex, bytes] | None) -> None:
        groups: list[tuple[int, Any, bytes]] = []
        for flag, kind in (("rsh", Schema), ("rch", Channel)):
            repeated = [r for r in content if isinstance(r, kind) and flag in self.on]
            groups += [(self._body(r)[0], r, self._body(r)[1]) for r in repeated]
        if "st" in self.on:
            groups.append(self._statistics(content, chunk is not None))
        if chunk and "chx" in self.on:
            groups.append((8, *chunk))
        groups += self.summary
        start, offsets = len(self.data), []
        for opcode, record, body in groups:
            place = self._record(opcode, body)
            self.expected.append(record)
            offsets.append((opcode, place, len(self.data) - place))
        offset_start = len(self.data) if "sum" in self.on and offsets else 0
        for opcode, place, length in offsets if offset_start else []:
            self.expected.append(
                SummaryOffset(group_opcode=opcode, group_start=place, group_length=length)
            )
            self._record(14, struct.pack("<BQQ", opcode, place, length))
        summary_start = start if groups else 0
        footer = struct.pack("<BQQQ", 2, 20, summary_start, offset_start)
        crc = zlib.crc32(self.data[start:] + footer)
        self.data += footer + struct.pack("<I", crc) + MAGIC

    def _statistics(self, content: list[Any], chunked: bool) -> tuple[int, Any, bytes]:
        kinds = [type(r) for r in content]
        times = [r.log_time for r in content if isinstance(r, Message)] or [0]
        counts = {1: kinds.count(Message)} if Message in kinds else {}
        statistics = Statistics(
            attachment_count=kinds.count(Attachment), channel_count=kinds.count(Channel),
            channel_message_counts=counts, chunk_count=int(chunked),
            message_count=kinds.count(Message), message_end_time=max(times),
            message_start_time=min(times), metadata_count=kinds.count(Metadata),
            schema_count=kinds.count(Schema),
        )  # fmt: skip
        pairs = b"".join(struct.pack("<HQ", *pair) for pair in counts.items())
        body = struct.pack(
            "<QHIIIIQQI", statistics.message_count, statistics.schema_count,
            statistics.channel_count, statistics.attachment_count, statistics.metadata_count,
            statistics.chunk_count, min(times), max(times), len(pairs),
        )  # fmt: skip
        return 11, statistics, body + pairs


@pytest.mark.parametrize("content", CONTENTS)
def test_every_allowed_shape_is_read_identically(content: str, tmp_path: Path) -> None:
    shapes = set()
    for on in features(content):
        case = Case(CONTENTS[content], on)
        path = tmp_path / "case.mcap"
        path.write_bytes(case.data)
        shapes.add(case.data)
        kinds = ("Header", "DataEnd", "Footer", "MessageIndex")
        records = [r for r in foreign_records(path) if type(r).__name__ not in kinds]
        assert records == case.expected, sorted(on)
        tables = read_foreign(path)
        messages = [r for r in CONTENTS[content] if isinstance(r, Message)]
        assert set(tables) == ({"example"} if messages else set())
        for topic in tables:
            names = ["log_time", "publish_time", "sequence", "data"]
            assert list(tables[topic].itertuples(index=False, name=None)) == [
                tuple(getattr(m, name) for name in names) for m in messages
            ]
    assert len(shapes) >= (4 if content == "no data" else 8)


def test_every_byte_of_a_conformance_case_counts(tmp_path: Path) -> None:
    case = Case(CONTENTS["ten messages"], frozenset({"ch", "chx", "mx", "rch", "rsh", "st", "sum"}))
    path = tmp_path / "case.mcap"
    for place in range(len(case.data)):
        bad = bytearray(case.data)
        bad[place] ^= 1 << place % 8
        path.write_bytes(bad)
        with pytest.raises(LogError):
            foreign_records(path)
