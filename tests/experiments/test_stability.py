"""Longest delays of the loops of the gain study."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hiersched.control import GainSchedule, spectral_radius_by_delay
from hiersched.experiments import stability
from hiersched.experiments.stability import (
    adjusted_delay,
    certified_delays,
    last_stable,
    longest_delay,
    write_stability,
)
from hiersched.scenario import Scenario
from hiersched.simulator.loop_gains import plant_of


@pytest.mark.parametrize("limit", range(-1, 8))
def test_bisection_finds_the_longest_delay(limit: int) -> None:
    asked: list[int] = []

    def holds(delay: int) -> bool:
        asked.append(delay)
        return delay <= limit

    assert longest_delay(holds, 7) == (None if limit < 0 else limit)
    assert len(asked) <= 4


@pytest.mark.parametrize(
    ("radii", "last"),
    [([0.9, 0.99, 1.0, 0.9], 1), ([1.0, 0.5], None), ([0.5, 0.6], 1), ([0.5, 1.5, 0.5, 1.1], 0)],
)
def test_the_first_unstable_delay_ends_the_region(radii: list[float], last: int | None) -> None:
    assert last_stable(np.array(radii)) == last


def test_regions_of_the_nominal_loops(tiny: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    """The known numbers at q = 700: unstable from 80 ms on, C1 for the split plant alone."""
    with monkeypatch.context() as patch:  # C2 says nothing here
        patch.setattr(stability, "analyse_delay_razumikhin", lambda *_: None)
        network = certified_delays(plant_of(tiny), 6)
    assert network == {"exact": 3, "c1": None, "c2": None, "c3": 3}
    split = plant_of(replace(tiny, control=replace(tiny.control, loop="split")))
    assert certified_delays(split, 2) == {"exact": 2, "c1": 2, "c2": 2, "c3": 2}


def test_the_region_of_an_adjusted_gain(tiny: Scenario, designed: Path) -> None:
    def schedule(name: str) -> GainSchedule:
        return GainSchedule.from_json((designed / f"gains/{name}.json").read_text())

    plant, own = plant_of(tiny), schedule("schedule")
    radii = spectral_radius_by_delay(*plant.closed_loop(own.gain(2)), own.max_delay_steps)
    assert adjusted_delay(plant, own, 2) == last_stable(radii) == 2
    # The predictor for 2 samples, with its memory of inputs, is stable at 2.
    assert adjusted_delay(plant, schedule("schedule_method_predictor"), 2) == 2


def test_the_file_has_every_weight_and_sampling_interval(
    tiny: Scenario, designed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stability, "certified_delays", lambda plant, cap: {"exact": cap})
    (tmp_path / "gains").mkdir()
    for path in (designed / "gains").iterdir():
        (tmp_path / "gains" / path.name).write_bytes(path.read_bytes())
    study = replace(tiny.gain_study, weight=(900.0,))
    rows = json.loads(write_stability(replace(tiny, gain_study=study), tmp_path).read_text())
    found = [(row["axis"], row["value"], row["plant"], row["criterion"]) for row in rows]
    assert found == [
        *(("weight", 900.0, plant, "exact") for plant in ("network", "split")),
        ("weight", 900.0, "network", "adjusted"),
        *(("sampling_s", h, "network", "exact") for h in (0.02, 0.04)),
    ]
    assert {row["max_delay_steps"] for row in rows if row["value"] != 0.04} == {2}
