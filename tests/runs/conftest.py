"""A study that is over in seconds: two robots, two cameras, worlds of a fifth of a second."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from hiersched.runs.gains import design_gains
from hiersched.runs.variants import gain_designs

from hiersched.runs import paths
from hiersched.scenario import Scenario, load_scenario

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
sweeps: {seeds: [21], warmup_s: 0.0, duration_s: 0.1, policies: [ddpg, pf],
         rayleigh_scale: [0.5, 1],
         sampling_s: [0.02, 0.04], reference: [arc], load: [0.9],
         load_ratio: [1.5], service_coefficient_mbps: [2.0]}
generalise: {warmup_s: 0.0}
gain_study: {seeds: [31, 32], num_robots: 3, num_windows: 3, violation_windows: [2],
             methods: [krasovskii, razumikhin, predictor], sweep_robots: 2, weight: [700.0, 900.0],
             fixed_delay_s: [0.02, 0.04], noise_position_m: [0.0], noise_heading_rad: [0.01]}
log: {chunk_bytes: 16384, train_profile: compact, evaluate_profile: full, sweep_profile: compact}
"""


@pytest.fixture(scope="session")
def tiny(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Scenario:
    path = tmp_path_factory.mktemp("scenario") / "tiny.yaml"
    path.write_text(TINY, encoding="utf-8")
    return load_scenario(path, defaults=project_root / "src/hiersched/config" / "defaults.yaml")


@pytest.fixture(scope="session")
def designed(tiny: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results folder with the gains of the tiny study; tests must not write here."""
    results = tmp_path_factory.mktemp("designed")
    for design in gain_designs(tiny):
        design_gains(tiny, design, results / paths.gain_file(design))
    return results


@pytest.fixture
def results(designed: Path, tmp_path: Path) -> Path:
    """Results folder with gains, for one test."""
    shutil.copytree(designed, tmp_path / "results")
    return tmp_path / "results"
