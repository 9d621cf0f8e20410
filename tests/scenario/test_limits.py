"""Values that cannot run together; scenarios away from the project's root."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from hiersched.cli import main
from hiersched.scenario import ScenarioError, load_scenario

LOADS = [round(0.5 + 0.01 * i, 2) for i in range(40)]
ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        # (0.01 s * 300 * 24 Mbit/s + 0.1 * 20 Mbit/s * 0.03 s) / (4 * 0.01 Mbit) = 1801.5
        ("traffic: {load: 300.0}", ["traffic.load = 300.0", "1801.5 batches", "600"]),
        (
            "sweeps: {axes: {load: {vary: {traffic.load: [0.9, 0.9]}}}}",
            ["sweeps.axes.load.vary.traffic.load = [0.9, 0.9]", "every value once"],
        ),
        ("learning: {weight_exponent: 100.0}", ["weight_exponent = 100.0", "less than or equal"]),
        ("control: {max_delay_s: 5.0}", ["control.max_delay_s = 5.0", "250 samples", "200"]),
    ],
)
def test_what_cannot_run_is_refused(tmp_path, text, words):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path, defaults=ROOT / "src/hiersched/config/defaults.yaml")
    for word in [str(path), *words]:
        assert word in str(caught.value)


def test_defaults_are_those_of_the_package(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert load_scenario("smoke").users.num_urllc == 4
    lone = tmp_path / "lone.yaml"
    lone.write_text("name: lone\n")
    assert load_scenario(lone).radio.num_prb == 25
    with pytest.raises(ScenarioError, match="a folder"):
        load_scenario(tmp_path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("radio: {bandwidth_hz: 1.0e-40}", "radio.bandwidth_hz = 1e-40: must be 0, or from 1e-12"),
        ("radio: {bandwidth_hz: 1.0e-3}", "4e-05 Hz a PRB, must be 1 to 1e+11 Hz"),
        ("robot: {speed_mps: 1.0e+40}", "robot.speed_mps = 1e+40: must be 0, or from 1e-12"),
        (
            "robot: {substep_s: 1.0e-9}",
            "2e+07 substeps in a slot or a control sample, at most 10000",
        ),
        ("log: {chunk_bytes: 1000000000}", "log.chunk_bytes = 1000000000: must be less than"),
        ("traffic: {arrivals: {batch_packets: 2000000}}", "must be below 1048576, since arrivals"),
        ("evaluate: {duration_s: 1.0e+7}", "10 worlds of 1000002000 slots: takes "),
        ("evaluate: {seeds: [1], duration_s: 1.0e+9, full_logs: 0}", "GiB of memory, this machine"),
        ("learning: {replay_capacity: 100000000000}", "learner ddpg: 10 seeds: takes "),
        ("users: {num_urllc: 1000000000}", "at most radio.num_prb = 25"),
        (
            "control: {sampling_s: 010}",
            "YAML reads 010 as 8, to the base 8: write 8, or quotes (line 1,",
        ),
        (
            "control: {sampling_s: 1:1}",
            "YAML reads 1:1 as 61, to the base 60: write 61, or quotes (line 1,",
        ),
        ("robot: {speed_mps: 1.0e-9}", "substeps until it repeats itself, at most 5000000"),
        (
            "extends: linear_plant\nplant: {B: [[0.0], [0.0], [0.0], [0.0]]}",
            "plant: (A, B) is not stabilisable: no input moves the mode of A at 1",
        ),
        (
            f"sweeps: {{axes: {{big: {{vary: {{traffic.load: {LOADS}, "
            f"radio.tx_power_dbm: {LOADS}}}}}}}}}",
            "1600 points, must be at most 1000",
        ),
    ],
)
def test_what_no_machine_could_run_is_refused_by_check(tmp_path, capsys, text, words):
    path = tmp_path / "mine.yaml"
    path.write_text(f"{text}\n", encoding="utf-8")
    assert main(["scenario", "check", str(path)]) == 2
    message = capsys.readouterr().err
    assert words in message
    assert message.startswith(f"hiersched: {path}: ")


def test_check_warns_where_service_keeps_arrivals_away(tmp_path, capsys):
    """1 ms slots with the defaults: a served packet keeps 6.1 others from arriving."""
    path = tmp_path / "mine.yaml"
    text = "radio: {slot_s: 1.0e-3}\nrobot: {substep_s: 1.0e-3}\n"
    path.write_text(text, encoding="utf-8")
    assert main(["scenario", "check", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith("offered: URLLC 159.6 and eMBB 209 Mbit/s; ")
    assert "the cell carries about 433.7 Mbit/s: 85 %" in lines[1]
    assert lines[2].startswith("warning: traffic.arrivals: for every packet that a URLLC user")
    assert main(["scenario", "check", "paper"]) == 0
    assert "warning" not in capsys.readouterr().out


def test_entries_of_matrices_may_be_as_small_as_rounding_leaves_them(tmp_path):
    path = tmp_path / "mine.yaml"
    shipped = load_scenario("linear_plant")
    rows = [list(row) for row in shipped.plant.A]
    rows[0][-1] = 1e-17
    text = yaml.safe_dump({"extends": "linear_plant", "plant": {"A": rows}})
    path.write_text(text, encoding="utf-8")
    assert load_scenario(path).plant.A[0][-1] == 1e-17


@pytest.mark.parametrize(
    "text",
    [
        *("users: {num_urllc: 2001-13-45}", "users: {num_urllc: !!int ''}", "a: !!float ''"),
        *("a: !!bool foo", "a: !!timestamp foo", "users: !!map foo", "users: !!map [a]"),
        *(
            'name: "\\U00110000"',
            'name: "\\uD800"',
            "a: " + "1:" * 3000 + "1",
            "%YAML 1" + "1" * 5000,
        ),
        *("a: " + "[" * 2000, "a: &a [*a]", "? {a: b}\n: c", "a: " + "9" * 5000, "!!python/none x"),
    ],
)
def test_yaml_of_any_content_is_one_message(tmp_path, capsys, text):
    path = tmp_path / "mine.yaml"
    path.write_text(f"{text}\n", encoding="utf-8")
    assert main(["scenario", "check", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"hiersched: {path}: ")
    assert len(line) < 800
