"""Files cut anywhere: refused by the reader, and got back by `recover` as far as they go."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.opcode import Opcode

from hiersched.log import LogDims, LogError, LogReader, LogWriter, log_digest, recover
from hiersched.log.recover import recovered_path

SLOT_NS = 10_000_000
SLOTS = 100


@pytest.fixture(params=["zstd", "none", "models"])
def log_path(
    request: pytest.FixtureRequest,
    tmp_path: Path,
    random_fields: Any,
    write_log: Any,
    dims: LogDims,
    model_dims: LogDims,
) -> Path:
    models = request.param == "models"
    path: Path = write_log(
        tmp_path / "a.mcap",
        random_fields(SLOTS, dims=model_dims if models else dims),
        dims=model_dims if models else dims,
        compression="zstd" if models else request.param,
        flush_slots=40,
    )
    return path


def records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, offset and size of every record."""
    offset = 8
    while offset < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, offset)
        yield opcode, offset, 9 + length
        offset += 9 + length


def test_every_bit_of_the_frame_matters(tmp_path: Path, random_fields: Any, write_log: Any) -> None:
    """All bits of what no checksum of a record covers: magics, opcodes, lengths, ends."""
    log_path = write_log(tmp_path / "a.mcap", random_fields(10), chunk_bytes=50_000)
    good = log_path.read_bytes()
    rng = np.random.default_rng(5)
    flips = [8 * place + bit for place in (*range(8), *range(-8, 0)) for bit in range(8)]
    for opcode, offset, size in records(good):
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            flips += range(8 * offset, 8 * (offset + size))
        else:  # opcode and length
            flips += [8 * (offset + byte) + int(rng.integers(8)) for byte in range(9)]
    for flip in flips:
        bad = bytearray(good)
        bad[flip // 8] ^= 1 << flip % 8
        log_path.write_bytes(bad)
        with pytest.raises(LogError):
            LogReader(log_path)


def cuts(data: bytes) -> Iterator[tuple[str, int]]:
    """Every boundary of records, and three places inside of each kind of record."""
    seen = set()
    for opcode, offset, size in records(data):
        name = Opcode(opcode).name
        yield f"before {name}", offset
        if opcode not in seen:
            seen.add(opcode)
            yield f"in the length of {name}", offset + 4
            yield f"at the start of {name}", offset + 9
            yield f"inside of {name}", offset + size // 2
    assert len(seen) == 14  # Message records lie within chunks
    yield "before the last magic", len(data) - 8
    yield "in the last magic", len(data) - 3


@pytest.mark.nightly
def test_truncation_at_every_kind_of_record(
    tmp_path: Path, random_fields: Any, write_log: Any
) -> None:
    """Refused; and what `recover` makes of it is a log whose slots are those of the original."""
    log_path = write_log(tmp_path / "a.mcap", random_fields(SLOTS), flush_slots=40)
    good, fields = log_path.read_bytes(), random_fields(SLOTS)
    kept = []
    for number, (_place, length) in enumerate(cuts(good)):
        log_path.write_bytes(good[:length])
        with pytest.raises(LogError, match="truncated"):
            LogReader(log_path)
        out = tmp_path / f"{number}.mcap"
        try:
            report = recover(log_path, out)
        except LogError:
            assert not out.exists()
            kept.append(0)
            continue
        kept.append(report.num_slots)
        assert_part_of(out, fields, report.num_slots)
    assert kept == sorted(kept)
    assert {0, 40, 80, SLOTS} <= set(kept)
    assert log_path.read_bytes() == good[: len(good) - 3]


def test_a_header_with_a_closing_magic_is_truncated(log_path: Path) -> None:
    """Too short for a log, though both ends are those of one."""
    good = log_path.read_bytes()
    (length,) = struct.unpack_from("<Q", good, 9)
    log_path.write_bytes(good[: 17 + length] + good[-8:])
    with pytest.raises(LogError, match="truncated"):
        LogReader(log_path)


def assert_part_of(path: Path, fields: Any, num_slots: int) -> None:
    with LogReader(path) as log:
        for topic in log.topics:
            values = log.read(topic)
            slots = values.pop("slot")
            assert slots.tolist() == list(range(num_slots))
            for name, array in values.items():
                assert array.tobytes() == fields[name][:num_slots].tobytes(), name


def test_recovered_log_has_the_digest_of_the_original(log_path: Path) -> None:
    """Nothing is lost when only the summary is."""
    digest = log_digest(log_path)
    data = log_path.read_bytes()
    (summary,) = struct.unpack_from("<Q", data, len(data) - 28)
    log_path.write_bytes(data[:summary])
    report = recover(log_path)
    assert report.path == log_path.with_name("a.recovered.mcap")
    assert report.losses == ()
    assert report.num_events == 4
    assert log_digest(report.path) == digest
    with LogReader(report.path) as log:
        assert log.metadata["policy"] == "pf"
        assert log.metadata["recovered_losses"] == ""
        assert log.attachments["policy.pt"] == bytes(range(256))


def test_recover_skips_a_damaged_chunk_and_says_so(log_path: Path, random_fields: Any) -> None:
    fields = random_fields(SLOTS)
    data = bytearray(log_path.read_bytes())
    chunks = [(o, s) for opcode, o, s in records(bytes(data)) if opcode == Opcode.CHUNK]
    offset, size = chunks[len(chunks) // 2]
    data[offset + size - 20] ^= 4
    log_path.write_bytes(data)
    report = recover(log_path)
    assert 0 < report.num_slots < SLOTS
    assert any(loss.startswith(f"at byte {offset}: /") for loss in report.losses)
    assert any("slots that other topics lack" in loss for loss in report.losses)
    with LogReader(report.path) as log:
        queue = log.read("/queue")
        slots = [slot for start, stop in report.spans for slot in range(start, stop)]
        assert queue["slot"].tolist() == slots
        for name in ("backlog_packets", "service_packets"):
            assert queue[name].tobytes() == fields[name][np.array(slots)].tobytes()
        assert log.metadata["recovered_losses"] == "; ".join(report.losses)


def test_recover_leaves_out_a_damaged_attachment(log_path: Path) -> None:
    data = bytearray(log_path.read_bytes())
    data[data.index(b"name: test") + 3] ^= 1
    log_path.write_bytes(data)
    report = recover(log_path)
    assert report.num_slots == SLOTS
    assert len(report.losses) == 1
    assert "attachment scenario.yaml" in report.losses[0]
    with LogReader(report.path) as log:
        assert "scenario.yaml" not in log.attachments


def test_recover_takes_what_an_aborted_run_left(
    tmp_path: Path, random_fields: Any, dims: LogDims
) -> None:
    log = LogWriter(tmp_path / "a.mcap", dims, slot_ns=SLOT_NS)
    log.write_block(5, random_fields(40))
    log.event(7, "INFO", "run", "text")
    log.abort()
    report = recover(tmp_path / "a.mcap.part")
    assert (report.path.name, report.spans, report.num_events) == (
        "a.recovered.mcap", ((5, 45),), 1,
    )  # fmt: skip
    assert report.losses == ()


def test_recover_never_overwrites(log_path: Path) -> None:
    before = log_path.read_bytes()
    with pytest.raises(FileExistsError, match="recover never overwrites"):
        recover(log_path, log_path)
    target = recovered_path(log_path)
    target.write_bytes(b"mine")
    with pytest.raises(FileExistsError, match=r"a\.recovered\.mcap: exists"):
        recover(log_path)
    assert (target.read_bytes(), log_path.read_bytes()) == (b"mine", before)


def test_recover_refuses_what_is_no_log(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    for content, message in ((b"", "empty"), (b"text " * 20, "not an MCAP file")):
        path.write_bytes(content)
        with pytest.raises(LogError, match=message):
            recover(path)
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize("cut", [False, True])
def test_recover_never_takes_damage_for_data(
    cut: bool, tmp_path: Path, random_fields: Any, write_log: Any
) -> None:
    """One bit flipped anywhere, with the summary and without: what is recovered is as it was."""
    fields = random_fields(SLOTS)
    log_path = write_log(tmp_path / "a.mcap", fields, flush_slots=40)
    with LogReader(log_path) as log:
        events, metadata = log.events(), log.metadata
    good = log_path.read_bytes()
    if cut:
        good = good[: struct.unpack_from("<Q", good, len(good) - 28)[0]]
    rng = np.random.default_rng(11)
    out = tmp_path / "out.mcap"
    recovered = 0
    for place in rng.integers(0, 8 * len(good), 60).tolist():
        bad = bytearray(good)
        bad[place // 8] ^= 1 << place % 8
        log_path.write_bytes(bad)
        out.unlink(missing_ok=True)
        try:
            report = recover(log_path, out)
        except LogError:
            continue
        recovered += 1
        with LogReader(out) as log:
            slots = log.read("/queue")["slot"].astype(int)
            assert report.num_slots == len(slots)
            assert report.losses or len(slots) == SLOTS
            for topic in log.topics:
                for name, array in log.read(topic).items():
                    expected = slots if name == "slot" else fields[name][slots]
                    assert array.tobytes() == expected.astype(array.dtype).tobytes(), name
            assert set(log.events()) <= set(events)
            assert metadata.items() <= log.metadata.items()
    assert recovered > 40
