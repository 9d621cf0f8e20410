"""Families and cells of the study of the task: faults with file, key, value, what is allowed."""

from __future__ import annotations

from pathlib import Path

import pytest

from hiersched.experiments.feasible import load_study
from hiersched.experiments.points import experiments, trained_learners
from hiersched.scenario import ScenarioError, load_resolved, load_scenario, scenario_to_yaml

FAMILY = "urgency: {policy: {model: urgency}, range: [0.5, 8.0]}"
CELL = "here: {values: {traffic.load: 1.0}}"


def text_of(families: str = FAMILY, cells: str = CELL, more: str = "") -> str:
    return f"task_study: {{families: {{{families}}}, cells: {{{cells}}}{more}}}"


def test_there_is_none_by_default():
    assert not [e for e in experiments(load_scenario("paper")).values() if e.stage == "task"]


def test_a_study_comes_back_from_what_is_written(load_text):
    scenario = load_text(text_of())
    again, added, _ = load_resolved(scenario_to_yaml(scenario), Path("scenario.yaml"))
    assert (again, added) == (scenario, ())


def test_a_null_cell_or_family_is_not_that_of_the_scenario_which_is_extended(tmp_path):
    families = f"{FAMILY}, calm: {{policy: {{model: urgency, floor: 1.0}}, range: [0.5, 8.0]}}"
    (tmp_path / "base.yaml").write_text(text_of(families, f"{CELL}, there: {{values: {{}}}}"))
    own = "extends: base.yaml\ntask_study: {families: {calm: null}, cells: {here: null}}\n"
    (tmp_path / "own.yaml").write_text(own)
    study = load_scenario(tmp_path / "own.yaml").task_study
    assert (list(study.families), list(study.cells)) == (["urgency"], ["there"])


def test_a_learner_that_runs_in_the_cells_is_trained(load_text):
    assert "ddpg" in trained_learners(load_text(text_of(more=", policies: [ddpg]")))


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (
            text_of("urgency: {policy: {model: urgency}}"),
            "families.urgency.range = None: must be [least, greatest] of urllc_factor",
        ),
        (
            text_of("urgency: {policy: {model: urgency}, range: [8.0, 0.5]}"),
            "range = [8.0, 0.5]: must be [least, greatest] of urllc_factor, the least first",
        ),
        (
            text_of("urgency: {policy: {model: urgency, urllc_factor: 3.0}, range: [0.5, 8.0]}"),
            "policy.urllc_factor = 3.0: must be left out: the study chooses it",
        ),
        (
            text_of("discard: {policy: {model: try_once_discard}, range: [1.0, 2.0]}"),
            "must be null: try_once_discard has no knob",
        ),
        (
            text_of("edf: {policy: {model: edf}, range: [0.5, 8.0]}"),
            "task_study.families.edf: the name of a policy: must be another one",
        ),
        (text_of("urgency: {policy: {model: urgent}, range: [1.0, 2.0]}"), "policy.model"),
        (text_of("urgency: {rule: pf, range: [1.0, 2.0]}"), "allowed: policy, range"),
        (text_of(families=""), "task_study.families = {}: must name one or more"),
        (
            text_of(cells="here: {values: {learning.seeds: [1]}}"),
            "cells.here.values.learning.seeds: must be a key of users, radio",
        ),
        (
            text_of(cells="here: {values: {}, families: [edf]}"),
            "cells.here.families = ['edf']: edf is no family; allowed: urgency",
        ),
        (
            text_of(cells="here: {values: {}, expected_rms: [2.0, 1.0]}"),
            "cells.here.expected_rms = [2.0, 1.0]: the least first",
        ),
        (text_of(cells="here: {values: {}, knobs: 3}"), "allowed: values, families, bound_late"),
        (text_of(more=", seeds: [1, 1]"), "task_study.seeds = [1, 1]: every seed once"),
        (text_of(more=", policies: [best]"), "best is no policy"),
        (text_of(more=", warmup_s: 0.005"), "task_study.warmup_s = 0.005: must be a multiple"),
        (
            text_of(cells="load: {values: {}}")
            + "\nsweeps: {axes: {task_load: {vary: {traffic.load: [1.0]}}}}",
            "task_study.cells.load: must be another name: sweeps.axes has task_load",
        ),
    ],
)
def test_faults(load_text, text, fault):
    with pytest.raises(ScenarioError) as caught:
        load_text(text)
    assert fault in str(caught.value)


def test_a_cell_that_cannot_be_is_named(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text(text_of(cells="here: {values: {traffic.loud: 1.0}}"))
    with pytest.raises(
        ScenarioError, match=r"own\.yaml: task_study\.cells\.here\.values"
    ) as caught:
        load_study(path)
    assert "unknown key" in str(caught.value)
