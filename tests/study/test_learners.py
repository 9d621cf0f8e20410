"""Learners side by side: paired differences by hand, what their figures draw."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from hiersched.scenario import Scenario
from hiersched.study.figures.comparison import draw_learners
from hiersched.study.figures.style import house_style, policy_look
from hiersched.study.figures.training import draw_learning
from hiersched.study.study import Study
from hiersched.study.tables.policies import CELL_MEASURES, differing_keys, learner_table

SHARES = [name for name in CELL_MEASURES if name.endswith("_share")]


def runs_of(policy: str, values: list[float], axis: str = "load") -> pd.DataFrame:
    columns = dict.fromkeys(CELL_MEASURES, values) | dict.fromkeys(SHARES, np.divide(values, 100.0))
    sizes = {"num_slots": 100, "urllc_due_packets": 4000, "embb_due_packets": 4000}
    frame = pd.DataFrame({"seed": [21, 22, 23], **columns, **sizes})
    return frame.assign(stage="sweep", experiment=axis, axis=axis, value=0.85, policy=policy)


def test_learners_are_compared_world_by_world(
    tiny: Scenario, planted: Callable[..., Study]
) -> None:
    """By hand: rates differ by 1, 2 and 3; what is skewed has ratios 1.1 whatever the world.

    Whatever the order of the rows; others do not count.
    """
    runs = [
        runs_of("ddpg", [10.0, 20.0, 30.0]),
        runs_of("alt", [11.0, 22.0, 33.0]).iloc[::-1],
        runs_of("pf", [5.0, 5.0, 5.0]),
        runs_of("alt", [0.0, 0.0, 0.0], axis="reference"),
    ]
    table = learner_table(planted(tiny, runs=pd.concat(runs))).set_index("learner")
    assert list(table.index) == ["ddpg", "alt"]
    row = table.loc["alt"]
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


def test_a_learner_that_is_never_late_has_a_ratio_from_above(
    tiny: Scenario, planted: Callable[..., Study]
) -> None:
    """Shares of 0 count as the 4 packets of a batch of 4000: 0.001 of the own learner's 0.1."""
    runs = pd.concat([runs_of("ddpg", [10.0] * 3), runs_of("alt", [0.0] * 3)])
    row = learner_table(planted(tiny, runs=runs)).set_index("learner").loc["alt"]
    late = "urllc_late_share_over_own"
    assert row[[late, f"{late}_lo", f"{late}_hi"]].tolist() == pytest.approx([0.01, 0.0, 0.01])


def test_only_what_differs_is_named(tiny: Scenario) -> None:
    slow = replace(tiny.learning, actor_lr=1e-9, reward="independent")
    assert differing_keys(replace(tiny, learners={"slow": slow}), "slow") == {
        "actor_lr": 1e-9,
        "reward": "independent",
    }


def test_curves_are_those_of_the_logs(study: Study) -> None:
    with house_style():
        panel = draw_learning(study).axes[1]
    assert list(study.training) == ["ddpg", "alt"]
    for line, (name, frame) in zip(panel.get_lines(), study.training.items(), strict=True):
        rounds = frame.groupby([(frame["episode"] - 1) // 2, "seed"])["urllc_backlog_packets"]
        expected = rounds.mean().groupby(level=0).mean()
        assert line.get_label() == policy_look(name, study.scenario).label
        assert line.get_ydata() == pytest.approx(expected.to_numpy())
        assert line.get_xdata() == pytest.approx([0.5, 1.0])


def test_every_learner_is_drawn_at_every_load(
    study: Study, tables: dict[str, pd.DataFrame]
) -> None:
    with house_style():
        figure = draw_learners(study)
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["DRL (DDPG)", "alt", "PF", "drift-plus-penalty"]
    along = tables["sweeps"].query("axis == 'load' and policy == 'alt'")
    drawn = figure.axes[3].containers[1].lines[0].get_ydata()
    assert drawn == pytest.approx(along["embb_rate_mbps"].to_numpy())
