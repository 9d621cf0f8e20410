"""What pandas sees, and the digest."""

from __future__ import annotations

import hashlib
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from hiersched.log import TOPICS, LogReader, log_digest, slot_span, topic_frame

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
            for field in TOPICS[topic].fields_in("full"):
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
