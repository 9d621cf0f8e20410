"""Under which conditions a claim is judged: as configured, and in every sensitivity run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import pandas as pd

from hiersched.experiments.points import experiments, trained_learners
from hiersched.scenario import Scenario
from hiersched.study.claims.verdicts import Condition, Judged, Statement
from hiersched.study.registry import axis_of
from hiersched.study.study import Study

COEFFICIENT, SAMPLING = "traffic.service_coefficient_mbps", "control.sampling_s"
Statements: TypeAlias = tuple[Statement, ...]
Measure: TypeAlias = Callable[[pd.DataFrame, str], Statements]
"""From the runs of one condition, and a policy, to statements."""


def learners(scenario: Scenario) -> list[str]:
    """Return the learners that learn, the scenario's own first."""
    return [name for name in trained_learners(scenario) if not scenario.learned[name].frozen]


def controls(scenario: Scenario) -> list[str]:
    """Return the learners that learn nothing."""
    return [name for name in trained_learners(scenario) if scenario.learned[name].frozen]


def first_trained(scenario: Scenario) -> str:
    """Return the first learner that is trained, one that learns before those that do not."""
    return [*learners(scenario), *controls(scenario)][0]


def control_of(scenario: Scenario, learner: str) -> str | None:
    """Return the learner that learns nothing from the same start and under the same noise."""

    def origin(name: str) -> tuple[object, ...]:
        learning = scenario.learned[name]
        return learning.algorithm, learning.start, learning.seeds

    alike = [name for name in controls(scenario) if origin(name) == origin(learner)]
    return alike[0] if alike and not scenario.learned[learner].frozen else None


def trained(
    study: Study,
    measure: Callable[[pd.DataFrame, pd.DataFrame | None], Statements],
    noisy: Callable[[pd.DataFrame, int], Statements],
) -> Judged:
    """Judge every learner by its noise-free checkpoints; the scenario's own is the base.

    Beside them stand, and do not count: the controls that learn nothing, without noise too, and
    what training shows of learners and controls, exploration noise included.

    The measure gets the checkpoints of a learner, and of its control if there is one; `noisy` gets
    a training and the number of episodes that ran side by side in it.
    """
    scenario, checkpoints = study.scenario, study.checkpoints
    conditions = []
    for name in learners(scenario):
        control = control_of(scenario, name)
        statements = measure(checkpoints[name], None if control is None else checkpoints[control])
        conditions.append(Condition("policy", name, name, statements))
    for name in controls(scenario):
        statements = measure(checkpoints[name], None)
        conditions.append(Condition("learns nothing", name, name, statements, counts=False))
    for name in (*learners(scenario), *controls(scenario)):
        learning, training = scenario.learned[name], study.training[name]
        if training["episode"].max() > learning.num_envs:  # one round says nothing
            what = "learns nothing, with noise" if learning.frozen else "with noise"
            statements = noisy(training, learning.num_envs)
            conditions.append(Condition(what, name, name, statements, counts=False))
    return _first_is_base(conditions)


def evaluated(study: Study, measure: Measure, *, needs: str = "", beside: bool = False) -> Judged:
    """Judge the evaluation, then other learned policies and every point of every sweep.

    Nothing is stated where a policy that the measure `needs` besides is missing. The classical
    schedulers of the evaluation are shown too if they are wanted `beside`.
    """
    scenario, runs = study.scenario, study.evaluation
    learned, own = _learned_and_own(scenario)

    def condition(
        axis: str, value: str, policy: str, rows: pd.DataFrame, counts: bool = True
    ) -> Condition:
        present = {policy, needs or policy} <= set(rows["policy"])
        return Condition(axis, value, policy, measure(rows, policy) if present else (), counts)

    others = [condition("policy", name, name, runs) for name in learned[1:]]
    keys = {name: ", ".join(axis.vary) for name, axis in scenario.sweeps.axes.items()}
    elsewhere = pd.concat([study.sweeps, study.cells], ignore_index=True)
    for axis, key in {**keys, "cell": "users and PRBs"}.items():
        along = elsewhere[elsewhere["axis"] == axis].groupby("value", sort=False)
        others += [condition(key, str(value), own, rows) for value, rows in along]
    if beside:
        classical = [name for name in scenario.evaluate.policies if name not in learned]
        others += [condition("policy", name, name, runs, False) for name in classical]
    return Judged(condition("", "", own, runs), tuple(others))


def swept(study: Study, key: str, measure: Measure) -> Judged:
    """Judge the sweep of a key under every policy that it has; the learned ones count.

    The measure gets the runs along the axis; a single value says nothing.
    """
    along = study.sweeps[study.sweeps["axis"] == axis_of(study.scenario, key)]
    learned, own = _learned_and_own(study.scenario)
    present = list(dict.fromkeys(along["policy"])) if along["value"].nunique() > 1 else []
    conditions = []
    for policy in dict.fromkeys((own, *along["policy"])):
        statements = measure(along, policy) if policy in present else ()
        conditions.append(Condition("policy", policy, policy, statements, policy in learned))
    return _first_is_base(conditions)


def by_coefficient(study: Study, measure: Measure) -> tuple[Condition, ...]:
    """Judge the own learner at both ends of the sampling interval, for every coefficient beta.

    The measure gets the runs at both ends, `value` is the sampling interval.
    """
    scenario, runs = study.scenario, study.sweeps
    own, axis = scenario.learning.algorithm, axis_of(scenario, COEFFICIENT, SAMPLING)
    along = runs[(runs["axis"] == axis) & (runs["policy"] == own)]
    if axis is None or along.empty:
        return ()
    points = {point.value: point.values for point in experiments(scenario)[axis].points}
    values = [points[str(value)] for value in along["value"]]
    along = along.assign(
        value=[value[SAMPLING] for value in values], beta=[value[COEFFICIENT] for value in values]
    )
    conditions = []
    for beta, rows in along.groupby("beta", sort=False):
        statements = measure(rows, own) if rows["value"].nunique() > 1 else ()
        conditions.append(Condition(COEFFICIENT, f"{beta:g}", own, statements))
    return tuple(conditions)


def _learned_and_own(scenario: Scenario) -> tuple[list[str], str]:
    """Return the evaluated policies that learn, and the one that is judged as configured."""
    learned = [name for name in learners(scenario) if name in scenario.evaluate.policies]
    return learned, next(iter(learned), scenario.learning.algorithm)


def _first_is_base(conditions: list[Condition]) -> Judged:
    """Take the first condition as the scenario as configured."""
    return Judged(replace(conditions[0], axis="", value=""), tuple(conditions[1:]))
