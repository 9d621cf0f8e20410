"""`hiersched replay` and `hiersched compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hiersched.cli import main
from hiersched.log import LogReader

PF = "runs/evaluate/pf/seed11.mcap"


def test_replay_says_ok_or_where(
    study: Path, tmp_path: Path, rewrite: Any, capsys: pytest.CaptureFixture
) -> None:
    assert main(["replay", str(study / PF)]) == 0
    out = capsys.readouterr().out
    assert out.endswith("OK, 40 slots computed again, every bit the same\n")

    def change(fields: dict, events: list, metadata: dict) -> None:
        fields["backlog_packets"][21, 3] *= 1 + 2**-52

    ddpg = str(study / "runs/evaluate/ddpg/seed11.mcap")
    assert main(["replay", ddpg]) == 0
    out = capsys.readouterr().out
    assert out.endswith("decisions are those of the log: --policy asks the policy again\n")
    path = rewrite(study / PF, tmp_path / "a.mcap", change)
    assert main(["replay", str(path)]) == 1
    assert "differs in slot 21, topic /queue, field backlog_packets[3]: " in capsys.readouterr().out


def test_counterfactual_shows_what_differs(
    study: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "new/edf.mcap"
    assert main(["replay", str(study / PF), "--policy", "edf", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    heading, *rows = text[text.index(" " * 20) :].split("\n/")[0].splitlines()
    assert any(row.startswith("URLLC late packets ") for row in rows)
    assert {row.index("  [") for row in rows} == {heading.index("  interval")}, text
    assert "/allocation parts in slot" in text
    with LogReader(out) as log:
        assert log.metadata["policy"] == "edf"
    assert main(["replay", str(study / PF), "--policy", "edf", "--out", str(out)]) == 2
    assert "never overwrites" in capsys.readouterr().err
    assert main(["replay", str(study / PF), "--policy", "pf"]) == 0
    assert capsys.readouterr().out == "every message is the same, bit for bit\n"
    assert main(["replay", str(study / PF), "--policy", "best"]) == 2
    assert "policy = 'best': must be one of" in capsys.readouterr().err


def test_compare_takes_several(study: Path, capsys: pytest.CaptureFixture) -> None:
    logs = [
        str(study / f"runs/evaluate/{policy}/seed11.mcap") for policy in ("pf", "edf", "ddpg", "pf")
    ]
    assert main(["compare", *logs]) == 0
    text = capsys.readouterr().out
    assert text.count("95 % intervals of the paired difference over 20 stretches") == 3
    assert text.endswith("the logs say the same, bit for bit\n")
    assert main(["compare", logs[0], str(study / "runs/evaluate/pf/seed12.mcap")]) == 2
