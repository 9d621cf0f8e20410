"""Small logs written again in full: what the stage itself would have logged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hiersched.cli import main
from hiersched.experiments import files
from hiersched.experiments.learned import learned_policies
from hiersched.experiments.logged import load_run
from hiersched.experiments.run import run_experiment
from hiersched.experiments.train import train_and_log
from hiersched.experiments.worlds import untrained_policies
from hiersched.log import LogReader, log_digest
from hiersched.replay.compare import compare_logs
from hiersched.replay.verify import expand, verify
from hiersched.scenario import Scenario
from hiersched.study.metrics import measured_row

TRAINING = "train/ddpg/seed1.mcap"


@pytest.fixture(scope="module")
def otherwise(small: Scenario, study: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same training in full, the same evaluations in compact logs."""
    results = tmp_path_factory.mktemp("otherwise")
    (results / "gains").symlink_to(study / "gains")
    log = replace(small.log, train_profile="full", evaluate_profile="compact")
    other = replace(small, log=log)
    train_and_log(other, "ddpg", results, "code", show=False)
    learned = learned_policies([study / name for name in files.policy_files(small, "ddpg")])
    for group, run in (("classical", untrained_policies), ("ddpg", learned)):
        run_experiment(other, results, "evaluate", group, run, measured_row)
    return results


def fields_of(path: Path) -> dict[str, np.ndarray]:
    with LogReader(path) as log:
        return {name: value for topic in log.topics for name, value in log.read(topic).items()}


@pytest.mark.parametrize("name", ["runs/evaluate/pf/seed11.mcap", "runs/evaluate/ddpg/seed12.mcap"])
def test_a_compact_evaluation_becomes_the_full_one(
    name: str, study: Path, otherwise: Path, tmp_path: Path
) -> None:
    run = load_run(otherwise / name)
    assert run.profile == "compact"
    assert expand(run, tmp_path / "full.mcap") is None
    assert log_digest(tmp_path / "full.mcap") == log_digest(study / name)
    assert verify(load_run(tmp_path / "full.mcap")) is None


def test_a_full_log_becomes_its_equal(study: Path, tmp_path: Path) -> None:
    assert expand(load_run(study / "runs/evaluate/pf/seed11.mcap"), tmp_path / "a.mcap") is None
    assert (tmp_path / "a.mcap").read_bytes() == (
        study / "runs/evaluate/pf/seed11.mcap"
    ).read_bytes()


def test_decisions_of_a_training_become_all_but_its_weights(
    study: Path, otherwise: Path, tmp_path: Path
) -> None:
    run = load_run(study / TRAINING)
    assert run.profile == "decisions"
    assert expand(run, tmp_path / "full.mcap") is None
    expanded, full = fields_of(tmp_path / "full.mcap"), fields_of(otherwise / TRAINING)
    assert expanded.keys() == full.keys()
    for name in expanded.keys() - {"weight"}:
        assert expanded[name].tobytes() == full[name].tobytes(), name
    assert np.isnan(expanded["weight"]).all()
    assert np.isfinite(full["weight"]).all()
    with LogReader(tmp_path / "full.mcap") as a, LogReader(otherwise / TRAINING) as b:
        assert a.events() == b.events()
        assert len(a.events()) > 0
    again = load_run(tmp_path / "full.mcap")
    assert verify(again) is None
    assert expand(again, tmp_path / "again.mcap") is None
    assert log_digest(tmp_path / "again.mcap") == log_digest(tmp_path / "full.mcap")


def test_both_profiles_of_a_training_measure_the_same(study: Path, otherwise: Path) -> None:
    comparison = compare_logs(study / TRAINING, otherwise / TRAINING)
    assert comparison.partings == ()
    names = [measure.name for measure in comparison.measures]
    kinds = ("late packets", "backlog", "reward")
    assert names == [f"{part} {kind}" for part in ("URLLC", "eMBB") for kind in kinds]
    for measure in comparison.measures:
        assert measure.other == pytest.approx(measure.baseline, rel=1e-12, nan_ok=True)


def test_what_differs_is_not_written(study: Path, tmp_path: Path, rewrite: Any) -> None:
    def change(fields: dict[str, Any], events: list, metadata: dict) -> None:
        fields["backlog_embb_packets"][21] *= 1 + 2**-52

    def another_event(fields: dict[str, Any], events: list, metadata: dict) -> None:
        events[0] = events[0]._replace(message="all is well")

    for number, tamper in enumerate((change, another_event)):
        path = rewrite(study / TRAINING, tmp_path / f"{number}.mcap", tamper)
        found = expand(load_run(path), tmp_path / "new/full.mcap")
        assert found is not None
        assert (found.slot, found.topic) == (21, "/delay") or found.topic == "/events"
        assert list((tmp_path / "new").iterdir()) == []


def test_command(study: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "full.mcap"
    words = ["replay", str(study / TRAINING), "--out", str(out)]
    assert main(words) == 0
    assert f"{out}: the same run, profile full" in capsys.readouterr().out
    before = out.read_bytes()
    assert main(words) == 2
    assert "never overwrites" in capsys.readouterr().err
    assert out.read_bytes() == before
    assert main(["info", str(study / TRAINING)]) == 0
    text = capsys.readouterr().out
    assert "profile decisions" in text
    assert "URLLC backlog" in text
    assert "tracking error" not in text
