"""Logs of other versions: they open by their own schema, and say what they have and lack.

`data/release_0.1.mcap` is by release 0.1 (profile compact, which had more fields then), and
`data/before_the_table.mcap` by the last version whose schema was a file of its own.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from hiersched.cli import main
from hiersched.core.fields import Field
from hiersched.log import LogError, LogReader, log_digest, recover, schema, topic_frame, writer

DATA = Path(__file__).with_name("data")
OLD = {
    "release_0.1.mcap": "6cc42304d2e36622e287a57f2909ed3d148ea3173859278863e4ae0dc5097f9e",
    "before_the_table.mcap": "5f5758502c972f277eaff151d2aa3c0b80d3a27a931d15596fb266d0aceb9371",
}
"""File -> digest, by the code that wrote it."""
SLOTS = 40

TORQUE = Field("/robots", "torque_nm", "<f4", ("R", 2), "N m", "of both wheels", ("full",))
BUSY = Field("/queue", "busy", "<u4", (), "1", "whether anybody waits", ("full", "compact"))
HARQ = Field("/harq", "failed_blocks", "<u4", ("U",), "1", "blocks that failed", ("full",))


def by_the_stock_reader(path: Path) -> dict[tuple[str, str], np.ndarray]:
    """Topic and field -> values (T, n)."""
    found: dict[tuple[str, str], list[Any]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            if channel.topic != "/events":
                for field, value in message.ListFields():
                    found.setdefault((channel.topic, field.name), []).append(value)
    return {key: np.array(values).reshape(len(values), -1) for key, values in found.items()}


@pytest.mark.parametrize("name", OLD)
def test_old_logs_are_read_to_the_last_bit(name: str) -> None:
    stock = by_the_stock_reader(DATA / name)
    with LogReader(DATA / name) as log:
        seen = 0
        for topic in log.topics:
            for field, values in log.read(topic).items():
                assert values.shape[0] == log.num_slots == 12
                expected = stock.get((topic, field), np.zeros(1))  # zeros alone are no message
                if len(expected) == 12:
                    seen += 1
                    flat = values.reshape(12, -1)
                    assert flat.tobytes() == expected.astype(values.dtype).tobytes(), field
        assert seen > 20
        assert log.read("/robots", ["tracking_error_m"])["tracking_error_m"].shape == (12, 2)
    assert log_digest(DATA / name) == OLD[name]


def test_a_small_log_of_release_0_1_has_what_small_logs_had_then() -> None:
    with LogReader(DATA / "release_0.1.mcap") as log:
        assert log.profile == "compact"
        assert {"state", "control"} <= set(log.fields("/robots"))
        assert log.read("/robots")["state"].shape == (12, 2, 5)
        assert "num_states" not in log.metadata
        assert log.dims.num_states == 5


@pytest.mark.parametrize("name", OLD)
def test_commands_take_old_logs(name: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = tmp_path / name
    path.write_bytes((DATA / name).read_bytes())
    assert main(["info", str(path)]) == 0
    assert main(["digest", str(path)]) == 0
    assert main(["compare", str(path), str(path)]) == 0
    assert main(["export", str(path), "--csv", "--out", str(tmp_path / "out")]) == 0
    assert main(["export", str(path), "--viewer", "--out", str(tmp_path / "out")]) == 0
    assert main(["recover", str(path)]) == 0
    out = capsys.readouterr().out
    assert "schema      version 1, profile " in out
    assert f"{OLD[name]}  {path}\n" in out
    assert "the logs say the same, bit for bit" in out
    recovered = path.with_name(f"{path.stem}.recovered.mcap")
    assert log_digest(recovered) == OLD[name]
    with LogReader(recovered) as log, LogReader(path) as original:
        assert log.attachments == original.attachments


@pytest.fixture
def newer(tmp_path: Path, random_fields: Any, write_log: Any, other_table: Any) -> Path:
    """A log of a version with two more fields, amid the others, and one topic more."""
    fields = random_fields(SLOTS)
    rng = np.random.default_rng(1)
    fields["torque_nm"] = rng.normal(size=(SLOTS, 3, 2)).astype(np.float32)
    fields["busy"] = rng.integers(0, 2, SLOTS, np.uint32)
    fields["failed_blocks"] = rng.integers(0, 9, (SLOTS, 5), np.uint32)
    with other_table(lambda table: [BUSY, TORQUE, *table, HARQ]):
        return write_log(tmp_path / "newer.mcap", fields)


def test_a_field_more_locks_nobody_out(newer: Path, random_fields: Any) -> None:
    fields, stock = random_fields(SLOTS), by_the_stock_reader(newer)
    with LogReader(newer) as log:
        assert log.metadata["schema_version"] == "7"
        assert log.unknown_fields == ("/queue busy", "/robots torque_nm", "/harq failed_blocks")
        assert log.missing_fields == ()
        for topic in log.topics:
            for name, values in log.read(topic, log.known_fields(topic)).items():
                if name != "slot":
                    assert values.shape == fields[name].shape
                    assert values.tobytes() == fields[name].tobytes(), name
        torque = log.read("/robots", ["torque_nm"])["torque_nm"]
        assert (torque.shape, torque.dtype) == ((SLOTS, 6), np.float32)
        assert (torque == stock["/robots", "torque_nm"]).all()
        assert log.read("/queue", ["busy"], 3, 9)["busy"].shape == (6,)
        assert log.read("/harq")["failed_blocks"].shape == (SLOTS, 5)
        with pytest.raises(LogError, match=r"newer.mcap.*/robots has no field jerk .*torque_nm"):
            log.read("/robots", ["jerk"])


def test_commands_take_unknown_fields(newer: Path, capsys: pytest.CaptureFixture) -> None:
    out = newer.with_name("out")
    assert main(["export", str(newer), "--csv", "--out", str(out)]) == 0
    header = pd.read_csv(out / "robots.csv").columns
    assert {"torque_nm[0]", "torque_nm[5]", "state[2,4]"} <= set(header)
    assert len(pd.read_csv(out / "harq.csv")) == SLOTS
    with LogReader(newer) as log:
        table = topic_frame(log, "/queue", ["busy"])
        assert list(table.columns) == ["slot", "time_s", "busy"]
    capsys.readouterr()
    assert main(["info", str(newer)]) == 0
    text = capsys.readouterr().out
    assert "schema      version 7, profile full" in text
    assert (
        "fields      not known to this hiersched, read as the log describes them: "
        "/queue busy, /robots torque_nm, /harq failed_blocks\n"
    ) in text


def test_recovered_logs_keep_the_schema_of_their_source(newer: Path) -> None:
    data = newer.read_bytes()
    newer.write_bytes(data[:-100])
    report = recover(newer)
    assert report.num_slots == SLOTS
    newer.write_bytes(data)
    assert log_digest(report.path) == log_digest(newer)
    with LogReader(report.path) as log, LogReader(newer) as original:
        assert log.library == "hiersched-log/7"
        assert log.attachments == original.attachments
        assert log.metadata.items() >= original.metadata.items()
        assert log.unknown_fields == original.unknown_fields


def test_lacking_fields_and_topics_are_named(
    tmp_path: Path, random_fields: Any, write_log: Any, other_table: Any,
    capsys: pytest.CaptureFixture,
) -> None:  # fmt: skip
    gone = ("state", "busy", "arrival_uniform", "robot_normal")
    fields = random_fields(SLOTS)
    with other_table(lambda table: [f for f in table if f.name not in gone], version=2):
        kept = {name: values for name, values in fields.items() if name not in gone}
        path = write_log(tmp_path / "older.mcap", kept)
    with LogReader(path) as log:
        assert log.unknown_fields == ()
        assert log.missing_fields == (
            "/world arrival_uniform", "/world robot_normal", "/robots state",
        )  # fmt: skip
        assert log.read("/robots")["control"].tobytes() == fields["control"].tobytes()
        with pytest.raises(LogError, match=r"older.mcap.*/robots has no field state in this log"):
            log.read("/robots", ["state"])
        with pytest.raises(LogError, match="no topic '/world' in this log of profile full, schema"):
            log.read("/world")
    assert main(["info", str(path)]) == 0
    assert (
        "fields      not in the log, which is of another version: "
        "/world arrival_uniform, /world robot_normal, /robots state\n"
    ) in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "shape", "dtype"),
    [
        ({"shape": ("R", 6)}, (SLOTS, 18), "<f8"),
        ({"dtype": "<f4"}, (SLOTS, 15), "<f4"),
        ({"shape": ()}, (SLOTS,), "<f8"),
    ],
)
def test_a_field_of_another_size_or_type_is_another_field(
    change: dict[str, Any], shape: tuple[int, ...], dtype: str, tmp_path: Path, random_fields: Any,
    write_log: Any, other_table: Any,
) -> None:  # fmt: skip
    fields = random_fields(SLOTS)
    own = {"dtype": dtype, "shape": (SLOTS, 3, shape[1] // 3) if len(shape) > 1 else shape}
    fields["state"] = np.arange(np.prod(own["shape"]), dtype=dtype).reshape(own["shape"])
    with other_table(
        lambda table: [replace(f, **change) if f.name == "state" else f for f in table]
    ):
        path = write_log(tmp_path / "a.mcap", fields)
    with LogReader(path) as log:
        assert log.unknown_fields == ("/robots state",)
        assert log.missing_fields == ()
        state = log.read("/robots")["state"]
        assert (state.shape, state.dtype.str) == (shape, dtype)
        assert state.tobytes() == fields["state"].tobytes()


@pytest.fixture
def described(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes the writer describe `/queue` otherwise than it is written."""
    original = writer._own_schemas

    def describe(descriptors: bytes) -> None:
        def lying(*arguments: Any) -> dict[str, Any]:
            schemas = original(*arguments)
            return {**schemas, "/queue": replace(schemas["/queue"], descriptors=descriptors)}

        monkeypatch.setattr(writer, "_own_schemas", lying)

    return describe


def test_fields_without_a_fixed_size_are_named(
    tmp_path: Path, random_fields: Any, write_log: Any, described: Any
) -> None:
    files = FileDescriptorSet.FromString(schema.descriptors())
    (queue,) = [m for m in files.file[0].message_type if m.name == "Queue"]
    queue.field[1].type = FieldDescriptorProto.TYPE_UINT32  # a varint
    described(files.SerializeToString())
    with LogReader(write_log(tmp_path / "a.mcap", random_fields(3))) as log:
        log.read("/robots")
        with pytest.raises(LogError, match="backlog_packets is of TYPE_UINT32, which has no fixed"):
            log.read("/queue")


@pytest.mark.parametrize("descriptors", [b"", b"text", schema.event_descriptors()])
def test_schemas_that_describe_nothing_are_refused(
    descriptors: bytes, tmp_path: Path, random_fields: Any, write_log: Any, described: Any
) -> None:
    described(descriptors)
    path = write_log(tmp_path / "a.mcap", random_fields(3))
    with pytest.raises(LogError, match="the schemas cannot be read"):
        LogReader(path)
