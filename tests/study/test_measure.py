"""Tables of measures against what plain loops over the logs say."""

from __future__ import annotations

import shutil
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from hiersched.experiments.points import experiments
from hiersched.log import LogError, LogReader
from hiersched.scenario import Scenario
from hiersched.study.measure import (
    RATE_EDGES,
    measure,
    measured_files,
    measured_groups,
    table_file,
)
from hiersched.study.metrics import metrics_row, run_metrics
from hiersched.study.study import Study

WARMUP = 4
"""Slots of the evaluation, in worlds of 40."""


def fields_of(path: Path) -> dict[str, Any]:
    """Every field of a log."""
    with LogReader(path) as log:
        return {name: values for topic in log.topics for name, values in log.read(topic).items()}


def of(study: Study, table: str, **labels: Any) -> pd.DataFrame:
    """Rows of a table with these labels."""
    rows = study.measures(table)
    for name, value in labels.items():
        rows = rows[rows[name] == value]
    assert len(rows), (table, labels)
    return rows


def test_every_log_is_measured_once(tiny: Scenario, logs: Path) -> None:
    names = [name for group in measured_groups(tiny) for name in measured_files(tiny, group)]
    there = [path for part in ("runs", "train") for path in (logs / part).rglob("*.[mp]*")]
    assert sorted(names) == sorted(str(path.relative_to(logs)) for path in there)


def test_groups_have_the_tables_of_what_they_run(tiny: Scenario, results: Path) -> None:
    runs = {"runs", "windows", "slots", "rates", "delays", "chains"}
    assert {group: set(names) for group, names in measured_groups(tiny).items()} == {
        "classical": runs,
        "ddpg": {*runs, "episodes"},
        "alt": {*runs, "episodes"},
        "gains": {"windows", "slots", "chains"},
    }
    written = [str(path.relative_to(results)) for path in results.rglob("*.parquet")]
    for group, names in measured_groups(tiny).items():
        assert {table_file(name, group) for name in names} <= set(written)


def test_every_run_has_a_row_with_the_measures_of_its_log(study: Study, logs: Path) -> None:
    runs = study.measures("runs")
    worlds = [
        (name, point.value, policy, seed)
        for name, experiment in experiments(study.scenario).items()
        for point, policy in experiment.runs(experiment.policies)
        for seed in experiment.seeds
        if not experiment.forced
    ]
    logged = runs[runs["logged"]]
    places = logged[["experiment", "value", "policy", "seed"]].itertuples(index=False, name=None)
    assert sorted(places) == sorted(worlds)
    some = logged[::5].drop(columns=["logged", "experiment", "group", "policy_seed"])
    expected = []
    for row in logged[::5].to_dict("records"):
        point = study.point(row["experiment"], row["value"])
        folder = logs / "runs" / row["experiment"] / row["value"] / row["policy"]
        metrics = run_metrics(folder / f"seed{row['seed']}.mcap", point.scenario)
        expected.append(metrics_row(metrics, point.scenario))
    frame = pd.DataFrame(expected, index=some.index)[list(some)]
    pd.testing.assert_frame_equal(some, frame, check_exact=True, check_dtype=False)


def test_a_learners_policies_are_crossed_with_worlds(study: Study, logs: Path) -> None:
    runs = study.measures("runs")
    rules = runs[runs["group"] == "classical"]
    assert rules["policy_seed"].isna().all()
    assert rules["logged"].all()
    for _, rows in runs[runs["group"] != "classical"].groupby(["experiment", "value", "policy"]):
        assert rows["policy_seed"].tolist() == [1, 1, 1, 2, 2, 2]
        assert rows["seed"].tolist() == sorted(set(rows["seed"])) * 2
        assert rows["logged"].tolist() == [True, False, True, False, True, False]
    own = runs[(runs["experiment"] == "evaluate") & (runs["policy"] == "ddpg")]
    for row in own[own["logged"]].itertuples():
        with LogReader(logs / f"runs/evaluate/ddpg/seed{row.seed}.mcap") as log:
            assert log.metadata["policy_seed"] == str(row.policy_seed)
    written = pd.read_parquet(logs / "runs/evaluate/ddpg/crossed.parquet")
    read = own[~own["logged"]]
    for name in ("urllc_late_share", "mean_square_backlog", "urllc_delay_p99_s"):
        assert sorted(read[name]) == sorted(written[name])  # to the last bit


@pytest.mark.parametrize(
    ("path", "labels"),
    [
        (
            "runs/load/0.85/pf",
            {"experiment": "load", "value": "0.85", "policy": "pf", "seed": 22},
        ),
        (
            "runs/gain_study/krasovskii/adjusted",
            {"experiment": "gain_study", "value": "krasovskii", "gain": "adjusted", "seed": 33},
        ),
    ],
)
def test_windows_are_of_every_robot(
    study: Study, logs: Path, path: str, labels: dict[str, Any]
) -> None:
    fields = fields_of(logs / path / f"seed{labels['seed']}.mcap")
    error_m, saturated = fields["tracking_error_m"], fields["control_saturated"]
    expected = [
        (
            window + 1,
            robot,
            100.0 * (sum(error_m[10 * window + i, robot] ** 2 for i in range(10)) / 10) ** 0.5,
            sum(saturated[10 * window + i, robot] for i in range(10)) / 10,
        )
        for window in range(len(error_m) // 10)
        for robot in range(2)
    ]
    rows = of(study, "windows", **labels)[["window", "robot", "error_cm", "saturated"]]
    assert rows.to_numpy(float) == pytest.approx(np.array(expected, float))


def test_the_first_slots_and_the_mean_behind_the_warm_up(study: Study, logs: Path) -> None:
    rows = of(study, "slots", experiment="evaluate", policy="ddpg", seed=12)
    fields = fields_of(logs / "runs/evaluate/ddpg/seed12.mcap")
    assert rows["slot"].tolist()[:-1] == list(range(1, 21))
    assert rows["slot"].isna().tolist() == [False] * 20 + [True]
    for name, field in (("channel_gain", "mean_fading_power"), ("urllc_rate_mbps", "rate_mbps")):
        means = [(float(values[0]) + float(values[1])) / 2 for values in fields[field]]
        expected = [*means[:20], sum(means[WARMUP:]) / (40 - WARMUP)]
        assert rows[name].tolist() == pytest.approx(expected)


def test_traces_go_from_a_window_before_the_violation_to_two_behind_it(
    study: Study, logs: Path
) -> None:
    rows = of(study, "slots", value="predictor", gain="adjusted", seed=31)
    assert rows["slot"].tolist() == list(range(-10, 30))
    first = 40  # the violated window is the fifth
    error_m = fields_of(logs / "runs/gain_study/predictor/adjusted/seed31.mcap")["tracking_error_m"]
    rms = [100.0 * (sum(e**2 for e in error_m[first + slot]) / 2) ** 0.5 for slot in rows["slot"]]
    assert rows["error_cm"].tolist() == pytest.approx(rms)
    assert set(study.measures("slots")["experiment"]) == {"evaluate", "gain_study"}


@pytest.mark.parametrize(("span", "length"), [("slot", 1), ("window", 10)])
@pytest.mark.parametrize(("part", "users"), [("urllc", [0, 1]), ("embb", [2])])
def test_distributions_of_rates_count_what_lies_at_or_below(
    study: Study, logs: Path, span: str, length: int, part: str, users: list[int]
) -> None:
    rate = fields_of(logs / "runs/evaluate/pf/seed13.mcap")["rate_mbps"][WARMUP:]
    means = [
        sum(float(rate[length * block + i, user]) for i in range(length)) / length
        for block in range(len(rate) // length)
        for user in users
    ]
    rows = of(study, "rates", policy="pf", seed=13, span=span, slice=part)
    edges = rows["rate_mbps"].to_numpy()
    begin = int(np.flatnonzero(RATE_EDGES == edges[0])[0])
    assert edges.tolist() == RATE_EDGES[begin : begin + len(edges)].tolist()
    shares = [sum(mean <= edge for mean in means) / len(means) for edge in edges]
    assert rows["share"].tolist() == pytest.approx(shares)
    assert (shares[0], shares[-1]) == (0.0, 1.0)


def sojourns(arrivals: np.ndarray, service: np.ndarray) -> list[float]:
    """Packet by packet, in slots, of those that arrive behind the warm-up and are delivered."""
    waiting: deque[list[float]] = deque()
    times = []
    for slot, (count, capacity) in enumerate(zip(arrivals, service, strict=True)):
        waiting.extend([slot, 1.0] for _ in range(count))
        used = 0.0
        while waiting and used < capacity:
            born, left = waiting[0]
            step = min(left, capacity - used)
            used += step
            waiting[0][1] -= step
            if step == left:
                waiting.popleft()
                if born >= WARMUP:
                    times.append(slot + used / capacity - born)
    return times


def test_distributions_of_delays_count_what_took_longer(study: Study, logs: Path) -> None:
    fields = fields_of(logs / "runs/evaluate/pf/seed11.mcap")
    times = [
        0.01 * time
        for user in range(2)
        for time in sojourns(
            fields["arrivals_packets"][:, user], fields["service_packets"][:, user]
        )
    ]
    rows = of(study, "delays", policy="pf", seed=11)
    assert len(rows) == 201
    assert rows["delay_s"].iloc[-1] == pytest.approx(5 * study.scenario.traffic.deadline_s)
    shares = [sum(time > t for time in times) / len(times) for t in rows["delay_s"]]
    assert rows["share"].tolist() == pytest.approx(shares)
    assert 0.0 < shares[20] < shares[0] == 1.0


def test_episodes_are_means_over_their_slots(study: Study, logs: Path) -> None:
    """Training: episodes of five slots. Checkpoints: two fixed worlds of an episode each."""
    for kind, name, length, numbers in (
        ("training", "seed2", 5, [1, 2, 3, 4]),
        ("checkpoint", "checkpoints_seed2", 10, [0, 2, 4]),
    ):
        rows = of(study, "episodes", kind=kind, group="alt", seed=2)
        fields = fields_of(logs / f"train/alt/{name}.mcap")
        assert rows["episode"].tolist() == numbers
        for place, row in enumerate(rows.to_dict("records")):
            own = slice(place * length, (place + 1) * length)
            backlog, reward = fields["backlog_packets"][own], fields["reward_urllc"][own]
            late, due = (fields[f"{name}_packets"][own, :2].sum() for name in ("late", "due"))
            assert row["urllc_reward"] == pytest.approx(sum(reward) / length)
            assert row["urllc_backlog_packets"] == pytest.approx(backlog[:, :2].mean())
            assert row["embb_backlog_packets"] == pytest.approx(backlog[:, 2].mean())
            assert row["urllc_late_share"] == pytest.approx(late / due)


# What is missing or wrong.


@pytest.fixture
def copied(logs: Path, tmp_path: Path) -> Path:
    """The logs, to be spoilt."""
    return Path(shutil.copytree(logs, tmp_path / "results"))


@pytest.mark.parametrize("fault", ["missing", "twice", "other"])
def test_a_learners_runs_must_be_each_policy_once_in_each_world(
    copied: Path, tiny: Scenario, fault: str
) -> None:
    path = copied / "runs/load/0.85/ddpg/crossed.parquet"
    rows = pd.read_parquet(path)
    if fault == "missing":
        rows = rows[:-1]
    elif fault == "twice":
        rows = pd.concat([rows, rows[:1]])
    else:
        rows.loc[0, "policy_seed"] = 3
    rows.to_parquet(path)
    with pytest.raises(ValueError, match=r"load ddpg: not each .* seeds 1, 2 once in each"):
        measure(tiny, copied, "ddpg")


@pytest.mark.parametrize(
    ("group", "name"),
    [
        ("classical", "runs/sampling_s/0.05/pf/seed21.mcap"),
        ("ddpg", "runs/evaluate/ddpg/crossed.parquet"),
        ("alt", "train/alt/checkpoints_seed1.mcap"),
        ("gains", "runs/gain_grid/q100_0.04/adjusted/seed31.mcap"),
    ],
)
def test_a_file_that_is_missing_is_named(
    copied: Path, tiny: Scenario, group: str, name: str
) -> None:
    (copied / name).unlink()
    with pytest.raises(FileNotFoundError, match=name):
        measure(tiny, copied, group)
    assert not (copied / table_file("windows", group)).exists()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("seed1", r"19 slots are no whole episodes of 5 slots"),
        ("checkpoints_seed1", r"19 slots, must be 3 checkpoints of 2 episodes of 5 slots"),
    ],
)
def test_a_training_that_is_cut_short_is_refused(
    copied: Path, tiny: Scenario, zero_fields: Any, write_log: Any, name: str, said: str
) -> None:
    path = copied / f"train/alt/{name}.mcap"
    with LogReader(path) as log:
        label = dict(log.metadata)
    own = {key: label[key] for key in ("policy", "seed", "slots_per_episode")}
    own["episodes_per_round"] = "2"
    write_log(path, zero_fields(19), metadata=own)
    with pytest.raises(LogError, match=said):
        measure(tiny, copied, "alt")
