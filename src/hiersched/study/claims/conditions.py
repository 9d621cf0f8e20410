"""Under which conditions a claim is judged: as configured, and in every sensitivity run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import pandas as pd

from hiersched.experiments.points import experiments, trained_learners
from hiersched.scenario import Scenario
from hiersched.study.claims.verdicts import Condition, Statement
from hiersched.study.registry import axis_of
from hiersched.study.study import Study

COEFFICIENT, SAMPLING = "traffic.service_coefficient_mbps", "control.sampling_s"
Measure: TypeAlias = Callable[[pd.DataFrame, str], tuple[Statement, ...]]
Noisy: TypeAlias = Callable[[pd.DataFrame, int], tuple[Statement, ...]]


def learners(scenario: Scenario) -> list[str]:
    """Return the learners that learn, the scenario's own first."""
    return [name for name in trained_learners(scenario) if not scenario.learned[name].frozen]


def controls(scenario: Scenario) -> list[str]:
    """Return the learners that learn nothing."""
    return [name for name in trained_learners(scenario) if scenario.learned[name].frozen]


def first_trained(scenario: Scenario) -> str:
    """Return the first learner that is trained, one that learns before those that do not."""
    return [*learners(scenario), *controls(scenario)][0]


def learned_policies(scenario: Scenario) -> list[str]:
    """Return the evaluated policies that are learned, the scenario's own algorithm first."""
    return [name for name in learners(scenario) if name in scenario.evaluate.policies]


def own_policy(scenario: Scenario) -> str:
    """Return the policy under which claims are judged as configured: the first learned one."""
    return next(iter(learned_policies(scenario)), scenario.learning.algorithm)


def control_of(scenario: Scenario, learner: str) -> str | None:
    """Return the learner that learns nothing from the same start and under the same noise."""
    own = scenario.learned[learner]
    if own.frozen:
        return None
    for name in controls(scenario):
        control = scenario.learned[name]
        same = (control.algorithm, control.start) == (own.algorithm, own.start)
        if same and control.seeds == own.seeds:
            return name
    return None


def trained(
    study: Study,
    measure: Callable[[pd.DataFrame, pd.DataFrame | None], tuple[Statement, ...]],
    noisy: Noisy,
) -> tuple[Condition, tuple[Condition, ...]]:
    """Judge every learner by its noise-free checkpoints; the scenario's own is the base.

    Beside them stand, and do not count: the controls that learn nothing, without noise too, and
    what training shows of learners and controls, exploration noise included.

    Parameters
    ----------
    study
        Checkpoints and training of its learners are used.
    measure
        From the checkpoints of a learner, and of its control if there is one, to its statements.
    noisy
        From a training and the episodes that ran side by side in it to statements.
    """
    scenario = study.scenario
    idle = controls(scenario)
    conditions = []
    for name in learners(scenario):
        control = control_of(scenario, name)
        beside = study.checkpoints[control] if control is not None else None
        statements = measure(study.checkpoints[name], beside)
        conditions.append(Condition(axis="policy", value=name, policy=name, statements=statements))
    for name in idle:
        statements = measure(study.checkpoints[name], None)
        conditions.append(_shown("learns nothing", name, statements))
    for name in (*learners(scenario), *idle):
        block = scenario.learned[name].num_envs
        training = study.training[name]
        if training["episode"].max() > block:  # a training of one round says nothing
            what = "learns nothing, with noise" if name in idle else "with noise"
            conditions.append(_shown(what, name, noisy(training, block)))
    return _first(conditions), tuple(conditions[1:])


def _shown(axis: str, policy: str, statements: tuple[Statement, ...]) -> Condition:
    """Return a condition that is shown for comparison and does not count."""
    return Condition(axis=axis, value=policy, policy=policy, statements=statements, counts=False)


def evaluated(
    study: Study, measure: Measure, *, needs: str = "", beside: bool = False
) -> tuple[Condition, tuple[Condition, ...]]:
    """Judge the evaluation, then other learned policies and every point of every sweep.

    Parameters
    ----------
    study
        What was run.
    measure
        From the runs of one condition, and a policy, to statements.
    needs
        A policy that the measure needs besides.
    beside
        Whether to show the classical schedulers of the evaluation too.
    """
    scenario, runs = study.scenario, study.evaluation
    learned = learned_policies(scenario)

    def condition(
        axis: str, value: str, policy: str, rows: pd.DataFrame, counts: bool = True
    ) -> Condition:
        present = {policy, needs or policy} <= set(rows["policy"])
        statements = measure(rows, policy) if present else ()
        return Condition(
            axis=axis, value=value, policy=policy, statements=statements, counts=counts
        )

    own = own_policy(scenario)
    base = condition("", "", own, runs)
    others = [condition("policy", p, p, runs) for p in learned[1:]]
    swept_axes = {name: ", ".join(axis.vary) for name, axis in scenario.sweeps.axes.items()}
    elsewhere = pd.concat([study.sweeps, study.cells], ignore_index=True)
    for axis, key in {**swept_axes, "cell": "users and PRBs"}.items():
        along = elsewhere[elsewhere["axis"] == axis]
        for value, rows in along.groupby("value", sort=False):
            others.append(condition(key, str(value), own, rows))
    if beside:
        classical = [p for p in scenario.evaluate.policies if p not in learned]
        others += [condition("policy", p, p, runs, False) for p in classical]
    return base, tuple(others)


def swept(study: Study, key: str, measure: Measure) -> tuple[Condition, tuple[Condition, ...]]:
    """Judge a sweep under every policy that it has; the learned ones count.

    Parameters
    ----------
    study
        What was run.
    key
        What the axis varies; a single value of it says nothing.
    measure
        From the runs along the axis, and a policy, to statements.
    """
    scenario = study.scenario
    along = study.sweeps[study.sweeps["axis"] == axis_of(scenario, key)]
    learned = learned_policies(scenario)
    own = own_policy(scenario)
    enough = along["value"].nunique() > 1
    present = list(dict.fromkeys(along["policy"]))
    conditions = [
        Condition(
            axis="policy",
            value=policy,
            policy=policy,
            statements=measure(along, policy) if enough and policy in present else (),
            counts=policy in learned,
        )
        for policy in dict.fromkeys((own, *present))
    ]
    return _first(conditions), tuple(conditions[1:])


def by_coefficient(study: Study, measure: Measure) -> tuple[Condition, ...]:
    """Judge the own learner at both ends of the sampling interval, for every coefficient beta.

    Parameters
    ----------
    study
        What was run.
    measure
        From the runs at both ends, `value` the sampling interval, and a policy, to statements.
    """
    scenario = study.scenario
    own = scenario.learning.algorithm
    axis = axis_of(scenario, COEFFICIENT, SAMPLING)
    runs = study.sweeps
    along = runs[(runs["axis"] == axis) & (runs["policy"] == own)]
    if axis is None or along.empty:
        return ()
    values = {p.value: p.values for p in experiments(scenario)[axis].points}
    coefficient, sampling_s = (
        pd.Series([values[str(value)][key] for value in along["value"]], index=along.index)
        for key in (COEFFICIENT, SAMPLING)
    )
    along = along.assign(value=sampling_s)
    return tuple(
        Condition(
            axis=COEFFICIENT,
            value=f"{beta:g}",
            policy=own,
            statements=measure(rows, own) if rows["value"].nunique() > 1 else (),
        )
        for beta, rows in along.groupby(coefficient, sort=False)
    )


def _first(conditions: Sequence[Condition]) -> Condition:
    """Return the first condition as the base."""
    return replace(conditions[0], axis="", value="")
