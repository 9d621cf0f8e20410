"""What a study shows: by which scenarios it is shown, and how a plug-in adds to it."""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import pandas as pd
import pytest

from hiersched.core.registry import load_plugin
from hiersched.scenario import Scenario, ScenarioError
from hiersched.study.built_in import shown
from hiersched.study.claims.report import join_claims
from hiersched.study.figures.style import house_style
from hiersched.study.registry import CLAIMS, FIGURES, TABLES
from hiersched.study.show import show
from hiersched.study.study import Study

REGISTRIES = {"table": TABLES, "figure": FIGURES, "claim": CLAIMS}


def names(scenario: Scenario) -> set[str]:
    """Everything that a scenario shows."""
    return {name for registry in REGISTRIES.values() for name in shown(registry, scenario)}


# Conditions.

NO_AXES = (
    "sweeps: {axes: {rayleigh_scale: null, sampling_s: null, reference: null, load: null,"
    " load_ratio: null, service_coefficient_mbps: null}}\n"
)
NO_GAINS, NO_CELLS = "gain_study: {methods: []}\n", "generalise: {cells: []}\n"
NO_BOUND = "bound: {slots_per_log: 0}\n"
NO_LOOP_CELLS = "gain_study: {cells: {near: null, far: null}}\n"
ALONE = NO_AXES + NO_GAINS + NO_CELLS + NO_BOUND
ALWAYS = set("policies comparison runs table1_parameters figX_delay figX_pareto".split())
ALWAYS |= {"fig8_violations", "second_moments"}
RATES = {"table3_rate", "fig4_rate_cdf"}
TRAINED = set("fig2_rewards fig3_queues figX_learning".split())
TRAINED |= {f"claim{number}" for number in (1, 2, 3, 9, 10)}
GAINS = set("gain_methods gains table2_gain table2_methods figX_gain figX_gain_traces".split())
GAINS |= {"claim8"}
GRID = set("gain_grid gain_stability figX_gain_grid figX_gain_stability".split())
SWEPT_GAINS = {"gain_sweeps", "figX_gain_sweeps"}
LOOP_CELLS = {"gain_cells", "figX_gain_cells"}


@pytest.mark.parametrize(
    ("text", "gone"),
    [
        (
            NO_GAINS + NO_CELLS + NO_BOUND,
            GAINS
            | GRID
            | SWEPT_GAINS
            | LOOP_CELLS
            | {"generalisation", "figX_generalise", "bound"}
            | {"figX_bound"},
        ),
        ("gain_study: {weight: []}\n", GRID | SWEPT_GAINS),
        (NO_LOOP_CELLS, LOOP_CELLS),
        ("control: {loop: split}\n", {"second_moments"}),
        ("gain_study: {noise_position_m: [], noise_heading_rad: []}\n", SWEPT_GAINS),
        (
            "sweeps: {axes: {load: null, load_ratio: null}}\n",
            {"scores", "learners", "figX_load", "figX_learners"},
        ),
        (
            "sweeps: {axes: {rayleigh_scale: null, sampling_s: null}}\n",
            {"fig5_rayleigh", "claim4", "claim5", "fig6_sampling", "claim6"},
        ),
        # An axis of two keys is none of either.
        (
            "sweeps: {axes: {reference: {vary: {robot.reference: [arc], traffic.load: [0.9]}}}}\n",
            {"fig7_dexterity", "claim7"},
        ),
        # Nobody runs along it, or nobody whom the figures compare.
        (
            "sweeps: {policies: [alt], axes: {reference: {policies: own}}}\n",
            {"fig5_rayleigh", "fig6_sampling", "fig7_dexterity", "claim7"},
        ),
        ("sweeps: {axes: {reference: {policies: [edf]}}}\n", {"fig7_dexterity"}),
        ("sweeps: {axes: {load: {policies: [edf]}}}\n", {"learners", "figX_learners"}),
        ("evaluate: {policies: [alt, edf]}\n", RATES),
    ],
)
def test_what_a_scenario_has_not_is_not_shown(
    tiny: Scenario, variant_of_tiny: Callable[..., Scenario], text: str, gone: set[str]
) -> None:
    assert names(tiny) - names(variant_of_tiny(text)) == gone
    assert names(variant_of_tiny(text)) <= names(tiny)


SMALL = pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("evaluate: {policies: [drift_plus_penalty]}\n", ALWAYS),
        # A learner besides the scenario's own, which is not trained.
        ("evaluate: {policies: [alt]}\n", ALWAYS | TRAINED),
        # A gain study without its sweeps, and a single point of a single axis.
        (
            "evaluate: {policies: [pf]}\ngain_study: {methods: [razumikhin], weight: []}\n"
            "sweeps: {policies: [pf], axes: {sampling_s: {vary: {control.sampling_s: [0.05]}}}}\n",
            ALWAYS | RATES | GAINS | LOOP_CELLS | {"sweeps", "fig6_sampling", "claim6"},
        ),
    ],
)


@SMALL
def test_a_small_study_lists_what_it_has(
    variant_of_tiny: Callable[..., Scenario], text: str, expected: set[str]
) -> None:
    assert names(variant_of_tiny(ALONE, text)) == expected


@pytest.mark.nightly
@SMALL
def test_a_small_study_shows_what_it_has(
    variant_of_tiny: Callable[..., Scenario],
    measured: Callable[[Scenario], Path],
    text: str,
    expected: set[str],
) -> None:
    """Each is made and laid out, without a warning."""
    scenario = variant_of_tiny(ALONE, text)
    assert names(scenario) == expected
    study = Study(scenario, measured(scenario))
    with house_style(), warnings.catch_warnings():
        warnings.simplefilter("error")
        for kind, registry in REGISTRIES.items():
            for thing in shown(registry, scenario).values():
                made = thing.build(study)
                if kind == "figure":
                    made.draw_without_rendering()
                elif kind == "table":
                    assert len(made.columns), thing.name


def test_claims_about_learners_are_not_judged_of_rules(
    variant_of_tiny: Callable[..., Scenario], measured: Callable[[Scenario], Path]
) -> None:
    text = NO_GAINS + "evaluate: {policies: [pf]}\ngeneralise: {policies: [pf], cells: []}\n"
    text += NO_BOUND + "sweeps: {policies: [pf], axes: {load: null}}\n"
    scenario = variant_of_tiny(text)
    study = Study(scenario, measured(scenario))
    claims = {name: claim.build(study).verdict for name, claim in shown(CLAIMS, scenario).items()}
    assert claims == dict.fromkeys((f"claim{n}" for n in (4, 5, 6, 7)), "not judged")


# Plug-ins.

PLUGIN = """
from matplotlib.figure import Figure

from hiersched.study.claims.verdicts import Condition, Judged
from hiersched.study.registry import claim, figure, has_cells, table

CALLS = []


@table("late_runs", title="Late", note="By run.", reads=("runs",), columns=("policy", "late"))
def late_runs(study):
    CALLS.append("table")
    runs = study.evaluation
    return runs[["policy", "seed"]].assign(late=runs["urllc_late_share"])


@figure("figY_late", title="Late packets.", reads=("runs",))
def draw_late(study):
    CALLS.append("figure")
    figure = Figure(figsize=(2.0, 1.0))
    figure.subplots().plot(study.evaluation["urllc_late_share"])
    return figure


@claim(11, reference="Fig. 9", paper="nobody is late", measured="By eye.", reads=("runs",))
def nobody_is_late(study):
    CALLS.append("claim")
    return Judged(Condition(axis="", value="", policy="pf", statements=()), ())


@table("where_there_are_cells", title="Cells", reads=("runs",), when=has_cells)
def cells(study):
    return study.cells
"""


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A file that adds a table, a figure and a claim; what it has registered is gone afterwards."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    file = tmp_path / "my_study.py"
    file.write_text(PLUGIN, encoding="utf-8")
    yield file
    file.write_text("", encoding="utf-8")
    load_plugin(file)
    del sys.modules["my_study"]


def test_a_file_adds_a_table_a_figure_and_a_claim(
    plugin: Path, variant_of_tiny: Callable[..., Scenario], results: Path, study: Study
) -> None:
    scenario = variant_of_tiny(f"plugins: [{plugin}]\n")
    assert names(scenario) - names(study.scenario) == {
        *("late_runs", "figY_late", "claim11", "where_there_are_cells")
    }
    folder = plugin.parent / "results"
    folder.mkdir()
    (folder / "measures").symlink_to(results / "measures")
    added = (("table", "late_runs"), ("figure", "figY_late"), ("claim", "claim11"))
    for kind, name in added:
        thing = shown(REGISTRIES[kind], scenario)[name]
        assert thing.file == plugin
        show(scenario, folder, kind, name, thing.module)
    assert sys.modules["my_study"].CALLS == [kind for kind, _ in added]
    written = pd.read_csv(folder / "tables/late_runs.csv")
    assert written["late"].tolist() == study.evaluation["urllc_late_share"].tolist()
    text = (folder / "tables/late_runs.md").read_text()
    assert text.startswith("# Late\n\nBy run.\n\n| policy | late |\n|---|---:|\n| ddpg |")
    assert (folder / "figures/figY_late.svg").stat().st_size
    assert (folder / "figures/figY_late.png").stat().st_size
    claim = json.loads((folder / "claims/claim11.json").read_text())
    assert (claim["claim"], claim["verdict"]) == ("nobody is late", "not judged")
    join_claims(scenario, folder, ["claim11"])
    assert "| 11 | nobody is late (Fig. 9) | By eye. |" in (folder / "claims.md").read_text()


def test_what_a_file_adds_can_have_a_condition(
    plugin: Path, variant_of_tiny: Callable[..., Scenario]
) -> None:
    text = f"plugins: [{plugin}]\ngeneralise: {{cells: []}}\n"
    assert "late_runs" in names(variant_of_tiny(text))
    assert "where_there_are_cells" not in names(variant_of_tiny(text))


def test_a_scenario_shows_nothing_of_anothers_plugins(
    plugin: Path, variant_of_tiny: Callable[..., Scenario], tiny: Scenario
) -> None:
    """Both may be in one run of the workflow, and a job knows its own scenario's alone."""
    before = names(tiny)
    variant_of_tiny(f"plugins: [{plugin}]\n")
    assert names(tiny) == before


def test_a_name_that_is_taken_is_an_error(
    plugin: Path, variant_of_tiny: Callable[..., Scenario], tiny: Scenario
) -> None:
    assert "policies" in names(tiny)
    plugin.write_text(PLUGIN.replace("late_runs", "policies"), encoding="utf-8")
    with pytest.raises(
        ScenarioError, match=r"table 'policies': the name is taken by .*policies\.py"
    ):
        variant_of_tiny(f"plugins: [{plugin}]\n")
