"""Under which conditions a claim is judged: as configured, and in every sensitivity run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import pandas as pd

from hiersched.runs.variants import SWEPT_KEYS, crossed_value
from hiersched.scenario import Scenario
from hiersched.study.verdicts import Condition, Statement

Measure: TypeAlias = Callable[[pd.DataFrame, str], tuple[Statement, ...]]
Noisy: TypeAlias = Callable[[pd.DataFrame, int], tuple[Statement, ...]]


class Frames(NamedTuple):
    """What the claims are computed from: frames of `collect`, those of training by learner."""

    training: Mapping[str, pd.DataFrame]
    checkpoints: Mapping[str, pd.DataFrame]
    runs: pd.DataFrame
    sweeps: pd.DataFrame
    gains: pd.DataFrame


def learners(scenario: Scenario) -> list[str]:
    """Return the learners that learn, the scenario's own first."""
    return [name for name, learning in scenario.learned.items() if not learning.frozen]


def controls(scenario: Scenario) -> list[str]:
    """Return the learners that learn nothing."""
    return [name for name, learning in scenario.learned.items() if learning.frozen]


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
    frames: Frames,
    scenario: Scenario,
    measure: Callable[[pd.DataFrame, pd.DataFrame | None], tuple[Statement, ...]],
    noisy: Noisy,
) -> tuple[Condition, tuple[Condition, ...]]:
    """Judge every learner by its noise-free checkpoints; the scenario's own is the base.

    Beside them stand, and do not count: the controls that learn nothing, without noise too, and
    what training shows of learners and controls, exploration noise included.

    Parameters
    ----------
    frames
        Checkpoints and training by learner are used.
    scenario
        Its learners.
    measure
        From the checkpoints of a learner, and of its control if there is one, to its statements.
    noisy
        From a training and the episodes that ran side by side in it to statements.
    """
    idle = controls(scenario)
    conditions = []
    for name in learners(scenario):
        control = control_of(scenario, name)
        beside = frames.checkpoints[control] if control is not None else None
        statements = measure(frames.checkpoints[name], beside)
        conditions.append(Condition(axis="policy", value=name, policy=name, statements=statements))
    for name in idle:
        statements = measure(frames.checkpoints[name], None)
        conditions.append(_shown("learns nothing", name, statements))
    for name in (*learners(scenario), *idle):
        block = scenario.learned[name].num_envs
        training = frames.training[name]
        if training["episode"].max() > block:  # a training of one round says nothing
            what = "learns nothing, with noise" if name in idle else "with noise"
            conditions.append(_shown(what, name, noisy(training, block)))
    return _first(conditions), tuple(conditions[1:])


def _shown(axis: str, policy: str, statements: tuple[Statement, ...]) -> Condition:
    """Return a condition that is shown for comparison and does not count."""
    return Condition(axis=axis, value=policy, policy=policy, statements=statements, counts=False)


def evaluated(
    frames: Frames, scenario: Scenario, measure: Measure, *, needs: str = "", beside: bool = False
) -> tuple[Condition, tuple[Condition, ...]]:
    """Judge the evaluation, then other learned policies and every point of every sweep.

    Parameters
    ----------
    frames, scenario
        What was run.
    measure
        From the runs of one condition, and a policy, to statements.
    needs
        A policy that the measure needs besides.
    beside
        Whether to show the classical schedulers of the evaluation too.
    """
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
    base = condition("", "", own, frames.runs)
    others = [condition("policy", p, p, frames.runs) for p in learned[1:]]
    for axis, key in {**SWEPT_KEYS, "cell": "users and PRBs"}.items():
        along = frames.sweeps[frames.sweeps["axis"] == axis]
        for value, rows in along.groupby("value", sort=False):
            others.append(condition(key, str(value), own, rows))
    if beside:
        classical = [p for p in scenario.evaluate.policies if p not in learned]
        others += [condition("policy", p, p, frames.runs, False) for p in classical]
    return base, tuple(others)


def swept(
    frames: Frames, scenario: Scenario, axis: str, measure: Measure
) -> tuple[Condition, tuple[Condition, ...]]:
    """Judge a sweep under every policy that it has; the learned ones count.

    Parameters
    ----------
    frames, scenario
        What was run.
    axis
        One of `variants.SWEPT_KEYS`; a single value of it says nothing.
    measure
        From the runs along the axis, and a policy, to statements.
    """
    along = frames.sweeps[frames.sweeps["axis"] == axis]
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


def by_coefficient(frames: Frames, scenario: Scenario, measure: Measure) -> tuple[Condition, ...]:
    """Judge the own learner at both ends of the sampling interval, for every coefficient beta.

    Parameters
    ----------
    frames, scenario
        What was run.
    measure
        From the runs at both ends, `value` the sampling interval, and a policy, to statements.
    """
    own = scenario.learning.algorithm
    along = frames.sweeps[frames.sweeps["axis"] == "service_coefficient_mbps"]
    if along.empty or own not in set(along["policy"]):
        return ()
    points = [crossed_value(value) for value in along["value"]]
    coefficients = pd.Series([point[0] for point in points], index=along.index)
    along = along.assign(value=[point[1] for point in points])
    conditions = []
    for coefficient, rows in along.groupby(coefficients, sort=False):
        enough = rows["value"].nunique() > 1
        conditions.append(
            Condition(
                axis="traffic.service_coefficient_mbps",
                value=str(coefficient),
                policy=own,
                statements=measure(rows, own) if enough else (),
            )
        )
    return tuple(conditions)


def _first(conditions: Sequence[Condition]) -> Condition:
    """Return the first condition as the base."""
    return replace(conditions[0], axis="", value="")
