"""Cells of the gain study, moments of the filter, growth over chains: from planted logs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hiersched.core.files import write_parquet
from hiersched.experiments.gains import design_gains, designs
from hiersched.experiments.logged import RunSlots
from hiersched.experiments.points import LOOP_CELLS, experiments
from hiersched.scenario import Scenario
from hiersched.simulator.loop_growth import (
    loop_growth,
    sampled_delays,
    separates,
    transitions,
    worst_growth,
)
from hiersched.study.figures.loops import draw_gain_cells
from hiersched.study.figures.style import house_style
from hiersched.study.measure import _chains, measure, measured_groups, table_file
from hiersched.study.study import Study
from hiersched.study.tables.loops import filter_table, has_filtered_cells

from .conftest import _schedule, _write_robots


def test_cells_have_the_planted_errors(tables: dict[str, pd.DataFrame]) -> None:
    """Robots of 2 and 12 cm behind the first window, 0.6 of that with gains for long delays."""
    table = tables["gain_cells"].set_index(["cell", "method"])
    assert list(table.index) == [
        (cell, method)
        for cell in ("near", "far")
        for method in ("krasovskii", "predictor", "nominal")
    ]
    assert table["error_cm"].to_numpy() == pytest.approx([7.0, 7.0, 7.0, 4.2, 4.2, 7.0])
    assert table.loc[("far", "nominal"), "over_first"] == pytest.approx(1.0 / 0.6)
    assert table.loc[("near", "krasovskii"), "off_track_share"] == 0.5
    assert table["sawtooth"].tolist() == [False] * 3 + [True] * 3


def test_the_figure_draws_every_method_of_every_cell(study: Study) -> None:
    with house_style():
        figure = draw_gain_cells(study)
    (axes,) = figure.axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["near", "far"]
    marks = [bar.lines[0] for bar in axes.containers]
    assert sorted(float(mark.get_xdata()[0]) for mark in marks) == pytest.approx(
        [4.2, 4.2, 7.0, 7.0, 7.0, 7.0]
    )
    assert len({mark.get_ydata()[0] for mark in marks}) == 6


def test_moments_are_those_of_the_filter_and_of_the_logs(
    variant_of_tiny: Callable[..., Scenario], tmp_path: Path
) -> None:
    scenario = variant_of_tiny(
        "gain_study: {methods: [krasovskii, lqg], weight: [], sampling_s: [], fixed_delay_s: [], "
        "noise_position_m: [], noise_heading_rad: [], cells: {near: {delay_s: 0.06}, far: null}, "
        "cell_methods: [krasovskii, lqg]}\n"
    )
    assert has_filtered_cells(scenario)
    for name in ("gain_study", LOOP_CELLS):
        experiment = experiments(scenario)[name]
        for point, gain in experiment.runs(experiment.policies):
            _write_robots(tmp_path, experiment, point, gain)
    for name, variant in designs(scenario).items():
        path = tmp_path / f"gains/{name}.json"
        if variant.control.method == "lqg":
            design_gains(scenario, name, path)
        elif not path.exists():
            path.parent.mkdir(exist_ok=True)
            path.write_text(_schedule(variant).to_json(), encoding="utf-8")
    measure(scenario, tmp_path, "gains")
    for group in measured_groups(scenario).keys() - {"gains"}:
        write_parquet(tmp_path / table_file("windows", group), pd.DataFrame())
    (row,) = filter_table(Study(scenario, tmp_path)).to_dict("records")
    assert row["age_samples"] == 3
    assert row["linear_over_expected"] == pytest.approx(1.0, abs=0.02)
    assert 0.5 < row["expected_cm"] < 1.2
    assert row["estimate_std_cm"] < row["expected_cm"]
    # Planted: 2 and 12 cm, of which runs of three seeds have 0.9, 1.0 and 1.1.
    wanted = np.sqrt(np.mean([(0.02 * f) ** 2 for f in (0.9, 1.0, 1.1)] + [0.12**2] * 3) / 1.0)
    assert row["robots_cm"] == pytest.approx(100.0 * wanted, rel=1e-6)


def test_chains_count_samples_and_not_slots(tiny: Scenario) -> None:
    """Samples every second slot behind the warm-up."""
    steps = np.array([[9, 9], [9, 9], [9, 9], [9, 9], [1, 17], [8, 8], [2, 12], [8, 8], [1, 3]])
    run = RunSlots(
        source="planted",
        metadata={},
        num_urllc=2,
        slot_s=0.01,
        warmup_slots=4,
        fields={"delay_steps": steps.astype(np.uint32)},
    )
    table = _chains(run, tiny).set_index(["robot", "delay_steps", "next_steps"])
    assert table["count"].to_dict() == {(0, 1, 2): 1, (1, 17, 12): 1}
    longer = sampled_delays(np.arange(10)[:, None], tiny, 0.01)
    assert longer[:, 0].tolist() == [0, 2, 4, 6, 8]


def test_growth_is_that_of_the_measured_chain(
    tables: dict[str, pd.DataFrame], study: Study
) -> None:
    table = tables["second_moments"].set_index("policy")
    assert sorted(table.index) == ["alt", "ddpg", "drift_plus_penalty", "pf"]
    assert table["filter"].isna().all()  # the tiny study has none
    chains = study.measures("chains")
    own = chains[(chains["policy"] == "pf") & (chains["robot"] == table.loc["pf", "user"])]
    counts = np.zeros((40, 40))
    for row in own.to_dict("records"):
        counts[row["delay_steps"], row["next_steps"]] += row["count"]
    growth = loop_growth(study.scenario, study.schedule(study.scenario), counts)
    assert table.loc["pf", list(growth._fields)].tolist() == pytest.approx(growth, nan_ok=True)
    policies = tables["policies"].set_index("policy")["loop_growth"]
    assert policies["pf"] == pytest.approx(table.loc["pf", "followed"], nan_ok=True)


def test_the_worst_robot_is_the_one_that_grows(tiny: Scenario) -> None:
    schedule = _schedule(tiny)
    steps = np.ones((400, 2), np.uint32)
    steps[:, 1] = np.resize(np.repeat([1, 12], 20), 400)
    counts = transitions(steps, tiny, 0.01)
    assert counts[0][1, 1] == counts[0].sum() == 199.0
    robot, growth = worst_growth(tiny, schedule, counts)
    assert robot == 1
    assert growth == loop_growth(tiny, schedule, counts[1])
    assert growth.nominal > 1.0


def test_growth_is_of_the_truth_and_not_of_beliefs(tiny: Scenario) -> None:
    """Actuators that are slower than believed; a filter whose stamps are wrong promises nothing."""
    schedule = _schedule(tiny)
    counts = np.zeros((13, 13))
    counts[4, 4] = 100.0
    slow = replace(tiny, robot=replace(tiny.robot, actuator_lag_s=0.2))
    believed = replace(slow, control=replace(slow.control, believed_lag_s=0.1))
    assert loop_growth(believed, schedule, counts) == loop_growth(slow, schedule, counts)
    assert loop_growth(slow, schedule, counts) != loop_growth(tiny, schedule, counts)
    assert separates(tiny)
    assert not separates(replace(tiny, control=replace(tiny.control, stamp_error_samples=1)))
    assert not separates(believed)
