"""Logs of every stage of a study that is over in seconds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hiersched.experiments import files
from hiersched.experiments.gains import design_gains, designs
from hiersched.experiments.learned import learned_policies
from hiersched.experiments.points import experiments, groups
from hiersched.experiments.run import run_experiment
from hiersched.experiments.train import train_and_log
from hiersched.experiments.worlds import untrained_policies
from hiersched.log import LogReader, LogWriter
from hiersched.scenario import Scenario, load_scenario
from hiersched.study.metrics import measured_row

# Two worlds for each learned policy: they run side by side. Windows of a tenth of a second: the
# dexterity index changes within a run. Delays beyond the table: events.
SMALL = """
name: small
users: {num_urllc: 2, num_embb: 2}
radio: {bandwidth_hz: 2.0e+6, num_prb: 5}
traffic: {urllc_offered_mbps: [20.0, 30.0], load: 1.1}
control: {max_delay_s: 0.04}
robot: {window_s: 0.1}
learning: {seeds: [1], episodes: 4, slots_per_episode: 12, num_envs: 2, hidden: [8],
           batch_size: 8, warmup_slots: 4}
learners: {flat: {algorithm: a2c, network: mlp, start: drift_plus_penalty, seeds: [2]},
           aware: {algorithm: es, network: linear, start: drift_plus_penalty, weighs: drift,
                   observe_demand: true, pairs: 1, num_envs: 6, episodes: 12, seeds: [3]}}
evaluate: {seeds: [11, 12], warmup_s: 0.1, duration_s: 0.3, full_logs: 0,
           policies: [ddpg, flat, aware, pf, edf, drift_plus_penalty]}
sweeps: {seeds: [21], warmup_s: 0.0, duration_s: 0.1, policies: [ddpg, pf],
         axes: {rayleigh_scale: {vary: {radio.fading.scale: [0.5]}},
                reference: {vary: {robot.reference: [arc]}}, sampling_s: null, load: null,
                load_ratio: null, service_coefficient_mbps: null}}
generalise: {seeds: [41], warmup_s: 0.0, duration_s: 0.1, policies: [ddpg, pf], cells: [[3, 2, 6]]}
gain_study: {seeds: [31], num_robots: 3, num_windows: 3, violation_windows: [2], weight: [],
             sampling_s: [], noise_position_m: [], noise_heading_rad: []}
log: {chunk_bytes: 16384, evaluate_profile: full, sweep_profile: compact}
"""


@pytest.fixture(scope="session")
def small(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Scenario:
    path = tmp_path_factory.mktemp("scenario") / "small.yaml"
    path.write_text(SMALL, encoding="utf-8")
    return load_scenario(path, defaults=project_root / "src/hiersched/config" / "defaults.yaml")


@pytest.fixture(scope="session")
def study(small: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a whole study; tests must not write here."""
    results = tmp_path_factory.mktemp("study")
    for design in designs(small):
        design_gains(small, design, results / files.gain_file(design))
    sources = {"classical": untrained_policies, "gains": untrained_policies}
    for learner in small.learned:
        train_and_log(small, learner, results, "code", show=False)
        weights = [results / name for name in files.policy_files(small, learner)]
        sources[learner] = learned_policies(weights)
    for name, experiment in experiments(small).items():
        for group in groups(small, experiment):
            run_experiment(small, results, name, group, sources[group], measured_row)
    return results


@pytest.fixture(scope="session")
def rewrite() -> Callable[..., Path]:
    """Write a log once more, with something in it changed: all its checksums are right."""

    def write(
        source: Path,
        target: Path,
        change: Callable[[dict, list, dict], None],
        attached: dict[str, bytes] | None = None,
    ) -> Path:
        with LogReader(source) as log:
            fields: dict[str, Any] = {}
            for topic in log.topics:
                fields |= log.read(topic)
            events, metadata = log.events(), dict(log.metadata)
            dims, profile, slot_ns = log.dims, log.profile, log.slot_ns
            attachments = {**log.attachments, **(attached or {})}
        first = int(fields.pop("slot")[0])
        change(fields, events, metadata)
        with LogWriter(target, dims, profile, metadata, attachments, slot_ns=slot_ns) as writer:
            writer.write_block(first, fields)
            for event in events:
                writer.event(*event)
        return target

    return write
