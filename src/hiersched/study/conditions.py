"""Under which conditions a claim is judged: as configured, and in every sensitivity run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import pandas as pd

from hiersched.runs.variants import SWEPT_KEYS
from hiersched.scenario import Scenario
from hiersched.study.verdicts import Condition, Statement

Measure: TypeAlias = Callable[[pd.DataFrame, str], tuple[Statement, ...]]


class Frames(NamedTuple):
    """What the claims are computed from: frames of `collect`, training by learned policy."""

    training: Mapping[str, pd.DataFrame]
    runs: pd.DataFrame
    sweeps: pd.DataFrame
    gains: pd.DataFrame


def learned_policies(scenario: Scenario) -> list[str]:
    """Return the evaluated policies that are learned, the scenario's own algorithm first."""
    return [name for name in scenario.learned if name in scenario.evaluate.policies]


def trained(
    frames: Frames, measure: Callable[[pd.DataFrame], tuple[Statement, ...]], block: int
) -> tuple[Condition, tuple[Condition, ...]]:
    """Judge the training of every learned policy; the scenario's own is the base.

    Parameters
    ----------
    frames
        Training by policy is used.
    measure
        From the training of a policy to its statements.
    block
        Episodes that ran side by side, a round; a training of one round says nothing.
    """
    conditions = [
        Condition(
            axis="policy",
            value=policy,
            policy=policy,
            statements=measure(training) if training["episode"].max() > block else (),
        )
        for policy, training in frames.training.items()
    ]
    return _first(conditions), tuple(conditions[1:])


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

    own = learned[0] if learned else scenario.learning.algorithm
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
    own = learned[0] if learned else scenario.learning.algorithm
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


def _first(conditions: Sequence[Condition]) -> Condition:
    """Return the first condition as the base."""
    return replace(conditions[0], axis="", value="")
