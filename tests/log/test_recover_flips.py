"""Flipped bits in unfinished logs: `recover` tells no lie, and loses nothing unsaid."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.opcode import Opcode

from hiersched.log import LogError, LogReader, recover

SLOTS = 60
Content = dict[str, Any]


def content(path: Path) -> Content:
    """All that a log holds: fields by topic and slot, events, attachments, what the run was."""
    with LogReader(path) as log:
        topics = {}
        for topic in log.topics:
            values = log.read(topic)
            slots = values.pop("slot").tolist()
            topics[topic] = {
                slot: {name: array[i].tobytes() for name, array in values.items()}
                for i, slot in enumerate(slots)
            }
        return {
            "topics": topics,
            "events": log.events(),
            "attachments": log.attachments,
            "metadata": {k: v for k, v in log.metadata.items() if k != "recovered_losses"},
        }


def lies(found: Content, right: Content) -> list[str]:
    """What a recovered log says and the original does not."""
    wrong = [] if found["metadata"] == right["metadata"] else ["metadata"]
    for name, data in found["attachments"].items():
        if right["attachments"].get(name) != data:
            wrong.append(f"attachment {name}")
    wrong += [f"event {event}" for event in found["events"] if event not in right["events"]]
    for topic, slots in found["topics"].items():
        if topic not in right["topics"]:
            wrong.append(topic)
            continue
        for slot, values in slots.items():
            if right["topics"][topic].get(slot) != values:
                wrong.append(f"{topic} slot {slot}")
    return wrong


@pytest.fixture
def unfinished(tmp_path: Path, random_fields: Any, write_log: Any) -> bytes:
    """A log up to the end of its data section, as a killed writer leaves it."""
    path = write_log(tmp_path / "whole.mcap", random_fields(SLOTS), flush_slots=20)
    data: bytes = path.read_bytes()
    (summary,) = struct.unpack_from("<Q", data, len(data) - 28)
    return data[: summary - 13]


def recovered(tmp_path: Path, data: bytes) -> tuple[Content, tuple[str, ...]] | None:
    """Recover a file of these bytes; None where it is refused."""
    path, out = tmp_path / "flipped.mcap.part", tmp_path / "out.mcap"
    path.write_bytes(data)
    out.unlink(missing_ok=True)
    try:
        report = recover(path, out)
    except LogError:
        assert not out.exists()
        return None
    return content(out), report.losses


def check(tmp_path: Path, data: bytes, right: Content) -> bool:
    """Whether something was got back; what is wrong or lost without a word fails."""
    result = recovered(tmp_path, data)
    if result is None:
        return False
    found, losses = result
    assert lies(found, right) == []
    if not losses:
        assert found == right
    return True


def flip(data: bytes, place: int, bit: int) -> bytes:
    damaged = bytearray(data)
    damaged[place] ^= 1 << bit
    return bytes(damaged)


@pytest.mark.parametrize("count", [100, pytest.param(1000, marks=pytest.mark.nightly)])
def test_nothing_is_lost_in_silence(tmp_path: Path, unfinished: bytes, count: int) -> None:
    """Half of the flips anywhere, half in what is no content of a chunk."""
    result = recovered(tmp_path, unfinished)
    assert result is not None
    right, losses = result
    assert losses == ()
    assert len(right["topics"]["/queue"]) == SLOTS
    frame = frame_bytes(unfinished)
    rng = np.random.default_rng(3)
    saved = 0
    for number in range(count):
        places = frame if number % 2 else range(len(unfinished))
        place = places[int(rng.integers(len(places)))]
        saved += check(tmp_path, flip(unfinished, place, int(rng.integers(8))), right)
    assert saved > count // 2


def frame_bytes(data: bytes) -> list[int]:
    """Places outside of the content of chunks and of attachments."""
    places, offset = [*range(8)], 8
    while offset < len(data):
        opcode, length = struct.unpack_from("<BQ", data, offset)
        head = {Opcode.CHUNK: 50, Opcode.ATTACHMENT: 40}.get(opcode, 9 + length)
        places += range(offset, offset + min(head, 9 + length))
        offset += 9 + length
    return places


@pytest.mark.nightly
def test_every_opcode_of_the_records(tmp_path: Path, unfinished: bytes) -> None:
    """A record in place of another one: each kind of each of the first of a kind."""
    result = recovered(tmp_path, unfinished)
    assert result is not None
    right, _ = result
    offset, seen = 8, set()
    while offset < len(unfinished):
        opcode, length = struct.unpack_from("<BQ", unfinished, offset)
        if opcode not in seen:
            seen.add(opcode)
            for other in (*range(20), 0x80, 0xFF):
                damaged = bytearray(unfinished)
                damaged[offset] = other
                check(tmp_path, bytes(damaged), right)
        offset += 9 + length
    assert len(seen) == 7


@pytest.mark.parametrize("cut", [0, 200])
def test_a_second_file_behind_the_first_is_named(
    tmp_path: Path, random_fields: Any, write_log: Any, cut: int
) -> None:
    """The first is recovered; what follows is said to be there."""
    whole: bytes = write_log(tmp_path / "a.mcap", random_fields(SLOTS)).read_bytes()
    other: bytes = write_log(tmp_path / "b.mcap", random_fields(SLOTS, seed=2)).read_bytes()
    right = content(tmp_path / "a.mcap")
    result = recovered(tmp_path, whole + other[: len(other) - cut])
    assert result is not None
    found, losses = result
    assert found == right
    assert [loss for loss in losses if f"{len(other) - cut} bytes behind the end" in loss]


@pytest.mark.parametrize("kept", [0, 4, 8, 9, 20])
def test_a_part_of_a_summary_is_no_loss(
    tmp_path: Path, random_fields: Any, write_log: Any, kept: int
) -> None:
    """All data lie before the summary: a file that ends within it has lost nothing."""
    whole: bytes = write_log(tmp_path / "a.mcap", random_fields(SLOTS)).read_bytes()
    (summary,) = struct.unpack_from("<Q", whole, len(whole) - 28)
    result = recovered(tmp_path, whole[: summary + kept])
    assert result == (content(tmp_path / "a.mcap"), ())


def test_wrong_times_of_a_chunk_are_named(tmp_path: Path, unfinished: bytes) -> None:
    result = recovered(tmp_path, unfinished)
    assert result is not None
    right, _ = result
    offset = 8
    while unfinished[offset] != Opcode.CHUNK:
        offset += 9 + struct.unpack_from("<Q", unfinished, offset + 1)[0]
    for place in (offset + 9, offset + 17):
        result = recovered(tmp_path, flip(unfinished, place + 3, 1))
        assert result is not None
        found, losses = result
        assert lies(found, right) == []
        assert [loss for loss in losses if "times are not those of its messages" in loss]


def test_a_claim_of_memory_is_refused_before_it_is_allocated(
    tmp_path: Path, random_fields: Any, write_log: Any
) -> None:
    """A chunk that says it has 10 GB, in the summary and in its own head, all checksums right."""
    import resource
    import zlib

    path: Path = write_log(tmp_path / "a.mcap", random_fields(SLOTS), flush_slots=20)
    data = bytearray(path.read_bytes())
    (summary,) = struct.unpack_from("<Q", data, len(data) - 28)
    offset, claimed = 8, 10_000_000_000
    while data[offset] != Opcode.CHUNK:
        offset += 9 + struct.unpack_from("<Q", data, offset + 1)[0]
    struct.pack_into("<Q", data, offset + 25, claimed)
    struct.pack_into("<I", data, summary - 4, zlib.crc32(data[: summary - 13]))
    place = summary
    while True:
        opcode, length = struct.unpack_from("<BQ", data, place)
        start = struct.unpack_from("<Q", data, place + 25)[0]
        if opcode == Opcode.CHUNK_INDEX and start == offset:
            break
        place += 9 + length
    struct.pack_into("<Q", data, place + 9 + length - 8, claimed)
    crc = zlib.crc32(data[summary : len(data) - 12])
    struct.pack_into("<I", data, len(data) - 12, crc)
    path.write_bytes(data)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    read: list[Callable[[], Any]] = [
        lambda: content(path),
        lambda: recovered(tmp_path, bytes(data)),
    ]
    with pytest.raises(LogError, match=r"claims 10000000000 bytes, more than|do not make"):
        read[0]()
    read[1]()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000  # KiB


@pytest.mark.parametrize("factor", [0.5, 1.5])
def test_a_compressed_chunk_that_wants_another_size_is_not_unpacked(
    tmp_path: Path, random_fields: Any, write_log: Any, factor: float
) -> None:
    """The frame itself says how much memory it wants; the checksum of the data section is right."""
    import zlib

    path: Path = write_log(tmp_path / "a.mcap", random_fields(SLOTS), compression="zstd")
    data = bytearray(path.read_bytes())
    (summary,) = struct.unpack_from("<Q", data, len(data) - 28)
    frame = data.index(b"\x28\xb5\x2f\xfd")
    head = data[frame + 4]
    assert head >> 6 == 1  # a size of two bytes, less 256, behind the window where there is one
    place = frame + 5 + (not head & 0x20)
    (size,) = struct.unpack_from("<H", data, place)
    struct.pack_into("<H", data, place, round(factor * (size + 256)) - 256)
    struct.pack_into("<I", data, summary - 4, zlib.crc32(data[: summary - 13]))
    path.write_bytes(data)
    with pytest.raises(LogError, match="the compressed data have another size"):
        content(path)


def chunks_of(data: bytes) -> list[tuple[int, int]]:
    """Begin and end of every chunk, its index included."""
    found, offset = [], 8
    while offset < len(data):
        opcode, length = struct.unpack_from("<BQ", data, offset)
        end = offset + 9 + length
        if opcode == Opcode.CHUNK:
            found.append((offset, end + 9 + struct.unpack_from("<Q", data, end + 1)[0]))
        offset = end
    return found


@pytest.mark.parametrize("change", ["reversed", "twice"])
def test_chunks_in_another_order_are_named(tmp_path: Path, unfinished: bytes, change: str) -> None:
    """All checksums right: nothing wrong comes out, what is left out is said, no part stays."""
    result = recovered(tmp_path, unfinished)
    assert result is not None
    right, _ = result
    pieces = [unfinished[begin:end] for begin, end in chunks_of(unfinished)]
    head = unfinished[: chunks_of(unfinished)[0][0]]
    pieces = pieces[::-1] if change == "reversed" else [*pieces, pieces[2]]
    result = recovered(tmp_path, head + b"".join(pieces))
    assert result is not None
    found, losses = result
    assert lies(found, right) == []
    assert [loss for loss in losses if "out of order, or there twice" in loss]
    assert not list(tmp_path.glob("out*.part"))
