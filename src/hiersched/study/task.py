"""Who is compared with whom in the study of the task, and where."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pandas as pd

from hiersched.experiments.points import FLOOR, REFERENCE, TASK, TUNED, experiments, task_families
from hiersched.policies.index_rules import CLASSICAL
from hiersched.scenario import Scenario
from hiersched.study.samples import paired, sample_of
from hiersched.study.statistics import Interval, mean_interval
from hiersched.study.study import Study

LOAD = "traffic.load"
RMS, P99 = "tracking_rms_cm", "tracking_p99_cm"

Kind = Literal["reference", "classical", "control-blind", "control-aware", "other", "learned"]
"""Of a policy; control-blind rules that are no classical ones know ages or packets."""


def kind_of(scenario: Scenario, policy: str) -> Kind:
    """Return the kind of a policy of a cell."""
    families = scenario.task_study.families
    if policy == REFERENCE:
        return "reference"
    if policy in scenario.learned:
        return "learned"
    if policy not in families:
        return "other"
    rule = families[policy].policy
    if rule.knows_task:
        return "control-aware"
    return "classical" if rule.model in CLASSICAL else "control-blind"


def best_family(study: Study, cell: str, kinds: Iterable[Kind]) -> str | None:
    """Return the family of some kinds with the least error in the design worlds of a cell.

    Held-out worlds decide nothing. None where no family of these kinds keeps the eMBB limit.
    """
    wanted = set(kinds)
    errors = {
        name: family[RMS]
        for name, family in study.tunings[cell]["families"].items()
        if family["keeps_limit"] and kind_of(study.scenario, name) in wanted
    }
    return min(errors, key=errors.__getitem__) if errors else None


def best_blind(study: Study, cell: str) -> str | None:
    """Return the best family that knows nothing of the task."""
    return best_family(study, cell, ("classical", "control-blind"))


def task_learners_of(scenario: Scenario) -> list[str]:
    """Return the learners that run in the cells."""
    return [policy for policy in scenario.task_study.policies if policy in scenario.learned]


def twin_of(scenario: Scenario, learner: str) -> str | None:
    """Return the learner that runs too and differs in whether it sees the task, in nothing else."""
    own = scenario.learned[learner]
    twin = replace(own, observe_demand=not own.observe_demand)
    same = (name for name in task_learners_of(scenario) if scenario.learned[name] == twin)
    return next(same, None)


def first_aware(scenario: Scenario, cell: str) -> str | None:
    """Return the first of a cell's families that knows the task: the one that claims are about."""
    aware = (f for f in task_families(scenario, cell) if kind_of(scenario, f) == "control-aware")
    return next(aware, None)


def keeps_limit(study: Study, cell: str, family: str | None) -> bool:
    """Whether a family's knob keeps the limits of a cell in its design worlds."""
    return family is not None and bool(study.tunings[cell]["families"][family]["keeps_limit"])


def runs_of(study: Study, cell: str, policy: str, point: str = TUNED) -> pd.DataFrame:
    """Return the runs of a policy at a point of a cell, as `samples` takes them."""
    runs = study.task
    return runs[(runs["cell"] == cell) & (runs["policy"] == policy) & (runs["point"] == point)]


def loop_at(study: Study, cell: str, policy: str, point: str = TUNED) -> dict[str, Any]:
    """Return how the loops grow under a policy at a point of a cell: `Study.loop_columns`."""
    return study.loop_columns(f"{TASK}_{cell}", point, policy)


def load_of(scenario: Scenario, cell: str) -> float:
    """Return the offered load in a cell."""
    return experiments(scenario)[f"{TASK}_{cell}"].points[0].scenario.traffic.load


def line_of(scenario: Scenario, cell: str) -> dict[str, object]:
    """Return what a cell differs in from the scenario, but for the load."""
    return {k: v for k, v in scenario.task_study.cells[cell].values.items() if k != LOAD}


def lines(scenario: Scenario) -> dict[str, list[str]]:
    """Return cells that differ in their loads alone, in the order of these, by a common name.

    That is what the names of the cells begin with.
    """
    cells = scenario.task_study.cells
    found: dict[str, list[str]] = {}
    for cell in cells:
        kind = line_of(scenario, cell), cells[cell].bound_late
        same = (
            name
            for name, own in found.items()
            if (line_of(scenario, own[0]), cells[own[0]].bound_late) == kind
        )
        short = cell.rpartition("_")[0] or cell
        name = next(same, cell if short in found else short)
        found.setdefault(name, []).append(cell)
    return {name: sorted(own, key=lambda c: load_of(scenario, c)) for name, own in found.items()}


def embb_share(study: Study, cell: str, policy: str, point: str = TUNED) -> Interval:
    """Return the eMBB throughput over the reference's in the same worlds: mean of the ratios."""
    pair = paired(runs_of(study, cell, policy, point), runs_of(study, cell, REFERENCE), "embb_mbps")
    return mean_interval(pair[0] / pair[1])


def network_share(study: Study, cell: str, policy: str) -> float:
    """Return the network's part of the mean square error: what is over the floor, mean over worlds.

    The floor is the error in the same worlds where every robot knows its reference; NaN where that
    is so in the cell itself.
    """
    floor = runs_of(study, cell, REFERENCE, FLOOR)
    if not len(floor):
        return math.nan
    own, least = paired(runs_of(study, cell, policy), floor, RMS)
    return float(np.mean(1.0 - (least / own) ** 2))


def mean_of(runs: pd.DataFrame, name: str) -> float:
    """Return the mean of a measure over worlds, and policies of a learner."""
    return float(sample_of(runs, name).mean())
