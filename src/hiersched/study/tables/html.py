"""Tables and verdicts as HTML pages to read: names as in the figures, units, rounded numbers."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from hiersched.core.html import codes, page
from hiersched.scenario import Scenario
from hiersched.study.registry import Shown
from hiersched.study.tables.cells import readable

_STYLE = """
th { max-width: 16ch; }
td { white-space: nowrap; }
td.text { white-space: normal; max-width: 60ch; }
"""
_LONG = 30
"""Characters of a text above which it may be broken."""


def table_page(shown: Shown, content: pd.DataFrame, scenario: Scenario) -> str:
    """Return a page with the columns of a table that are to be read.

    Headings have units, and the names of the columns in the file as tooltips; a mean and its bounds
    are one cell; policies and methods are called as in the figures.
    """
    heads, rows = readable(shown.read_columns(content), scenario)
    marked = [
        [_cell(cell.text, head.is_number) for head, cell in zip(heads, row, strict=True)]
        for row in rows
    ]
    body = [
        f"<h1>{codes(shown.title)}</h1>",
        _table([_head(*head) for head in heads], marked),
        f'<p class="note">{codes(shown.note)}</p>' if shown.note else "",
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
        f'<p class="note">{codes(rule)}</p>',
        '<p class="note">Every sensitivity run: <code>claims.md</code></p>',
    ]
    return page(title, "\n".join(body), styles=(_STYLE,))


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"<tr>{''.join(cells)}</tr>" for cells in rows]
    head = f"<thead><tr>{''.join(heads)}</tr></thead>"
    return (
        f'<div class="wide"><table>{head}<tbody>\n' + "\n".join(lines) + "\n</tbody></table></div>"
    )


def _head(text: str, name: str, is_number: bool) -> str:
    return f'<th{_class(is_number)} title="{html.escape(name)}">{html.escape(text)}</th>'


def _class(is_number: bool) -> str:
    return ' class="number"' if is_number else ""


def _cell(text: str, is_number: bool) -> str:
    kind = ' class="text"' if len(text) > _LONG and not is_number else _class(is_number)
    return f"<td{kind}>{html.escape(text)}</td>"
