"""The paper's central claim, where set-points cross the network."""

from __future__ import annotations

from hiersched.study.claims.effects import difference, ratio
from hiersched.study.claims.verdicts import Condition, Judged, Statement
from hiersched.study.registry import claim, has_task_study
from hiersched.study.samples import paired
from hiersched.study.study import Study
from hiersched.study.task import (
    P99,
    RMS,
    best_blind,
    first_aware,
    keeps_limit,
    line_of,
    load_of,
    runs_of,
)

EQUAL = 0.01
"""By how much the eMBB throughputs of two rules may differ and count as equal."""


@claim(
    0,
    reference="title",
    paper="allocation that knows the task improves the task at equal video throughput",
    measured="Tracking errors of the first rule that knows the task over those of the best rule "
    "that does not, in the same held-out worlds: ratios of the root mean square and of the 99 % "
    "quantile below 1, of the eMBB throughput above "
    f"{1.0 - EQUAL:g}. The knobs of both, and the best rule, are chosen in design worlds. The base "
    "is the cell with the scenario's own values and no limit on lateness, or the first. Where a "
    "cell bounds the lateness of eMBB packets, a rule that knows the task may make no more late "
    "than that bound over the other. A family that keeps no limit says nothing.",
    reads=("task", "tunings"),
    when=has_task_study,
)
def task_improves(study: Study) -> Judged:
    """Judge every cell; that with the scenario's own values is the base."""
    cells = list(study.scenario.task_study.cells)
    own_load = study.scenario.traffic.load
    base = next(
        (
            cell
            for cell in cells
            if not line_of(study.scenario, cell)
            and load_of(study.scenario, cell) == own_load
            and not study.scenario.task_study.cells[cell].bound_late
        ),
        cells[0],
    )
    others = tuple(_condition(study, cell, axis="cell") for cell in cells if cell != base)
    return Judged(_condition(study, base, axis=""), others)


def _condition(study: Study, cell: str, axis: str) -> Condition:
    aware, blind = first_aware(study.scenario, cell), best_blind(study, cell)
    statements: tuple[Statement, ...] = ()
    if aware is not None and blind is not None and keeps_limit(study, cell, aware):
        runs = runs_of(study, cell, aware), runs_of(study, cell, blind)
        asked = (
            (RMS, "RMS error", {"below": 1.0}),
            (P99, "99 % quantile of error", {"below": 1.0}),
            ("embb_mbps", "eMBB throughput", {"above": 1.0 - EQUAL}),
        )
        statements = tuple(
            ratio(*paired(*runs, name)).statement(f"{text}, {aware} / {blind}", "1", **claimed)
            for name, text, claimed in asked
        )
        if study.scenario.task_study.cells[cell].bound_late:
            excess = difference(*paired(*runs, "embb_late_share"))
            most = study.scenario.task_study.embb_late_excess
            text = f"share of late eMBB packets, {aware} - {blind}"
            statements += (excess.statement(text, "1", below=most),)
    return Condition(axis, cell, aware or "none", statements)
