"""The gain study beyond Table II: methods, grid, sweeps, regions and traces, from planted logs."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hiersched.study.collect import gain_schedules
from hiersched.study.figures_gain_grid import draw_gain_grid
from hiersched.study.figures_gain_sweeps import (
    draw_gain_stability,
    draw_gain_sweeps,
    draw_gain_traces,
)
from hiersched.study.gain_logs import (
    Robots,
    delay_range,
    gain_sweep_frame,
    robot_measures,
    schedule_state,
    stability_frame,
    trace_frame,
)
from hiersched.study.gain_summary import (
    compared,
    effect_of,
    grid_table,
    methods_table,
    sweeps_table,
)
from hiersched.study.style import house_style
from matplotlib.axes import Axes

from hiersched.scenario import Scenario
from hiersched.study.statistics import Interval


@pytest.fixture(scope="module")
def grid(results: Path, tiny: Scenario) -> pd.DataFrame:
    return grid_table(results, tiny)


def texts(axes: Axes) -> list[str]:
    return [text.get_text() for text in axes.texts]


def test_methods_have_the_planted_ratios_in_violated_slots_alone(
    results: Path, tiny: Scenario
) -> None:
    table = methods_table(results, tiny).set_index(["method", "slot"])
    assert list(table.index.get_level_values("slot").unique()) == [
        "5",
        "10",
        "20",
        "violated",
        "calm",
    ]
    # Geometric means of 0.49, 0.50, 0.51 and of 1.19, 1.20, 1.21.
    for method, ratio in (("krasovskii", 0.499933), ("razumikhin", 1.0), ("predictor", 1.199972)):
        assert table.loc[(method, "calm"), "ratio"] == 1.0
        for slot in ("5", "20", "violated"):
            assert table.loc[(method, slot), "ratio"] == pytest.approx(ratio, abs=1e-6)
    assert table["nominal_cm"].to_numpy() == pytest.approx(np.full(15, 2.0))
    assert (table["seeds"] == 3).all()
    assert table.loc[("razumikhin", "5"), "plant"] == "split"
    state = ["delay_steps", "status", "certified"]
    assert table.loc[("krasovskii", "violated"), state].tolist() == ["4–6", "adjusted", "3 of 3"]
    assert table.loc[("krasovskii", "calm"), state].tolist() == ["1", "nominal", "1 of 1"]


def test_grid_tells_same_gains_from_gains_that_help(grid: pd.DataFrame) -> None:
    assert grid["weight"].tolist() == [100.0, 100.0]
    assert grid["delay_s"].tolist() == [0.04, 0.2]
    assert grid["delay_steps"].tolist() == ["2", "10"]
    assert grid["effect"].tolist() == ["same gain", "helps"]
    assert grid["ratio"].to_numpy() == pytest.approx([1.0, 0.6])
    assert grid["nominal_cm"].to_numpy() == pytest.approx([7.0, 7.0])  # of 2 and 12 cm
    assert grid["nominal_off_track_share"].tolist() == [0.5, 0.5]
    assert grid["adjusted_off_track_share"].tolist() == [0.5, 0.0]
    assert grid["nominal_saturated_share"].tolist() == [0.5, 0.5]


def test_robots_in_trouble_are_counted_and_not_left_out() -> None:
    robots = Robots(np.array([[1.0, 30.0], [2.0, 9.0]]), np.array([[0.5, 0.0], [0.51, 0.2]]))
    assert robot_measures(robots, slice(0, 1)) == {
        "error_cm": 15.5,
        "off_track": 0.5,
        "saturated": 0.0,
    }
    assert robot_measures(robots, [1]) == {"error_cm": 5.5, "off_track": 0.0, "saturated": 0.5}


@pytest.mark.parametrize(
    ("lo", "hi", "effect"),
    [
        (0.5, 0.99, "helps"),
        (0.5, 1.0, "no difference"),
        (1.0, 1.2, "no difference"),
        (1.01, 1.2, "hurts"),
        (-math.inf, math.inf, "no difference"),
        (math.nan, math.nan, "no difference"),
    ],
)
def test_an_effect_needs_an_interval_without_1(lo: float, hi: float, effect: str) -> None:
    assert effect_of(Interval(0.9, lo, hi)) == effect


def test_comparison_is_paired_by_seed() -> None:
    """Errors that differ by half between worlds, and by a tenth between gains."""
    errors = {"nominal": np.array([2.0, 2.5, 3.0]), "adjusted": np.array([1.8, 2.25, 2.7])}
    runs = pd.DataFrame(
        [
            {"gain": gain, "error_cm": error, "off_track": 0.0, "saturated": 0.0}
            for gain, values in errors.items()
            for error in values
        ]
    )
    row = compared(runs)
    assert (row["ratio_lo"], row["ratio_hi"]) == pytest.approx((0.9, 0.9))
    assert row["nominal_cm_hi"] > 3.0


def test_delays_in_samples_and_the_gains_there(results: Path, tiny: Scenario) -> None:
    assert list(delay_range(tiny, (0.08, 0.12))) == [4, 5, 6]
    assert list(delay_range(tiny, (0.041, 0.041))) == [3]
    assert list(delay_range(tiny, (0.23, 9.0))) == [12]  # capped at T_max, as in the loop
    schedule = gain_schedules(results, tiny)["krasovskii"]
    mixed = {"delay_steps": "3–4", "status": "nominal, adjusted", "certified": "2 of 2"}
    assert schedule_state(schedule, range(3, 5)) == mixed
    assert schedule_state(schedule, range(12, 13))["certified"] == "0 of 1"


def test_sweeps_have_the_first_unstable_delay(results: Path, tiny: Scenario) -> None:
    table = sweeps_table(results, tiny)
    sampling, noise = (table[table["axis"] == axis] for axis in ("sampling_s", "noise"))
    assert sampling["sampling_s"].tolist() == [0.02, 0.05]
    assert sampling["first_unstable_delay_s"].tolist() == pytest.approx(
        [0.08, math.nan], nan_ok=True
    )
    assert noise["first_unstable_delay_s"].isna().all()
    assert noise["noise_position_m"].tolist() == [0.0, 0.002]
    assert noise["noise_heading_rad"].tolist() == [0.0, 0.005]
    assert table["ratio"].to_numpy() == pytest.approx(0.6 * np.ones(4))


def test_regions_are_read_with_what_they_do_not_reach(results: Path) -> None:
    frame = stability_frame(results)
    own = frame[frame["axis"] == "weight"].set_index("criterion")
    assert own.loc["exact", "delay_s"] == pytest.approx(0.16)
    assert math.isnan(own.loc["c1", "delay_s"])
    assert own["at_least"].tolist() == [False, False, True]
    with pytest.raises(FileNotFoundError, match=r"stability\.json: no such file"):
        stability_frame(results / "nowhere")


def test_a_missing_log_of_a_sweep_is_named(results: Path, tiny: Scenario, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"grid/q100_0\.04_adjusted_seed31\.mcap: no such"):
        gain_sweep_frame(tmp_path, tiny, "grid")


def test_grid_figure_writes_the_table(grid: pd.DataFrame, tiny: Scenario) -> None:
    with house_style():
        ratios, errors, *_ = draw_gain_grid(grid, tiny).axes
    assert texts(ratios) == ["1", "0.600\n0.600–0.600"]
    assert [text.get_fontweight() for text in ratios.texts] == ["normal", "bold"]
    assert len(ratios.patches) == 1  # hatched: the same gain
    assert texts(errors) == ["7.00\n50 % off", "7.00\n50 % off"]


def test_stability_figure_marks_what_is_at_least(results: Path, tiny: Scenario) -> None:
    with house_style():
        (axes,) = draw_gain_stability(stability_frame(results), tiny).axes
    lines = {line.get_label(): line for line in axes.get_lines()}
    assert lines["nominal gain, exact (constant delay)"].get_ydata() == pytest.approx([160.0])
    white = [line for line in axes.get_lines() if line.get_markerfacecolor() == "white"]
    assert sum(len(line.get_xdata()) for line in white) == 1


def test_sweep_figure_draws_the_known_delays(results: Path, tiny: Scenario) -> None:
    with house_style():
        unstable, *_ = draw_gain_sweeps(sweeps_table(results, tiny), tiny).axes
    (line,) = unstable.get_lines()
    assert line.get_xydata() == pytest.approx(np.array([[20.0, 80.0]]))


def test_traces_begin_a_window_before_the_violation(results: Path, tiny: Scenario) -> None:
    frame = trace_frame(results, tiny)
    window = 10  # slots
    assert set(frame["slot"]) == set(range(-window, 3 * window))
    one = frame[(frame["method"] == "krasovskii") & (frame["seed"] == 32)].set_index("slot")
    inside = (one.index >= 0) & (one.index < window)
    assert one["error_cm"].to_numpy() == pytest.approx(np.where(inside, 1.0, 2.0))
    with house_style():
        figure = draw_gain_traces(frame, tiny)
    assert "Razumikhin: the nominal gain, at all" in figure.get_supxlabel().replace("\n", " ")
    shaded = figure.axes[0].patches[0]
    assert (shaded.get_x(), shaded.get_width()) == (0.0, tiny.robot.window_s)
