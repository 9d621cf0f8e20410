"""The files as stock readers see them, and what the writer refuses."""

from __future__ import annotations

import contextlib
import struct
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pool
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message_factory import GetMessageClass
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader, SeekingReader, make_reader
from mcap.records import Chunk, Message, MessageIndex
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap_protobuf.decoder import DecoderFactory

from hiersched.log import TOPICS, LogDims, LogReader, LogWriter
from hiersched.log.container import MAGIC
from hiersched.log.schema import descriptors, topics_in

SLOT_NS = 10_000_000
SLOTS = 100


def same_bits(a: Any, b: Any) -> bool:
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


@pytest.fixture(params=["zstd", "none"])
def compression(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_stock_reader_returns_every_bit(
    tmp_path: Path, random_fields: Any, write_log: Any, compression: str
) -> None:
    # Infinities, denormals and -0.0, but no NaN: protobuf hands out doubles, which quiets some.
    fields = {
        name: np.where(np.isnan(values), -values.dtype.type(0), values)
        for name, values in random_fields(SLOTS).items()
    }
    path = write_log(tmp_path / "a.mcap", fields, compression=compression)
    seen = defaultdict(list)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            if channel.topic == "/events":
                continue
            slot = message.sequence
            assert message.log_time == message.publish_time == slot * SLOT_NS
            assert decoded.slot == slot
            seen[channel.topic].append(slot)
            for field in TOPICS[channel.topic].fields_in("full"):
                value = np.array(getattr(decoded, field.name), field.dtype)
                expected = fields[field.name][slot]
                assert same_bits(value.reshape(expected.shape), expected), field
    assert seen == {topic: list(range(SLOTS)) for topic in topics_in("full")}


def test_messages_decode_with_plain_protobuf(
    tmp_path: Path, random_fields: Any, write_log: Any
) -> None:
    """Cut messages out of an uncompressed file by hand and parse them with google.protobuf."""
    fields = random_fields(SLOTS)
    data = write_log(tmp_path / "a.mcap", fields, compression="none").read_bytes()
    pool = descriptor_pool.DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptors()).file:
        pool.Add(file)
    robots = GetMessageClass(pool.FindMessageTypeByName("hiersched.Robots"))
    slot = 77
    time = struct.pack("<QQ", slot * SLOT_NS, slot * SLOT_NS)
    found = 0
    position = data.find(time)
    while position >= 0:
        start = position - 15  # opcode 1, length 8, channel id 2, sequence 4
        opcode, length, channel, sequence = struct.unpack_from("<BQHI", data, start)
        if (opcode, channel, sequence) == (5, 6, slot):
            payload = data[start + 31 : start + 9 + length]
            message = robots.FromString(payload)
            # A proto3 parser keeps everything: parsed and serialised, the same bytes come out
            # (none of these scalars is zero).
            assert message.SerializeToString(deterministic=True) == payload
            assert message.slot == slot
            assert same_bits(np.reshape(message.state, (3, 5)), fields["state"][slot])
            assert list(message.delay_steps) == fields["delay_steps"][slot].tolist()
            found += 1
        position = data.find(time, position + 1)
    assert found == 1


def test_seeking_by_topic_and_time(
    tmp_path: Path, random_fields: Any, write_log: Any, compression: str
) -> None:
    path = write_log(tmp_path / "a.mcap", random_fields(SLOTS), compression=compression)
    with path.open("rb") as stream:
        reader = SeekingReader(stream, validate_crcs=True)
        for topics in (["/queue"], ["/robots", "/world"]):
            got = [
                (channel.topic, message.sequence)
                for _, channel, message in reader.iter_messages(
                    topics, starting_at=37 * SLOT_NS, ending_before=63 * SLOT_NS
                )
            ]
            assert sorted(got) == sorted((t, s) for t in topics for s in range(37, 63))
            assert [slot for _, slot in got] == sorted(slot for _, slot in got)
        backwards = [m.sequence for *_, m in reader.iter_messages(["/delay"], reverse=True)]
        assert backwards == list(range(SLOTS))[::-1]


def test_indexes_and_statistics_agree_with_a_walk_through_the_file(
    tmp_path: Path, random_fields: Any, write_log: Any, compression: str
) -> None:
    path = write_log(tmp_path / "a.mcap", random_fields(SLOTS), compression=compression)
    with path.open("rb") as stream:
        records = list(StreamReader(stream, emit_chunks=True, validate_crcs=True).records)
        stream.seek(0)
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    chunks = [r for r in records if isinstance(r, Chunk)]
    indexes = [r for r in records if isinstance(r, MessageIndex)]
    assert len(chunks) == len(indexes) == len(summary.chunk_indexes) > 2 * len(topics_in("full"))
    counts: dict[int, int] = defaultdict(int)
    data = path.read_bytes()
    for chunk, index, entry in zip(chunks, indexes, summary.chunk_indexes, strict=True):
        messages = [r for r in breakup_chunk(chunk, validate_crc=True) if isinstance(r, Message)]
        assert {m.channel_id for m in messages} == {index.channel_id}  # grouped by topic
        counts[index.channel_id] += len(messages)
        position, expected = 0, []
        for message in messages:
            expected.append((message.log_time, position))
            position += 31 + len(message.data)
        assert index.records == expected
        assert position == chunk.uncompressed_size == entry.uncompressed_size
        times = [message.log_time for message in messages]
        assert (min(times), max(times)) == (chunk.message_start_time, chunk.message_end_time)
        assert (min(times), max(times)) == (entry.message_start_time, entry.message_end_time)
        assert (
            entry.chunk_length
            == 9 + struct.unpack_from("<Q", data, entry.chunk_start_offset + 1)[0]
        )
        assert data[entry.chunk_start_offset] == 6
        (offset,) = entry.message_index_offsets.values()
        assert data[offset] == 7
        assert offset == entry.chunk_start_offset + entry.chunk_length
        assert entry.message_index_length == 9 + struct.unpack_from("<Q", data, offset + 1)[0]
    statistics = summary.statistics
    assert statistics.channel_message_counts == counts
    assert statistics.message_count == sum(counts.values()) == SLOTS * len(topics_in("full")) + 4
    assert (statistics.message_start_time, statistics.message_end_time) == (0, 99 * SLOT_NS)
    assert (statistics.attachment_count, statistics.metadata_count) == (3, 1)


def test_stock_reader_sees_preamble_and_events(
    tmp_path: Path, random_fields: Any, write_log: Any
) -> None:
    path = write_log(tmp_path / "a.mcap", random_fields(SLOTS))
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        assert (reader.get_header().profile, reader.get_header().library) == ("", "hiersched-log/1")
        (metadata,) = reader.iter_metadata()
        assert metadata.name == "hiersched"
        assert metadata.metadata["policy"] == "pf"
        assert metadata.metadata["slot_ns"] == str(SLOT_NS)
        attachments = {a.name: a.data for a in reader.iter_attachments()}
        assert set(attachments) == {"scenario.yaml", "policy.pt", "hiersched.proto"}
        assert attachments["policy.pt"] == bytes(range(256))
        events = [
            (m.sequence, e.timestamp.nanos, e.level, e.name, e.message)
            for _, _, m, e in reader.iter_decoded_messages("/events")
        ]
    assert events == [
        (0, 0, 2, "run", "starts"),
        (41, 410_000_000, 4, "network", "deadline violated"),
        (70, 700_000_000, 3, "control", "gain for T = 12 infeasible: α² ≥ 1"),
        (70, 700_000_000, 1, "control", "second of its slot"),
    ]


def test_bytes_depend_on_the_content_alone(
    tmp_path: Path, random_fields: Any, write_log: Any, compression: str
) -> None:
    fields = random_fields(SLOTS)
    first = write_log(tmp_path / "a.mcap", fields, compression=compression).read_bytes()
    for block in (1, 7, SLOTS):
        again = write_log(tmp_path / "b.mcap", fields, block=block, compression=compression)
        assert again.read_bytes() == first


def test_order_of_metadata_and_attachments_does_not_matter(tmp_path: Path, dims: LogDims) -> None:
    contents = []
    for step in (1, -1):
        given = dict([("b", "1"), ("a", "2")][::step])
        files = dict([("y", b"1"), ("x", b"2")][::step])
        with LogWriter(tmp_path / "a.mcap", dims, "full", given, files, slot_ns=1):
            pass
        contents.append((tmp_path / "a.mcap").read_bytes())
    assert contents[0] == contents[1]


def test_exception_leaves_no_finished_file(
    tmp_path: Path, random_fields: Any, dims: LogDims
) -> None:
    path = tmp_path / "a.mcap"

    def run_and_stop() -> None:
        with LogWriter(path, dims, slot_ns=SLOT_NS) as log:
            log.write_block(0, random_fields(40))
            log.event(3, "INFO", "run", "so far")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_and_stop()
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap.part"]
    part = tmp_path / "a.mcap.part"
    assert not part.read_bytes().endswith(MAGIC)
    with part.open("rb") as stream:  # and what was written by then can be got back
        slots = defaultdict(list)
        with contextlib.suppress(EndOfFile):
            for _, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=False):
                slots[channel.topic].append(message.sequence)
    assert slots == {**{topic: list(range(40)) for topic in topics_in("full")}, "/events": [3]}


def test_older_log_survives_a_run_that_fails(
    tmp_path: Path, random_fields: Any, write_log: Any, dims: LogDims
) -> None:
    path = write_log(tmp_path / "a.mcap", random_fields(10))
    before = path.read_bytes()
    with pytest.raises(RuntimeError), LogWriter(path, dims, slot_ns=SLOT_NS):
        raise RuntimeError
    assert path.read_bytes() == before


@pytest.mark.parametrize("cells", [LogDims(num_urllc=0, num_embb=2, num_prb=4),
                                   LogDims(num_urllc=1, num_embb=0, num_prb=1),
                                   LogDims(num_urllc=90, num_embb=40, num_prb=273)])  # fmt: skip
def test_other_dimensions(
    tmp_path: Path, random_fields: Any, write_log: Any, cells: LogDims
) -> None:
    fields = random_fields(5, dims=cells)
    path = write_log(tmp_path / "a.mcap", fields, dims=cells, chunk_bytes=1)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = [m for *_, m in reader.iter_decoded_messages("/queue")]
    assert [list(m.arrivals_packets) for m in decoded] == fields["arrivals_packets"].tolist()
    with LogReader(path) as log:
        assert log.dims == cells
        for topic in log.topics:
            for name, values in log.read(topic).items():
                assert name == "slot" or same_bits(values, fields[name])


def test_lossless_conversions_are_made(tmp_path: Path, random_fields: Any, dims: LogDims) -> None:
    fields = random_fields(4)
    fields["arrival_clamped"] = np.array([[True, False, True, True, False]] * 4)
    fields["num_prb"] = np.arange(20, dtype=np.uint8).reshape(4, 5)
    fields["rate_mbps"] = np.linspace(0, 1, 20, dtype=np.float32).reshape(4, 5)
    fields["fading_power"] = np.asfortranarray(fields["fading_power"])
    fields["state"] = fields["state"].astype(">f8")
    with LogWriter(tmp_path / "a.mcap", dims, slot_ns=SLOT_NS) as log:
        log.write_block(0, fields)
    with LogReader(tmp_path / "a.mcap") as reader:
        delay, allocation = reader.read("/delay"), reader.read("/allocation")
        assert (delay["arrival_clamped"] == fields["arrival_clamped"]).all()
        assert (allocation["num_prb"] == fields["num_prb"]).all()
        assert (allocation["rate_mbps"] == fields["rate_mbps"]).all()
        assert same_bits(reader.read("/channel")["fading_power"], fields["fading_power"])
        assert same_bits(reader.read("/robots")["state"], fields["state"].astype("<f8"))


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        ("fading_power", np.float64),
        ("prb_owner", np.int64),
        ("prb_owner", np.int32),
        ("due_packets", np.float64),
        ("rate_mbps", np.int64),
        ("rate_mbps", np.complex128),
        ("rate_mbps", object),
    ],
)
def test_lossy_types_are_refused(
    tmp_path: Path, random_fields: Any, dims: LogDims, name: str, dtype: Any
) -> None:
    fields = random_fields(4)
    fields[name] = np.zeros(fields[name].shape, dtype)
    with LogWriter(tmp_path / "a.mcap", dims, slot_ns=SLOT_NS) as log:
        with pytest.raises(TypeError, match=f"{name} has type .*; allowed: "):
            log.write_block(0, fields)
        log.write_block(0, random_fields(4))  # nothing of the refused block is in the file
    with LogReader(tmp_path / "a.mcap") as reader:
        assert reader.num_slots == 4


def test_wrong_shapes_and_names_are_refused(
    tmp_path: Path, random_fields: Any, dims: LogDims
) -> None:
    good = random_fields(4)
    without = {name: values for name, values in good.items() if name != "state"}
    cases: list[tuple[dict[str, Any], str]] = [
        (
            {**good, "state": good["state"][:3]},
            r"state has shape \(3, 3, 5\); allowed: \(4, 3, 5\)",
        ),
        ({**good, "fading_power": good["fading_power"][:, :, :6]}, r"allowed: \(4, 5, 7\)"),
        ({**good, "drift_embb": good["drift_embb"][:, None]}, r"drift_embb has shape \(4, 1\)"),
        ({**good, "constraint": 1.0}, r"constraint has shape \(\)"),
        (without, r"missing: \['state'\]"),
        ({**good, "speed": good["state"]}, r"unknown to the log: \['speed'\]"),
    ]
    with LogWriter(tmp_path / "a.mcap", dims, slot_ns=SLOT_NS) as log:
        for fields, message in cases:
            with pytest.raises(ValueError, match=message):
                log.write_block(0, fields)


def test_slots_run_forward(tmp_path: Path, random_fields: Any, dims: LogDims) -> None:
    with LogWriter(tmp_path / "a.mcap", dims, slot_ns=SLOT_NS) as log:
        log.write_block(5, random_fields(4))
        with pytest.raises(ValueError, match="allowed: 9 to"):
            log.write_block(8, random_fields(4))
        log.write_block(20, random_fields(4))  # a gap is no error
        log.write_block(24, random_fields(0))
        log.write_block((1 << 32) - 4, random_fields(4))
        with pytest.raises(ValueError, match="4294967295"):
            log.write_block(1 << 32, random_fields(1))
    with LogReader(tmp_path / "a.mcap") as reader:
        last = [(1 << 32) - 4 + i for i in range(4)]
        assert reader.read("/delay")["slot"].tolist() == [*range(5, 9), *range(20, 24), *last]


@pytest.mark.parametrize(
    "settings",
    [
        {"profile": "short"},
        {"compression": "lz4"},
        {"chunk_bytes": 0},
        {"slot_ns": 0},
        {"metadata": {"num_urllc": "4"}},
    ],
)
def test_settings_are_checked(tmp_path: Path, dims: LogDims, settings: dict[str, Any]) -> None:
    (name,) = settings
    with pytest.raises(ValueError, match="num_urllc" if name == "metadata" else name):
        LogWriter(tmp_path / "a.mcap", **{"dims": dims, "slot_ns": SLOT_NS, **settings})
    assert list(tmp_path.iterdir()) == []


def test_metadata_and_events_are_checked(tmp_path: Path, dims: LogDims) -> None:
    with pytest.raises(TypeError, match="seed is 3; allowed: a string"):
        LogWriter(tmp_path / "a.mcap", dims, metadata={"seed": 3}, slot_ns=1)  # type: ignore[dict-item]
    with LogWriter(tmp_path / "a.mcap", dims, slot_ns=1) as log:
        with pytest.raises(ValueError, match="level is 'LOUD'; allowed: UNKNOWN, DEBUG"):
            log.event(1, "LOUD", "run", "text")
        with pytest.raises(ValueError, match="slot is -1"):
            log.event(-1, "INFO", "run", "text")
    with pytest.raises(ValueError, match="closed"):
        log.event(1, "INFO", "run", "text")


def test_many_events_fill_several_chunks(tmp_path: Path, dims: LogDims) -> None:
    with LogWriter(tmp_path / "a.mcap", dims, slot_ns=SLOT_NS, chunk_bytes=500) as writer:
        for i in range(300):
            writer.event(299 - i, "INFO", "run", f"event {i}")
    with LogReader(tmp_path / "a.mcap") as log:
        events = log.events()
    assert [(e.slot, e.message) for e in events] == [(i, f"event {299 - i}") for i in range(300)]
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded = [(m, e.timestamp) for *_, m, e in reader.iter_decoded_messages("/events")]
    assert [m.log_time for m, _ in decoded] == [slot * SLOT_NS for slot in range(300)]
    assert all(m.log_time == t.seconds * 10**9 + t.nanos for m, t in decoded)
    assert decoded[250][1].seconds == 2
