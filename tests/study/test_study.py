"""What of a study's measures whatever shows it reads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from hiersched.scenario import Scenario
from hiersched.study.claims.conditions import by_coefficient
from hiersched.study.registry import axis_of
from hiersched.study.study import Study


@pytest.mark.parametrize(
    ("tables", "files"),
    [
        ("runs", "runs/classical runs/ddpg runs/alt"),
        ("windows", "windows/classical windows/ddpg windows/alt windows/gains"),
        ("delays", "delays/classical delays/ddpg delays/alt"),
        ("episodes", "episodes/ddpg episodes/alt"),
        ("episodes runs", "episodes/ddpg episodes/alt runs/classical runs/ddpg runs/alt"),
    ],
)
def test_sources_are_the_files_of_every_group(tiny: Scenario, tables: str, files: str) -> None:
    expected = [f"measures/{name}.parquet" for name in files.split()]
    assert Study.sources(tiny, tuple(tables.split())) == expected


def test_sources_that_are_no_measures(tiny: Scenario) -> None:
    assert Study.sources(tiny, ()) == []
    assert Study.sources(tiny, ("bound", "stability")) == [
        "bound/slots.csv",
        "gains/stability.json",
    ]
    assert set(Study.sources(tiny, ("schedules",))) == {
        "gains/schedule.json",
        "gains/schedule_loop_split_method_razumikhin.json",
        "gains/schedule_method_predictor.json",
        "gains/schedule_weight_100.json",
        "gains/schedule_sampling_s_0.05.json",
    }


def test_a_study_without_learners_has_no_episodes(
    variant_of_tiny: Callable[..., Scenario],
) -> None:
    rules = "evaluate: {policies: [pf]}\nsweeps: {policies: [pf], axes: {load: null}}\n"
    scenario = variant_of_tiny(rules, "generalise: {cells: []}\ngain_study: {methods: []}\n")
    assert Study.sources(scenario, ("runs", "episodes")) == ["measures/runs/classical.parquet"]


def test_a_table_of_measures_that_is_none_is_an_error(tiny: Scenario) -> None:
    with pytest.raises(ValueError, match="reads = 'run': must be one of runs, windows, slots"):
        Study.sources(tiny, ("runs", "run"))


def test_runs_are_in_the_order_of_the_scenario(study: Study) -> None:
    """Experiments and their policies; of each, points, then training seeds, then worlds."""
    axes = ["", *study.scenario.sweeps.axes, "cell"]
    assert study.runs["axis"].unique().tolist() == axes
    assert study.evaluation["policy"].unique().tolist() == list(study.scenario.evaluate.policies)
    own = study.evaluation[study.evaluation["policy"] == "alt"]
    places = own[["policy_seed", "seed"]].itertuples(index=False, name=None)
    assert list(places) == [(p, seed) for p in (1, 2) for seed in (11, 12, 13)]
    cells = study.cells[study.cells["policy"] == "pf"]
    assert cells["value"].unique().tolist() == ["u2_e1_k4", "u2_e1_k6"]
    stages = (study.evaluation, study.cells, study.sweeps)
    assert sum(map(len, stages)) == len(study.runs)


def test_an_evaluation_in_another_order_is_read_in_it(tiny: Scenario, results: Path) -> None:
    order = ("alt", "pf", "ddpg", "drift_plus_penalty")
    other = replace(tiny, evaluate=replace(tiny.evaluate, policies=order))
    assert Study(other, results).evaluation["policy"].unique().tolist() == list(order)


def test_swept_numbers_are_numbers_and_names_of_several_are_not(study: Study) -> None:
    """Python takes ``0_0.02`` for the number 0.02: points of different beta would be one."""
    values = {
        str(axis): list(dict.fromkeys(rows["value"])) for axis, rows in study.sweeps.groupby("axis")
    }
    assert float("0_0.02") == 0.02
    assert values["service_coefficient_mbps"] == ["0_0.02", "0_0.05", "8_0.02", "8_0.05"]
    assert values["load"] == [0.85, 1.0]
    assert values["sampling_s"] == [0.02, 0.05]
    assert values["reference"] == ["zigzag", "arc"]
    assert set(study.cells["value"]) == {"u2_e1_k4", "u2_e1_k6"}


def test_an_axis_of_two_keys_has_every_combination(
    study: Study, tables: dict[str, pd.DataFrame]
) -> None:
    scenario, axis = study.scenario, "service_coefficient_mbps"
    keys = ("traffic.service_coefficient_mbps", "control.sampling_s")
    assert axis_of(scenario, *keys) == axis_of(scenario, *reversed(keys)) == axis
    assert axis_of(scenario, keys[0]) is None
    for value, beta, sampling_s in (("0_0.05", 0.0, 0.05), ("8_0.02", 8.0, 0.02)):
        point = study.point(axis, value)
        assert point.values == dict(zip(keys, (beta, sampling_s), strict=True))
        assert point.scenario.traffic.service_coefficient_mbps == beta
        assert point.scenario.control.sampling_s == sampling_s
        row = tables["sweeps"].query("axis == @axis and value == @value and policy == 'pf'")
        runs = study.sweeps.query("axis == @axis and value == @value and policy == 'pf'")
        assert row["embb_rate_mbps"].item() == pytest.approx(runs["embb_rate_mbps"].mean())
    seen = []
    conditions = by_coefficient(study, lambda rows, _: seen.append(rows) or ())
    assert [condition.value for condition in conditions] == ["0", "8"]
    for rows in seen:  # both ends of the sampling interval, three worlds under two policies
        assert rows.groupby("value").size().to_dict() == {0.02: 6, 0.05: 6}


def test_learners_are_in_the_order_of_the_scenario(study: Study) -> None:
    assert list(study.training) == list(study.checkpoints) == list(study.scenario.learned)
    assert study.training["alt"]["kind"].unique().tolist() == ["training"]
    assert study.checkpoints["ddpg"]["episode"].tolist() == [0, 2, 4] * 2


def test_the_schedule_of_a_point_is_that_of_its_design(study: Study) -> None:
    for method, kind in (("krasovskii", "network"), ("razumikhin", "split")):
        schedule = study.schedule(study.point("gain_study", method).scenario)
        assert (schedule.method, schedule.kind) == (method, kind)
    slow = study.point("gain_sampling_s", "0.05").scenario
    assert study.schedule(slow).sampling_s == 0.05


def test_a_study_that_is_not_measured_names_the_file(tiny: Scenario, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"measures/runs/classical\.parquet"):
        _ = Study(tiny, tmp_path).runs
