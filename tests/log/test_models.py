"""The topic of what models add: there only where they add something, and by their names."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from hiersched.cli import main
from hiersched.core.fields import ModelField, fields_from_text, fields_to_text
from hiersched.log import LogDims, LogError, LogReader, LogWriter, log_digest, recover, topic_frame
from hiersched.replay.export import export_tables

SLOT_NS = 10_000_000
SLOTS = 100
FIELDS = (
    ModelField("radio.fading/coherence", "1", 0, 5),
    ModelField("plant/slip", "m/s", 5, 3),
)


@pytest.fixture
def fields(random_fields: Any, model_dims: LogDims) -> dict[str, Any]:
    return random_fields(SLOTS, dims=model_dims)


@pytest.fixture
def path(tmp_path: Path, fields: Any, write_log: Any, model_dims: LogDims) -> Path:
    return write_log(tmp_path / "a.mcap", fields, dims=model_dims)


def test_every_bit_comes_back_by_name(path: Path, fields: Any, model_dims: LogDims) -> None:
    values = fields["model_values"]
    with LogReader(path) as log:
        assert log.dims == model_dims
        assert log.model_fields == FIELDS
        assert log.read("/models")["model_values"].tobytes() == values.tobytes()
        read = log.read_models()
        assert list(read) == ["slot", "radio.fading/coherence", "plant/slip"]
        assert read["slot"].tolist() == list(range(SLOTS))
        assert read["radio.fading/coherence"].tobytes() == values[:, :5].tobytes()
        assert read["plant/slip"].tobytes() == values[:, 5:].tobytes()
        some = log.read_models("plant/slip", 7, 31)
        assert list(some) == ["slot", "plant/slip"]
        assert some["plant/slip"].tobytes() == values[7:31, 5:].tobytes()
        with pytest.raises(LogError, match=r"no field speed .*allowed: radio\.fading/coherence, "):
            log.read_models(["speed"])


def test_stock_reader_returns_every_bit(tmp_path: Path, write_log: Any, fields: Any,
                                        model_dims: LogDims) -> None:  # fmt: skip
    values = fields["model_values"] = np.random.default_rng(1).normal(size=(SLOTS, 8))
    path = write_log(tmp_path / "b.mcap", fields, dims=model_dims)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        messages = [m for *_, m in reader.iter_decoded_messages("/models")]
        (named,) = [m.metadata for m in reader.iter_metadata()]
    assert [m.slot for m in messages] == list(range(SLOTS))
    assert np.array([list(m.model_values) for m in messages]).tobytes() == values.tobytes()
    assert json.loads(named["model_fields"])[1] == {
        "name": "plant/slip", "unit": "m/s", "start": 5, "count": 3,
    }  # fmt: skip


def test_tables_have_their_names(path: Path, fields: Any, tmp_path: Path) -> None:
    names = [*[f"radio.fading/coherence[{i}]" for i in range(5)],
             *[f"plant/slip[{i}]" for i in range(3)]]  # fmt: skip
    with LogReader(path) as log:
        table = topic_frame(log, "/models", None, 0.07, 0.3)
        assert list(table.columns) == ["slot", "time_s", *names]
        assert table["slot"].tolist() == list(range(7, 30))
        for column, name in zip(fields["model_values"][7:30].T, names, strict=True):
            assert table[name].to_numpy().tobytes() == column.tobytes()
        assert list(topic_frame(log, "/models", ["plant/slip"]).columns[2:]) == names[5:]
    (file,) = export_tables(path, tmp_path, "csv", ["/models"])
    assert file.name == "models.csv"
    header = file.read_text().splitlines()[0]
    assert header == ",".join(["slot", "time_s", *names])


def test_parquet_has_their_names(path: Path, fields: Any, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    (file,) = export_tables(path, tmp_path, "parquet", ["/models"])
    column = parquet.read_table(file)["plant/slip[2]"].to_numpy()
    assert column.tobytes() == fields["model_values"][:, 7].tobytes()


def test_info_names_them(tmp_path: Path, fields: Any, write_log: Any, model_dims: LogDims,
                         capsys: pytest.CaptureFixture) -> None:  # fmt: skip
    zeros = {name: np.zeros_like(values) for name, values in fields.items()}
    path = write_log(tmp_path / "a.mcap", zeros, dims=model_dims)
    assert main(["info", str(path)]) == 0
    out = capsys.readouterr().out
    assert "models      radio.fading/coherence [1] (5), plant/slip [m/s] (3)\n" in out
    assert f"/models{SLOTS:>16}" in out


def test_a_damaged_message_is_noticed_and_left_out(path: Path, fields: Any) -> None:
    data = bytearray(path.read_bytes())
    with LogReader(path) as log:
        chunk = log._file.topics["/models"].chunks[0]
    data[chunk.chunk_start_offset + chunk.chunk_length - 9] ^= 1
    path.write_bytes(data)
    with pytest.raises(LogError):
        LogReader(path)
    with LogReader(path, verify="chunks") as log, pytest.raises(LogError, match=r"checksum|read"):
        log.read_models()
    report = recover(path)
    assert any("/models" in loss for loss in report.losses)
    with LogReader(report.path) as log:
        assert log.model_fields == FIELDS
        read = log.read("/models")
        assert 0 < len(read["slot"]) < SLOTS
        whole = fields["model_values"][read["slot"].astype(int)]
        assert read["model_values"].tobytes() == whole.tobytes()


def test_digest_covers_them(path: Path, tmp_path: Path, fields: Any, write_log: Any,
                            model_dims: LogDims) -> None:  # fmt: skip
    bits = fields["model_values"].copy()
    bits.view(np.uint64)[41, 6] ^= 1
    other = write_log(tmp_path / "b.mcap", {**fields, "model_values": bits}, dims=model_dims)
    assert log_digest(other) != log_digest(path)


@pytest.mark.parametrize("profile", ["decisions", "robots"])
def test_small_profiles_know_of_them_but_leave_them_out(
    profile: str, tmp_path: Path, fields: Any, write_log: Any, model_dims: LogDims
) -> None:
    names = ("backlog", "due", "late")
    for name in (f"{n}_{part}_packets" for n in names for part in ("urllc", "embb")):
        fields[name] = np.zeros(SLOTS, "<f8" if "backlog" in name else "<u4")
    path = write_log(tmp_path / "b.mcap", fields, dims=model_dims, profile=profile)
    with LogReader(path) as log:
        assert log.model_fields == FIELDS
        assert "/models" not in log.topics
        with pytest.raises(LogError, match=f"no topic '/models' in this log of profile {profile}"):
            log.read_models()


def test_logs_without_such_models_say_nothing_of_them(
    tmp_path: Path, fields: Any, write_log: Any, dims: LogDims
) -> None:
    """Fields of no width are taken, as the simulator hands them out."""
    given = {**fields, "model_values": np.zeros((SLOTS, 0))}
    with LogReader(write_log(tmp_path / "b.mcap", given)) as log:
        assert log.dims == dims
        assert "/models" not in log.topics
        assert log.model_fields == ()
        assert not any("model" in key for key in log.metadata)


WRONG = {
    "another number": replace(FIELDS[1], count=4),
    "a gap": replace(FIELDS[1], start=6),
    "an overlap": replace(FIELDS[1], start=4, count=4),
    "nothing": replace(FIELDS[1], count=0),
    "the same name": replace(FIELDS[1], name=FIELDS[0].name),
}


@pytest.mark.parametrize(
    "text",
    [
        *[fields_to_text([FIELDS[0], second]) for second in WRONG.values()],
        *("[]", "{}", "7", "text", '[{"name": "x"}]', '[{"start": 0}, 3]', "[[1, 2]]"),
        '[{"name": "x", "unit": "1", "start": 0, "count": "8"}]',
    ],
)
def test_fields_that_do_not_fit_are_refused(
    text: str, tmp_path: Path, fields: Any, write_log: Any, model_dims: LogDims, monkeypatch: Any
) -> None:
    with pytest.raises(ValueError):  # noqa: PT011  (JSON has messages of its own)
        fields_from_text(text, 8)
    metadata = {"model_fields": text}
    with pytest.raises(ValueError, match="metadata model_fields: "):
        LogWriter(tmp_path / "b.mcap", model_dims, metadata=metadata, slot_ns=SLOT_NS)
    assert not list(tmp_path.iterdir())
    monkeypatch.setattr("hiersched.log.writer.fields_from_text", lambda *_: ())
    path = write_log(tmp_path / "b.mcap", fields, dims=model_dims, metadata=metadata)
    with pytest.raises(LogError, match="the metadata cannot be read"):
        LogReader(path)


def test_numbers_without_names_are_refused(tmp_path: Path, model_dims: LogDims) -> None:
    with pytest.raises(ValueError, match="metadata model_fields: "):
        LogWriter(tmp_path / "b.mcap", model_dims, slot_ns=SLOT_NS)
    with pytest.raises(ValueError, match="metadata num_model_values is '8', but the log has '0'"):
        LogWriter(
            tmp_path / "b.mcap",
            replace(model_dims, num_model_values=0),
            metadata={"num_model_values": "8"},
            slot_ns=SLOT_NS,
        )


def test_fields_read_back() -> None:
    assert fields_from_text(fields_to_text(FIELDS), 8) == FIELDS
