"""Tables and verdicts as pages: what a reader sees, by the standard library's parser."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from hiersched.scenario import Scenario
from hiersched.study.figures.style import policy_look
from hiersched.study.headings import heading
from hiersched.study.registry import Shown, always
from hiersched.study.show import write_table
from hiersched.study.tables.html import claims_page, table_page
from hiersched.study.tables.text import interval_text

READ = pd.DataFrame(
    {
        "policy": ["ddpg", "m_lwdf", "<b>&amp;"],
        "method": ["lqg", "nominal", "own"],
        "urllc_rate_mbps": [22.528017, 21.7934, float("nan")],
        "urllc_rate_mbps_lo": [20.0, 21.0, float("nan")],
        "urllc_rate_mbps_hi": [25.0, 22.5, float("nan")],
        "load": [0.123456789, 1.0, 12345.678],
        "certified": [True, False, True],
    }
)


class Cells(HTMLParser):
    """Rows of cells as text, headings first; the names below the headings; other text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.tips: list[str | None] = []
        self.codes: list[str] = []
        self._open: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self._open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag == "th":
            self.tips.append(dict(attrs).get("title"))
        if tag == "code":
            self.codes.append("")

    def handle_endtag(self, tag: str) -> None:
        while self._open and self._open.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] in ("td", "th"):
            self.rows[-1][-1] += data
        if self._open and self._open[-1] == "code":
            self.codes[-1] += data


def made(scenario: Scenario, **given: Any) -> Cells:
    thing = Shown(name="mine", build=lambda study: READ, reads=("runs",), when=always, **given)
    return Cells(table_page(thing, READ, scenario))


def test_a_table_is_read_with_the_names_of_the_figures_units_and_intervals(
    smoke_scenario: Scenario,
) -> None:
    page = made(smoke_scenario, title="Mine", note="Of `load` & all.")
    names = ["Policy", "Method", "URLLC rate [Mbit/s]", "Load", "Certified"]
    assert page.rows[0] == names
    assert page.tips == ["policy", "method", "urllc_rate_mbps", "load", "certified"]
    ddpg, rule, own = page.rows[1:]
    assert ddpg[0] == policy_look("ddpg", smoke_scenario).label == "DRL (DDPG)"
    assert rule[0] == "M-LWDF"
    assert [row[1] for row in (ddpg, rule, own)] == ["filter (LQG)", "nominal gain", "own"]
    assert ddpg[2] == interval_text(22.528017, 20.0, 25.0) == "22.5 [20.0, 25.0]"
    assert own[2] == "–"
    assert [row[3] for row in (ddpg, rule, own)] == ["0.1235", "1", "12350"]
    assert [row[4] for row in (ddpg, rule, own)] == ["yes", "no", "yes"]
    assert page.codes == ["load", "tables/mine.csv"]


def test_what_looks_like_markup_is_text(smoke_scenario: Scenario) -> None:
    page = made(smoke_scenario, title="<script>", note="<i>")
    assert page.rows[-1][0] == "<b>&amp;"


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("urllc_rate_mbps", "URLLC rate [Mbit/s]"),
        ("embb_rate_mbps_median", "eMBB rate median [Mbit/s]"),
        ("tracking_error_cm", "Tracking error [cm]"),
        ("tracking_error_cm_over_own", "Tracking error over own"),
        ("urllc_late_share", "URLLC late share"),
        ("urllc_delay_p99_s", "URLLC delay 99 % quantile [s]"),
        ("control_saturations_per_s", "Control saturations [1/s]"),
        ("delay_steps", "Delay [samples]"),
        ("mean_square_backlog", "Mean square backlog [packets²]"),
        ("noise_heading_rad", "Noise heading [rad]"),
        ("policy", "Policy"),
        ("slots", "Slots"),
    ],
)
def test_headings_are_words_and_a_unit(name: str, text: str) -> None:
    assert heading(name) == text


def test_a_table_to_compute_with_is_no_page(tmp_path: Path, smoke_scenario: Scenario) -> None:
    thing = Shown(
        name="mine", build=lambda study: READ, title="Mine", reads=(), when=always, columns=()
    )
    write_table(thing, READ, tmp_path, smoke_scenario)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.csv"]
    few = Shown(
        name="few",
        build=lambda study: READ,
        title="Few",
        reads=(),
        when=always,
        columns=("load", "no"),
    )
    write_table(few, READ, tmp_path / "few", smoke_scenario)
    assert sorted(p.name for p in (tmp_path / "few").iterdir()) == ["few.csv", "few.html", "few.md"]
    page = Cells((tmp_path / "few/few.html").read_text(encoding="utf-8"))
    assert page.rows[0] == ["Load"]


def test_verdicts_have_their_numbers(smoke_scenario: Scenario) -> None:
    statement = {"text": "rate / PF's: 0.9 [0.8, 1.0]"}
    claim = {
        "number": 3,
        "claim": "a < b",
        "reference": "Fig. 4",
        "verdict": "depends",
        "base": {"statements": [statement]},
        "flipped_by": ["load = 1.0"],
    }
    page = Cells(claims_page([claim], "A `rule`.", smoke_scenario))
    assert page.rows[1] == ["3", "a < b (Fig. 4)", "depends", statement["text"], "load = 1.0"]
    assert page.codes == ["rule", "claims.md"]
