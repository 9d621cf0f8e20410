"""Paired differences of two runs in the same world, and where they part."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from hiersched.log import LogError, LogReader
from hiersched.replay.compare import MOST_BATCHES, compare_logs
from hiersched.replay.measures import batch_means

PF, EDF = "runs/evaluate/pf/seed11.mcap", "runs/evaluate/edf/seed11.mcap"


def test_a_log_does_not_differ_from_itself(study: Path) -> None:
    comparison = compare_logs(study / PF, study / PF)
    assert comparison.partings == ()
    assert all(m.difference == (0, 0, 0) for m in comparison.measures)
    assert comparison.num_slots == 40


def test_differences_and_intervals_are_those_of_the_batches(study: Path) -> None:
    comparison = compare_logs(study / PF, study / EDF)
    assert (comparison.baseline, comparison.other) == ("pf", "edf")
    assert comparison.num_batches == MOST_BATCHES == 20
    with LogReader(study / PF) as a, LogReader(study / EDF) as b:
        rates, waits = (
            [log.read(topic)[field] for log in (a, b)]
            for topic, field in (("/allocation", "rate_mbps"), ("/queue", "backlog_packets"))
        )
        delay = a.read("/delay")
    for name, (x, y) in {"URLLC rate": rates, "URLLC backlog": waits}.items():
        measure = next(m for m in comparison.measures if m.name == name)
        assert measure.baseline == pytest.approx(x[:, :2].mean())
        assert measure.other == pytest.approx(y[:, :2].mean())
        pairs = (y - x)[:, :2].reshape(20, 2, 2).mean(axis=(1, 2))
        expected = stats.ttest_1samp(pairs, 0.0).confidence_interval(0.95)
        assert measure.difference == pytest.approx((pairs.mean(), expected.low, expected.high))
    late = next(m for m in comparison.measures if m.name == "URLLC late packets")
    share = delay["late_packets"][:, :2].sum() / delay["due_packets"][:, :2].sum()
    assert late.baseline == pytest.approx(100 * share)
    assert share > 0


def test_means_do_not_depend_on_the_batches(study: Path) -> None:
    with LogReader(study / PF) as log:
        one, many = (batch_means(log, 40, batches) for batches in (1, 8))
    for (name, _, whole), (_, _, parts) in zip(one, many, strict=True):
        assert parts.mean() == pytest.approx(whole[0], nan_ok=True), name


def test_where_runs_part(study: Path, tmp_path: Path, rewrite: Any) -> None:
    def change(fields: dict, events: list, metadata: dict) -> None:
        for slot in (17, 23):
            fields["prb_owner"][slot, 2] += 1
        fields["state"][31, 1, 4] = -fields["state"][31, 1, 4]

    other = rewrite(study / PF, tmp_path / "a.mcap", change)
    partings = compare_logs(study / PF, other).partings
    assert [tuple(vars(p).values()) for p in partings] == [
        ("/allocation", 17, 2),
        ("/robots", 31, 1),
    ]


def test_runs_of_other_worlds_are_not_paired(study: Path, tmp_path: Path, rewrite: Any) -> None:
    with pytest.raises(LogError, match=r"another world than that of .*: seed is 12, not 11"):
        compare_logs(study / PF, study / "runs/evaluate/pf/seed12.mcap")
    disguised = rewrite(
        study / "runs/evaluate/pf/seed12.mcap",
        tmp_path / "a.mcap",
        lambda f, e, m: m.update(seed="11"),
    )
    with pytest.raises(LogError, match="/channel mean_fading_power differs from slot 0 on"):
        compare_logs(study / PF, disguised)

    def change(fields: dict, events: list, metadata: dict) -> None:
        fields["arrival_uniform"][7, 1] = np.nextafter(fields["arrival_uniform"][7, 1], 1)

    with pytest.raises(LogError, match="/world arrival_uniform differs from slot 7 on"):
        compare_logs(study / PF, rewrite(study / PF, tmp_path / "b.mcap", change))
    with pytest.raises(LogError, match="dims is"):
        compare_logs(study / PF, study / "runs/gain_study/krasovskii/nominal/seed31.mcap")
