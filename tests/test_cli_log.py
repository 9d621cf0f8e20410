"""What people type about logs."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from mcap.writer import Writer

from hiersched.cli import main
from hiersched.log import LogDims, LogReader, LogWriter, log_digest
from hiersched.log.schema import topics_in

DIMS = LogDims(num_urllc=3, num_embb=2, num_prb=7)
SLOT_NS = 10_000_000


def write_log(
    path: Path, *, slots: int = 30, seed: int = 5, abort: bool = False, policy: str = "pf"
) -> Path:
    """Random numbers in every field."""
    rng = np.random.default_rng(seed)
    fields: dict[str, Any] = {}
    for topic in topics_in("full").values():
        for field in topic.fields:
            shape = (slots, *field.sized(DIMS.sizes))
            scale = rng.integers(0, 9, shape) if field.dtype == "<u4" else rng.normal(size=shape)
            fields[field.name] = scale.astype(field.dtype)
    log = LogWriter(
        path, DIMS, metadata={"policy": policy, "scenario": "test", "seed": "4"}, slot_ns=SLOT_NS
    )
    log.write_block(0, fields)
    log.event(7, "WARNING", "queue", 'user 1, says "late"')
    log.abort() if abort else log.close()
    return path


@pytest.fixture
def run(capsys: pytest.CaptureFixture) -> Callable[..., tuple[int, str, str]]:
    def call(*words: str | Path) -> tuple[int, str, str]:
        status = main([str(word) for word in words])
        output = capsys.readouterr()
        assert "Traceback" not in output.err
        return status, output.out, output.err

    return call


def bad_inputs(folder: Path) -> dict[str, Path]:
    """Message -> file."""
    paths = {
        "the file is empty": folder / "empty.mcap",
        "this is not an MCAP file": folder / "text.mcap",
        "this MCAP file is by 'another', not a log of hiersched": folder / "other.mcap",
        "the file is truncated": folder / "cut.mcap",
        "No such file": folder / "none.mcap",
    }
    empty, text, other, cut, _ = paths.values()
    empty.write_bytes(b"")
    text.write_text("slot,delay\n" * 50)
    with other.open("wb") as stream:
        foreign = Writer(stream)
        foreign.start(library="another")
        foreign.finish()
    cut.write_bytes(write_log(cut).read_bytes()[:-100])
    return paths


@pytest.mark.parametrize("command", ["info", "digest", "replay", "export", "compare", "recover"])
def test_bad_input_has_a_message_of_its_own_and_status_2(
    command: str, tmp_path: Path, run: Any
) -> None:
    more = {"export": ["--csv"], "compare": [tmp_path / "empty.mcap"]}.get(command, [])
    for message, path in bad_inputs(tmp_path).items():
        if command == "recover" and "truncated" in message:
            continue
        status, out, err = run(command, path, *more)
        assert (status, out) in ((2, ""), (2, f"{path} and {tmp_path / 'empty.mcap'}\n"))
        assert re.fullmatch(rf"hiersched: {re.escape(str(path))}: .*{message}.*\n", err), err


def test_info_says_what_there_is(tmp_path: Path, run: Any) -> None:
    status, out, err = run("info", write_log(tmp_path / "a.mcap"))
    assert (status, err) == (0, "")
    for text in (
        "a.mcap: complete, every checksum is right",
        "scenario    test",
        "policy pf, seed 4",
        "schema      version 1, profile full",
        "3 URLLC and 2 eMBB users, 7 PRBs",
        "30 slots of 10 ms: 0.3 s",
        "1 WARNING of queue",
        "attachment  hiersched.proto",
    ):
        assert text in out
    assert re.search(r"/robots +30 +1 ", out)
    with LogReader(tmp_path / "a.mcap") as log:
        rate = log.read("/allocation")["rate_mbps"][:, :3].mean()
    assert float(re.search(r"URLLC rate +(\S+) Mbit/s", out)[1]) == pytest.approx(rate, rel=1e-5)


def test_metadata_do_not_look_like_other_lines(tmp_path: Path, run: Any) -> None:
    policy = "pf\nrecovered   lost: nothing\x1b[2J"
    status, out, _ = run("info", write_log(tmp_path / "a.mcap", policy=policy))
    assert status == 0
    assert r"policy pf\nrecovered   lost: nothing\x1b[2J, seed 4" in out


def test_info_refuses_a_damaged_log(tmp_path: Path, run: Any) -> None:
    path = write_log(tmp_path / "a.mcap")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 8
    path.write_bytes(data)
    status, out, err = run("info", path)
    assert (status, out) == (2, "")
    assert "does not match its checksum" in err


def test_digest(tmp_path: Path, run: Any) -> None:
    path = write_log(tmp_path / "a.mcap")
    assert run("digest", path) == (0, f"{log_digest(path)}  {path}\n", "")


def test_recover(tmp_path: Path, run: Any) -> None:
    part_path = tmp_path / "a.mcap.part"
    write_log(tmp_path / "a.mcap", abort=True)
    status, out, _ = run("recover", part_path)
    assert status == 0
    assert f"{tmp_path / 'a.recovered.mcap'}: 30 slots (0 to 29), 1 events" in out
    assert run("info", tmp_path / "a.recovered.mcap")[0] == 0
    status, _, err = run("recover", part_path)
    assert (status, "recover never overwrites" in err) == (2, True)
    part_path.write_bytes(part_path.read_bytes()[:-50])
    status, out, _ = run("recover", part_path, "--out", tmp_path / "b.mcap")
    assert status == 3
    assert "lost: at byte" in out


def test_csv_reads_back_to_the_same_bits(tmp_path: Path, run: Any) -> None:
    path = write_log(tmp_path / "a.mcap")
    status, out, _ = run("export", path, "--csv")
    folder = tmp_path / "a"
    names = [*[topic.removeprefix("/") for topic in topics_in("full")], "events"]
    assert (status, out.split()) == (0, [str(folder / f"{name}.csv") for name in names])
    assert sorted(p.name for p in folder.iterdir()) == sorted(f"{name}.csv" for name in names)
    with LogReader(path) as log:
        for name in names[:-1]:
            table = pd.read_csv(folder / f"{name}.csv")
            for field, values in log.read(f"/{name}").items():
                columns = [c for c in table if c.split("[")[0] == field]
                back = table[columns].to_numpy().astype(values.dtype)
                assert back.tobytes() == np.ascontiguousarray(values).tobytes(), field
    events = pd.read_csv(folder / "events.csv")
    assert events["message"].tolist() == ['user 1, says "late"']


def test_parquet_reads_back_to_the_same_bits(tmp_path: Path, run: Any) -> None:
    pytest.importorskip("pyarrow")
    path = write_log(tmp_path / "a.mcap")
    out = tmp_path / "out"
    assert run("export", path, "--parquet", "--out", out, "--topic", "/robots")[0] == 0
    table = pd.read_parquet(out / "robots.parquet")
    with LogReader(path) as log:
        state = log.read("/robots")["state"]
    columns = [f"state[{i},{j}]" for i in range(3) for j in range(5)]
    assert table[columns].to_numpy().tobytes() == state.tobytes()
    assert table["slot"].dtype == np.uint64


def test_export_of_a_span_of_time(tmp_path: Path, run: Any) -> None:
    path = write_log(tmp_path / "a.mcap")
    words = ("--topic", "/queue", "--from", "0.07", "--to", "0.2")
    assert run("export", path, "--csv", *words)[0] == 0
    assert pd.read_csv(tmp_path / "a/queue.csv")["slot"].tolist() == list(range(7, 20))
    status, _, err = run("export", path, "--csv", "--from", "3", "--to", "1")
    assert (status, err) == (2, "hiersched: times 3 s to 1 s; allowed: 0 <= start <= stop\n")
    assert run("export", path, "--csv", "--topic", "/radio")[0] == 2


def test_out_of_a_log_that_is_no_run(tmp_path: Path, run: Any) -> None:
    words = ("replay", write_log(tmp_path / "a.mcap"), "--out", tmp_path / "x.mcap")
    assert run(*words)[0] == 2
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_no_file_is_overwritten_unless_told(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    log_path = write_log(tmp_path / "a.mcap")
    folder = tmp_path / "tables"
    export = ["export", str(log_path), "--csv", "--topic", "/queue", "--out", str(folder)]
    assert main(export) == 0
    written = (folder / "queue.csv").read_bytes()
    (folder / "queue.csv").write_text("mine")
    capsys.readouterr()
    assert main(export) == 2
    assert "queue.csv: exists; --overwrite replaces it" in capsys.readouterr().err
    assert (folder / "queue.csv").read_text() == "mine"
    assert main([*export, "--overwrite"]) == 0
    assert (folder / "queue.csv").read_bytes() == written
    viewer = ["export", str(log_path), "--viewer", "--out", str(folder)]
    (folder / "foxglove.json").write_text("mine")
    assert main(viewer) == 2
    assert (folder / "foxglove.json").read_text() == "mine"
    log = tmp_path / "mine.mcap"
    log.write_text("mine")
    assert main(["run", "smoke", "--policy", "pf", "--seconds", "1", "--out", str(log)]) == 2
    assert "mine.mcap: exists; --overwrite replaces it" in capsys.readouterr().err
    assert log.read_text() == "mine"
