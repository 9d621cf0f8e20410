"""A study of two robots and one camera with planted logs: what is in them is known, not simulated.

Its measures and what it shows are made as in the workflow, each once.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from hiersched.control import Certificate, GainSchedule
from hiersched.core.files import write_parquet
from hiersched.experiments import files
from hiersched.experiments.gains import designs
from hiersched.experiments.logged import RunSlots
from hiersched.experiments.points import Experiment, Point, experiments
from hiersched.log import TOPICS, LogDims, LogWriter
from hiersched.scenario import Scenario, load_scenario
from hiersched.scenario.schema import checkpoint_rounds
from hiersched.simulator.loop_gains import plant_of
from hiersched.study import growth as growth_module
from hiersched.study import study as study_module
from hiersched.study.built_in import shown
from hiersched.study.fifo import backlog_path, deadline_in_slots, late_packets
from hiersched.study.growth import write_growth
from hiersched.study.measure import measure, measured_groups
from hiersched.study.metrics import measured_row
from hiersched.study.registry import CLAIMS, FIGURES, TABLES, Shown
from hiersched.study.show import show
from hiersched.study.study import Study

TINY = """
users: {num_urllc: 2, num_embb: 1}
radio: {bandwidth_hz: 1.6e+6, num_prb: 4}
traffic: {urllc_offered_mbps: 10.0}
robot: {window_s: 0.1}
learning: {seeds: [1, 2], slots_per_episode: 5, num_envs: 2, episodes: 4, checkpoints: 3,
           checkpoint_worlds: 2}
learners: {alt: {network: mlp}}
evaluate: {seeds: [11, 12, 13], warmup_s: 0.04, duration_s: 0.36, full_logs: 0,
           policies: [ddpg, pf, drift_plus_penalty, alt]}
sweeps:
  seeds: [21, 22, 23]
  warmup_s: 0.0
  policies: [ddpg, pf]
  axes:
    rayleigh_scale: {vary: {radio.fading.scale: [0.5, 1.0]}}
    sampling_s: {vary: {control.sampling_s: [0.02, 0.05]}}
    reference: {vary: {robot.reference: [zigzag, arc]}}
    load: {vary: {traffic.load: [0.85, 1.0]}}
    load_ratio: {vary: {traffic.load_ratio: [0.7, 1.4]}}
    service_coefficient_mbps:
      vary: {traffic.service_coefficient_mbps: [0.0, 8.0], control.sampling_s: [0.02, 0.05]}
generalise: {seeds: [41, 42, 43], warmup_s: 0.0, cells: [[2, 1, 4], [2, 1, 6]],
             policies: [ddpg, pf, drift_plus_penalty]}
gain_study: {seeds: [31, 32, 33], methods: [krasovskii, razumikhin, predictor], weight: [100.0],
             fixed_delay_s: [0.04, 0.2], sampling_s: [0.02, 0.05],
             noise_position_m: [0.0, 0.002], noise_heading_rad: [0.0, 0.005],
             cells: {near: {delay_s: 0.04}, far: {delay_s: 0.2, sawtooth: true}},
             cell_methods: [krasovskii, predictor], cell_windows: 3}
"""
WRITTEN_FIGURES = ("fig8_violations", "figX_gain_grid")

DIMS = LogDims(num_urllc=2, num_embb=1, num_prb=4)
Fields = dict[str, Any]


@pytest.fixture(scope="session", autouse=True)
def _unverified_gains() -> Iterator[None]:
    """Take made-up gains as they are: their verdicts are planted, and fit no plant."""

    def read(path: Path, scenario: Scenario) -> GainSchedule:
        return GainSchedule.from_json(path.read_text(encoding="utf-8"))

    with pytest.MonkeyPatch.context() as patch:
        for module in (study_module, growth_module):
            patch.setattr(module, "read_gains", read)
        yield


@pytest.fixture(scope="session")
def variant_of_tiny(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Scenario]:
    """The tiny study with something else, as YAML; each text goes over those before it."""
    folder = tmp_path_factory.mktemp("scenario")

    def load(*texts: str) -> Scenario:
        for number, text in enumerate((TINY, *texts)):
            path = folder / f"{number}.yaml"
            base = f"extends: {number - 1}.yaml\n" if number else ""
            path.write_text(f"name: tiny\n{base}{text}", encoding="utf-8")
        return load_scenario(path)

    return load


@pytest.fixture(scope="session")
def tiny(variant_of_tiny: Callable[..., Scenario]) -> Scenario:
    return variant_of_tiny()


@pytest.fixture(scope="session")
def logs(tmp_path_factory: pytest.TempPathFactory, tiny: Scenario) -> Path:
    """Every file of the tiny study that its measures and figures come from."""
    folder: Path = tmp_path_factory.mktemp("logs")
    for experiment in experiments(tiny).values():
        for point, policy in experiment.runs(experiment.policies):
            if experiment.forced:
                _write_robots(folder, experiment, point, policy)
            else:
                _write_runs(folder, tiny, experiment, point, policy)
    for learner in tiny.learned:
        _write_training(folder, tiny, learner)
    for name, variant in designs(tiny).items():
        path = folder / files.gain_file(name)
        path.parent.mkdir(exist_ok=True)
        path.write_text(_schedule(variant).to_json(), encoding="utf-8")
    _write_stability(folder / files.STABILITY)
    _write_bound(folder / files.BOUND, tiny)
    return folder


@pytest.fixture(scope="session")
def measured(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[Scenario], Path]:
    """Measure what a scenario has of the logs of the tiny study, into a folder of its own."""

    def folder_of(scenario: Scenario) -> Path:
        folder: Path = tmp_path_factory.mktemp("results")
        for path in logs.iterdir():
            (folder / path.name).symlink_to(path)
        for group in measured_groups(scenario):
            measure(scenario, folder, group)
        write_growth(scenario, folder)
        return folder

    return folder_of


@pytest.fixture(scope="session")
def results(measured: Callable[[Scenario], Path], tiny: Scenario) -> Path:
    """Results folder of the tiny study with its measures."""
    return measured(tiny)


@pytest.fixture(scope="session")
def study(results: Path, tiny: Scenario) -> Study:
    return Study(tiny, results)


@pytest.fixture(scope="session")
def with_sources(
    results: Path, tiny: Scenario, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[Shown], Path]:
    """A folder with the files alone that a table, figure or claim says it reads."""

    def folder_of(thing: Shown) -> Path:
        folder: Path = tmp_path_factory.mktemp(thing.name)
        for source in Study.sources(tiny, thing.reads):
            (folder / source).parent.mkdir(parents=True, exist_ok=True)
            (folder / source).symlink_to(results / source)
        return folder

    return folder_of


@pytest.fixture(scope="session")
def written(
    with_sources: Callable[[Shown], Path], tiny: Scenario, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Files of all tables and claims, and of some figures."""
    whole: Path = tmp_path_factory.mktemp("shown")
    for kind, registry in (("table", TABLES), ("figure", FIGURES), ("claim", CLAIMS)):
        for name, thing in shown(registry, tiny).items():
            if kind != "figure" or name in WRITTEN_FIGURES:
                folder = with_sources(thing)
                show(tiny, folder, kind, name, thing.module)
                shutil.copytree(folder / f"{kind}s", whole / f"{kind}s", dirs_exist_ok=True)
    return whole


@pytest.fixture(scope="session")
def tables(written: Path) -> dict[str, pd.DataFrame]:
    """Tables as they are read back."""
    return {path.stem: pd.read_csv(path) for path in sorted((written / "tables").glob("*.csv"))}


@pytest.fixture(scope="session")
def planted(results: Path) -> Callable[..., Study]:
    """Return a study with some of its properties replaced, such as its runs."""

    def make(scenario: Scenario, **properties: Any) -> Study:
        study = Study(scenario, results)
        for name, value in properties.items():
            setattr(study, name, value)
        return study

    return make


# Logs.


@pytest.fixture(scope="session")
def zero_fields() -> Callable[..., Fields]:
    return _zero_fields


@pytest.fixture(scope="session")
def queue_fields() -> Callable[..., Fields]:
    return _queue_fields


@pytest.fixture(scope="session")
def write_log() -> Callable[..., Path]:
    return _write_log


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


def _write_log(
    path: Path,
    fields: Fields,
    dims: LogDims = DIMS,
    *,
    metadata: dict[str, str] | None = None,
    profile: str = "compact",
) -> Path:
    label = {"policy": "pf", "seed": "1"} if metadata is None else metadata
    path.parent.mkdir(parents=True, exist_ok=True)
    with LogWriter(path, dims, profile, label, slot_ns=10_000_000) as log:
        log.write_block(0, fields)
    return path


# The tiny study's.


def _run(scenario: Scenario, policy: str, seed: int, slots: int = 40) -> Fields:
    """Random traffic that one policy serves twice as well."""
    rng = np.random.default_rng(seed)
    arrivals = rng.poisson(8.0, (slots, 3)).astype(np.uint32)
    rate = rng.uniform(7.0, 10.0, (slots, 3)) * (1.6 if policy == "ddpg" else 1.0)
    fields = _queue_fields(scenario, arrivals, rate)
    fields["rate_mbps"] = rate
    fields["mean_fading_power"] = rng.uniform(1.0, 3.0, (slots, 3)).astype(np.float32)
    fields["tracking_error_m"] = rng.uniform(0.01, 0.02, (slots, 2))
    fields["control_saturated"] = rng.integers(0, 2, (slots, 2), np.uint32)
    fields["dexterity_index"] = rng.uniform(0.7, 0.8, (slots, 2))
    fields["penalty_urllc"] = rng.uniform(0.0, 1.0, slots)
    return fields


def _write_runs(
    folder: Path, scenario: Scenario, experiment: Experiment, point: Point, policy: str
) -> None:
    """Log a policy in its worlds; of a learner's two, world i under policy i, the others as rows.

    The second policy of a learner serves each world as if it were another.
    """
    learning = scenario.learned.get(policy)
    policies: tuple[int | None, ...] = (None,) if learning is None else learning.seeds
    warmup_slots = experiment.num_slots(point.scenario)[1]
    rows = []
    for place, seed in enumerate(experiment.seeds):
        for index, policy_seed in enumerate(policies):
            fields = _run(scenario, policy, seed + 500 * index + sum(map(ord, point.value)))
            label = {"policy": policy, "stage": experiment.stage, "seed": str(seed)}
            label |= {"axis": experiment.axis, "value": point.value}
            if policy_seed is not None:
                label["policy_seed"] = str(policy_seed)
            if warmup_slots:
                label["warmup_slots"] = str(warmup_slots)
            if place % len(policies) == index:
                path = folder / files.run_log(experiment, point, policy, seed)
                _write_log(path, fields, metadata=label)
                continue
            slots = RunSlots(
                source="planted",
                metadata=label,
                num_urllc=2,
                slot_s=0.01,
                warmup_slots=warmup_slots,
                fields=fields,
            )
            rows.append(measured_row(slots, point.scenario))
    if rows:
        write_parquet(folder / files.crossed_file(experiment, point, policy), pd.DataFrame(rows))


def _write_training(folder: Path, scenario: Scenario, learner: str) -> None:
    """Reward of episode k (from 0) is k + seed."""
    learning = scenario.learned[learner]
    worlds = learning.checkpoint_worlds
    for seed in learning.seeds:
        fields = _run(scenario, learner, seed, slots=20)
        fields["reward_urllc"] = np.repeat(np.arange(4.0), 5) + seed
        label = {"policy": learner, "seed": str(seed), "slots_per_episode": "5"}
        _write_log(folder / files.training_log(learner, seed), fields, metadata=label)
        slots = 5 * worlds * len(checkpoint_rounds(learning))
        fields = _run(scenario, learner, seed + 100, slots=slots)
        label["episodes_per_round"] = str(worlds)
        _write_log(folder / files.checkpoint_log(learner, seed), fields, metadata=label)


RATIOS = {"krasovskii": 0.5, "razumikhin": 1.0, "predictor": 1.2, "lqg": 0.4}
"""Adjusted over nominal error in violated windows, by method."""


def _write_robots(folder: Path, experiment: Experiment, point: Point, gain: str) -> None:
    """Nominal 1.8, 2.0, 2.2 cm; adjusted 0.49, 0.50, 0.51 of it, or so, in violated windows.

    In sweeps 2 cm likewise, but 12 cm at its limits of one robot in the violated window; adjusted
    0.6 of that where delays are long. Delays are of four samples in violated windows, else of one.
    """
    assert point.delays is not None
    for seed in experiment.seeds:
        windows = experiment.num_slots(point.scenario)[0] // 10
        error = np.full((windows, 10, 2), 0.02) * (1.0 + 0.1 * (seed - 32))
        saturated = np.zeros((windows, 10, 2), np.uint32)
        violated = [window - 1 for window in point.delays.windows]
        if experiment.axis:
            error[violated, :, 1], saturated[violated, :, 1] = 0.12, 1
        if gain == "adjusted" and not experiment.axis:
            ratio = RATIOS[point.value]
            error[violated] *= ratio + 0.01 * (seed - 32) * (point.value != "razumikhin")
        elif gain == "adjusted" and point.delays.violation_s[1] > 0.06:
            error[violated] *= 0.6
        fields = _zero_fields(10 * windows)
        fields["tracking_error_m"] = error.reshape(-1, 2)
        fields["control_saturated"] = saturated.reshape(-1, 2)
        steps = np.ones((windows, 10, 2), np.uint32)
        steps[violated] = 4
        fields["delay_steps"] = steps.reshape(-1, 2)
        label = {"policy": "none", "seed": str(seed), "stage": experiment.stage}
        path = folder / files.run_log(experiment, point, gain, seed)
        _write_log(path, fields, metadata=label, profile="robots")


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
        status=(*["nominal"] * min(4, steps), *["adjusted"] * (steps - 4), "infeasible"),
        certificates=certificates,
        nominal=plant.nominal_gain,
        operator_gain=plant.operator_gain,
        kind=plant.kind,
        method=scenario.control.method,
        decay_rate=None,
        sampling_s=plant.sampling_s,
        key="made up",
    )


def _write_stability(path: Path) -> None:
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
    path.write_text(json.dumps(rows), encoding="utf-8")


def _write_bound(path: Path, scenario: Scenario) -> None:
    """Two slots a world, optimum -100: gaps of 1 + seed - 12 (greedy), 50 (ddpg), 200 (pf)."""
    gaps = {"ddpg": 50.0, "pf": 200.0, "drift_plus_penalty": 1.0, "alt": 60.0}
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
    path.parent.mkdir()
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
