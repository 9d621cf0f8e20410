"""Writes the verdicts on the paper's claims: JSON to compute with, Markdown to read."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hiersched.core.files import write_bytes
from hiersched.scenario import Scenario
from hiersched.study.claims import judge
from hiersched.study.collect import (
    checkpoint_frames,
    gain_frame,
    runs_frame,
    training_frames,
)
from hiersched.study.sensitivities import Frames
from hiersched.study.statistics import LEVEL
from hiersched.study.tables import interval_text
from hiersched.study.verdicts import RULE, Claim, Condition, Statement

BEGIN, END = "<!-- claims: begin -->", "<!-- claims: end -->"
"""Marks in a text between which `insert_table` writes."""

NAMES = ("claims.json", "claims.md")


def write_claims(results_dir: str | os.PathLike[str], scenario: Scenario) -> list[Path]:
    """Judge the claims by the measures of all runs and the logs of training and gain study.

    Parameters
    ----------
    results_dir
        ``results/<scenario>`` with its logs and tables.
    scenario
        The scenario that was run.

    Returns
    -------
    list of Path
        ``claims.json`` and ``claims.md``.

    Raises
    ------
    FileNotFoundError
        If a log or measures are missing.
    ValueError
        If the scenario runs too few policies, values or rounds for a claim.
    """
    results = Path(results_dir)
    runs = runs_frame(results, scenario)
    evaluated = runs["stage"] == "evaluate"
    frames = Frames(
        training=training_frames(results, scenario),
        checkpoints=checkpoint_frames(results, scenario),
        runs=runs[evaluated],
        sweeps=runs[~evaluated],
        gains=gain_frame(results, scenario),
    )
    claims = judge(frames, scenario)
    texts = (claims_json(claims, scenario), claims_markdown(claims, scenario))
    return [
        write_bytes(results / name, text.encode()) for name, text in zip(NAMES, texts, strict=True)
    ]


def claims_json(claims: Sequence[Claim], scenario: Scenario) -> str:
    """Return the claims as JSON; bounds that are not finite are null."""
    document = {
        "scenario": scenario.name,
        "level": LEVEL,
        "rule": RULE,
        "claims": [
            {
                "number": claim.number,
                "reference": claim.reference,
                "claim": claim.paper,
                "measured": claim.measured,
                "verdict": claim.verdict,
                "halvings_that_agree": _finite(claim.base.agreement),
                "base": _condition(claim.base),
                "sensitivity": [_condition(c) for c in claim.others if c.counts],
                "flipped_by": [_label(c) for c in claim.flipped_by],
                "beside": [_condition(c) for c in claim.others if not c.counts],
                "not_swept": claim.unswept,
            }
            for claim in claims
        ],
    }
    return json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def claims_markdown(claims: Sequence[Claim], scenario: Scenario) -> str:
    """Return the claims as Markdown: the table of verdicts, then every sensitivity run."""
    lines = [
        f"# The paper's claims in scenario `{scenario.name}`",
        "",
        f"{RULE} Brackets hold {100.0 * LEVEL:g} % intervals over seeds, of learned policies "
        "over training seeds and worlds, each policy in every world, paired where worlds are "
        "shared: Student t, of ratios on their logarithms. *d* is the standardised effect: mean "
        "over standard deviation of the paired differences, or of the logarithms of the ratios.",
        "",
        *verdict_table(claims),
        "",
        "## Sensitivity",
        "",
        "| | Condition | Policy | Outcome | Numbers |",
        "|---:|---|---|---|---|",
    ]
    for claim in claims:
        for condition in (claim.base, *claim.others):
            outcome = condition.outcome if condition.counts else f"({condition.outcome})"
            lines.append(
                f"| {claim.number} | {_label(condition)} | {condition.policy} | {outcome} "
                f"| {_numbers(condition)} |"
            )
    return "\n".join(lines) + "\n"


def verdict_table(claims: Sequence[Claim]) -> list[str]:
    """Return the lines of the table of verdicts."""
    lines = [
        "| | Claim | How it is measured | Numbers | Verdict | Halvings that agree | Flipped by |",
        "|---:|---|---|---|---|---:|---|",
    ]
    for claim in claims:
        flips = "; ".join(_label(c) for c in claim.flipped_by) or "nothing that was run"
        note = f". {claim.unswept}" if claim.unswept else ""
        lines.append(
            f"| {claim.number} | {claim.paper} ({claim.reference}) | {claim.measured} "
            f"| {_numbers(claim.base)} | **{claim.verdict}** | {_agreeing(claim.base.agreement)} "
            f"| {flips}{note} |"
        )
    return lines


def insert_table(text: str, claims_json: str) -> str:
    """Return a text with the table of verdicts between its two marks, from ``claims.json``.

    Parameters
    ----------
    text
        Has the lines `BEGIN` and `END`.
    claims_json
        Content of the file.

    Raises
    ------
    ValueError
        If the marks are missing.
    """
    if text.count(BEGIN) != 1 or text.count(END) != 1:
        raise ValueError(f"the text must have the lines {BEGIN} and {END} once each")
    lines = [
        "| | Claim | As configured | Verdict | Halvings that agree | Flipped by |",
        "|---:|---|---|---|---:|---|",
    ]
    for claim in json.loads(claims_json)["claims"]:
        numbers = "; ".join(map(_plain, claim["base"]["statements"]))
        flips = "; ".join(claim["flipped_by"]) or "nothing that was run"
        lines.append(
            f"| {claim['number']} | {claim['claim']} ({claim['reference']}) | {numbers} "
            f"| **{claim['verdict']}** | {_agreeing(claim['halvings_that_agree'])} | {flips} |"
        )
    before, rest = text.split(BEGIN)
    return "\n".join([before + BEGIN, *lines, END + rest.split(END)[1]])


def _agreeing(share: float | None) -> str:
    return "–" if share is None or math.isnan(share) else f"{100.0 * share:.0f} %"


def _plain(statement: dict[str, Any]) -> str:
    """Return name, estimate and interval of a statement of ``claims.json``."""
    bounds = (statement[key] for key in ("estimate", "lo", "hi"))
    numbers = (math.inf if bound is None else float(bound) for bound in bounds)
    unit = "" if statement["unit"] == "1" else f" {statement['unit']}"
    return f"{statement['name']}: {interval_text(*numbers)}{unit}"


def _condition(condition: Condition) -> dict[str, Any]:
    return {
        "axis": condition.axis,
        "value": condition.value,
        "policy": condition.policy,
        "outcome": condition.outcome,
        "statements": [_statement(statement) for statement in condition.statements],
    }


def _statement(statement: Statement) -> dict[str, Any]:
    mean, lo, hi = map(_finite, statement.interval)
    return {
        "name": statement.name,
        "unit": statement.unit,
        "estimate": mean,
        "lo": lo,
        "hi": hi,
        "claimed_above": _finite(statement.above),
        "claimed_below": _finite(statement.below),
        "effect_size": _finite(statement.effect),
        "seeds": statement.count,
        "outcome": statement.outcome,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _label(condition: Condition) -> str:
    return f"{condition.axis} = {condition.value}" if condition.axis else "as configured"


def _numbers(condition: Condition) -> str:
    return "; ".join(map(_number, condition.statements))


def _number(statement: Statement) -> str:
    unit = "" if statement.unit == "1" else f" {statement.unit}"
    effect = f", *d* = {statement.effect:.2g}" if math.isfinite(statement.effect) else ""
    return f"{statement.name}: {interval_text(*statement.interval)}{unit}{effect}"
