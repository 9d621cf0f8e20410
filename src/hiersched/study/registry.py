"""What a study shows: tables, figures and claims, each a registered function of its measures.

A plug-in adds one by the same decorators. Every one has a rule of its own in the workflow, which
runs again when its measures, its scenario or its code change.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hiersched.core.registry import Registry
from hiersched.experiments.points import BASELINE, axis_policies, experiments, trained_learners
from hiersched.scenario import Scenario

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from hiersched.study.claims.verdicts import Judged
    from hiersched.study.study import Study

Condition = Callable[[Scenario], bool]
"""Whether a scenario has what a table, figure or claim shows."""


@dataclass(frozen=True, kw_only=True)
class Shown:
    """A registered table, figure or claim."""

    name: str
    """Of its files."""
    build: Callable[[Study], Any]
    """From a `Study` to a DataFrame, a matplotlib figure, or what was judged."""
    title: str = ""
    note: str = ""
    """Heading and text of a table; of a figure its caption in reports; of a claim the paper's words
    and how they are measured."""
    reads: tuple[str, ...] = ()
    """Tables of measures that it reads (`Study.sources` lists them)."""
    when: Condition
    """Whether a scenario has what it shows."""
    columns: tuple[str, ...] | None = None
    """Columns of a table's Markdown, all unless given; none: no Markdown."""
    reference: str = ""
    unswept: str = ""
    """Of a claim: its place in the paper, and which sensitivity has not been run."""

    @property
    def file(self) -> Path:
        """File of the function."""
        return Path(inspect.getfile(self.build))

    @property
    def module(self) -> str:
        """Module of the function."""
        return self.build.__module__

    def read_columns(self, content: pd.DataFrame) -> pd.DataFrame:
        """Return the columns of a table that are to be read, as far as it has them."""
        columns = content.columns if self.columns is None else self.columns
        return content[[name for name in columns if name in content]]


TABLES: Registry[Shown] = Registry("table", part="study")
FIGURES: Registry[Shown] = Registry("figure", part="study")
CLAIMS: Registry[Shown] = Registry("claim", part="study")


def always(_scenario: Scenario) -> bool:
    """Say that every scenario has it."""
    return True


def table(
    name: str,
    *,
    title: str,
    note: str = "",
    reads: tuple[str, ...],
    when: Condition = always,
    columns: tuple[str, ...] | None = None,
) -> Callable[[Callable[[Study], pd.DataFrame]], Callable[[Study], pd.DataFrame]]:
    """Register a table: a function of a `Study` that returns a DataFrame; see `Shown`."""
    return _adds(TABLES, name, title=title, note=note, reads=reads, when=when, columns=columns)


def figure(
    name: str, *, title: str, note: str = "", reads: tuple[str, ...], when: Condition = always
) -> Callable[[Callable[[Study], Figure]], Callable[[Study], Figure]]:
    """Register a figure: a function of a `Study` that returns one of matplotlib; see `Shown`."""
    return _adds(FIGURES, name, title=title, note=note, reads=reads, when=when)


def claim(
    number: int,
    *,
    reference: str,
    paper: str,
    measured: str,
    reads: tuple[str, ...],
    when: Condition = always,
    unswept: str = "",
) -> Callable[[Callable[[Study], Judged]], Callable[[Study], Judged]]:
    """Register a claim: a function of a `Study` that says what came out; see `Shown`."""
    texts = {"title": paper, "note": measured, "reference": reference, "unswept": unswept}
    return _adds(CLAIMS, f"claim{number}", reads=reads, when=when, **texts)


def _adds(registry: Registry[Shown], name: str, **given: Any) -> Callable[[Any], Any]:
    def decorate(build: Any) -> Any:
        registry.add(name, Shown(name=name, build=build, **given), source=build)
        return build

    return decorate


def varies(
    key: str, among: Callable[[Scenario, Iterable[str]], list[str]] | None = None
) -> Condition:
    """Return the condition that an axis of the sweeps varies a key, and nothing else.

    If `among` is given, it has to pick one at least of the policies along the axis.
    """

    def condition(scenario: Scenario) -> bool:
        axis = axis_of(scenario, key)
        if axis is None:
            return False
        return among is None or bool(among(scenario, axis_policies(scenario, axis)))

    return condition


def axis_of(scenario: Scenario, *keys: str) -> str | None:
    """Return the name of the axis that varies some keys and no others.

    None if there is none, or none along which a policy runs.
    """
    axes, run = scenario.sweeps.axes, experiments(scenario)
    found = (name for name, axis in axes.items() if name in run and set(axis.vary) == set(keys))
    return next(found, None)


def has_sweeps(scenario: Scenario) -> bool:
    """Whether a policy runs along an axis."""
    return any(experiment.stage == "sweep" for experiment in experiments(scenario).values())


def has_gain_study(scenario: Scenario) -> bool:
    """Whether a scenario has a gain study."""
    return bool(scenario.gain_study.methods)


def has_cells(scenario: Scenario) -> bool:
    """Whether policies run in cells of other sizes."""
    return bool(scenario.generalise.cells)


def has_task_study(scenario: Scenario) -> bool:
    """Whether families of rules run in cells of the study of the task."""
    return bool(scenario.task_study.cells)


def has_pareto(scenario: Scenario) -> bool:
    """Whether they run over a grid of knobs in one of the cells."""
    return any(cell.pareto for cell in scenario.task_study.cells.values())


def has_task_learners(scenario: Scenario) -> bool:
    """Whether trained policies run in these cells."""
    study = scenario.task_study
    return bool(study.cells) and any(policy in scenario.learned for policy in study.policies)


def has_learners(scenario: Scenario) -> bool:
    """Whether a scenario trains policies."""
    return bool(trained_learners(scenario))


def has_bound(scenario: Scenario) -> bool:
    """Whether exact optima are computed."""
    return scenario.bound.slots_per_log > 0


def own_and_baseline(scenario: Scenario, policies: Iterable[str]) -> list[str]:
    """List the scenario's own learner and PF, as far as they are among some policies."""
    among = set(policies)
    return [name for name in (scenario.learning.algorithm, BASELINE) if name in among]


def learners_among(scenario: Scenario, policies: Iterable[str]) -> list[str]:
    """List the learners among some policies."""
    return [name for name in policies if name in scenario.learned]


def compares_rates(scenario: Scenario) -> bool:
    """Whether the own learner or PF is evaluated, whose rates the paper compares."""
    return bool(own_and_baseline(scenario, scenario.evaluate.policies))
