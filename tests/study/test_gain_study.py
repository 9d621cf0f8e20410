"""The gain study beyond Table II: methods, grid, sweeps, regions and traces, from planted logs."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes

from hiersched.study.figures.gains import (
    draw_gain_grid,
    draw_gain_stability,
    draw_gain_sweeps,
    draw_gain_traces,
)
from hiersched.study.figures.style import house_style
from hiersched.study.statistics import Interval
from hiersched.study.study import Study
from hiersched.study.tables.gains import (
    by_run,
    compared,
    delay_range,
    effect_of,
    schedule_state,
)


def texts(axes: Axes) -> list[str]:
    return [text.get_text() for text in axes.texts]


def test_methods_have_the_planted_ratios_in_violated_slots_alone(
    tables: dict[str, pd.DataFrame],
) -> None:
    table = tables["gain_methods"].set_index(["method", "slot"])
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


def test_grid_tells_same_gains_from_gains_that_help(tables: dict[str, pd.DataFrame]) -> None:
    grid = tables["gain_grid"]
    assert grid["weight"].tolist() == [100.0, 100.0]
    assert grid["delay_s"].tolist() == [0.04, 0.2]
    assert grid["delay_steps"].tolist() == [2, 10]
    assert grid["effect"].tolist() == ["same gain", "helps"]
    assert grid["ratio"].to_numpy() == pytest.approx([1.0, 0.6])
    assert grid["nominal_cm"].to_numpy() == pytest.approx([7.0, 7.0])  # of 2 and 12 cm
    assert grid["nominal_off_track_share"].tolist() == [0.5, 0.5]
    assert grid["adjusted_off_track_share"].tolist() == [0.5, 0.0]
    assert grid["nominal_saturated_share"].tolist() == [0.5, 0.5]


def test_robots_in_trouble_are_counted_and_not_left_out() -> None:
    """Two robots in two windows: over 10 cm, or at their limits for more than half of a window."""
    windows = pd.DataFrame(
        {
            **{"gain": "nominal", "seed": 1, "window": [1, 1, 2, 2], "robot": [0, 1, 0, 1]},
            **{"error_cm": [1.0, 30.0, 2.0, 9.0], "saturated": [0.5, 0.0, 0.51, 0.2]},
        }
    )

    def measures(window: int) -> list[float]:
        (row,) = by_run(windows[windows["window"] >= window]).to_dict("records")
        return [row[name] for name in ("error_cm", "off_track", "saturated")]

    assert measures(2) == [5.5, 0.0, 0.5]
    assert measures(1) == [10.5, 0.5, 0.5]


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


def test_delays_in_samples_and_the_gains_there(study: Study) -> None:
    tiny = study.scenario
    assert list(delay_range(tiny, (0.08, 0.12))) == [4, 5, 6]
    assert list(delay_range(tiny, (0.041, 0.041))) == [3]
    assert list(delay_range(tiny, (0.23, 9.0))) == [12]  # capped at T_max, as in the loop
    schedule = study.schedule(tiny)
    mixed = {"delay_steps": "3–4", "status": "nominal, adjusted", "certified": "2 of 2"}
    assert schedule_state(schedule, range(3, 5)) == mixed
    assert schedule_state(schedule, range(12, 13))["certified"] == "0 of 1"


def test_sweeps_have_the_first_unstable_delay(tables: dict[str, pd.DataFrame]) -> None:
    table = tables["gain_sweeps"]
    sampling, noise = (table[table["axis"] == axis] for axis in ("sampling_s", "noise"))
    assert sampling["sampling_s"].tolist() == [0.02, 0.05]
    assert sampling["first_unstable_delay_s"].tolist() == pytest.approx(
        [0.08, math.nan], nan_ok=True
    )
    assert noise["first_unstable_delay_s"].isna().all()
    assert noise["noise_position_m"].tolist() == [0.0, 0.002]
    assert noise["noise_heading_rad"].tolist() == [0.0, 0.005]
    assert table["ratio"].to_numpy() == pytest.approx(0.6 * np.ones(4))


def test_regions_are_read_with_what_they_do_not_reach(tables: dict[str, pd.DataFrame]) -> None:
    table = tables["gain_stability"]
    own = table[table["axis"] == "weight"].set_index("criterion")
    assert own.loc["exact", "delay_s"] == pytest.approx(0.16)
    assert math.isnan(own.loc["c1", "delay_s"])
    assert own["at_least"].tolist() == [False, False, True]


def test_grid_figure_writes_the_table(study: Study) -> None:
    with house_style():
        ratios, errors, *_ = draw_gain_grid(study).axes
    assert texts(ratios) == ["1", "0.600\n0.600–0.600"]
    assert [text.get_fontweight() for text in ratios.texts] == ["normal", "bold"]
    assert len(ratios.patches) == 1  # hatched: the same gain
    assert texts(errors) == ["7.00\n50 % off", "7.00\n50 % off"]


def test_stability_figure_marks_what_is_at_least(study: Study) -> None:
    with house_style():
        (axes,) = draw_gain_stability(study).axes
    lines = {line.get_label(): line for line in axes.get_lines()}
    assert lines["nominal gain, exact (constant delay)"].get_ydata() == pytest.approx([160.0])
    white = [line for line in axes.get_lines() if line.get_markerfacecolor() == "white"]
    assert sum(len(line.get_xdata()) for line in white) == 1


def test_sweep_figure_draws_the_known_delays(study: Study) -> None:
    with house_style():
        unstable, *_ = draw_gain_sweeps(study).axes
    (line,) = unstable.get_lines()
    assert line.get_xydata() == pytest.approx(np.array([[20.0, 80.0]]))


def test_traces_begin_a_window_before_the_violation(study: Study) -> None:
    """Krasovskii's gains are planted to halve the error of 2 cm in the violated window of 0.1 s."""
    with house_style():
        figure = draw_gain_traces(study)
    assert "Razumikhin: the nominal gain, at all" in figure.get_supxlabel().replace("\n", " ")
    panel = figure.axes[0]
    shaded = panel.patches[0]
    assert (shaded.get_x(), shaded.get_width()) == (0.0, study.scenario.robot.window_s)
    lines = {line.get_label(): line for line in panel.get_lines()}
    time_s = 0.01 * (np.arange(-10, 30) + 0.5)
    inside = (time_s > 0.0) & (time_s < 0.1)
    assert lines["Krasovskii"].get_xdata() == pytest.approx(time_s)
    mean = (1.8 * 0.49 + 2.0 * 0.5 + 2.2 * 0.51) / 3
    assert lines["Krasovskii"].get_ydata() == pytest.approx(np.where(inside, mean, 2.0))
    assert lines["nominal gain"].get_ydata() == pytest.approx(np.full(40, 2.0))
    assert set(lines) == {"nominal gain", "Krasovskii", "predictor"}  # of the network plant
