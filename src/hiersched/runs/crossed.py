"""Trained policies crossed with worlds: what stays of the runs that have no log.

Every policy of a learner runs in every world, and world i with policy i, modulo their number, is
logged: logs of all pairs would be ten times as large. Of the others the measures are taken as they
run; a log of any of them comes from the log of a rule in that world, with ``hiersched replay LOG
--policy FILE``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd

from hiersched.core.files import csv_text, write_bytes
from hiersched.runs.logged import RunSlots
from hiersched.runs.logging import RunLabel
from hiersched.runs.policies import WorldRun
from hiersched.scenario import Scenario

Measure = Callable[[RunSlots, Scenario], dict[str, Any]]
"""From the slots of a run to a row of its measures."""


class CrossedRows:
    """Measures of the runs of one policy under one condition that are not logged.

    Parameters
    ----------
    measure
        Takes them. None: such runs are not made.
    scenario
        Of the runs.
    """

    def __init__(self, measure: Measure | None, scenario: Scenario) -> None:
        self._measure = measure
        self._scenario = scenario
        self._rows: list[dict[str, Any]] = []

    @property
    def wanted(self) -> bool:
        """Whether such runs are to be made."""
        return self._measure is not None

    def add(self, label: RunLabel, run: WorldRun) -> None:
        """Measure a run."""
        if self._measure is None:
            raise ValueError("a run without log, and nothing to measure it")
        self._rows.append(self._measure(slots_of(self._scenario, label, run), self._scenario))

    def write(self, path: Path) -> None:
        """Write one row a run, where there are any."""
        if self._rows:
            write_bytes(path, csv_text(pd.DataFrame(self._rows)).encode())


def slots_of(scenario: Scenario, label: RunLabel, run: WorldRun) -> RunSlots:
    """Return the slots of a run as `logged.read_slots` would read them from its log."""
    metadata = {
        "policy": label.policy,
        "seed": str(label.seed),
        "stage": label.stage,
        "axis": label.axis,
        "value": label.value,
        **run.metadata,
    }
    seed = metadata.get("policy_seed", "none")
    return RunSlots(
        source=f"{label.stage} {label.axis} {label.value} {label.policy}, policy {seed}, "
        f"world {label.seed}",
        metadata=metadata,
        num_urllc=scenario.users.num_urllc,
        slot_s=round(scenario.radio.slot_s * 1e9) * 1e-9,
        warmup_slots=int(metadata.get("warmup_slots", "0")),
        fields=dict(run.fields),
    )
