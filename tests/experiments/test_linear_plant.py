"""A linear plant through design, evaluation and log, and computed again from the log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hiersched.experiments.gains import design_gains, design_of, designs
from hiersched.experiments.logged import load_run
from hiersched.experiments.points import experiments
from hiersched.experiments.run import run_experiment
from hiersched.experiments.worlds import untrained_policies
from hiersched.log import LogReader
from hiersched.replay.verify import verify
from hiersched.scenario import Scenario, load_scenario
from hiersched.study.metrics import measured_row


def pendulum() -> Scenario:
    scenario = load_scenario("linear_plant")
    evaluation = replace(
        scenario.evaluate,
        warmup_s=0.2,
        duration_s=0.4,
        full_logs=1,
        full_log_s=0.6,
        policies=("pf",),
    )
    return replace(scenario, evaluate=evaluation)


def test_its_log_is_computed_again_bit_for_bit(tmp_path: Path) -> None:
    scenario = pendulum()
    design_gains(scenario, "schedule", tmp_path / "gains/schedule.json")
    run_experiment(scenario, tmp_path, "evaluate", "classical", untrained_policies, measured_row)
    assert verify(load_run(tmp_path / "runs/evaluate/pf/seed101.mcap")) is None
    path = tmp_path / "runs/evaluate/pf/seed101_full.mcap"
    with LogReader(path) as log:
        assert (log.dims.num_states, log.dims.num_inputs, log.dims.num_normals) == (4, 1, 8)
        assert log.dims.num_posed == 0
        robots = log.read("/robots")
        assert robots["state"].shape == (60, 4, 4)
        assert robots["control"].shape == (60, 4, 1)
        assert np.abs(robots["state"]).max() > 0
    assert verify(load_run(path)) is None


def test_the_gain_study_stays_on_the_plant() -> None:
    scenario = pendulum()
    held = replace(scenario, control=replace(scenario.control, hold_samples=3))
    points = {point.value: point.scenario for point in experiments(held)["gain_study"].points}
    assert list(points) == list(scenario.gain_study.methods)
    for method, variant in points.items():
        assert variant.plant_name == "linear"
        assert variant.control.hold_samples == (0 if method == "predictor" else 3)
        design = designs(held)[design_of(held, variant)]
        assert (design.control.method, design.plant_name) == (method, "linear")
