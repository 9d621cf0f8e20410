"""From the logs of a study to tables of measures: each log is read once.

Tables are Parquet files ``measures/<table>/<group>.parquet``, one a group of policies that share
jobs; `study.Study` reads them, and what is shown reads nothing else. A row is

runs
    A run, with the columns of `RunMetrics`: a learner's by training seed and world; `logged` says
    whether the run has a log.
windows
    A whole window and robot of a logged run: `error_cm`, `saturated` (share of slots with a control
    at its limit).
slots
    One of the first slots of an evaluation, and the mean behind the warm-up (`slot` empty):
    `channel_gain`, `urllc_rate_mbps`. Of the gain study a slot around a violation: `error_cm`.
rates
    A rate: `share` of the slots or windows (`span`) and users of a `slice` at or below it, in a
    logged run of the evaluation.
chains
    A transition of a robot's delay from one control sample to the next, in a logged run whose loops
    cross the network, and its `count`; of the gain study within a `span` of its windows,
    ``violated`` or ``calm``.
delays
    A time: `share` of the delivered URLLC packets of such a run that took longer.
task
    A run of the study of the task, with the columns of `task_metrics.task_row`, its `cell` and its
    `point`: ``tuned``, ``floor``, or ``knob0`` and so on of the curves, with the `knob` there.
traces
    A slot and robot of a cell with curves, under a rule at its tuned knob in the first world, for a
    while behind the warm-up: `TRACED`.
episodes
    An episode of a training, or the policies at a checkpoint (`kind`): rewards, backlogs, late
    share.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hiersched.core.fields import SLICE_FIELDS
from hiersched.core.files import write_parquet
from hiersched.experiments import files
from hiersched.experiments.logged import RunSlots, read_slots
from hiersched.experiments.logging import slice_fields
from hiersched.experiments.points import (
    GAIN_GROUP,
    TASK,
    Experiment,
    Point,
    cell_of,
    experiments,
    groups,
    has_unlogged,
    is_crossed,
    trained_learners,
)
from hiersched.log import LogError, LogReader
from hiersched.policies.registry import Rule
from hiersched.scenario import Scenario
from hiersched.scenario.schema import checkpoint_rounds
from hiersched.simulator.loop_growth import sampled_delays
from hiersched.study.metrics import (
    MEASURED,
    checked_sojourns,
    metrics_row,
    slot_metrics,
    slots_per_window,
    tracking_error_by_window_cm,
)

RUN_TABLES = ("runs", "windows", "slots", "rates", "delays", "chains")
"""Of a group of policies."""
TASK_TABLES = ("task", "traces")
"""Of a group of policies that runs in the study of the task."""
GAIN_TABLES = ("windows", "slots", "chains")
"""Of the gain study."""
PROGRESS = {
    "reward_urllc": "urllc_reward",
    "reward_embb": "embb_reward",
    "backlog_urllc_packets": "urllc_backlog_packets",
    "backlog_embb_packets": "embb_backlog_packets",
    "late_share": "urllc_late_share",
}
"""Column of the progress file of a training -> that of the table ``episodes``."""

FIRST_SLOTS = 20
"""Slots at the start of an evaluation of which the table ``slots`` holds each."""
RATE_EDGES = 10.0 ** (np.arange(-1500, 2001) / 500.0)
"""Rates at which distributions are kept [Mbit/s]: half a per cent apart."""
DELAY_POINTS = 201
DEADLINES_KEPT = 5.0
"""Distributions of delay end at this many deadlines."""
TRACED = ("reference", "hol_delay_s", "tracking_error_m", "num_prb")
"""Fields of a trace; of the reference its speed."""
TRACE_S = 8.0
WINDOWS_AFTER = 2
"""Windows of a trace behind the violated one, in which the loop recovers."""

Table = dict[str, list[pd.DataFrame]]


def measured_groups(scenario: Scenario) -> dict[str, tuple[str, ...]]:
    """Return the groups whose logs are measured, each with the tables that this makes."""
    found: dict[str, tuple[str, ...]] = {}
    for experiment in experiments(scenario).values():
        for group in groups(scenario, experiment):
            own = GAIN_TABLES if group == GAIN_GROUP else RUN_TABLES
            more = TASK_TABLES if experiment.stage == TASK else ()
            found[group] = tuple(dict.fromkeys((*found.get(group, own), *more)))
    for learner in trained_learners(scenario):
        found[learner] = (*found.get(learner, ()), "episodes")
    return found


def table_file(table: str, group: str) -> str:
    """Table of measures of a group, relative to the folder of the study."""
    return f"measures/{table}/{group}.parquet"


def chain_files(scenario: Scenario) -> list[str]:
    """List the tables ``chains``: of groups of policies that run, and not only train."""
    tables = measured_groups(scenario).items()
    return [table_file("chains", group) for group, names in tables if "chains" in names]


def measured_files(scenario: Scenario, group: str) -> list[str]:
    """List logs, and measures of runs without one, from which the tables of a group come."""
    names = []
    for experiment in experiments(scenario).values():
        policies = groups(scenario, experiment).get(group, ())
        names += files.group_logs(experiment, policies)
        names += [
            files.crossed_file(experiment, point, policy)
            for point, policy in experiment.runs(policies)
            if has_unlogged(scenario, experiment, policy)
        ]
    if group in trained_learners(scenario):
        names += files.learner_logs(scenario, group)
        names += [] if files.logs_training(scenario) else [files.progress_file(group)]
    return names


def measure(scenario: Scenario, results: Path, group: str) -> None:
    """Read every log of a group once and write its tables.

    FileNotFoundError if a log is missing, or measures of runs without one; LogError if a log is
    damaged or contradicts itself; ValueError if a learner's policies are not those of its training
    seeds, each in every world.
    """
    names = measured_groups(scenario)[group]
    tables: Table = {name: [] for name in names}
    for experiment in experiments(scenario).values():
        policies = groups(scenario, experiment).get(group, ())
        for point, policy in experiment.runs(policies):
            if experiment.stage == TASK:
                _measure_task(tables, scenario, results, experiment, point, policy)
            elif group == GAIN_GROUP:
                _measure_gains(tables, results, experiment, point, policy)
            else:
                _measure_runs(tables, scenario, results, experiment, point, policy)
    if "episodes" in names:
        tables["episodes"] += [
            _training_episodes(results, scenario, group).assign(kind="training"),
            _checkpoint_episodes(results, scenario, group).assign(kind="checkpoint"),
        ]
    for name in names:
        table = pd.concat(tables[name], ignore_index=True) if tables[name] else pd.DataFrame()
        write_parquet(results / table_file(name, group), table)


def _measure_runs(
    tables: Table,
    scenario: Scenario,
    results: Path,
    experiment: Experiment,
    point: Point,
    policy: str,
) -> None:
    """Add the runs of a policy at a point to the tables."""
    rows, evaluated = [], experiment.stage == "evaluate"
    labels = {"experiment": experiment.name, "axis": experiment.axis, "value": point.value}
    fields = (*MEASURED, "mean_fading_power") if evaluated else MEASURED
    for seed in experiment.seeds:
        run = read_slots(results / files.run_log(experiment, point, policy, seed), fields)
        sojourns = checked_sojourns(run, point.scenario)
        rows.append(metrics_row(slot_metrics(run, point.scenario, sojourns), point.scenario))
        found = {"windows": _windows(run.fields, point.scenario)}
        if evaluated:
            found["slots"] = _slots(run)
            found["rates"] = _rates(run, point.scenario)
            found["delays"] = _delays(sojourns, point.scenario)
        if point.scenario.loop_kind != "local":
            found["chains"] = _chains(run.measured("delay_steps"), point.scenario)
        for name, frame in found.items():
            tables[name].append(frame.assign(**labels, policy=policy, seed=seed))
    table = pd.DataFrame(rows).assign(logged=True)
    if is_crossed(scenario, policy):
        others = pd.read_parquet(results / files.crossed_file(experiment, point, policy))
        table = pd.concat([table, others.assign(logged=False)], ignore_index=True)
    table["policy_seed"] = table["policy_seed"].astype("Int64")
    if policy in scenario.learned:
        table = _in_order(table, scenario, experiment, policy)
    first = ["policy", "policy_seed", "seed", "logged"]
    table = table[[*first, *(name for name in table if name not in first)]]
    tables["runs"].append(table.assign(**labels))


def _measure_task(
    tables: Table,
    scenario: Scenario,
    results: Path,
    experiment: Experiment,
    point: Point,
    policy: str,
) -> None:
    """Add the runs of a policy at a point of a cell, and what its traces show."""
    cell = cell_of(experiment)
    runs = pd.read_parquet(results / files.crossed_file(experiment, point, policy))
    runs["policy_seed"] = runs["policy_seed"].astype("Int64")
    seeds = scenario.learned[policy].seeds if policy in scenario.learned else (pd.NA,)
    places = list(zip(runs["policy_seed"], runs["seed"], strict=True))
    if sorted(places, key=str) != sorted(product(seeds, experiment.seeds), key=str):
        raise ValueError(f"{experiment.name} {point.value} {policy}: not once in each world")
    rule = point.scenario.policies.get(policy)
    knob = getattr(rule, rule.knob) if isinstance(rule, Rule) and rule.knob else np.nan
    labels = {"cell": cell, "point": point.value, "knob": np.nan if point.tuned else knob}
    tables["task"].append(runs.assign(**labels))
    for seed in experiment.logged_seeds if point.scenario.loop_kind != "local" else ():
        run = read_slots(results / files.run_log(experiment, point, policy, seed), ["delay_steps"])
        chains = _chains(run.measured("delay_steps"), point.scenario)
        labels = {"experiment": experiment.name, "axis": experiment.axis, "value": point.value}
        tables["chains"].append(chains.assign(**labels, policy=policy, seed=seed))
    if scenario.task_study.cells[cell].pareto and point.tuned and policy not in scenario.learned:
        path = results / files.run_log(experiment, point, policy, experiment.seeds[0])
        tables["traces"].append(_trace(path, point.scenario).assign(cell=cell, policy=policy))


def _trace(path: Path, scenario: Scenario) -> pd.DataFrame:
    """Return slots and robots of a run for `TRACE_S` behind its warm-up."""
    run = read_slots(path, TRACED)
    robots, slots = run.num_urllc, round(TRACE_S / run.slot_s)
    shown = {name: run.measured(name)[:slots] for name in TRACED}
    length = len(shown["hol_delay_s"])
    reference = shown.pop("reference")
    columns = {"speed_mps": reference[:, :, 3]} | {
        name: values[:, :robots] for name, values in shown.items()
    }
    return pd.DataFrame(
        {
            "slot": np.repeat(np.arange(length), robots),
            "robot": np.tile(np.arange(robots), length),
            **{name: values.ravel() for name, values in columns.items()},
        }
    )


def _in_order(
    table: pd.DataFrame, scenario: Scenario, experiment: Experiment, policy: str
) -> pd.DataFrame:
    """Return a learner's runs by training seed and world, after a check that each is there."""
    seeds = scenario.learned[policy].seeds
    wanted = list(product(seeds, experiment.seeds))
    places = list(zip(table["policy_seed"], table["seed"], strict=True))
    if sorted(places, key=str) != sorted(wanted, key=str):
        raise ValueError(
            f"{experiment.name} {policy}: not each of the policies of training seeds "
            f"{', '.join(map(str, seeds))} once in each world"
        )
    return table.iloc[[places.index(pair) for pair in wanted]]


def _windows(fields: dict[str, NDArray[Any]], scenario: Scenario) -> pd.DataFrame:
    """Return a row a whole window and robot: error, share of slots with a control at its limit."""
    length = slots_per_window(scenario)
    error_cm = tracking_error_by_window_cm(fields["tracking_error_m"], length)
    windows, robots = error_cm.shape
    saturated = fields["control_saturated"][: windows * length].astype(np.float64)
    share = saturated.reshape(windows, length, robots).mean(axis=1)
    return pd.DataFrame(
        {
            "window": np.repeat(np.arange(1, windows + 1), robots),
            "robot": np.tile(np.arange(robots), windows),
            "error_cm": error_cm.ravel(),
            "saturated": share.ravel(),
        }
    )


def _slots(run: RunSlots) -> pd.DataFrame:
    """Return channel gain (mean of |h|^2 over URLLC users and PRBs) and URLLC rate, by slot."""
    urllc = run.num_urllc
    gain, rate = (
        run.fields[name][:, :urllc].mean(axis=1, dtype=np.float64)
        for name in ("mean_fading_power", "rate_mbps")
    )
    first, measured = slice(0, FIRST_SLOTS), slice(run.warmup_slots, None)
    slots = [*range(1, min(FIRST_SLOTS, len(gain)) + 1), None]
    return pd.DataFrame(
        {
            "slot": pd.array(slots, dtype="Int64"),
            "channel_gain": [*gain[first], gain[measured].mean()],
            "urllc_rate_mbps": [*rate[first], rate[measured].mean()],
        }
    )


def _rates(run: RunSlots, scenario: Scenario) -> pd.DataFrame:
    """Return the share of rates at or below `RATE_EDGES`, where it rises, by slot and window."""
    rate, urllc = run.measured("rate_mbps"), run.num_urllc
    frames = []
    for span, length in (("slot", 1), ("window", slots_per_window(scenario))):
        blocks = len(rate) // length
        parts = rate[: blocks * length].reshape(blocks, length, rate.shape[1])
        mean = parts.mean(axis=1, dtype=np.float64)
        for name, users in (("embb", slice(urllc, None)), ("urllc", slice(0, urllc))):
            sample = np.sort(mean[:, users].ravel())
            share = np.searchsorted(sample, RATE_EDGES, side="right") / max(1, sample.size)
            begin = max(0, int(np.searchsorted(share, 0.0, side="right")) - 1)
            end = int(np.searchsorted(share, 1.0)) + 1
            rises = {"rate_mbps": RATE_EDGES[begin:end], "share": share[begin:end]}
            frames.append(pd.DataFrame({"span": span, "slice": name, **rises}))
    return pd.concat(frames, ignore_index=True)


def _chains(
    delay_steps: NDArray[Any], scenario: Scenario, is_violated: NDArray[np.bool_] | None = None
) -> pd.DataFrame:
    """Count how often a robot's delay was followed by another, sample by sample.

    `delay_steps` (T, R) are those of slots. With `is_violated` (T,) each pair of samples counts for
    the span of both, and for none if they differ.
    """
    slot_s = scenario.radio.slot_s
    delays = sampled_delays(delay_steps, scenario, slot_s)
    start, end, robots = delays[:-1], delays[1:], np.arange(delays.shape[1])
    spans = {"": np.ones(len(start), np.bool_)}
    if is_violated is not None:
        violated = sampled_delays(is_violated[:, None], scenario, slot_s)[:, 0] > 0
        spans = {
            "violated": violated[:-1] & violated[1:],
            "calm": ~(violated[:-1] | violated[1:]),
        }
    base = int(delays.max(initial=0)) + 1
    frames = []
    for span, counted in spans.items():
        codes = ((robots * base + start[counted]) * base + end[counted]).ravel()
        code, count = np.unique(codes, return_counts=True)
        rows = {"robot": code // base**2, "delay_steps": code // base % base}
        frames.append(
            pd.DataFrame({**rows, "next_steps": code % base, "count": count, "span": span})
        )
    return pd.concat(frames, ignore_index=True)


def _delays(sojourn_s: list[NDArray[np.float64]], scenario: Scenario) -> pd.DataFrame:
    """Return the share of delivered URLLC packets that took longer than a time."""
    grid = np.linspace(0.0, DEADLINES_KEPT * scenario.traffic.deadline_s, DELAY_POINTS)
    urllc = sojourn_s[: scenario.users.num_urllc]
    delays = np.sort(np.concatenate(urllc)) if urllc else np.empty(0)
    longer = delays.size - np.searchsorted(delays, grid, side="right")
    share = longer / delays.size if delays.size else np.full(len(grid), np.nan)
    return pd.DataFrame({"delay_s": grid, "share": share})


def _measure_gains(
    tables: Table, results: Path, experiment: Experiment, point: Point, gain: str
) -> None:
    """Add robots under forced delays to ``windows``, and around a violation to ``slots``."""
    window = slots_per_window(point.scenario)
    labels = {"experiment": experiment.name, "axis": experiment.axis, "value": point.value}
    assert point.delays is not None  # they are forced
    for seed in experiment.seeds:
        path = results / files.run_log(experiment, point, gain, seed)
        with LogReader(path, verify="chunks") as log:
            names = ["tracking_error_m", "control_saturated", "delay_steps"]
            fields = log.read("/robots", names)
        windows = _windows(fields, point.scenario)
        tables["windows"].append(windows.assign(**labels, gain=gain, seed=seed))
        steps = fields["delay_steps"]
        is_violated = np.isin(np.arange(len(steps)) // window + 1, point.delays.windows)
        chains = _chains(steps, point.scenario, is_violated)
        tables["chains"].append(chains.assign(**labels, gain=gain, seed=seed))
        if experiment.axis:
            continue
        begin = (min(point.delays.windows) - 1) * window
        span = slice(max(0, begin - window), begin + (1 + WINDOWS_AFTER) * window)
        error_cm = 100.0 * np.sqrt((fields["tracking_error_m"][span] ** 2).mean(axis=1))
        slots = np.arange(len(error_cm)) + span.start - begin
        trace = pd.DataFrame({"slot": slots, "error_cm": error_cm})
        tables["slots"].append(trace.assign(**labels, gain=gain, seed=seed))


def _training_episodes(results: Path, scenario: Scenario, learner: str) -> pd.DataFrame:
    """Read every training episode of a learner, number 1 the first, by training seed.

    Where training is not logged every round is, the last episode standing for it.
    """
    if not files.logs_training(scenario):
        progress = pd.read_csv(results / files.progress_file(learner))
        wanted = progress[["seed", "episode", *PROGRESS]].rename(columns=PROGRESS)
        return wanted.sort_values(["seed", "episode"], ignore_index=True)
    frames = []
    for seed in scenario.learned[learner].seeds:
        path = results / files.training_log(learner, seed)
        with LogReader(path, verify="chunks") as log:
            length = int(log.metadata["slots_per_episode"])
            if not log.num_slots or log.num_slots % length:
                said = f"{log.num_slots} slots are no whole episodes of {length} slots"
                raise LogError(path, 0, said)
            episode = np.arange(1, log.num_slots // length + 1)
            columns = _episode_columns(log, length)
        frames.append(pd.DataFrame({"seed": seed, "episode": episode, **columns}))
    return pd.concat(frames, ignore_index=True)


def _checkpoint_episodes(results: Path, scenario: Scenario, learner: str) -> pd.DataFrame:
    """Read what the policies of a learner do without noise, mean over the fixed worlds.

    `episode` is that of the training behind which the checkpoint is.
    """
    learning, frames = scenario.learned[learner], []
    episodes = [learning.num_envs * number for number in checkpoint_rounds(learning)]
    for seed in learning.seeds:
        path = results / files.checkpoint_log(learner, seed)
        with LogReader(path, verify="chunks") as log:
            length = int(log.metadata["slots_per_episode"])
            worlds = int(log.metadata["episodes_per_round"])
            if log.num_slots != length * worlds * len(episodes):
                must = f"{len(episodes)} checkpoints of {worlds} episodes of {length} slots"
                raise LogError(path, 0, f"{log.num_slots} slots, must be {must}")
            columns = _episode_columns(log, length * worlds)
        frames.append(pd.DataFrame({"seed": seed, "episode": episodes, **columns}))
    return pd.concat(frames, ignore_index=True)


def _episode_columns(log: LogReader, length: int) -> dict[str, NDArray[Any]]:
    """Return means over every `length` slots, and over users, and the share of late packets."""
    reward = log.read("/delay", ["reward_urllc", "reward_embb"])
    if log.profile == "decisions":
        slices = log.read("/delay", SLICE_FIELDS)
    else:
        users = log.read("/delay", ["due_packets", "late_packets"])
        users |= log.read("/queue", ["backlog_packets"])
        slices = slice_fields(users, log.dims.num_urllc)
    mean = {
        name: values.reshape(len(values) // length, -1).mean(axis=1)
        for name, values in {**reward, **slices}.items()
    }
    late, due = mean["late_urllc_packets"], mean["due_urllc_packets"]
    return {
        "urllc_reward": mean["reward_urllc"],
        "embb_reward": mean["reward_embb"],
        "urllc_backlog_packets": mean["backlog_urllc_packets"],
        "embb_backlog_packets": mean["backlog_embb_packets"],
        "urllc_late_share": np.divide(late, due, out=np.full(len(due), np.nan), where=due > 0),
    }
