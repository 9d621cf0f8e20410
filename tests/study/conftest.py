from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hiersched.runs import paths
from hiersched.runs.gain_points import GAIN_SWEEPS, GainPoint, gain_points
from hiersched.runs.variants import (
    SWEPT_KEYS,
    cell_text,
    policy_groups,
    study_scenario,
    swept_policies,
    swept_values,
)
from hiersched.study.collect import write_measures

from hiersched.control import Certificate, GainSchedule
from hiersched.core.files import csv_text, write_bytes
from hiersched.experiments.logged import RunSlots
from hiersched.log import TOPICS, LogDims, LogWriter
from hiersched.scenario import Scenario, load_scenario
from hiersched.scenario.schema import checkpoint_rounds
from hiersched.simulator.loop_gains import plant_of
from hiersched.study.fifo import backlog_path, deadline_in_slots, late_packets
from hiersched.study.metrics import measured_row

DIMS = LogDims(num_urllc=2, num_embb=1, num_prb=4)
Fields = dict[str, Any]


def _zero_fields(slots: int, dims: LogDims = DIMS) -> Fields:
    """Every field of the log, zero."""
    return {
        field.name: np.zeros((slots, *field.sized(dims.sizes)), field.dtype)
        for topic in TOPICS.values()
        for field in topic.fields
    }


def _queue_fields(
    scenario: Scenario, arrivals: np.ndarray, service: np.ndarray, dims: LogDims = DIMS
) -> Fields:
    """Fields of a run with these arrivals and this service, the rest zero."""
    fields = _zero_fields(len(arrivals), dims)
    traffic, slot_s = scenario.traffic, scenario.radio.slot_s
    backlog = backlog_path(arrivals, service)
    fields |= {"arrivals_packets": arrivals, "service_packets": service}
    fields["backlog_packets"] = backlog[:-1]
    for user in range(arrivals.shape[1]):
        own = user < dims.num_urllc
        deadline_s = traffic.deadline_s if own else traffic.embb_deadline_s
        due, late = late_packets(
            arrivals[:, user],
            service[:, user],
            backlog[:, user],
            deadline_in_slots(deadline_s, slot_s),
        )
        fields["due_packets"][:, user], fields["late_packets"][:, user] = due, late
    return fields


def _write_log(path: Path, fields: Fields, dims: LogDims = DIMS, **settings: Any) -> Path:
    metadata: Mapping[str, str] = settings.pop("metadata", {"policy": "pf", "seed": "1"})
    path.parent.mkdir(parents=True, exist_ok=True)
    with LogWriter(path, dims, "compact", metadata, slot_ns=10_000_000, **settings) as log:
        log.write_block(0, fields)
    return path


@pytest.fixture(scope="session")
def zero_fields() -> Callable[..., Fields]:
    return _zero_fields


@pytest.fixture(scope="session")
def queue_fields() -> Callable[..., Fields]:
    return _queue_fields


@pytest.fixture(scope="session")
def write_log() -> Callable[..., Path]:
    return _write_log


@pytest.fixture(scope="session")
def tiny(project_root: Path) -> Scenario:
    """Two robots, one video user, few seeds and values: a study that is written in a second."""
    base = load_scenario(
        project_root / "src/hiersched/config/scenarios/smoke.yaml",
        defaults=project_root / "src/hiersched/config/defaults.yaml",
    )
    learning = replace(base.learning, seeds=(1, 2), slots_per_episode=5, num_envs=2, episodes=4)
    return replace(
        base,
        name="tiny",
        users=replace(base.users, num_urllc=2, num_embb=1),
        radio=replace(base.radio, num_prb=4),
        traffic=replace(base.traffic, urllc_offered_mbps=10.0),
        robot=replace(base.robot, window_s=0.1),
        learning=learning,
        learners={"flat": replace(learning, network="mlp")},
        evaluate=replace(
            base.evaluate,
            warmup_s=0.0,
            seeds=(11, 12, 13),
            policies=("ddpg", "pf", "drift_plus_penalty", "flat"),
        ),
        sweeps=replace(
            base.sweeps,
            seeds=(21, 22, 23),
            policies=("ddpg", "pf"),
            rayleigh_scale=(0.5, 1.0),
            sampling_s=(0.02, 0.05),
            reference=("zigzag", "arc"),
            load=(0.85, 1.0),
            load_ratio=(0.7, 1.4),
            service_coefficient_mbps=(0.0, 8.0),
        ),
        generalise=replace(
            base.generalise,
            seeds=(41, 42, 43),
            cells=((2, 1, 4), (2, 1, 6)),
            policies=("ddpg", "pf", "drift_plus_penalty"),
        ),
        gain_study=replace(base.gain_study, seeds=(31, 32, 33)),
    )


def _run(scenario: Scenario, policy: str, seed: int, slots: int = 40) -> Fields:
    """Random traffic that one policy serves twice as well: known to differ, not simulated."""
    rng = np.random.default_rng(seed)
    arrivals = rng.poisson(8.0, (slots, 3)).astype(np.uint32)
    rate = rng.uniform(7.0, 10.0, (slots, 3)) * (1.6 if policy == "ddpg" else 1.0)
    fields = _queue_fields(scenario, arrivals, rate)
    fields["rate_mbps"] = rate
    fields["mean_fading_power"] = rng.uniform(1.0, 3.0, (slots, 3)).astype(np.float32)
    fields["tracking_error_m"] = rng.uniform(0.01, 0.02, (slots, 2))
    fields["dexterity_index"] = rng.uniform(0.7, 0.8, (slots, 2))
    fields["penalty_urllc"] = rng.uniform(0.0, 1.0, slots)
    return fields


def _schedule(scenario: Scenario) -> GainSchedule:
    """A schedule with made-up verdicts: adjusted from T = 4 on, infeasible at the last delay."""
    plant, steps = plant_of(scenario), scenario.max_delay_steps
    certificates = tuple(
        Certificate(
            certified=delay < steps,
            tolerance=1e-9,
            spectral_radii=np.linspace(0.9, 0.95, delay + 1),
        )
        for delay in range(steps + 1)
    )
    gains = np.repeat(plant.nominal_gain[None], steps + 1, axis=0)
    gains[4:steps] *= 0.9
    return GainSchedule(
        gains=gains,
        status=(*["nominal"] * 4, *["adjusted"] * (steps - 4), "infeasible"),
        certificates=certificates,
        nominal=plant.nominal_gain,
        operator_gain=plant.operator_gain,
        kind=plant.kind,
        method="krasovskii",
        decay_rate=None,
        sampling_s=plant.sampling_s,
        key="made up",
    )


@pytest.fixture(scope="session")
def results(tmp_path_factory: pytest.TempPathFactory, tiny: Scenario) -> Path:
    """A results folder with every log of the tiny scenario."""
    folder: Path = tmp_path_factory.mktemp("results")
    for policy in tiny.evaluate.policies:
        label = {"policy": policy, "stage": "evaluate"}
        files = {s: f"eval/{policy}/seed{s}.mcap" for s in tiny.evaluate.seeds}
        crossed = paths.evaluation_crossed(policy)
        _write_runs(folder, tiny, label, files, crossed, lambda seed: seed)
    for axis in SWEPT_KEYS:
        for policy in swept_policies(tiny, axis):
            for value in swept_values(tiny, axis):
                text = value if isinstance(value, str) else f"{value:g}"
                label = {"policy": policy, "stage": "sweep", "axis": axis, "value": text}
                files = {s: f"sweep/{axis}/{policy}/{text}_seed{s}.mcap" for s in tiny.sweeps.seeds}
                crossed = paths.sweep_crossed(axis, policy, value)
                shift = _number_of(text)
                _write_runs(folder, tiny, label, files, crossed, lambda seed, k=shift: seed + k)
    for cell in tiny.generalise.cells:
        for policy in tiny.generalise.policies:
            label = {"policy": policy, "stage": "generalise", "axis": "cell"}
            label["value"] = cell_text(cell)
            files = {s: paths.cell_log(cell, policy, s) for s in tiny.generalise.seeds}
            crossed = paths.cell_crossed(cell, policy)
            _write_runs(folder, tiny, label, files, crossed, lambda seed, k=cell[2]: seed + k)
    _write_bound(folder, tiny)
    _write_gain_study(folder, tiny)
    for learner in tiny.learned:
        for seed in tiny.learning.seeds:
            fields = _run(tiny, learner, seed, slots=20)
            fields["reward_urllc"] = np.repeat(np.arange(4.0), 5) + seed
            label = {"policy": learner, "seed": str(seed), "slots_per_episode": "5"}
            _write_log(folder / paths.training_log(learner, seed), fields, metadata=label)
            worlds = tiny.learning.checkpoint_worlds
            slots = 5 * worlds * len(checkpoint_rounds(tiny.learning))
            fixed = _run(tiny, learner, seed + 100, slots=slots)
            label["episodes_per_round"] = str(worlds)
            _write_log(folder / paths.checkpoint_log(learner, seed), fixed, metadata=label)
    for group in policy_groups(tiny):
        write_measures(folder, tiny, group)
    return folder


def _write_runs(
    folder: Path,
    scenario: Scenario,
    label: dict[str, str],
    files: dict[int, str],
    crossed: str,
    numbered: Callable[[int], int],
) -> None:
    """Log a policy in its worlds; of a learner's two, world i under policy i, the others as rows.

    The second policy of a learner serves each world as if it were another.
    """
    learning = scenario.learned.get(label["policy"])
    policies: tuple[int | None, ...] = (None,) if learning is None else learning.seeds
    rows = []
    for place, (seed, name) in enumerate(files.items()):
        for index, policy_seed in enumerate(policies):
            fields = _run(scenario, label["policy"], numbered(seed) + 500 * index)
            text = {**label, "seed": str(seed)}
            if policy_seed is not None:
                text["policy_seed"] = str(policy_seed)
            if place % len(policies) == index:
                _write_log(folder / name, fields, metadata=text)
            else:
                slots = RunSlots(
                    source="planted",
                    metadata=text,
                    num_urllc=2,
                    slot_s=0.01,
                    warmup_slots=0,
                    fields=fields,
                )
                rows.append(measured_row(slots, scenario))
    if rows:
        write_bytes(folder / crossed, csv_text(pd.DataFrame(rows)).encode())


def _write_bound(folder: Path, scenario: Scenario) -> None:
    """Two slots a world, optimum -100: gaps of 1 + seed - 12 (greedy), 50 (ddpg), 200 (pf)."""
    gaps = {"ddpg": 50.0, "pf": 200.0, "drift_plus_penalty": 1.0, "flat": 60.0}
    names = "policy seed slot decider value exact bound first_lagrangian_exact "
    names += "first_lagrangian_greedy first_log_rate_exact first_log_rate_greedy"
    lines = [",".join(names.split())]
    for policy in scenario.evaluate.policies:
        asked = gaps if policy == "drift_plus_penalty" else (policy, "drift_plus_penalty")
        for seed in scenario.evaluate.seeds:
            for decider in asked:
                value = -100.0 + gaps[decider] + (seed - 12) * (decider == "drift_plus_penalty")
                row = f"{decider},{value},-100.0,-100.001,10.0,12.0,-5.0,-4.5"
                lines += [f"{policy},{seed},{slot},{row}" for slot in (3, 8)]
    (folder / paths.BOUND).parent.mkdir()
    (folder / paths.BOUND).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _number_of(text: str) -> int:
    return sum(map(ord, text))


RATIOS = {"krasovskii": 0.5, "razumikhin": 1.0, "predictor": 1.2}
"""Adjusted over nominal error in violated windows, by method; planted."""


def _write_gain_study(folder: Path, scenario: Scenario) -> None:
    """Nominal 1.8, 2.0, 2.2 cm; adjusted 0.49, 0.50, 0.51 of it, or so, in violated windows."""
    study = scenario.gain_study
    for name in paths.gain_study_logs(scenario):
        method, gain, seed = _label(name)
        error = np.full((study.num_windows, 10, 2), 0.02) * (1.0 + 0.1 * (seed - 32))
        if gain == "adjusted":
            for window in study.violation_windows:
                error[window - 1] *= RATIOS[method] + 0.01 * (seed - 32) * (method != "razumikhin")
        variant = study_scenario(scenario, method, gain)
        _write_robots(folder / name, variant, error.reshape(-1, 2), seed)
    for axis in GAIN_SWEEPS:
        for point in gain_points(scenario, axis):
            for gain in ("nominal", "adjusted"):
                for seed in study.seeds:
                    _write_point(folder, scenario, axis, point, gain, seed)
    rows = [
        {
            "axis": axis,
            "value": value,
            "plant": "network",
            "sampling_s": value if axis == "sampling_s" else 0.02,
            "criterion": criterion,
            "delay_steps": longest,
            "max_delay_steps": 12,
        }
        for axis, value, criterion, longest in (
            ("weight", 100.0, "exact", 8),
            ("weight", 100.0, "c1", None),
            ("weight", 100.0, "c3", 12),
            ("sampling_s", 0.02, "exact", 3),
            ("sampling_s", 0.05, "exact", 12),
        )
    ]
    (folder / paths.STABILITY).parent.mkdir(parents=True, exist_ok=True)
    (folder / paths.STABILITY).write_text(json.dumps(rows), encoding="utf-8")


def _write_point(
    folder: Path, scenario: Scenario, axis: str, point: GainPoint, gain: str, seed: int
) -> None:
    """2 cm, but 12 cm at its limits of one robot in the violated window; adjusted: 0.6 of it."""
    error = np.full((2, 10, 2), 0.02) * (1.0 + 0.1 * (seed - 32))
    saturated = np.zeros((2, 10, 2), np.uint32)
    error[1, :, 1], saturated[1, :, 1] = 0.12, 1
    if gain == "adjusted" and point.violation_delay_s[1] > 0.06:
        error[1] *= 0.6
    path = folder / paths.gain_sweep_log(axis, point.value, gain, seed)
    _write_robots(path, point.scenario, error.reshape(-1, 2), seed, saturated.reshape(-1, 2))


def _write_robots(
    path: Path,
    scenario: Scenario,
    error_m: np.ndarray,
    seed: int,
    saturated: np.ndarray | int = 0,
) -> None:
    fields = _zero_fields(len(error_m))
    fields["tracking_error_m"] = error_m
    fields["control_saturated"][:] = saturated
    schedule = _schedule(scenario).to_json().encode()
    label = {"policy": "none", "seed": str(seed)}
    _write_log(path, fields, metadata=label, attachments={"schedule.json": schedule})


def _label(name: str) -> tuple[Any, Any, int]:
    """``gain_study/<method>_<gain>_seed<N>.mcap`` -> method, gain, N."""
    method, gain, seed = Path(name).stem.rsplit("_", 2)
    return method, gain, int(seed.removeprefix("seed"))
