"""A study that is over in seconds: two robots, two cameras, worlds of a fifth of a second."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from hiersched.experiments import files
from hiersched.experiments.gains import design_gains, designs
from hiersched.experiments.run import run_experiment
from hiersched.experiments.worlds import PolicySource, untrained_policies
from hiersched.scenario import Scenario, load_scenario
from hiersched.study.metrics import measured_row

TINY = """
name: tiny
users: {num_urllc: 2, num_embb: 2}
radio: {bandwidth_hz: 2.0e+6, num_prb: 5}
traffic: {urllc_offered_mbps: [20.0, 30.0]}
control: {max_delay_s: 0.04}
learning: {seeds: [1, 2], episodes: 6, slots_per_episode: 10, num_envs: 2, hidden: [8],
           batch_size: 8, warmup_slots: 4}
evaluate: {seeds: [11, 12, 13], warmup_s: 0.0, duration_s: 0.2, full_logs: 0,
           policies: [ddpg, pf, edf]}
sweeps: {seeds: [21], warmup_s: 0.0, duration_s: 0.1, policies: [ddpg, pf], axes: {
         rayleigh_scale: {vary: {radio.fading.scale: [0.5, 1]}},
         sampling_s: {vary: {control.sampling_s: [0.02, 0.04]}},
         reference: {vary: {robot.reference: [arc]}},
         load: {vary: {traffic.load: [0.9]}},
         load_ratio: {vary: {traffic.load_ratio: [1.5]}},
         service_coefficient_mbps:
           {vary: {traffic.service_coefficient_mbps: [2.0], control.sampling_s: [0.02, 0.04]}}}}
generalise: {warmup_s: 0.0, duration_s: 0.05, seeds: [41, 42], policies: [ddpg, pf, edf],
             cells: [[1, 3, 6], [3, 4, 9]]}
gain_study: {seeds: [31, 32], num_robots: 3, num_windows: 3, violation_windows: [2],
             methods: [krasovskii, razumikhin, predictor], sweep_robots: 2, weight: [700.0, 900.0],
             fixed_delay_s: [0.02, 0.04], sampling_s: [0.02, 0.04], noise_position_m: [0.0],
             noise_heading_rad: [0.01]}
log: {chunk_bytes: 16384, train_profile: compact, evaluate_profile: full, sweep_profile: compact}
"""


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Scenario:
    path = tmp_path_factory.mktemp("scenario") / "tiny.yaml"
    path.write_text(TINY, encoding="utf-8")
    return load_scenario(path)


@pytest.fixture(scope="session")
def designed(tiny: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results folder with the gains of the tiny study; tests must not write here."""
    results = tmp_path_factory.mktemp("designed")
    for design in designs(tiny):
        design_gains(tiny, design, results / files.gain_file(design))
    return results


@pytest.fixture
def results(designed: Path, tmp_path: Path) -> Path:
    """Results folder with gains, for one test."""
    shutil.copytree(designed, tmp_path / "results")
    return tmp_path / "results"


@pytest.fixture
def run(results: Path) -> Callable[..., None]:
    """Run a group of policies of an experiment into `results`, those without training at first."""

    def run_group(
        scenario: Scenario,
        experiment: str,
        group: str = "classical",
        source: PolicySource = untrained_policies,
    ) -> None:
        run_experiment(scenario, results, experiment, group, source, measured_row)

    return run_group


@pytest.fixture
def tiny_with(tmp_path: Path) -> Callable[[str], Scenario]:
    """Load the tiny study with other values, given as YAML: ``mine.yaml``, which extends it."""

    def load(text: str) -> Scenario:
        (tmp_path / "tiny.yaml").write_text(TINY, encoding="utf-8")
        path = tmp_path / "mine.yaml"
        path.write_text(f"extends: tiny.yaml\n{text}\n", encoding="utf-8")
        return load_scenario(path)

    return load
