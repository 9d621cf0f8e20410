"""Sums of slices, and texts that logs in a row share."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hiersched.experiments.logging import RunLabel, open_log, slice_fields
from hiersched.log import LogReader
from hiersched.scenario import Scenario, load_scenario, scenario_sha256


def test_slices_by_hand() -> None:
    fields = {
        "backlog_packets": np.array([[1.0, 2.0, 6.0, 10.0], [0.5, 0.0, 0.25, 3.0]]),
        "due_packets": np.array([[1, 2, 3, 4], [5, 0, 0, 7]], np.uint32),
        "late_packets": np.array([[1, 0, 2, 4], [0, 0, 0, 6]], np.uint32),
    }
    slices = slice_fields(fields, 3)
    assert {name: values.tolist() for name, values in slices.items()} == {
        "backlog_urllc_packets": [3.0, 0.25],
        "backlog_embb_packets": [10.0, 3.0],
        "due_urllc_packets": [6, 5],
        "due_embb_packets": [4, 7],
        "late_urllc_packets": [3, 0],
        "late_embb_packets": [4, 6],
    }
    assert {values.dtype.str for values in slices.values()} == {"<f8", "<u4"}


def test_slices_have_the_same_bits_in_every_memory_layout() -> None:
    """Logs are written from views of a record and computed again in another batch."""
    rng = np.random.default_rng(3)
    fields = {
        "backlog_packets": rng.exponential(size=(4, 30, 25)),
        "due_packets": rng.integers(0, 9, (4, 30, 25), dtype=np.uint32),
        "late_packets": rng.integers(0, 9, (4, 30, 25), dtype=np.uint32),
    }
    whole = slice_fields(fields, 14)
    turned = slice_fields({k: np.asfortranarray(v) for k, v in fields.items()}, 14)
    for name, values in whole.items():
        assert values.tobytes() == turned[name].tobytes()
        one = slice_fields({k: v[2, 7:8] for k, v in fields.items()}, 14)[name]
        assert one.tobytes() == values[2, 7:8].tobytes()
    nobody = slice_fields(fields, 0)
    assert not nobody["backlog_urllc_packets"].any()
    assert not nobody["due_urllc_packets"].any()


class Schedule:
    """All of a gain schedule that a log asks for."""

    def __init__(self, text: str) -> None:
        self.text = text

    def to_json(self) -> str:
        return self.text


@pytest.fixture(scope="module")
def smoke(project_root: Path) -> Scenario:
    defaults = project_root / "src/hiersched/config/defaults.yaml"
    return load_scenario(
        project_root / "src/hiersched/config/scenarios/smoke.yaml", defaults=defaults
    )


def test_logs_in_a_row_have_the_texts_of_their_own_scenario(
    smoke: Scenario, tmp_path: Path
) -> None:
    one, two = Schedule("1"), Schedule("2")
    other = replace(smoke, name="other")
    label = RunLabel(stage="evaluate", policy="pf", seed=1)
    for scenario, schedule in (
        (smoke, one),
        (smoke, one),
        (smoke, two),
        (other, two),
        (smoke, one),
    ):
        path = tmp_path / "a.mcap"
        open_log(path, scenario, schedule, label, profile="compact").close()
        with LogReader(path) as log:
            assert log.metadata["scenario_sha256"] == scenario_sha256(scenario)
            assert f"name: {scenario.name}".encode() in log.attachments["scenario.yaml"]
            assert log.attachments["schedule.json"].decode() == schedule.text
