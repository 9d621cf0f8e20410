from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from hiersched.cli import main
from hiersched.scenario import load_scenario
from hiersched.scenario.plugins import CONFIG

SHIPPED = sorted((CONFIG / "scenarios").glob("*.yaml"))


@pytest.fixture(autouse=True)
def in_project(project_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(project_root)


@pytest.mark.parametrize("path", SHIPPED, ids=str)
def test_every_scenario_of_the_project_is_fine(path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["scenario", "check", str(path)]) == 0
    assert f"scenario {path.stem} is fine" in capsys.readouterr().out


def test_show_prints_what_loads_to_the_same(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["scenario", "show", "smoke"]) == 0
    path = tmp_path / "shown.yaml"
    path.write_text(capsys.readouterr().out, encoding="utf-8")
    assert load_scenario(path) == load_scenario("smoke")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("radio: {num_prbs: 3}", "radio.num_prbs = 3: unknown key; allowed: slot_s, "),
        ("radio: {tx_power_dbm: 1e1}", "write 1.0e-3"),
        ("users: {num_urllc: 40}", "at most radio.num_prb = 25"),
        ("sweeps: {sampling_s: [0.03]}", "sweeps.sampling_s = 0.03: robot.window_s"),
        ("radio: {num_prb: 3", "not valid YAML"),
        ("traffic: {load: -1}", "traffic.load = -1"),
        ("- 1", "a scenario is a mapping of sections"),
    ],
)
def test_a_fault_is_one_message(
    tmp_path: Path, capsys: pytest.CaptureFixture, text: str, message: str
) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(f"{text}\n", encoding="utf-8")
    for action in ("check",) if message.startswith("sweeps") else ("check", "show"):
        assert main(["scenario", action, str(path)]) == 2
        output = capsys.readouterr()
        assert output.out == ""
        assert message in output.err
        assert "Traceback" not in output.err


def test_a_missing_file_names_those_that_exist(capsys: pytest.CaptureFixture) -> None:
    assert main(["scenario", "check", "papper"]) == 2
    there = ", ".join(path.stem for path in SHIPPED)
    assert "paper, smoke" in there
    assert f"no such scenario; there are: {there}" in capsys.readouterr().err


def test_the_installed_command(project_root: Path) -> None:
    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "hiersched.cli", *words],
            capture_output=True,
            text=True,
            check=False,
        )

    assert run("--version").stdout == "hiersched 0.1.0\n"
    usage = run("scenario")
    assert (usage.returncode, "usage: hiersched" in usage.stderr) == (2, True)
