"""What our reader returns, and everything it refuses to return."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer

from hiersched.log import Event, LogDims, LogError, LogReader, LogWriter, logfile, writer
from hiersched.log import container as container_module
from hiersched.log.schema import topics_in

SLOT_NS = 10_000_000
SLOTS = 100


def same_bits(a: Any, b: Any) -> bool:
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def read_everything(path: Path, **settings: Any) -> dict[str, Any]:
    with LogReader(path, **settings) as log:
        content: dict[str, Any] = {topic: log.read(topic) for topic in log.topics}
        content |= {"events": log.events(), "metadata": log.metadata, "files": log.attachments}
    return content


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
    )
    return path


@pytest.mark.parametrize("verify", ["file", "chunks"])
def test_every_bit_comes_back(
    log_path: Path, random_fields: Any, verify: str, model_dims: LogDims
) -> None:
    fields = random_fields(SLOTS, dims=model_dims)
    content = read_everything(log_path, verify=verify)
    models = {}
    if "/models" in content:
        models = {"num_model_values": "8", "model_fields": content["metadata"]["model_fields"]}
    for name, topic in topics_in("full", len(models)).items():
        assert list(content[name]) == ["slot", *(field.name for field in topic.fields_in("full"))]
        assert content[name]["slot"].tolist() == list(range(SLOTS))
        for field in topic.fields_in("full"):
            assert same_bits(content[name][field.name], fields[field.name])
    assert content["metadata"] == {
        "scenario": "test", "seed": "1", "policy": "pf", "schema_version": "1", "profile": "full",
        "num_urllc": "3", "num_embb": "2", "num_prb": "7", "slot_ns": str(SLOT_NS),
        "topics_crc32": content["metadata"]["topics_crc32"],
        "num_states": "5", "num_inputs": "2", "num_normals": "5", **models,
    }  # fmt: skip
    assert set(content["files"]) == {"scenario.yaml", "policy.pt", "hiersched.proto"}
    assert content["files"]["scenario.yaml"] == b"name: test\n"
    assert content["events"] == [
        Event(0, "INFO", "run", "starts"),
        Event(41, "ERROR", "network", "deadline violated"),
        Event(70, "WARNING", "control", "gain for T = 12 infeasible: α² ≥ 1"),
        Event(70, "DEBUG", "control", "second of its slot"),
    ]


@pytest.mark.parametrize("span", [(0, 100), (13, 14), (37, 63), (99, 500), (0, 0), (200, 300)])
def test_span_of_slots_and_choice_of_fields(
    log_path: Path, random_fields: Any, span: tuple[int, int]
) -> None:
    fields = random_fields(SLOTS)
    with LogReader(log_path) as log:
        part = log.read("/queue", ["service_packets"], *span)
        assert list(part) == ["slot", "service_packets"]
        assert part["slot"].tolist() == list(range(SLOTS))[slice(*span)]
        assert same_bits(part["service_packets"], fields["service_packets"][slice(*span)])
        with pytest.raises(ValueError, match="slots 5 to 4"):
            log.read("/queue", None, 5, 4)


def test_compact_log_has_no_world(tmp_path: Path, random_fields: Any, write_log: Any) -> None:
    path = write_log(tmp_path / "a.mcap", random_fields(SLOTS), profile="compact")
    with LogReader(path) as log:
        assert log.topics == ("/channel", "/allocation", "/queue", "/delay", "/robots")
        assert log.profile == "compact"
        channel = log.read("/channel")
        assert list(channel) == ["slot", "mean_fading_power"]
        assert same_bits(channel["mean_fading_power"], random_fields(SLOTS)["mean_fading_power"])
        with pytest.raises(LogError, match=r"no topic '/world' .* profile compact"):
            log.read("/world")
        with pytest.raises(LogError, match=r"no field fading_power .*; allowed: mean_fading_power"):
            log.read("/channel", ["fading_power"])


def test_log_without_slots(tmp_path: Path, dims: LogDims) -> None:
    with LogWriter(tmp_path / "a.mcap", dims, slot_ns=SLOT_NS):
        pass
    with LogReader(tmp_path / "a.mcap") as log:
        assert log.num_slots == 0
        assert log.events() == []
        assert log.read("/robots")["slot"].shape == (0,)
        assert log.fields("/robots") == ()
        with pytest.raises(LogError, match="/robots has no field state"):
            log.read("/robots", ["state"])


def test_reading_a_topic_touches_its_chunks_alone(
    tmp_path: Path, random_fields: Any, write_log: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_log(tmp_path / "a.mcap", random_fields(2000), compression="none")
    size = path.stat().st_size
    read = 0
    original = logfile.LogFile.read

    def counting(self: Any, offset: int, length: int) -> bytes:
        nonlocal read
        read += length
        return original(self, offset, length)

    monkeypatch.setattr(logfile.LogFile, "read", counting)
    with LogReader(path, verify="chunks") as log:
        opened = read
        slots = len(log.read("/queue")["slot"])
    assert opened < 0.2 * size
    assert slots == 2000
    assert read - opened < 0.15 * size


@pytest.mark.parametrize("verify", ["file", "chunks"])
def test_no_flipped_bit_goes_unnoticed(log_path: Path, verify: str) -> None:
    """Nothing wrong is ever returned; and with all bytes verified, every flip is an error."""
    good = log_path.read_bytes()
    truth = repr_of(read_everything(log_path))
    rng = np.random.default_rng(7)
    places = rng.integers(0, 8 * len(good), 1000 if verify == "file" else 200).tolist()
    # The preamble, the summary, the footer and the end are small: flip there on purpose too.
    (summary,) = struct.unpack_from("<Q", good, len(good) - 28)
    small = [(0, 300), (summary - 13, summary), (summary, len(good)), (len(good) - 37, len(good))]
    for low, high in small:
        places += rng.integers(8 * low, 8 * high, 60).tolist()
    silent = 0
    for place in places:
        bad = bytearray(good)
        bad[place // 8] ^= 1 << place % 8
        log_path.write_bytes(bad)
        content = read_or_none(log_path, verify)
        if content is not None:
            silent += 1
            assert repr_of(content) == truth
    # Without a pass over all bytes, damage to bytes that nobody read does no harm.
    assert silent == 0 if verify == "file" else silent < 0.3 * len(places)


def read_or_none(path: Path, verify: str) -> dict[str, Any] | None:
    """Content of a log, None if it is refused; any error but LogError passes through."""
    try:
        return read_everything(path, verify=verify)
    except LogError:
        return None


def repr_of(content: dict[str, Any]) -> list[Any]:
    """Bytes of arrays, so that NaNs compare equal."""
    return [
        {name: array.tobytes() for name, array in value.items()} if key.startswith("/") else value
        for key, value in content.items()
    ]


def test_every_truncation_is_noticed(log_path: Path) -> None:
    good = log_path.read_bytes()
    rng = np.random.default_rng(8)
    lengths = [0, 1, 7, 8, 9, 50, len(good) - 1, len(good) - 8, len(good) - 9, len(good) - 37]
    for length in lengths + rng.integers(0, len(good), 100).tolist():
        log_path.write_bytes(good[:length])
        what = "empty" if length == 0 else "truncated"
        with pytest.raises(LogError, match=what) as caught:
            LogReader(log_path)
        assert caught.value.offset == length


def test_bytes_added_or_lost_in_the_middle_are_noticed(log_path: Path) -> None:
    good = log_path.read_bytes()
    middle = len(good) // 2
    cases = [
        good + b"\0",
        good + good,
        good[:middle] + good[middle + 1 :],
        good[:middle] + b"x" + good[middle:],
        good[: middle - 999] + good[middle + 999 :],
    ]
    for bad in cases:
        log_path.write_bytes(bad)
        with pytest.raises(LogError):
            read_everything(log_path)


def test_part_of_a_killed_run_is_refused(tmp_path: Path, random_fields: Any, dims: LogDims) -> None:
    log = LogWriter(tmp_path / "a.mcap", dims, slot_ns=SLOT_NS)
    log.write_block(0, random_fields(40))
    log.abort()
    with pytest.raises(LogError, match="truncated"):
        LogReader(tmp_path / "a.mcap.part")


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"slot,delay\n" * 100)
    with pytest.raises(LogError, match="not an MCAP file") as caught:
        LogReader(path)
    assert str(caught.value) == f"{path}: at byte 0: this is not an MCAP file"
    with path.open("wb") as stream:
        foreign = Writer(stream)
        foreign.start(library="python mcap 1.0")
        channel = foreign.register_channel("/queue", "json", 0)
        foreign.add_message(channel, 0, b"{}", 0)
        foreign.finish()
    with pytest.raises(LogError, match=r"by 'python mcap 1\.0', not a log"):
        LogReader(path)
    with pytest.raises(FileNotFoundError):
        LogReader(tmp_path / "none.mcap")


def test_impostors_are_refused(tmp_path: Path) -> None:
    """Another writer under our name: whatever is missing or odd, it is a LogError."""
    path = tmp_path / "a.mcap"
    for metadata in (None, {}, {"schema_version": "1", "slot_ns": "x"}):
        with path.open("wb") as stream:
            foreign = Writer(stream, enable_data_crcs=True)
            foreign.start(library="hiersched-log/1")
            if metadata is not None:
                foreign.add_metadata("hiersched", metadata)
            foreign.register_channel("/queue", "json", 0)
            foreign.finish()
        with pytest.raises(LogError):
            LogReader(path)


QUEUE_BYTES = 31 + 9 + (2 + 40) + 2 * (2 + 20) + 2 * (2 + 40)  # of a message of five users


@pytest.mark.parametrize(
    ("place", "bits", "what"),
    [
        (0, 1, "opcode 4, channel 4"),
        (1, 1, "cannot be read"),  # length
        (9, 2, "opcode 5, channel 6"),
        (31, 0x60, "field 13 is not in the schema"),
        (31, 4, "slot has wire type 5"),
        (40, 3, "backlog_packets has wire type 1"),
        (40, 0x1B, "field 1 is not in the schema, or there twice"),
        (41, 1, "cannot be read"),  # length of a field
        (QUEUE_BYTES + 31, 0x10, r"do not follow the schema \(slot:tag\)"),
        (QUEUE_BYTES + 9, 0x10, r"do not follow the schema \(header:channel_id\)"),
    ],
)
def test_messages_that_do_not_follow_the_schema_are_refused(
    place: int,
    bits: int,
    what: str,
    tmp_path: Path,
    random_fields: Any,
    write_log: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All checksums are right, but a byte of the first message, or the second, is not."""
    original = container_module.Container.add_chunk

    def bend(self: Any, channel_id: int, data: Any, *rest: Any, **settings: Any) -> None:
        changed = bytearray(data)
        if channel_id == 4:
            changed[place] ^= bits
        original(self, channel_id, bytes(changed), *rest, **settings)

    monkeypatch.setattr(container_module.Container, "add_chunk", bend)
    path = write_log(tmp_path / "a.mcap", random_fields(3))
    with LogReader(path) as log:
        log.read("/robots")
        with pytest.raises(LogError, match=f"/queue .*{what}"):
            log.read("/queue")


@pytest.mark.parametrize(
    "changes",
    [
        {"slot_ns": "ten"},
        {"slot_ns": "0"},
        {"num_prb": "-1"},
        {"profile": None},
        {"schema_version": ""},
        {"num_urllc": None},
        {"num_model_values": "-1"},
        {"num_model_values": "8"},
    ],
)
def test_metadata_that_make_no_sense_are_refused(
    changes: dict[str, str | None],
    tmp_path: Path,
    random_fields: Any,
    write_log: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All checksums are right."""
    original = writer._full_metadata

    def bent(*arguments: Any) -> dict[str, str]:
        metadata = {**original(*arguments), **changes}
        return {key: value for key, value in metadata.items() if value is not None}

    monkeypatch.setattr(writer, "_full_metadata", bent)
    path = write_log(tmp_path / "a.mcap", random_fields(3))
    with pytest.raises(LogError):
        LogReader(path)


@pytest.mark.parametrize("place", [0, 1, 31])
def test_events_that_make_no_sense_are_refused(
    place: int, tmp_path: Path, dims: LogDims, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All checksums are right, but an opcode, a length or a tag is not."""
    original = writer.encode_event

    def bent(*arguments: Any) -> bytes:
        record = bytearray(original(*arguments))
        record[place] ^= 0x07
        return bytes(record)

    monkeypatch.setattr(writer, "encode_event", bent)
    with LogWriter(tmp_path / "a.mcap", dims, slot_ns=SLOT_NS) as log:
        log.event(3, "INFO", "run", "text")
    with LogReader(tmp_path / "a.mcap") as reader, pytest.raises(LogError, match="event"):
        reader.events()


def test_attachment_has_a_checksum_of_its_own(log_path: Path) -> None:
    data = bytearray(log_path.read_bytes())
    data[data.index(b"name: test") + 3] ^= 1
    log_path.write_bytes(data)
    with pytest.raises(LogError, match="data section does not match its checksum"):
        LogReader(log_path)
    with (
        LogReader(log_path, verify="chunks") as log,
        pytest.raises(LogError, match="Attachment does not match its checksum"),
    ):
        _ = log.attachments


def test_checksums_that_are_absent_are_not_trusted(log_path: Path) -> None:
    """MCAP says 0 for an unknown checksum; a log always has them."""
    good = log_path.read_bytes()
    (summary,) = struct.unpack_from("<Q", good, len(good) - 28)
    bad = bytearray(good)
    bad[summary - 4 : summary] = bytes(4)
    log_path.write_bytes(bad)
    with pytest.raises(LogError, match="data section"):
        LogReader(log_path)
    bad = bytearray(good)
    bad[-12:-8] = bytes(4)
    log_path.write_bytes(bad)
    with pytest.raises(LogError, match="summary"):
        LogReader(log_path)


def test_arguments_are_checked(log_path: Path) -> None:
    with pytest.raises(ValueError, match="verify is 'all'; allowed: file, chunks"):
        LogReader(log_path, verify="all")  # type: ignore[arg-type]
    with LogReader(log_path) as log, pytest.raises(LogError, match="no topic '/radio'"):
        log.read("/radio")
