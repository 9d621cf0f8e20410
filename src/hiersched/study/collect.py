"""From the logs of a results folder to data frames: one row a run, in the scenario's order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hiersched.control import GainSchedule
from hiersched.core.files import csv_text, write_bytes
from hiersched.log import LogError, LogReader
from hiersched.runs import paths
from hiersched.runs.logged import RunSlots, read_slots
from hiersched.runs.logging import slice_fields
from hiersched.runs.variants import (
    STUDY_PLANTS,
    SWEPT_KEYS,
    baseline_method,
    cell_scenario,
    cell_text,
    group_policies,
    group_runs,
    policy_groups,
    swept_policies,
    swept_values,
    value_text,
)
from hiersched.scenario import Scenario
from hiersched.scenario.schema import GainMethod, checkpoint_rounds
from hiersched.study.fifo import FloatArray
from hiersched.study.metrics import (
    metrics_row,
    run_metrics,
    slots_per_window,
    tracking_error_by_window_cm,
)

BASELINE = "pf"


def evaluation_log(results_dir: Path, policy: str, seed: int) -> Path:
    """Return the path of the evaluation log of a policy in a world."""
    return _existing(results_dir / "eval" / policy / f"seed{seed}.mcap")


def measure_group(results_dir: Path, scenario: Scenario, group: str) -> pd.DataFrame:
    """Measure every run of a group of policies in evaluation, sweeps and cells of other sizes.

    Parameters
    ----------
    results_dir
        Folder of the study, with the logs.
    scenario
        The scenario that was run.
    group
        One of `variants.policy_groups`.

    Returns
    -------
    DataFrame
        Columns of `RunMetrics`, one row a run, in the scenario's order, those of a learner by
        training seed and world; `stage` says evaluate, sweep or generalise, `axis` and `value` the
        point of a sweep or the cell, `policy_seed` the training seed (empty for a rule), `seed` the
        world, and `logged` whether the run has a log.

    Raises
    ------
    FileNotFoundError
        If a log of the scenario's policies and seeds is missing, or measures of runs without one.
    ValueError
        If a learner's policies are not those of its training seeds, each in every world.
    """
    tables = [_condition_frame(results_dir, run) for run in _conditions(scenario, group)]
    table = pd.concat(tables, ignore_index=True)
    first = ["policy", "policy_seed", "seed", "logged"]
    return table[[*first, *(name for name in table if name not in first)]]


class _Condition(NamedTuple):
    """Runs of one policy under one condition: their logs, by world, and measures of the others."""

    policy: str
    logs: dict[int, str]
    crossed: str
    scenario: Scenario
    stage: str
    axis: str = ""
    value: str = ""


def _conditions(scenario: Scenario, group: str) -> Iterator[_Condition]:
    """Yield the conditions under which a group runs, in the order of the scenario."""
    for policy in group_policies(scenario, scenario.evaluate.policies, group):
        logs = {seed: paths.evaluation_log(policy, seed) for seed in scenario.evaluate.seeds}
        crossed = paths.evaluation_crossed(policy)
        yield _Condition(policy, logs, crossed, scenario, "evaluate")
    for axis in SWEPT_KEYS:
        for policy in group_policies(scenario, swept_policies(scenario, axis), group):
            for value in swept_values(scenario, axis):
                seeds = scenario.sweeps.seeds
                logs = {seed: paths.sweep_log(axis, policy, value, seed) for seed in seeds}
                crossed = paths.sweep_crossed(axis, policy, value)
                text = value_text(value)
                yield _Condition(policy, logs, crossed, scenario, "sweep", axis, text)
    for cell in scenario.generalise.cells:
        variant = cell_scenario(scenario, cell)
        for policy in group_policies(scenario, scenario.generalise.policies, group):
            seeds = scenario.generalise.seeds
            logs = {seed: paths.cell_log(cell, policy, seed) for seed in seeds}
            crossed = paths.cell_crossed(cell, policy)
            yield _Condition(policy, logs, crossed, variant, "generalise", "cell", cell_text(cell))


def _condition_frame(results_dir: Path, run: _Condition) -> pd.DataFrame:
    """Measures of all runs under one condition."""
    rows = [
        metrics_row(run_metrics(_existing(results_dir / name), run.scenario), run.scenario)
        for name in run.logs.values()
    ]
    table = pd.DataFrame(rows).assign(logged=True)
    if paths.is_crossed(run.scenario, run.policy):
        path = _existing(results_dir / run.crossed)
        others = pd.read_csv(path).assign(logged=False)
        table = pd.concat([table, others], ignore_index=True)
    table["policy_seed"] = table["policy_seed"].astype("Int64")
    learning = run.scenario.learned.get(run.policy)
    if learning is not None:
        wanted = list(product(learning.seeds, run.logs))
        places = list(zip(table["policy_seed"], table["seed"], strict=True))
        if sorted(places, key=str) != sorted(wanted, key=str):
            raise ValueError(
                f"{run.stage} {run.axis} {run.value} {run.policy}: not each of the policies of "
                f"training seeds {', '.join(map(str, learning.seeds))} once in each world"
            )
        table = table.iloc[[places.index(pair) for pair in wanted]]
    return table.assign(stage=run.stage, axis=run.axis, value=run.value)


def write_measures(results_dir: Path, scenario: Scenario, group: str) -> None:
    """Write what `measure_group` returns where `runs_frame` reads it."""
    table = measure_group(results_dir, scenario, group)
    write_bytes(results_dir / paths.measures_file(group), csv_text(table).encode())


def runs_frame(results_dir: Path, scenario: Scenario) -> pd.DataFrame:
    """Read the measures of every run: columns of `measure_group`, one row a run.

    Raises
    ------
    FileNotFoundError
        If the measures of a group are missing.
    """
    frames = [
        pd.read_csv(
            _existing(results_dir / paths.measures_file(group)),
            dtype=dict.fromkeys(("policy", "stage", "axis", "value"), "str")
            | {"policy_seed": "Int64"},
        )
        for group in policy_groups(scenario)
        if group_runs(scenario, group)
    ]
    table = pd.concat(frames, ignore_index=True)
    table[["axis", "value"]] = table[["axis", "value"]].fillna("")
    table["value"] = [_axis_key(value) for value in table["value"]]
    return table


def evaluation_frame(results_dir: Path, scenario: Scenario) -> pd.DataFrame:
    """Measures of every evaluation, one row a policy, training seed of it and world."""
    return _stage(results_dir, scenario, "evaluate", scenario.evaluate.policies)


def sweep_frame(results_dir: Path, scenario: Scenario) -> pd.DataFrame:
    """Measures of every sweep, one row an axis, value, policy, training seed and world."""
    return _stage(results_dir, scenario, "sweep", ())


def cell_frame(results_dir: Path, scenario: Scenario) -> pd.DataFrame:
    """Measures of every run in a cell of another size: axis ``cell``, rows likewise."""
    return _stage(results_dir, scenario, "generalise", scenario.generalise.policies)


def _stage(
    results_dir: Path, scenario: Scenario, stage: str, policies: tuple[str, ...]
) -> pd.DataFrame:
    """Rows of one stage by axis and policy, in the scenario's order."""
    runs = runs_frame(results_dir, scenario)
    runs = runs[runs["stage"] == stage]
    order = {name: place for place, name in enumerate(SWEPT_KEYS)}

    def place(row: Any) -> tuple[int, int]:
        listed = policies or swept_policies(scenario, row.axis)
        return order.get(row.axis, 0), listed.index(row.policy)

    places = [place(row) for row in runs[["axis", "policy"]].itertuples()]
    rows = sorted(range(len(runs)), key=places.__getitem__)
    return runs.iloc[rows].reset_index(drop=True)


def gain_frame(results_dir: Path, scenario: Scenario) -> pd.DataFrame:
    """Read the tracking errors of the gain study, mean over robots.

    Returns
    -------
    DataFrame
        Columns method, plant, gain (nominal, adjusted), seed, slot (window, 1 = the first),
        violated, error_cm; the scenario's own method first. Methods on one plant share the runs
        with the nominal gain.

    Raises
    ------
    FileNotFoundError
        If a log of the study's methods and seeds is missing.
    """
    rows: list[dict[str, Any]] = []
    for method in _study_methods(scenario):
        for gain, run in (("nominal", baseline_method(scenario, method)), ("adjusted", method)):
            for seed in scenario.gain_study.seeds:
                path = _existing(results_dir / paths.gain_study_log(run, gain, seed))
                rows += _gain_rows(path, scenario, {"method": method, "gain": gain, "seed": seed})
    return pd.DataFrame(rows)


def gain_schedules(results_dir: Path, scenario: Scenario) -> dict[str, GainSchedule]:
    """Read the gain schedules attached to the logs of the gain study, by method."""
    seed = scenario.gain_study.seeds[0]
    return {
        method: attached_schedule(
            _existing(results_dir / paths.gain_study_log(method, "adjusted", seed))
        )
        for method in _study_methods(scenario)
    }


def attached_schedule(path: Path) -> GainSchedule:
    """Read the gain schedule that is attached to a log.

    Raises
    ------
    LogError
        If there is none.
    """
    with LogReader(path, verify="chunks") as log:
        text = log.attachments.get("schedule.json")
    if text is None:
        raise LogError(path, 0, "no gain schedule (schedule.json) is attached")
    return GainSchedule.from_json(text.decode())


def training_frames(results_dir: Path, scenario: Scenario) -> dict[str, pd.DataFrame]:
    """Read the training of every learner, the scenario's own first: frames of `training_frame`."""
    return {name: training_frame(results_dir, scenario, name) for name in scenario.learned}


def training_frame(results_dir: Path, scenario: Scenario, learner: str) -> pd.DataFrame:
    """Read rewards and backlogs of every training episode, mean over its slots (and users).

    Returns
    -------
    DataFrame
        Columns seed, episode (1 = the first), urllc_reward, embb_reward, urllc_backlog_packets,
        embb_backlog_packets, urllc_late_share (late packets over due packets of the episode).

    Raises
    ------
    LogError
        If a log does not consist of whole episodes.
    """
    frames = []
    learning = scenario.learned[learner]
    for seed in learning.seeds:
        path = results_dir / paths.training_log(learner, seed)
        with LogReader(_existing(path), verify="chunks") as log:
            length = int(log.metadata.get("slots_per_episode", learning.slots_per_episode))
            if not log.num_slots or log.num_slots % length:
                raise LogError(
                    path, 0, f"{log.num_slots} slots are no whole episodes of {length} slots"
                )
            columns = _training_columns(log, length)
            episode = np.arange(1, log.num_slots // length + 1)
        frames.append(pd.DataFrame({"seed": seed, "episode": episode, **columns}))
    return pd.concat(frames, ignore_index=True)


def checkpoint_frames(results_dir: Path, scenario: Scenario) -> dict[str, pd.DataFrame]:
    """Read the noise-free checkpoints of every learner; see `checkpoint_frame`."""
    return {
        learner: checkpoint_frame(results_dir, scenario, learner) for learner in scenario.learned
    }


def checkpoint_frame(results_dir: Path, scenario: Scenario, learner: str) -> pd.DataFrame:
    """Read what the policies of a learner do without noise, at the start and during training.

    Returns
    -------
    DataFrame
        Columns seed, episode (of the training behind which it is) and those of
        `training_frame`: means over the fixed worlds.

    Raises
    ------
    LogError
        If a log has not every checkpoint of the scenario.
    """
    frames = []
    learning = scenario.learned[learner]
    episodes = [learning.num_envs * r for r in checkpoint_rounds(learning)]
    for seed in learning.seeds:
        path = results_dir / paths.checkpoint_log(learner, seed)
        with LogReader(_existing(path), verify="chunks") as log:
            length = int(log.metadata["slots_per_episode"])
            worlds = int(log.metadata["episodes_per_round"])
            if log.num_slots != length * worlds * len(episodes):
                raise LogError(
                    path,
                    0,
                    f"{log.num_slots} slots, must be {len(episodes)} checkpoints of {worlds} "
                    f"episodes of {length} slots",
                )
            columns = _training_columns(log, length * worlds)
        frames.append(pd.DataFrame({"seed": seed, "episode": episodes, **columns}))
    return pd.concat(frames, ignore_index=True)


def _training_columns(log: LogReader, length: int) -> dict[str, NDArray[Any]]:
    """Return the columns of `training_frame`, one value an episode of `length` slots."""
    reward = log.read("/delay", ["reward_urllc", "reward_embb"])
    if log.profile == "decisions":
        slices = log.read("/slices")
    else:
        users = log.read("/delay", ["due_packets", "late_packets"])
        users |= log.read("/queue", ["backlog_packets"])
        slices = slice_fields(users, log.dims.num_urllc)
    late, due = (
        _by_episode(slices[name], length) for name in ("late_urllc_packets", "due_urllc_packets")
    )
    return {
        "urllc_reward": _by_episode(reward["reward_urllc"], length),
        "embb_reward": _by_episode(reward["reward_embb"], length),
        "urllc_backlog_packets": _by_episode(slices["backlog_urllc_packets"], length),
        "embb_backlog_packets": _by_episode(slices["backlog_embb_packets"], length),
        "urllc_late_share": np.divide(late, due, out=np.full(len(due), np.nan), where=due > 0),
    }


def read_evaluation(results_dir: Path, policy: str, seed: int, names: Sequence[str]) -> RunSlots:
    """Read fields of every slot of an evaluation, its warm-up included."""
    return read_slots(evaluation_log(results_dir, policy, seed), names)


def _axis_key(value: float | str) -> float | str:
    try:
        return float(value)
    except ValueError:
        return value


def _study_methods(scenario: Scenario) -> list[GainMethod]:
    """Methods of the gain study, the scenario's own first."""
    own = scenario.control.method
    return sorted(scenario.gain_study.methods, key=lambda method: method != own)


def _gain_rows(path: Path, scenario: Scenario, labels: dict[str, Any]) -> list[dict[str, Any]]:
    with LogReader(path, verify="chunks") as log:
        error_m: FloatArray = log.read("/robots", ["tracking_error_m"])["tracking_error_m"]
    error_cm = tracking_error_by_window_cm(error_m, slots_per_window(scenario)).mean(axis=1)
    plant, violated = STUDY_PLANTS[labels["method"]], scenario.gain_study.violation_windows
    return [
        {**labels, "plant": plant, "slot": slot, "violated": slot in violated, "error_cm": error}
        for slot, error in enumerate(error_cm.tolist(), start=1)
    ]


def _by_episode(values: NDArray[Any], length: int) -> NDArray[Any]:
    """Return the mean over the slots of each episode, and over users."""
    means: NDArray[Any] = values.reshape(len(values) // length, -1).mean(axis=1)
    return means


def _existing(path: Path) -> Path:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such log")
    return path
