"""A linear plant through design, evaluation and log, and computed again from the log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from hiersched.runs.evaluate import evaluate
from hiersched.runs.gains import design_gains
from hiersched.runs.policies import untrained_policies
from hiersched.runs.variants import design_of, gain_designs, study_scenario

from hiersched.log import LogReader
from hiersched.replay.verify import verify
from hiersched.runs import paths
from hiersched.experiments.logged import load_run
from hiersched.scenario import Scenario, load_scenario


def pendulum(project_root: Path) -> Scenario:
    scenario = load_scenario(project_root / "src/hiersched/config/scenarios/linear_plant.yaml")
    evaluation = replace(
        scenario.evaluate,
        warmup_s=0.2,
        duration_s=0.4,
        full_logs=1,
        full_log_s=0.6,
        policies=("pf",),
    )
    return replace(scenario, evaluate=evaluation)


def test_its_log_is_computed_again_bit_for_bit(project_root: Path, tmp_path: Path) -> None:
    scenario = pendulum(project_root)
    design_gains(scenario, "schedule", tmp_path / paths.gain_file("schedule"))
    evaluate(scenario, tmp_path, "classical", untrained_policies)
    assert verify(load_run(tmp_path / "eval/pf/seed101.mcap")) is None
    path = tmp_path / "eval/pf/seed101_full.mcap"
    with LogReader(path) as log:
        assert (log.dims.num_states, log.dims.num_inputs, log.dims.num_normals) == (4, 1, 8)
        assert log.dims.num_posed == 0
        robots = log.read("/robots")
        assert robots["state"].shape == (60, 4, 4)
        assert robots["control"].shape == (60, 4, 1)
        assert np.abs(robots["state"]).max() > 0
    assert verify(load_run(path)) is None


def test_the_gain_study_stays_on_the_plant(project_root: Path) -> None:
    scenario = pendulum(project_root)
    held = replace(scenario, control=replace(scenario.control, hold_samples=3))
    for method in scenario.gain_study.methods:
        variant = study_scenario(held, method, "adjusted")
        assert variant.plant_name == "linear"
        assert variant.control.hold_samples == (0 if method == "predictor" else 3)
        design = gain_designs(held)[design_of(held, variant)]
        assert (design.control.method, design.plant_name) == (method, "linear")
