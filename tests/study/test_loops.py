"""Cells of the gain study, moments of the filter, growth over chains: from planted logs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from hiersched.control import spectral_radius_by_delay
from hiersched.core.files import write_parquet
from hiersched.experiments import files
from hiersched.experiments.gains import design_gains, designs
from hiersched.experiments.points import LOOP_CELLS, experiments
from hiersched.scenario import Scenario
from hiersched.simulator import loop_growth as loop_growth_module
from hiersched.simulator.loop_gains import plant_of
from hiersched.simulator.loop_growth import (
    loop_growth,
    sampled_delays,
    separates,
    transitions,
    worst_growth,
    worst_unheld,
)
from hiersched.study.figures.loops import draw_gain_cells
from hiersched.study.figures.style import house_style
from hiersched.study.growth import loop_word
from hiersched.study.measure import _chains, measure, measured_groups, table_file
from hiersched.study.study import Study
from hiersched.study.tables.gains import gain_table
from hiersched.study.tables.loops import filter_table, has_filtered_cells
from hiersched.study.tables.policies import sweep_table

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
    place = {"experiment": LOOP_CELLS, "value": "near_lqg", "policy": "adjusted"}
    planted = {**place, "span": "violated", "loop_growth": 0.5, "loop": "shrinks"}
    write_parquet(tmp_path / files.GROWTH, pd.DataFrame([planted]))
    (row,) = filter_table(Study(scenario, tmp_path)).to_dict("records")
    assert (row["age_samples"], row["loop_growth"], row["loop"]) == (3, 0.5, "shrinks")
    assert row["linear_over_expected"] == pytest.approx(1.0, abs=0.02)
    assert 0.5 < row["expected_cm"] < 1.2
    assert row["estimate_std_cm"] < row["expected_cm"]
    # Planted: 2 and 12 cm, of which runs of three seeds have 0.9, 1.0 and 1.1.
    wanted = np.sqrt(np.mean([(0.02 * f) ** 2 for f in (0.9, 1.0, 1.1)] + [0.12**2] * 3) / 1.0)
    assert row["robots_cm"] == pytest.approx(100.0 * wanted, rel=1e-6)


def test_chains_count_samples_and_not_slots(tiny: Scenario) -> None:
    """Samples every second slot."""
    steps = np.array([[1, 17], [8, 8], [2, 12], [8, 8], [1, 3], [8, 8]], np.uint32)
    table = _chains(steps, tiny).set_index(["robot", "delay_steps", "next_steps", "span"])
    assert table["count"].to_dict() == {
        (0, 1, 2, ""): 1,
        (0, 2, 1, ""): 1,
        (1, 12, 3, ""): 1,
        (1, 17, 12, ""): 1,
    }
    longer = sampled_delays(np.arange(10)[:, None], tiny, 0.01)
    assert longer[:, 0].tolist() == [0, 2, 4, 6, 8]


def test_chains_of_violated_and_calm_windows_do_not_mix(tiny: Scenario) -> None:
    """The step from one into the other is in neither."""
    steps = np.repeat([1, 2, 5, 6, 5, 1], 2)[:, None]
    is_violated = np.repeat([False, False, True, True, True, False], 2)
    table = _chains(steps, tiny, is_violated).set_index(["span", "delay_steps", "next_steps"])
    assert table["count"].to_dict() == {
        ("violated", 5, 6): 1,
        ("violated", 6, 5): 1,
        ("calm", 1, 2): 1,
    }


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
    policies = tables["policies"].set_index("policy")
    assert policies.loc["pf", "loop_growth"] == pytest.approx(table.loc["pf", "followed"])
    assert set(policies["loop"]) == set(table["loop"]) == {"shrinks"}


FORCED = ("gain_methods", "gain_grid", "gain_sweeps", "table2_gain", "table2_methods")
"""Tables that compare the nominal and the adjusted gain under forced delays."""


def test_every_table_with_errors_marks_the_loops_that_grow(
    tables: dict[str, pd.DataFrame], measured: Callable[[Scenario], Path], tiny: Scenario
) -> None:
    """Whatever has a tracking error has the mark; it is that of the point and policy of the row."""
    words = {"shrinks", "grows", "not known", "local"}
    errors = ("error_cm", "nominal_cm", "tracking_error_cm", "robots_cm", "tracking_rms_cm")
    for name, table in tables.items():
        if not set(errors) & set(table):
            continue
        columns = ["nominal_loop", "adjusted_loop"] if name in FORCED else ["loop"]
        for column in columns:
            assert set(table[column]) <= words, name
            grows = table[f"{column}_growth"] >= 1.0
            assert (grows == (table[column] == "grows")).all(), name
    robots = tables["comparison"]["measure"].isin(["tracking_error_cm", "off_track_share"])
    for column in ("loop", "baseline_loop"):
        assert tables["comparison"].loc[robots, column].isin(words).all()
        assert tables["comparison"].loc[~robots, column].isna().all()
    results = measured(tiny)
    growth = pd.read_parquet(results / files.GROWTH)
    at = (growth["value"] == "arc") & (growth["policy"] == "pf")
    growth.loc[at, ["loop_growth", "loop"]] = 1.25, "grows"
    at = (growth["experiment"] == "gain_study") & (growth["value"] == "krasovskii")
    at &= (growth["policy"] == "nominal") & (growth["span"] == "violated")
    growth.loc[at, ["loop_growth", "loop"]] = 1.5, "grows"
    (results / files.GROWTH).unlink()
    write_parquet(results / files.GROWTH, growth)
    study = Study(tiny, results)
    marked = sweep_table(study)
    marked = marked[marked["loop"] == "grows"]
    assert marked[["axis", "value", "policy"]].to_numpy().tolist() == [["reference", "arc", "pf"]]
    assert marked["loop_growth"].tolist() == [1.25]
    gains = gain_table(study)  # the predictor's nominal loop is that of the first on its plant
    expected = gains["violated"] & gains["method"].isin(["krasovskii", "predictor"])
    assert ((gains["nominal_loop"] == "grows") == expected).all()
    assert (gains.loc[~gains["violated"], "adjusted_loop"] == "shrinks").all()


def test_forced_delays_have_the_growth_of_their_span(study: Study) -> None:
    """Delays of one sample were planted in calm windows, of four in violated ones."""
    growth = study.measures("growth")
    for method in ("krasovskii", "razumikhin"):
        own = growth[(growth["experiment"] == "gain_study") & (growth["value"] == method)]
        found = own.set_index(["policy", "span"])["loop_growth"]
        plant = plant_of(study.point("gain_study", method).scenario)
        # The planted schedule has 0.9 of the nominal gain from four samples on.
        nominal = spectral_radius_by_delay(*plant.closed_loop(plant.nominal_gain), 4) ** 2
        adjusted = spectral_radius_by_delay(*plant.closed_loop(0.9 * plant.nominal_gain), 4) ** 2
        wanted = {
            ("nominal", "calm"): nominal[1],
            ("nominal", "violated"): nominal[4],
            ("adjusted", "calm"): nominal[1],
            ("adjusted", "violated"): adjusted[4],
        }
        assert found.to_dict() == pytest.approx(wanted), method
        assert len({round(value, 6) for value in wanted.values()}) == 3


def test_a_loop_is_local_or_not_known_where_nothing_tells(tiny: Scenario) -> None:
    local = replace(tiny, control=replace(tiny.control, loop="local"))
    assert loop_word(float("nan"), local) == "local"
    assert [loop_word(x, tiny) for x in (float("nan"), 0.99, 1.0)] == [
        "not known",
        "shrinks",
        "grows",
    ]


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


def test_one_that_is_not_known_comes_first_and_nobody_is_followed_twice(
    tiny: Scenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    schedule = _schedule(tiny)
    steps = np.ones((400, 3), np.uint32)
    steps[:, 1] = np.resize([5000, 6000], 400)
    steps[:, 2] = np.resize([1, 2], 400)
    counts = transitions(steps, tiny, 0.01)
    asked: list[int] = []
    follow = loop_growth_module.growth_in_force

    def count(scenario: Scenario, *given: Any, **options: Any) -> float:
        asked.append(len(given[1]))
        return follow(scenario, *given, **options)

    monkeypatch.setattr(loop_growth_module, "growth_in_force", count)
    assert worst_unheld(tiny, schedule, counts) == (1, pytest.approx(np.nan, nan_ok=True))
    assert asked == [1]
    asked.clear()
    robot, growth = worst_growth(tiny, schedule, counts[::2])
    # Each of both once, then the worst with the nominal gain and held.
    assert len(asked) == 4
    assert growth == loop_growth(tiny, schedule, counts[::2][robot])


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
