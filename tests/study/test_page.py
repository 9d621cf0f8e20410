"""A study as one page: what its files hold, as text; tables that sort in a browser."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from hiersched.experiments import files
from hiersched.scenario import Scenario
from hiersched.study.built_in import shown
from hiersched.study.figures.style import policy_look
from hiersched.study.outputs import run_files, source_files
from hiersched.study.page import write_study_page
from hiersched.study.page.build import MOST_SVG_BYTES, _ranges
from hiersched.study.registry import CLAIMS, FIGURES, TABLES
from hiersched.study.show import write_table

BAD = "<img src=x onerror='window.hacked=1'><script>window.hacked=1</script>"
SVG = "<svg xmlns='http://www.w3.org/2000/svg'><rect width='9' height='9'/></svg>"
TABLE = f"""policy,seeds,urllc_late_share,urllc_rate_mbps,urllc_rate_mbps_lo,urllc_rate_mbps_hi
pf,2,0.25,9.0,8.0,10.0
{BAD},2,,10.5,10.25,10.75
edf,2,2e-05,100.0,,
"""


def test_seeds_are_listed_as_runs() -> None:
    assert _ranges((1, 2, 3, 4, 7, 9, 10)) == "1 to 4, 7, 9, 10"


@pytest.fixture
def results(smoke_scenario: Scenario, tmp_path: Path) -> Path:
    """Folder of a study whose files hold markup wherever they hold text."""
    folder = tmp_path / "smoke"
    for name in ("figures", "tables", "benchmarks"):
        (folder / name).mkdir(parents=True)
    stray = ("runs/evaluate/gone/seed1.mcap", "measures/gone.parquet", "gains/gone.json")
    for name in (*run_files(smoke_scenario), *source_files(smoke_scenario), *stray):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x" * 1234)
    for job in ("evaluate_pf", "gone"):
        (folder / f"benchmarks/{job}.tsv").write_text(
            "s\th:m:s\tmax_rss\tcpu_time\n6.25\t0:00:06\t326.5\t6.0\n"
        )
    for name in shown(FIGURES, smoke_scenario):
        for end in ("svg", "png"):
            (folder / f"figures/{name}.{end}").write_text(SVG)
    for name, thing in shown(TABLES, smoke_scenario).items():
        text = TABLE
        if thing.columns:  # the policy's column has the name of the first that is read
            text = TABLE.replace("policy,", f"{thing.columns[0]},", 1)
        (folder / f"tables/{name}.csv").write_text(text)
    statement = {"text": f"rate{BAD}: 1.0 [0.9, 1.1]"}
    claim = {
        "number": 4,
        "claim": f"rates rise{BAD}",
        "reference": "Fig. 5a",
        "measured": f"slope of `rate` {BAD}",
        "verdict": "depends",
        "base": {"statements": [statement]},
        "halvings_that_agree": None,
        "flipped_by": [f"policy = {BAD}"],
        "not_swept": "",
    }
    document = {"level": 0.95, "rule": f"A rule {BAD}", "claims": [claim]}
    (folder / files.CLAIMS[0]).write_text(json.dumps(document))
    return folder


def test_a_page_has_all_that_a_study_shows(smoke_scenario: Scenario, results: Path) -> None:
    jobs = ("evaluate_pf", "evaluate_edf")  # the second has left no times
    text = write_study_page(smoke_scenario, results, jobs).read_text(encoding="utf-8")
    figures, tables = shown(FIGURES, smoke_scenario), shown(TABLES, smoke_scenario)
    assert re.findall(r'<figure id="figure-(\w+)">', text) == sorted(figures)
    named = {name for name in tables if f"tables/{name}.csv" in text}
    assert named == set(tables)
    read = {name for name, thing in tables.items() if thing.columns != ()}
    assert set(re.findall(r'id="table-(\w+)"', text)) == read
    assert len(shown(CLAIMS, smoke_scenario)) > 5  # and yet those of the file are shown
    assert text.count('<td data-key="depends"') == 1
    assert "learning" in re.findall(r"<pre>(.*?)</pre>", text, re.S)[0]  # the scenario
    for wanted in ("1,234", "6.2", "326.5", "101, 102", "numpy 2", "hiersched report"):
        assert wanted in text, wanted
    assert "gone" not in text  # what the scenario does not ask for
    logs = [name for name in run_files(smoke_scenario) if name.endswith(".mcap")]
    assert all(f">{name}<" in text for name in (*logs, *source_files(smoke_scenario)))
    assert "Times of 1 jobs" in text
    assert "0.25 " not in text  # four digits, no more
    assert "slope of <code>rate</code> &lt;img" in text


def test_both_pages_say_the_same_of_a_cell(smoke_scenario: Scenario, results: Path) -> None:
    thing = shown(TABLES, smoke_scenario)["policies"]
    rows = pd.DataFrame(
        {
            "policy": ["drift_plus_penalty", "ddpg", ""],
            "seeds": [12345, 2, 3],
            "urllc_rate_mbps": [0.1234567, math.inf, math.nan],
            "loop": ["0.1234567", None, "grows"],
            "best_classical": [True, None, False],
        }
    )
    write_table(thing, rows, results / "tables", smoke_scenario)
    page = write_study_page(smoke_scenario, results)
    section = re.findall(r'id="table-policies">(.*?)</table>', page.read_text("utf-8"), re.S)[0]
    own = (results / "tables/policies.html").read_text("utf-8")
    for tag in ("th", "td"):
        cells = re.findall(rf"<{tag}[^>]*>(.*?)</{tag}>", own)
        assert cells == re.findall(rf"<{tag}[^>]*>(.*?)</{tag}>", section)
    drift, learned, none = (cells[i : i + 5] for i in (0, 5, 10))
    assert drift[0] == policy_look("drift_plus_penalty", smoke_scenario).label
    assert (drift[3], learned[3], none[3]) == ("yes", "–", "no")
    assert none[0] == "–"


def test_a_large_drawing_is_shown_as_pixels(smoke_scenario: Scenario, results: Path) -> None:
    first, second, *_ = shown(FIGURES, smoke_scenario)
    (results / f"figures/{first}.svg").write_text(SVG + " " * MOST_SVG_BYTES)
    text = write_study_page(smoke_scenario, results).read_text(encoding="utf-8")
    kinds = dict(re.findall(r'<figure id="figure-(\w+)">\s*<img src="data:(image/[\w+]+);', text))
    assert (kinds[first], kinds[second]) == ("image/png", "image/svg+xml")


def test_tables_sort_and_text_stays_text(
    smoke_scenario: Scenario,
    results: Path,
    browser: Callable[[], AbstractContextManager[Any]],
) -> None:
    page = write_study_page(smoke_scenario, results)
    with browser() as tab:
        tab.open(page)
        assert tab.run("window.hacked") is None
        assert tab.run("document.querySelectorAll('script').length") == 2  # its own, and no data
        assert tab.run("document.querySelectorAll('img:not([src^=data])').length") == 0
        name = "policies"
        tab.run(f"document.querySelector('#table-{name}').closest('details').open = true")
        heads = tab.run(
            f"[...document.querySelectorAll('#table-{name} th')].map(h => h.textContent)"
        )
        assert heads[:4] == ["Policy", "Seeds", "URLLC late share", "URLLC rate [Mbit/s]"]

        def column(place: int) -> list[str]:
            cells = f"[...document.querySelectorAll('#table-{name} td:nth-child({place})')]"
            found: list[str] = tab.run(f"{cells}.map(c => c.textContent)")
            return found

        rates = ["9.0 [8.0, 10.0]", "10.50 [10.25, 10.75]", "100"]
        assert column(4) == rates
        tab.click(f"#table-{name} th:nth-child(4)")
        assert column(4) == rates  # as numbers: 9 comes before 10.5 and 100
        tab.click(f"#table-{name} th:nth-child(4)")
        assert column(4) == rates[::-1]
        tab.click(f"#table-{name} th:nth-child(3)")
        assert column(3) == ["2e-05", "0.25", "–"]
        tab.click(f"#table-{name} th:nth-child(3)")
        assert column(3) == ["0.25", "2e-05", "–"]  # none last, however it sorts
        assert BAD in column(1)
        assert tab.faults == []
        assert {url.partition(":")[0] for url in tab.requests} == {"file", "data"}
        assert len([url for url in tab.requests if url.startswith("file:")]) == 1
