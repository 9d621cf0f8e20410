"""What a study measured, for whatever shows it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from hiersched.control import GainSchedule
from hiersched.experiments import files
from hiersched.experiments.gains import design_of, designs
from hiersched.experiments.points import Point, experiments
from hiersched.experiments.tune import read_tuning
from hiersched.scenario import Scenario
from hiersched.simulator.gain_source import read_gains
from hiersched.study.measure import RUN_TABLES, TASK_TABLES, measured_groups, table_file


class Study:
    """A scenario and what was measured of it in `results`, ``results/<scenario>``."""

    def __init__(self, scenario: Scenario, results: Path) -> None:
        self.scenario = scenario
        self.results = results

    @staticmethod
    def sources(scenario: Scenario, reads: tuple[str, ...]) -> list[str]:
        """List the files of tables of measures, relative to the folder of the study.

        They are the tables of `measure` (runs, windows, slots, rates, delays, chains, task, traces,
        episodes), ``growth`` (of loops over their delays), ``bound`` (exact optima), ``stability``
        (regions of the gain study), ``schedules`` (its gains) and ``tunings`` (knobs of the study
        of the task); ValueError for any other.
        """
        own = {
            "growth": [files.GROWTH],
            "bound": [files.BOUND],
            "stability": [files.STABILITY],
            "tunings": [files.tuning_file(cell) for cell in scenario.task_study.cells],
            "schedules": [files.gain_file(design) for design in designs(scenario)],
        }
        known = (*RUN_TABLES, *TASK_TABLES, "episodes", *own)
        names = []
        for table in reads:
            if table not in known:
                raise ValueError(f"reads = {table!r}: must be one of {', '.join(known)}")
            names += own.get(table) or [
                table_file(table, group)
                for group, tables in measured_groups(scenario).items()
                if table in tables
            ]
        return names

    @cache  # noqa: B019  # a study lives as long as its process
    def measures(self, table: str) -> pd.DataFrame:
        """Read a table of `measure`: the rows of all groups."""
        frames = [
            pd.read_parquet(self.results / name).assign(group=Path(name).stem)
            for name in self.sources(self.scenario, (table,))
        ]
        filled = [frame for frame in frames if len(frame)]
        return pd.concat(filled, ignore_index=True) if filled else pd.DataFrame({"group": []})

    @cached_property
    def runs(self) -> pd.DataFrame:
        """Every run of a policy, one a row, in the scenario's order.

        Columns of `measure`'s table ``runs``: `value` is a number where it reads as one.
        """
        runs = self.measures("runs").groupby(["experiment", "policy"], sort=False)
        by_policy = {(str(name), str(policy)): own for (name, policy), own in runs}
        ordered = [
            by_policy[name, policy]
            for name, experiment in experiments(self.scenario).items()
            for policy in experiment.policies
            if (name, policy) in by_policy
        ]
        table = pd.concat(ordered, ignore_index=True)
        return table.assign(value=[_number(value) for value in table["value"]])

    @property
    def evaluation(self) -> pd.DataFrame:
        """Runs of the evaluation."""
        return self._stage("evaluate")

    @property
    def sweeps(self) -> pd.DataFrame:
        """Runs of all sweeps."""
        return self._stage("sweep")

    @property
    def cells(self) -> pd.DataFrame:
        """Runs in cells of other sizes: axis ``cell``."""
        return self._stage("generalise")

    def _stage(self, stage: str) -> pd.DataFrame:
        return self.runs[self.runs["stage"] == stage].reset_index(drop=True)

    @cached_property
    def training(self) -> dict[str, pd.DataFrame]:
        """Learner -> its training, an episode a row."""
        return self._episodes("training")

    @cached_property
    def checkpoints(self) -> dict[str, pd.DataFrame]:
        """Learner -> its policies without noise, a training seed and checkpoint a row."""
        return self._episodes("checkpoint")

    def _episodes(self, kind: str) -> dict[str, pd.DataFrame]:
        table = self.measures("episodes")
        own = table[table["kind"] == kind].groupby("group")
        found = {str(name): rows.reset_index(drop=True) for name, rows in own}
        return {name: found[name] for name in self.scenario.learned if name in found}

    def robots(self, experiment: str) -> pd.DataFrame:
        """Windows of an experiment of the gain study: table ``windows`` of `measure`."""
        table = self.measures("windows")
        return table[table["experiment"] == experiment]

    def point(self, experiment: str, value: str) -> Point:
        """Return a point of an experiment by its name."""
        points = experiments(self.scenario)[experiment].points
        return next(point for point in points if point.value == value)

    def scenario_of(self, runs: pd.DataFrame) -> Scenario:
        """Return the scenario of some rows of `runs`, all at the same point."""
        (axis,), (value,) = runs["axis"].unique(), runs["value"].unique()
        own = (e for e in experiments(self.scenario).values() if e.axis == axis and not e.forced)
        points = (point for experiment in own for point in experiment.points)
        found = (point.scenario for point in points if _number(point.value) == value)
        return next(found, self.scenario)  # the evaluation's, where nothing is varied

    @cached_property
    def _growth(self) -> dict[tuple[str, float | str, str, str], Mapping[Any, Any]]:
        """Rows of the table ``growth`` by experiment, value, policy or gain, and span."""
        return {
            (row["experiment"], _number(row["value"]), row["policy"], row["span"]): row
            for row in self.measures("growth").to_dict("records")
        }

    def loop_columns(
        self,
        experiment: str,
        value: float | str,
        policy: str,
        *,
        span: str = "",
        name: str = "loop",
    ) -> dict[str, Any]:
        """Return what a table says of the loops behind its errors: growth, and the word for it.

        At a point of an experiment, under a policy or a gain; of the gain study in a span of its
        windows, ``violated`` or ``calm``. A name of the columns tells several loops apart.
        """
        key = _number(value) if isinstance(value, str) else value
        row = self._growth[experiment, key, policy, span]
        return {f"{name}_growth": row["loop_growth"], name: row["loop"]}

    def loop_of(self, runs: pd.DataFrame, name: str = "loop") -> dict[str, Any]:
        """Return `loop_columns` of some rows of `runs`, all of one policy at the same point."""
        first = runs.iloc[0]
        return self.loop_columns(first["experiment"], first["value"], first["policy"], name=name)

    def schedule(self, variant: Scenario) -> GainSchedule:
        """Read the gain schedule of a variant of the scenario."""
        path = self.results / files.gain_file(design_of(self.scenario, variant))
        return read_gains(path, variant)

    @cached_property
    def task(self) -> pd.DataFrame:
        """Runs of the study of the task: table ``task`` of `measure`."""
        return self.measures("task")

    @cached_property
    def tunings(self) -> dict[str, dict[str, Any]]:
        """Cell of the study of the task -> the choice of its knobs: see `experiments.tune`."""
        cells = self.scenario.task_study.cells
        return {cell: read_tuning(self.results / files.tuning_file(cell)) for cell in cells}

    @property
    def bound(self) -> pd.DataFrame:
        """Decisions in sampled slots and their exact optima: see `experiments.bound`."""
        return pd.read_csv(self.results / files.BOUND)

    @property
    def stability(self) -> list[dict[str, Any]]:
        """Rows of the stability regions: see `experiments.stability`."""
        text = (self.results / files.STABILITY).read_text(encoding="utf-8")
        rows: list[dict[str, Any]] = json.loads(text)
        return rows


def _number(value: str) -> float | str:
    try:
        return value if "_" in value else float(value)  # Python takes 0_8 for a number
    except ValueError:
        return value
