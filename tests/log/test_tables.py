"""What pandas sees, the digest, and MCAP files of others."""

from __future__ import annotations

import hashlib
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from hiersched.log import (
    TOPICS,
    LogError,
    LogReader,
    log_digest,
    read_foreign,
    slot_span,
    topic_frame,
)
from hiersched.log.schema import descriptor_set

SLOT_NS = 10_000_000
SLOTS = 100


def test_frames_hold_every_bit(tmp_path: Path, random_fields: Any, write_log: Any) -> None:
    fields = random_fields(SLOTS)
    with LogReader(write_log(tmp_path / "a.mcap", fields)) as log:
        for topic in log.topics:
            table = topic_frame(log, topic)
            assert table["slot"].tolist() == list(range(SLOTS))
            assert table["time_s"].tolist() == [slot / 100 for slot in range(SLOTS)]
            names = []
            for field in TOPICS[topic].fields[1:]:
                array = fields[field.name].reshape(SLOTS, -1)
                places = list(np.ndindex(*fields[field.name].shape[1:]))
                for column, place in zip(array.T, places, strict=True):
                    name = f"{field.name}[{','.join(map(str, place))}]" if place else field.name
                    names.append(name)
                    assert table[name].dtype == array.dtype
                    assert table[name].to_numpy().tobytes() == column.tobytes()
            assert list(table.columns) == ["slot", "time_s", *names]


def test_frames_take_a_span_of_time(tmp_path: Path, random_fields: Any, write_log: Any) -> None:
    with LogReader(write_log(tmp_path / "a.mcap", random_fields(SLOTS))) as log:
        table = topic_frame(log, "/queue", ["arrivals_packets"], 0.07, 0.3)
        assert table["slot"].tolist() == list(range(7, 30))
        assert list(table.columns[2:]) == [f"arrivals_packets[{i}]" for i in range(5)]
        events = topic_frame(log, "/events", None, 0.1, 0.7)
        assert events[["slot", "level"]].to_numpy().tolist() == [[41, "ERROR"]]
        assert topic_frame(log, "/events", None, 0.7)["message"].tolist() == [
            "gain for T = 12 infeasible: α² ≥ 1",
            "second of its slot",
        ]
        assert slot_span(log, 0.07, float("inf")) == (7, 1 << 32)
        assert slot_span(log, 0.071, 0.071) == (8, 8)
        for span in ((-0.1, 1.0), (0.3, 0.2), (float("nan"), 1.0)):
            with pytest.raises(ValueError, match="allowed: 0 <= start <= stop"):
                slot_span(log, *span)


def stock_digest(path: Path) -> str:
    """The digest as its docstring says, by the stock reader."""
    messages: dict[str, list[tuple[int, bytes]]] = {}
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(log_time_order=False):
            messages.setdefault(channel.topic, []).append((message.log_time, message.data))
    digest = hashlib.sha256()
    for topic in sorted(messages):
        digest.update(topic.encode() + b"\0")
        for time, data in sorted(messages[topic], key=lambda message: message[0]):
            digest.update(struct.pack("<QI", time, len(data)) + data)
    return digest.hexdigest()


def test_digest_is_of_topic_time_and_payload_alone(
    tmp_path: Path, random_fields: Any, write_log: Any
) -> None:
    fields = random_fields(SLOTS)
    variants: list[dict[str, Any]] = [
        {},
        {"compression": "none"},
        {"chunk_bytes": 900, "block": 7},
        {"flush_slots": 3},
        {"metadata": {"note": "another"}, "attachments": {}},
    ]
    paths = [
        write_log(tmp_path / f"{i}.mcap", fields, **settings) for i, settings in enumerate(variants)
    ]
    assert len({path.read_bytes() for path in paths}) == len(variants)
    assert {log_digest(path) for path in paths} == {stock_digest(paths[0])}


def test_digest_sees_a_single_bit_and_a_shift_in_time(
    tmp_path: Path, random_fields: Any, write_log: Any
) -> None:
    fields = random_fields(SLOTS)
    digests = {log_digest(write_log(tmp_path / "a.mcap", fields))}
    for name in fields:
        changed = {**fields, name: fields[name].copy()}
        changed[name].reshape(-1).view(np.uint8)[77] ^= 1
        digests.add(log_digest(write_log(tmp_path / "a.mcap", changed)))
    digests.add(log_digest(write_log(tmp_path / "a.mcap", fields, slot_ns=SLOT_NS + 1)))
    assert len(digests) == len(fields) + 2


def foreign_file(path: Path, **settings: Any) -> Path:
    """A file of another project: JSON, protobuf and an encoding that nobody knows."""
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptor_set("foxglove.Log")).file:
        pool.Add(file)
    message = GetMessageClass(pool.FindMessageTypeByName("foxglove.Log"))
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=200, **settings)
        writer.start(library="another")
        writer.add_metadata("about", {"key": "value"})
        writer.add_attachment(0, 0, "notes.txt", "text/plain", b"some notes")
        schema = writer.register_schema("foxglove.Log", "protobuf", descriptor_set("foxglove.Log"))
        plain = writer.register_channel("/json", "json", 0)
        proto = writer.register_channel("/log", "protobuf", schema)
        raw = writer.register_channel("/raw", "own", 0)
        for i in range(30):
            text = f'{{"x": {i}, "pose": {{"y": {i / 8}, "names": ["a"]}}}}'
            writer.add_message(plain, 10 * i, text.encode(), 10 * i, i)
            log = message(level=2, message=f"line {i}")
            log.timestamp.seconds = i
            writer.add_message(proto, 10 * i, log.SerializeToString(), 10 * i + 1, i)
            writer.add_message(raw, 10 * i, bytes([i]), 10 * i, i)
        writer.finish()
    return path


@pytest.mark.parametrize("compression", list(CompressionType))
def test_foreign_files_become_tables(tmp_path: Path, compression: CompressionType) -> None:
    path = foreign_file(tmp_path / "f.mcap", compression=compression, enable_data_crcs=True)
    tables = read_foreign(path)
    assert set(tables) == {"/json", "/log", "/raw"}
    assert tables["/json"]["pose.y"].tolist() == [i / 8 for i in range(30)]
    assert tables["/json"]["pose.names"][3] == ["a"]
    assert tables["/log"]["timestamp.seconds"].tolist() == list(range(30))
    assert tables["/log"]["message"][7] == "line 7"
    assert tables["/log"]["publish_time"].tolist() == [10 * i + 1 for i in range(30)]
    assert tables["/raw"]["data"][5] == b"\x05"
    part = read_foreign(path, ["/json"], 55, 100)
    assert part["/json"]["x"].tolist() == [6, 7, 8, 9]


def test_our_files_read_as_foreign_ones(tmp_path: Path, random_fields: Any, write_log: Any) -> None:
    fields = random_fields(SLOTS)
    tables = read_foreign(write_log(tmp_path / "a.mcap", fields), ["/allocation", "/events"])
    owners = np.array(tables["/allocation"]["prb_owner"].tolist(), np.uint32)
    assert owners.tobytes() == fields["prb_owner"].tobytes()
    assert tables["/events"]["name"].tolist() == ["run", "network", "control", "control"]


def test_damage_to_a_foreign_file_is_noticed(tmp_path: Path) -> None:
    path = foreign_file(tmp_path / "f.mcap", enable_data_crcs=True)
    good = path.read_bytes()
    truth = {topic: table.to_csv() for topic, table in read_foreign(path).items()}
    rng = np.random.default_rng(3)
    accepted = []
    for place in rng.integers(0, 8 * len(good), 400).tolist():
        bad = bytearray(good)
        bad[place // 8] ^= 1 << place % 8
        path.write_bytes(bad)
        try:
            tables = read_foreign(path)
        except LogError:
            continue
        accepted.append(place // 8)
        assert {topic: table.to_csv() for topic, table in tables.items()} == truth
    assert accepted == []


def test_foreign_files_that_are_none(tmp_path: Path) -> None:
    path = foreign_file(tmp_path / "f.mcap")
    good = path.read_bytes()
    for content, message in (
        (b"", "the file is empty"),
        (b"text " * 9, "not an MCAP file"),
        (good[:-1], "truncated"),
        (good[:-30] + good[-8:], "lie outside|footer"),
        (good + good, "lie outside|footer"),
    ):
        path.write_bytes(content)
        with pytest.raises(LogError, match=message):
            read_foreign(path)


def test_checksums_are_optional_in_foreign_files(tmp_path: Path) -> None:
    path = foreign_file(tmp_path / "f.mcap", enable_crcs=False)
    assert len(read_foreign(path)["/raw"]) == 30
