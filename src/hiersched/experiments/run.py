"""Runs an experiment: every policy at every point in the worlds of all seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from hiersched.core.files import write_parquet
from hiersched.experiments import files
from hiersched.experiments.gains import design_of, load_gains
from hiersched.experiments.logged import RunSlots
from hiersched.experiments.logging import RunLabel, write_log
from hiersched.experiments.points import (
    GAIN_GROUP,
    Experiment,
    Gain,
    Point,
    experiments,
    groups,
    has_unlogged,
)
from hiersched.experiments.worlds import PolicySource, WorldRun, run_worlds, seed_worlds
from hiersched.scenario import Scenario
from hiersched.simulator import Gains, Simulator

Measure = Callable[[RunSlots, Scenario], dict[str, Any]]
"""From the slots of a run to a row of its measures."""
AsRun = Callable[[Path, Experiment, Point, str], Scenario]
"""(results, experiment, point, policy) -> the scenario that runs."""


def run_experiment(
    scenario: Scenario,
    results: Path,
    name: str,
    group: str,
    source: PolicySource,
    measure: Measure | None = None,
    as_run: AsRun | None = None,
) -> None:
    """Run and log a group of policies; every policy runs in all worlds of a point as one batch.

    Of a learner's policies one a world is logged, the others are measured as they run, by
    `measure`; where an experiment logs its first worlds alone, all are. The beginning of the first
    worlds is also logged in full: to look at, not to measure. `results` is the folder of the study,
    with its gain schedules; `name` is one of `experiments`, `group` one of its `groups`. `as_run`
    gives the scenario of the runs at a point that waits for other jobs.
    """
    experiment = experiments(scenario)[name]
    policies = groups(scenario, experiment)[group]
    _clear(scenario, results, experiment, group)
    for point, policy in experiment.runs(policies):
        variant = point.scenario
        if group == GAIN_GROUP:
            variant = gain_variant(point, policy)  # type: ignore[arg-type]  # one of GAINS
        elif point.tuned:
            assert as_run is not None  # only the study of the task has such points
            variant = as_run(results, experiment, point, policy)
        path = results / files.gain_file(design_of(scenario, variant))
        schedule, gains = load_gains(path, variant)
        num_slots, warmup_slots = experiment.num_slots(variant)
        metadata = {"warmup_slots": str(warmup_slots)} if warmup_slots else {}
        if point.delays is not None:
            metadata |= {"method": variant.control.method, "delays": point.delays.to_json()}
            runs = _forced_runs(experiment, point, variant, gains)
        else:
            worlds = experiment.stage, experiment.seeds, num_slots
            runs = run_worlds(variant, gains, source(variant, policy), *worlds)
        rows = []
        for run in runs:
            label = RunLabel(
                stage=experiment.stage,
                policy="none" if experiment.forced else policy,
                seed=run.seed,
                axis=experiment.axis,
                value=point.value if experiment.axis else "",
            )
            run = replace(run, metadata={**run.metadata, **metadata})
            is_logged = run.logged and run.seed in experiment.logged_seeds
            if not is_logged or experiment.logs is not None:
                assert measure is not None  # else there are as many logs as runs
                rows.append(measure(slots_of(variant, label, run), variant))
            if not is_logged:
                continue
            path = results / files.run_log(experiment, point, policy, run.seed)
            write_log(path, variant, schedule, label, run, profile=experiment.profile)
            if run.seed in experiment.seeds[: experiment.full_logs]:
                first = run.beginning(round(experiment.full_log_s / variant.radio.slot_s))
                path = results / files.full_log(experiment, point, policy, run.seed)
                write_log(path, variant, schedule, label, first, profile="full")
        if has_unlogged(scenario, experiment, policy):
            crossed = results / files.crossed_file(experiment, point, policy)
            write_parquet(crossed, pd.DataFrame(rows))
        print(f"{name} {point.value} {policy}: {num_slots} slots", flush=True)


def gain_variant(point: Point, gain: Gain) -> Scenario:
    """Return the scenario of a point of the gain study under nominal or adjusted gains."""
    return replace(point.scenario, control=replace(point.scenario.control, gain=gain))


def _forced_runs(
    experiment: Experiment, point: Point, variant: Scenario, gains: Gains
) -> Iterator[WorldRun]:
    assert point.delays is not None
    keys = seed_worlds(experiment.stage, experiment.seeds)
    num_slots, _ = experiment.num_slots(variant)
    delays = point.delays.draw(variant, keys, num_slots)
    record = Simulator(variant, gains, keys, num_slots).run_robots(delays)
    for index, seed in enumerate(experiment.seeds):
        yield WorldRun(seed=seed, fields=record.environment(index))


def slots_of(scenario: Scenario, label: RunLabel, run: WorldRun) -> RunSlots:
    """Return the slots of a run as `logged.read_slots` would read them from its log."""
    metadata = {**label.metadata(), **run.metadata}
    seed = metadata.get("policy_seed", "none")
    return RunSlots(
        source=f"{label.stage} {label.axis} {label.value} {label.policy}, policy {seed}, "
        f"world {label.seed}",
        metadata=metadata,
        num_urllc=scenario.users.num_urllc,
        slot_s=round(scenario.radio.slot_s * 1e9) * 1e-9,
        warmup_slots=int(metadata.get("warmup_slots", "0")),
        fields=dict(run.fields),
    )


def _clear(scenario: Scenario, results: Path, experiment: Experiment, group: str) -> None:
    """Remove what runs have left and nobody asks for now: other seeds, points, policies."""
    keep = {results / name for name in files.group_files(scenario, experiment, group)}
    own = groups(scenario, experiment)[group]
    others = {policy for run in groups(scenario, experiment).values() for policy in run} - set(own)
    for path in (results / files.RUNS / experiment.name).glob("**/*"):
        is_run = ".mcap" in path.name or path.name.startswith("crossed.")
        if is_run and path not in keep and path.parent.name not in others:
            path.unlink()
