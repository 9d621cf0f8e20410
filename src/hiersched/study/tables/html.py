"""Tables and verdicts as HTML pages to read: names as in the figures, units, rounded numbers."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from hiersched.core.html import page
from hiersched.policies.find import UNTRAINED
from hiersched.policies.registry import RULES
from hiersched.scenario import Scenario
from hiersched.study.headings import heading
from hiersched.study.registry import Shown
from hiersched.study.tables.text import cell_text, interval_text, merged_columns

_POLICY_COLUMNS = (
    *("policy", "learner", "baseline", "best_classical", "decider", "states_of"),
    *("blind", "classical", "aware", "twin"),
)
"""Columns whose cells name a policy."""
_STYLE = """
th { max-width: 16ch; }
td { white-space: nowrap; }
td.text { white-space: normal; max-width: 60ch; }
[data-verdict] { font-weight: 600; white-space: nowrap; }
[data-verdict="reproduced"] { color: var(--good); }
[data-verdict="not reproduced"] { color: var(--bad); }
[data-verdict="depends"] { color: var(--mixed); }
"""
_LONG = 30
"""Characters of a text above which it may be broken."""


def table_page(shown: Shown, read: pd.DataFrame, scenario: Scenario) -> str:
    """Return a page with the columns of a table that are to be read.

    Headings have units, and the names of the columns in the file as tooltips; a mean and its bounds
    are one cell; policies and methods are called as in the figures.
    """
    merged, names = merged_columns(read)
    numeric = [pd.api.types.is_numeric_dtype(read[name]) for name in names]
    kinds = dict(zip(names, numeric, strict=True))
    heads = [_head(str(name), is_number) for name, is_number in kinds.items()]
    rows = [
        [_cell(_text(row, name, name in merged, scenario), kinds[name]) for name in names]
        for row in read.to_dict("records")
    ]
    body = [
        f"<h1>{html.escape(shown.title)}</h1>",
        _table(heads, rows),
        f'<p class="note">{_codes(shown.note)}</p>' if shown.note else "",
        f'<p class="note">Scenario {html.escape(scenario.name)}. Every digit and column: '
        f"<code>tables/{html.escape(shown.name)}.csv</code></p>",
    ]
    return page(shown.title, "\n".join(body), styles=(_STYLE,))


def claims_page(claims: Sequence[Mapping[str, Any]], rule: str, scenario: Scenario) -> str:
    """Return a page with the verdicts on claims, as they stand in ``claims.json``."""
    rows = []
    for claim in claims:
        verdict = html.escape(claim["verdict"])
        numbers = "<br>".join(html.escape(s["text"]) for s in claim["base"]["statements"])
        flips = "; ".join(claim["flipped_by"]) or "nothing that was run"
        rows.append(
            [
                _cell(str(claim["number"]), True),
                _cell(f"{claim['claim']} ({claim['reference']})", False),
                f'<td data-verdict="{verdict}">{verdict}</td>',
                f'<td class="text">{numbers}</td>',
                _cell(flips, False),
            ]
        )
    heads = [f"<th>{text}</th>" for text in ("", "Claim", "Verdict", "Numbers", "Flipped by")]
    title = f"The paper's claims in scenario {scenario.name}"
    body = [
        f"<h1>{html.escape(title)}</h1>",
        _table(heads, rows),
        f'<p class="note">{_codes(rule)}</p>',
        '<p class="note">Every sensitivity run: <code>claims.md</code></p>',
    ]
    return page(title, "\n".join(body), styles=(_STYLE,))


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"<tr>{''.join(cells)}</tr>" for cells in rows]
    head = f"<thead><tr>{''.join(heads)}</tr></thead>"
    return (
        f'<div class="wide"><table>{head}<tbody>\n' + "\n".join(lines) + "\n</tbody></table></div>"
    )


def _head(name: str, is_number: bool) -> str:
    text = html.escape(heading(name))
    return f'<th{_class(is_number)} title="{html.escape(name)}">{text}</th>'


def _class(is_number: bool) -> str:
    return ' class="number"' if is_number else ""


def _cell(text: str, is_number: bool) -> str:
    kind = ' class="text"' if len(text) > _LONG and not is_number else _class(is_number)
    return f"<td{kind}>{html.escape(text)}</td>"


def _text(row: Mapping[Any, Any], name: str, has_bounds: bool, scenario: Scenario) -> str:
    value = row[name]
    if has_bounds:
        return interval_text(value, row[f"{name}_lo"], row[f"{name}_hi"])
    if isinstance(value, bool):
        return "yes" if value else "no"
    if name in _POLICY_COLUMNS and isinstance(value, str):
        return policy_label(value, scenario)
    if name == "method" and isinstance(value, str):
        return method_label(value)
    return cell_text(value).replace("\\|", "|")


def policy_label(name: str, scenario: Scenario) -> str:
    """Return what figures call a policy; a name that is none is its own."""
    from hiersched.study.figures.style import policy_look

    known = (*UNTRAINED, *RULES, *scenario.learned, *scenario.policies)
    return policy_look(name, scenario).label if name in known else name


def method_label(name: str) -> str:
    """Return what figures call a method of the gain study; a name that is none is its own."""
    from hiersched.study.figures.style import GAIN_METHODS

    return GAIN_METHODS[name].label if name in GAIN_METHODS else name


def _codes(text: str) -> str:
    """Return markup of a text in which `words` in backquotes are code; all else is escaped."""
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", html.escape(text))
