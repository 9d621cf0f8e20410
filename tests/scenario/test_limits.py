"""Values that cannot run together; scenarios away from the project's root."""

from __future__ import annotations

from pathlib import Path

import pytest

from hiersched.scenario import ScenarioError, load_scenario

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
