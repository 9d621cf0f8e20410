"""Writes the verdicts on claims: JSON to compute with, Markdown to read."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hiersched.core.files import write_bytes
from hiersched.scenario import Scenario
from hiersched.study.claims.verdicts import RULE, Condition, Judged, Statement
from hiersched.study.registry import Shown
from hiersched.study.statistics import LEVEL
from hiersched.study.tables.html import claims_page
from hiersched.study.tables.text import interval_text

BEGIN, END = "<!-- claims: begin -->", "<!-- claims: end -->"
"""Marks in a text between which `insert_table` writes."""

JsonObject = dict[str, Any]


def claim_json(shown: Shown, judged: Judged) -> JsonObject:
    """Return a claim as it stands in ``claims.json``; bounds that are not finite are null."""
    return {
        "number": int(shown.name.removeprefix("claim")),
        "reference": shown.reference,
        "claim": shown.title,
        "measured": shown.note,
        "verdict": judged.verdict,
        "halvings_that_agree": _finite(judged.base.agreement),
        "base": _condition(judged.base),
        "sensitivity": [_condition(c) for c in judged.others if c.counts],
        "flipped_by": [_label(_condition(c)) for c in judged.flipped_by],
        "beside": [_condition(c) for c in judged.others if not c.counts],
        "not_swept": shown.unswept,
    }


def write_json(path: Path, document: JsonObject) -> None:
    """Write a JSON file that a person can read."""
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False)
    write_bytes(path, (text + "\n").encode())


def join_claims(scenario: Scenario, results: Path, names: Sequence[str]) -> None:
    """Put the claims of a study together: ``claims.json``, ``claims.md`` and ``claims.html``."""
    claims = [
        json.loads((results / f"claims/{name}.json").read_text(encoding="utf-8")) for name in names
    ]
    claims.sort(key=lambda claim: claim["number"])
    document = {"scenario": scenario.name, "level": LEVEL, "rule": RULE, "claims": claims}
    write_json(results / "claims.json", document)
    write_bytes(results / "claims.md", claims_markdown(claims, scenario).encode())
    write_bytes(results / "claims.html", claims_page(claims, RULE, scenario).encode())


def claims_markdown(claims: Sequence[JsonObject], scenario: Scenario) -> str:
    """Return the claims as Markdown: the table of verdicts, then every sensitivity run."""
    lines = [
        f"# The paper's claims in scenario `{scenario.name}`",
        "",
        f"{RULE} Brackets hold {100.0 * LEVEL:g} % intervals over seeds, of learned policies "
        "over training seeds and worlds, each policy in every world, paired where worlds are "
        "shared: Student t, of ratios on their logarithms. *d* is the standardised effect: mean "
        "over standard deviation of the paired differences, or of the logarithms of the ratios.",
        "",
        "| | Claim | How it is measured | Numbers | Verdict | Halvings that agree | Flipped by |",
        "|---:|---|---|---|---|---:|---|",
    ]
    for claim in claims:
        note = f". {claim['not_swept']}" if claim["not_swept"] else ""
        flips = "; ".join(claim["flipped_by"]) or "nothing that was run"
        share = claim["halvings_that_agree"]
        agreeing = "–" if share is None else f"{100.0 * share:.0f} %"
        lines.append(
            f"| {claim['number']} | {claim['claim']} ({claim['reference']}) | {claim['measured']} "
            f"| {_numbers(claim['base'])} | **{claim['verdict']}** | {agreeing} | {flips}{note} |"
        )
    lines += [
        "",
        "## Sensitivity",
        "",
        "| | Condition | Policy | Outcome | Numbers |",
        "|---:|---|---|---|---|",
    ]
    for claim in claims:
        counted = [claim["base"], *claim["sensitivity"]]
        for condition in (*counted, *claim["beside"]):
            outcome = condition["outcome"] if condition in counted else f"({condition['outcome']})"
            lines.append(
                f"| {claim['number']} | {_label(condition)} | {condition['policy']} | {outcome} "
                f"| {_numbers(condition)} |"
            )
    return "\n".join(lines) + "\n"


def insert_table(text: str, claims_json: str) -> str:
    """Return a text with the table of verdicts between its two marks, from ``claims.json``.

    ValueError if the lines `BEGIN` and `END` are not there once each.
    """
    if text.count(BEGIN) != 1 or text.count(END) != 1:
        raise ValueError(f"the text must have the lines {BEGIN} and {END} once each")
    lines = ["| | Claim | Number, of several the first | Verdict |", "|---:|---|---|---|"]
    for claim in json.loads(claims_json)["claims"]:
        number = next((s["text"] for s in claim["base"]["statements"]), "–")
        lines.append(
            f"| {claim['number']} | {claim['claim']} ({claim['reference']}) | {number} "
            f"| **{claim['verdict']}** |"
        )
    before, rest = text.split(BEGIN)
    return "\n".join([before + BEGIN, *lines, END + rest.split(END)[1]])


def _condition(condition: Condition) -> JsonObject:
    return {
        "axis": condition.axis,
        "value": condition.value,
        "policy": condition.policy,
        "outcome": condition.outcome,
        "statements": [_statement(statement) for statement in condition.statements],
    }


def _statement(statement: Statement) -> JsonObject:
    mean, lo, hi = map(_finite, statement.interval)
    unit = "" if statement.unit == "1" else f" {statement.unit}"
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
        "text": f"{statement.name}: {interval_text(*statement.interval)}{unit}",
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _label(condition: JsonObject) -> str:
    return f"{condition['axis']} = {condition['value']}" if condition["axis"] else "as configured"


def _numbers(condition: JsonObject) -> str:
    numbers = []
    for statement in condition["statements"]:
        effect = statement["effect_size"]
        numbers.append(statement["text"] + ("" if effect is None else f", *d* = {effect:.2g}"))
    return "; ".join(numbers)
