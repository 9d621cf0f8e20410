"""Another policy in the same world; and the log's own, to the last bit."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from hiersched.experiments import files
from hiersched.experiments.learned import learned_policies
from hiersched.experiments.logged import load_run
from hiersched.experiments.points import experiments
from hiersched.experiments.run import run_experiment
from hiersched.log import LogError, LogReader, log_digest
from hiersched.policies.trained import TrainedPolicy
from hiersched.replay.compare import compare_logs
from hiersched.replay.counterfactual import policy_of, rerun
from hiersched.replay.verify import verify
from hiersched.scenario import Scenario
from hiersched.study.metrics import measured_row, metrics_row, run_metrics


def fields_of(path: Path) -> dict[str, np.ndarray]:
    with LogReader(path) as log:
        return {name: value for topic in log.topics for name, value in log.read(topic).items()}


@pytest.mark.parametrize(
    "name",
    [
        "runs/evaluate/pf/seed11.mcap",
        "runs/evaluate/drift_plus_penalty/seed12.mcap",
        "runs/evaluate/ddpg/seed11.mcap",
        "runs/evaluate/ddpg/seed12.mcap",
        "runs/evaluate/flat/seed12.mcap",
        "runs/rayleigh_scale/0.5/pf/seed21.mcap",
        "runs/reference/arc/ddpg/seed21.mcap",
    ],
)
def test_own_policy_reproduces_the_log(name: str, study: Path, tmp_path: Path) -> None:
    run = load_run(study / name)
    rerun(run, policy_of(run, run.policy), tmp_path / "again.mcap")
    assert log_digest(tmp_path / "again.mcap") == log_digest(study / name)
    assert (tmp_path / "again.mcap").read_bytes() == (study / name).read_bytes()


def test_another_policy_meets_the_same_world(study: Path, tmp_path: Path) -> None:
    """What comes out is the log that the stage wrote for that policy."""
    run = load_run(study / "runs/evaluate/pf/seed11.mcap")
    rerun(run, policy_of(run, "edf"), tmp_path / "edf.mcap")
    assert (tmp_path / "edf.mcap").read_bytes() == (
        study / "runs/evaluate/edf/seed11.mcap"
    ).read_bytes()
    before, after = fields_of(run.path), fields_of(tmp_path / "edf.mcap")
    for name in ("fading_power", "arrival_uniform", "robot_normal"):
        assert np.array_equal(before[name], after[name])
    assert not np.array_equal(before["prb_owner"], after["prb_owner"])


def test_every_episode_of_a_training_under_another_policy(study: Path, tmp_path: Path) -> None:
    run = load_run(study / "train/ddpg/seed1.mcap")
    rerun(run, policy_of(run, "max_weight"), tmp_path / "a.mcap")
    assert compare_logs(run.path, tmp_path / "a.mcap").num_slots == 48
    again = load_run(tmp_path / "a.mcap")
    assert (again.policy, again.stage, again.num_slots) == ("max_weight", "train", 48)
    assert verify(again) is None


@pytest.mark.parametrize("name", ["runs/evaluate/pf/seed12.mcap", "train/ddpg/seed1.mcap"])
def test_a_file_of_weights(name: str, study: Path, tmp_path: Path) -> None:
    run = load_run(study / name)
    weights = study / "train/ddpg/policy_seed1.json"
    rerun(run, policy_of(run, str(weights)), tmp_path / "a.mcap")
    again = load_run(tmp_path / "a.mcap")
    assert again.policy == "ddpg"
    assert again.attachments["policy_seed1.json"] == weights.read_bytes()
    assert verify(again) is None
    if "eval" in name:  # and the new log can be reproduced in turn
        rerun(again, policy_of(again, "ddpg"), tmp_path / "b.mcap")
        assert log_digest(tmp_path / "b.mcap") == log_digest(tmp_path / "a.mcap")


@pytest.mark.parametrize("name", ["evaluate", "reference", "generalise"])
def test_a_run_without_log_comes_from_a_rules_log_of_its_world(
    name: str, small: Scenario, study: Path, tmp_path: Path
) -> None:
    """Every pair of policy and world that is measured and not logged, to the last bit."""
    weights = []
    for seed in (1, 2):
        policy = TrainedPolicy.load(study / "train/ddpg/policy_seed1.json")
        rng = np.random.default_rng(seed)
        parameters = rng.normal(0.0, 0.5, policy.parameters.shape).astype(np.float32)
        weights.append(tmp_path / f"policy_seed{seed}.json")
        replace(policy, parameters=parameters, seed=seed).save(weights[-1])
    results, source = tmp_path / "results", learned_policies(weights)
    shutil.copytree(study / "gains", results / "gains")
    experiment = experiments(small)[name]
    (point,) = experiment.points
    scenario = point.scenario
    logs = {seed: files.run_log(experiment, point, "pf", seed) for seed in experiment.seeds}
    two = replace(small, learning=replace(small.learning, seeds=(1, 2)))
    run_experiment(two, results, name, "ddpg", source, measured_row)
    rows = pd.read_parquet(results / files.crossed_file(experiment, point, "ddpg"))
    assert len(rows) == len(logs)  # of two policies in these worlds one each is logged
    for row in rows.to_dict("records"):
        run = load_run(study / logs[row["seed"]])
        out = tmp_path / f"{row['seed']}.mcap"
        rerun(run, policy_of(run, str(weights[row["policy_seed"] - 1])), out)
        again = metrics_row(run_metrics(out, scenario), scenario)
        assert again.keys() == row.keys()
        for key, value in again.items():
            same = value == row[key] or (not isinstance(value, str) and np.isnan(value))
            assert same, (key, value, row[key])
        assert again["policy_seed"] == row["policy_seed"]
        assert again["seed"] == row["seed"]


def test_weights_for_another_number_of_users(study: Path, tmp_path: Path) -> None:
    policy = TrainedPolicy.load(study / "train/ddpg/policy_seed1.json").for_users(5, 2)
    policy.save(tmp_path / "five.json")
    run = load_run(study / "runs/evaluate/pf/seed12.mcap")
    rerun(run, policy_of(run, str(tmp_path / "five.json")), tmp_path / "a.mcap")
    assert verify(load_run(tmp_path / "a.mcap")) is None


def test_policies_that_are_not_to_be_had(study: Path, tmp_path: Path, rewrite: Any) -> None:
    run = load_run(study / "runs/evaluate/pf/seed11.mcap")
    with pytest.raises(ValueError, match=r"policy = 'best': must be one of pf, .*, or a file of"):
        policy_of(run, "best")
    (tmp_path / "text.json").write_text("no weights")
    with pytest.raises(ValueError, match=r"text\.json: not a policy: its first line"):
        policy_of(run, str(tmp_path / "text.json"))
    training = load_run(study / "train/ddpg/seed1.mcap")
    with pytest.raises(LogError, match="ddpg was learning in this log"):
        policy_of(training, "ddpg")
    study_run = load_run(study / "runs/gain_study/krasovskii/nominal/seed31.mcap")
    with pytest.raises(LogError, match="its delays are forced"):
        policy_of(study_run, "pf")
    path = rewrite(
        study / "runs/evaluate/ddpg/seed11.mcap",
        tmp_path / "a.mcap",
        lambda f, e, m: m.pop("policy_seed"),
    )
    with pytest.raises(LogError, match="does not have the weights of ddpg"):
        policy_of(load_run(path), "ddpg")
