"""Logs of other versions: replay verifies what they have and it knows, and says what it cannot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from hiersched.cli import main
from hiersched.core.fields import Field
from hiersched.experiments.logged import load_run, read_slots
from hiersched.log import LogError, LogReader, log_digest
from hiersched.replay.compare import compare_logs
from hiersched.replay.verify import verify
from hiersched.replay.viewer_topics import IMAGE_TOPIC

PF, DDPG = "runs/evaluate/pf/seed11.mcap", "runs/evaluate/ddpg/seed11.mcap"
TORQUE = Field("/robots", "torque_nm", "<f4", ("R", 2), "N m", "of both wheels", ("full",))
HARQ = Field("/harq", "failed_blocks", "<u4", ("U",), "1", "blocks that failed", ("full",))


@pytest.fixture
def newer(study: Path, tmp_path: Path, rewrite: Any, other_table: Any) -> Callable[..., Path]:
    """A run as a version with a field and a topic more would log it."""

    def write(change: Callable[[dict], None] = lambda fields: None) -> Path:
        def more(fields: dict[str, Any], events: list, metadata: dict) -> None:
            slots = len(fields["prb_owner"])
            fields["torque_nm"] = np.ones((slots, 2, 2), np.float32)
            fields["failed_blocks"] = np.ones((slots, 4), np.uint32)
            del metadata["schema_version"]
            change(fields)

        with other_table(lambda table: [HARQ, TORQUE, *table]):
            return rewrite(study / PF, tmp_path / "newer.mcap", more)

    return write


def test_unknown_fields_are_named_and_the_others_verified(
    newer: Any, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    path = newer()
    assert main(["replay", str(path)]) == 0
    out = capsys.readouterr().out
    assert out == (
        f"{path}: OK, 40 slots computed again, every bit the same\n"
        "not checked, since this hiersched does not know them: "
        "/harq failed_blocks, /robots torque_nm\n"
    )

    def change(fields: dict[str, Any]) -> None:
        fields["state"] = fields["state"].copy()
        fields["state"][17, 1, 2] += 1e-9

    assert main(["replay", str(newer(change))]) == 1
    assert "differs in slot 17, topic /robots, field state[1,2]: " in capsys.readouterr().out


def test_a_log_with_unknown_fields_is_written_again_without_them(
    newer: Any, study: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    path, full = newer(), tmp_path / "full.mcap"
    assert main(["replay", str(path), "--out", str(full)]) == 0
    assert f"not checked, nor in {full}, since this" in capsys.readouterr().out
    assert log_digest(full) == log_digest(study / PF)
    with LogReader(full) as log:
        assert log.metadata["schema_version"] == "1"
        assert b"torque_nm" not in log.attachments["hiersched.proto"]
    assert compare_logs(path, full).partings == ()
    assert main(["replay", str(path), "--policy", "edf"]) == 0
    names = ["delay_s", "backlog_packets"]
    fields, own = (read_slots(p, names).fields for p in (path, study / PF))
    assert all(fields[name].tobytes() == own[name].tobytes() for name in names)


def test_a_field_of_another_type_cannot_be_checked_and_is_computed(
    study: Path, tmp_path: Path, rewrite: Any, other_table: Any
) -> None:
    def halve(fields: dict[str, Any], events: list, metadata: dict) -> None:
        del metadata["schema_version"]
        fields["tracking_error_m"] = fields["tracking_error_m"].astype(np.float32)

    with other_table(
        lambda table: [replace(f, dtype="<f4") if "tracking" in f.name else f for f in table]
    ):
        path = rewrite(study / PF, tmp_path / "single.mcap", halve)
    run = load_run(path)
    assert run.unknown_fields == ("/robots tracking_error_m",)
    assert verify(run) is None
    errors, own = (read_slots(p, ["tracking_error_m"]).fields for p in (path, study / PF))
    assert errors["tracking_error_m"].dtype == np.float64
    assert errors["tracking_error_m"].tobytes() == own["tracking_error_m"].tobytes()
    (parting,) = compare_logs(path, study / PF).partings
    assert (parting.topic, parting.first_slot, parting.num_slots) == ("/robots", 0, 40)


def test_compare_names_topics_that_only_newer_logs_have(newer: Any, tmp_path: Path) -> None:
    first = newer().rename(tmp_path / "first.mcap")

    def change(fields: dict[str, Any]) -> None:
        fields["failed_blocks"][7] = 3

    (parting,) = compare_logs(first, newer(change)).partings
    assert (parting.topic, parting.first_slot, parting.num_slots) == ("/harq", 7, 1)


def without(names: set[str]) -> Callable[[list[Field]], list[Field]]:
    return lambda table: [field for field in table if field.name not in names]


@pytest.fixture
def older(study: Path, tmp_path: Path, rewrite: Any, other_table: Any) -> Callable[..., Path]:
    """A run as a version that did not have these fields would have logged it."""

    def write(
        name: str, lacking: set[str], change: Callable[[dict], None] = lambda fields: None
    ) -> Path:
        def less(fields: dict[str, Any], events: list, metadata: dict) -> None:
            del metadata["schema_version"]
            for field in lacking:
                del fields[field]
            change(fields)

        with other_table(without(lacking)):
            return rewrite(study / name, tmp_path / "older.mcap", less)

    return write


LACKING = {
    *("state", "arrival_uniform", "robot_normal", "mean_fading_power", "reward_urllc"),
    *("due_packets", "hol_delay_s"),
}


@pytest.mark.parametrize("name", [PF, DDPG])
def test_what_is_there_is_verified(
    name: str, older: Any, study: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    path = older(name, LACKING)
    assert main(["replay", str(path), "--out", str(tmp_path / "full.mcap")]) == 0
    assert "not checked" not in capsys.readouterr().out
    assert log_digest(tmp_path / "full.mcap") == log_digest(study / name)
    measured = [m.name for m in compare_logs(path, study / name).measures]
    assert "URLLC backlog" in measured
    assert not {"URLLC late packets", "URLLC wait", "URLLC reward"} & set(measured)
    names = ["due_packets", "rate_mbps"]
    fields, own = (read_slots(p, names).fields for p in (path, study / name))
    assert all(fields[field].tobytes() == own[field].tobytes() for field in names)

    def change(fields: dict[str, Any]) -> None:
        fields["control"] = fields["control"].copy()
        fields["control"][11, 0, 1] += 1e-9

    found = verify(load_run(older(name, LACKING, change)))
    assert found is not None
    assert (found.slot, found.field) == (11, "control[0,1]")


@pytest.mark.parametrize("lacking", [{"prb_owner"}, {"multiplier"}])
def test_logs_without_their_decisions_need_a_rule(lacking: set[str], older: Any) -> None:
    assert verify(load_run(older(PF, {"prb_owner"}))) is None
    path = older(DDPG, {*lacking, "weight"})
    (name,) = lacking
    with pytest.raises(LogError, match=f"it has no {name}, which nothing else says"):
        verify(load_run(path))
    with pytest.raises(LogError, match=f"it has no {name}, which nothing else says"):
        read_slots(path, ["weight"])


def test_viewers_show_what_a_log_has(older: Any) -> None:
    for lacking, gone in (("state", "/robots/0/pose"), ("prb_owner", IMAGE_TOPIC)):
        path = older(PF, {lacking})
        assert main(["export", str(path), "--viewer", "--overwrite"]) == 0
        with (path.with_suffix("") / "viewer.mcap").open("rb") as file:
            summary = make_reader(file).get_summary()
        topics = {channel.topic for channel in summary.channels.values()}
        assert gone not in topics
        assert topics


def test_old_files(
    project_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:  # fmt: skip
    """Of an older log everything but what has changed since is computed again to the bit.

    Its references have the sines of NumPy on a processor with AVX-512.
    """
    monkeypatch.chdir(project_root)  # for the defaults of keys that came later
    data = project_root / "tests/log/data"
    full = tmp_path / "full.mcap"
    path = data / "before_the_table.mcap"
    assert main(["replay", str(path)]) == 1
    assert "differs in slot 0, topic /robots, field reference[1,0]: " in capsys.readouterr().out
    assert main(["replay", str(path), "--policy", "pf", "--out", str(full)]) == 0
    partings = compare_logs(full, path).partings
    assert {parting.topic for parting in partings} == {"/robots"}
    with LogReader(full) as new, LogReader(path) as old:
        for name in ("state", "reference", "control"):
            values = (log.read("/robots")[name] for log in (new, old))
            np.testing.assert_allclose(*values, rtol=1e-9, atol=1e-12)
    assert main(["replay", str(data / "release_0.1.mcap")]) == 2
    assert "cannot be run again: not a gain schedule: its format" in capsys.readouterr().err


def test_a_log_replays_on_any_processor(
    project_root: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """Written where NumPy has no AVX-512. After a change of results, make it anew there.

    ``hiersched replay before_the_table.mcap --policy pf --out another_processor.mcap`` does.
    """
    monkeypatch.chdir(project_root)
    assert main(["replay", str(project_root / "tests/log/data/another_processor.mcap")]) == 0
    assert "OK, 12 slots computed again, every bit the same" in capsys.readouterr().out
