"""Learners side by side: paired differences by hand, what their figures draw."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hiersched.study.collect import checkpoint_frames, sweep_frame, training_frames
from hiersched.study.comparison import CELL_MEASURES
from hiersched.study.figures_learners import draw_learners, draw_learning
from hiersched.study.learners import differing_keys, learner_table
from hiersched.study.style import house_style, policy_look
from hiersched.study.summary import sweep_table

from hiersched.scenario import Scenario

SHARES = [name for name in CELL_MEASURES if name.endswith("_share")]


def runs_of(policy: str, values: list[float], load: float) -> pd.DataFrame:
    columns = dict.fromkeys(CELL_MEASURES, values) | dict.fromkeys(SHARES, np.divide(values, 100.0))
    sizes = {"num_slots": 100, "urllc_due_packets": 4000, "embb_due_packets": 4000}
    frame = pd.DataFrame({"seed": [21, 22, 23], **columns, **sizes})
    return frame.assign(axis="load", value=load, policy=policy)


def test_learners_are_compared_world_by_world(tiny: Scenario) -> None:
    """By hand: rates differ by 1, 2 and 3; what is skewed has ratios 1.1 whatever the world.

    Whatever the order of the rows; others do not count.
    """
    flat = runs_of("flat", [11.0, 22.0, 33.0], 0.85).iloc[::-1]
    sweeps = pd.concat(
        [
            runs_of("ddpg", [10.0, 20.0, 30.0], 0.85),
            flat,
            runs_of("pf", [5.0, 5.0, 5.0], 0.85),
            runs_of("flat", [0.0, 0.0, 0.0], 0.85).assign(axis="reference"),
        ]
    )
    table = learner_table(sweeps, tiny).set_index("learner")
    assert list(table.index) == ["ddpg", "flat"]
    row = table.loc["flat"]
    assert row["urllc_rate_mbps"] == pytest.approx(22.0)
    assert row["urllc_rate_mbps_minus_own"] == pytest.approx(2.0)
    half = 4.302653 / np.sqrt(3.0)  # Student's t of two degrees of freedom, spread 1
    assert row["urllc_rate_mbps_minus_own_lo"] == pytest.approx(2.0 - half, rel=1e-6)
    for name in (*SHARES, "tracking_error_cm", "mean_square_backlog", "penalty_cost"):
        over = [row[f"{name}_over_own{end}"] for end in ("", "_lo", "_hi")]
        assert over == pytest.approx([1.1, 1.1, 1.1])
        assert f"{name}_minus_own" not in table
    assert np.isnan(table.loc["ddpg", "urllc_rate_mbps_minus_own"])
    assert row["differs"] == "network = mlp"
    assert table.loc["ddpg", "differs"] == "as configured"


def test_a_learner_that_is_never_late_has_a_ratio_from_above(tiny: Scenario) -> None:
    """Shares of 0 count as the 4 packets of a batch of 4000: 0.001 of the own learner's 0.1."""
    sweeps = pd.concat(
        [runs_of(p, v, 0.85) for p, v in (("ddpg", [10.0] * 3), ("flat", [0.0] * 3))]
    )
    row = learner_table(sweeps, tiny).set_index("learner").loc["flat"]
    late = "urllc_late_share_over_own"
    assert row[[late, f"{late}_lo", f"{late}_hi"]].tolist() == pytest.approx([0.01, 0.0, 0.01])


def test_only_what_differs_is_named(tiny: Scenario) -> None:
    slow = replace(tiny.learning, actor_lr=1e-9, reward="independent")
    assert differing_keys(replace(tiny, learners={"slow": slow}), "slow") == {
        "actor_lr": 1e-9,
        "reward": "independent",
    }


def test_curves_are_those_of_the_logs(tiny: Scenario, results: Path) -> None:
    training = training_frames(results, tiny)
    assert list(training) == ["ddpg", "flat"]
    with house_style():
        figure = draw_learning(training, checkpoint_frames(results, tiny), tiny)
    panel = figure.axes[1]
    for line, (name, frame) in zip(panel.get_lines(), training.items(), strict=True):
        rounds = frame.groupby([(frame["episode"] - 1) // 2, "seed"])["urllc_backlog_packets"]
        expected = rounds.mean().groupby(level=0).mean()
        assert line.get_label() == policy_look(name, tiny).label
        assert line.get_ydata() == pytest.approx(expected.to_numpy())
        assert line.get_xdata() == pytest.approx([0.5, 1.0])


def test_every_learner_is_drawn_at_every_load(tiny: Scenario, results: Path) -> None:
    sweeps = sweep_table(sweep_frame(results, tiny), tiny)
    with house_style():
        figure = draw_learners(sweeps, tiny)
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["DRL (DDPG)", "flat", "PF", "drift-plus-penalty"]
    along = sweeps[(sweeps["axis"] == "load") & (sweeps["policy"] == "flat")]
    drawn = figure.axes[3].containers[1].lines[0].get_ydata()
    assert drawn == pytest.approx(along["embb_rate_mbps"].to_numpy())
