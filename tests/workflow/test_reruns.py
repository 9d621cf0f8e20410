"""Which jobs run again after which change: Snakemake decides, over files that are stand-ins."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from hiersched.scenario import load_scenario

pytestmark = pytest.mark.nightly

SMOKE = "src/hiersched/config/scenarios/smoke.yaml"
MINE = """
extends: smoke
plugins: [my_figures.py, my_rules.py]
policies: {mine: {import: "my_rules:flat"}}
evaluate: {policies: [ddpg, a2c, pf, edf, mine]}
sweeps: {axes: {packets: {vary: {traffic.packet_bits: [1.0e+4, 2.0e+4]}, policies: [edf]}}}
"""
FIGURES = """
from hiersched.study.registry import figure


@figure("mine", title="Mine.", reads=("runs",))
def my_figure(study):
    return None
"""
RULES = """
def flat(view):
    return view.backlog_packets * 0.0 + 1.0
"""

GROUPS = ("classical", "ddpg", "a2c")
AXES = tuple(load_scenario("smoke").sweeps.axes)
DDPG = {f"{name}_ddpg" for name in ("train", "evaluate", "generalise", "measure", *AXES)}
A2C = {f"{name}_a2c" for name in ("train", "evaluate", "generalise", "measure", "load")}
FROZEN = {f"{name}_{own}" for name in ("train", "measure") for own in ("frozen", "frozen_a2c")}
ES = {
    f"{name}_{own}"
    for name in ("train", "measure", "task_hold", "task_batch")
    for own in ("es_task", "es_blind")
}
OF_RUNS = {"bound", "growth"}  # over the evaluation, and over the delays of every run
LEARNED = {*DDPG, *A2C, *FROZEN, *ES, *OF_RUNS}
SWEEPS = {f"{axis}_classical" for axis in (*AXES, "packets")}
CLASSICAL = {*SWEEPS, "evaluate_classical", "generalise_classical", "measure_classical", *OF_RUNS}
GAIN_RUNS = {f"gain_{name}_gains" for name in ("study", "grid", "cells", "sampling_s", "noise")}
GAINS = {*GAIN_RUNS, "measure_gains", "growth"}
TASK_RUNS = {"tune_hold", "tune_batch", "task_hold_classical", "task_batch_classical"}
EVERY_RUN = {*LEARNED, *CLASSICAL, *GAINS, *TASK_RUNS}


@pytest.fixture(scope="module")
def project(
    project_root: Path, tmp_path_factory: pytest.TempPathFactory, snakemake: Callable
) -> tuple[Path, set[str]]:
    """A copy of the project, its results stand-ins that Snakemake takes for made; its rules."""
    copy = tmp_path_factory.mktemp("project")
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(project_root / "src", copy / "src", ignore=ignored)
    for name, text in (("mine.yaml", MINE), ("my_figures.py", FIGURES), ("my_rules.py", RULES)):
        (copy / name).write_text(text, encoding="utf-8")
    given = {"scenario": "mine.yaml", "source": copy / "src"}
    listed = snakemake(copy, "--summary", **given)
    assert listed.returncode == 0, listed.stderr
    lines = [line.split("\t") for line in listed.stdout.splitlines() if "\t" in line]
    place = lines[0].index("rule")
    assert len(lines) > 200
    for name, *_ in lines[1:]:
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        (copy / name).write_text("stand-in\n", encoding="utf-8")
    touched = snakemake(copy, "--cores", "1", "--touch", "--forceall", **given)
    assert touched.returncode == 0, touched.stderr
    return copy, {line[place].removesuffix("_mine") for line in lines[1:]}


@pytest.fixture(scope="module")
def tree(project: tuple[Path, set[str]]) -> Path:
    """The copy of the project."""
    return project[0]


@pytest.fixture(scope="module")
def shown(project: tuple[Path, set[str]]) -> set[str]:
    """Jobs of everything that is shown: it follows every value."""
    jobs = {job for job in project[1] if job.startswith(("table_", "figure_", "claim"))}
    assert len(jobs) > 40
    return jobs


@pytest.fixture
def to_run(tree: Path, snakemake: Callable, planned: Callable) -> Callable[[], set[str]]:
    """Jobs of a dry run; `resolve` and the page of the study follow every value."""

    def jobs() -> set[str]:
        names = planned(snakemake(tree, "-n", scenario="mine.yaml", source=tree / "src"))
        return {name.removesuffix("_mine") for name in names} - {"resolve", "page"}

    return jobs


@contextmanager
def edited(tree: Path, *edits: tuple[str, str, str]) -> Iterator[None]:
    """Replace text in files of the tree, for a while."""
    before = {name: (tree / name).read_bytes() for name, _, _ in edits}
    try:
        for name, old, new in edits:
            text = (tree / name).read_text(encoding="utf-8")
            assert old in text, (name, old)
            (tree / name).write_text(text.replace(old, new, 1), encoding="utf-8")
        yield
    finally:
        for name, content in before.items():
            (tree / name).write_bytes(content)


# Values.


def test_comments_and_the_order_of_keys_run_nothing(tree: Path, to_run: Callable) -> None:
    module = '"""Reads logs'
    with edited(
        tree,
        (
            SMOKE,
            "  seeds: [101, 102]\n  warmup_s: 1.0\n",
            "  warmup_s: 1.0 # why\n  seeds: [101, 102]\n",
        ),
        ("src/hiersched/log/reader.py", module, f"# A remark.\n{module} again"),
        (
            "src/hiersched/control/krasovskii.py",
            "from __future__",
            "# A remark.\n\nfrom __future__",
        ),
        ("src/hiersched/workflow/rules/run.smk", "for s in", "# A remark.\nfor s in"),
        ("src/hiersched/workflow/scripts/train.py", '"""Train', '"""Do train'),
    ):
        assert to_run() == set()


def test_a_value_runs_its_dependents(tree: Path, to_run: Callable, shown: set[str]) -> None:
    """Of a part of the study, an axis, a learner; what else is shown of the study stays."""
    with edited(
        tree,
        (SMOKE, "duration_s: 3.0", "duration_s: 4.0"),
        (SMOKE, "traffic.load: [0.85, 1.0]", "traffic.load: [0.85, 0.95]"),
        (SMOKE, "weight: [100.0]", "weight: [100.0, 300.0]"),
    ):
        assert to_run() == {
            *(f"{name}_{group}" for name in ("evaluate", "load", "measure") for group in GROUPS),
            *("gains_schedule_weight_300", "gain_grid_gains", "measure_gains", "stability"),
            *(OF_RUNS | shown),
        }
    old = "control.sampling_s: [0.02, 0.05]}}\n    ref"
    with edited(
        tree,
        (SMOKE, "a2c: {algorithm: a2c}", "a2c: {algorithm: a2c, actor_lr: 1.0e-3}"),
        (SMOKE, old, old.replace("0.05", "0.04")),
    ):
        assert to_run() == {
            *(A2C | OF_RUNS | shown),
            *(f"{name}_{group}" for name in ("sampling_s", "measure") for group in GROUPS[:2]),
            "gains_schedule_sampling_s_0.04",
        }


def test_two_swapped_values_are_a_change(tree: Path, to_run: Callable, shown: set[str]) -> None:
    new = "  actor_lr: 1.0e-3\n  critic_lr: 5.0e-4\n  episodes: "
    with edited(tree, (SMOKE, "  episodes: ", new)):
        assert to_run() == LEARNED | shown


def test_a_swept_keys_own_value_does_not_run_its_sweep(
    tree: Path, to_run: Callable, shown: set[str]
) -> None:
    """All others' own loads are other loads; trained policies are others wherever they run."""
    with edited(tree, (SMOKE, "traffic:\n", "traffic:\n  load: 0.7\n")):
        assert to_run() == (EVERY_RUN - {"load_classical"}) | shown


def test_the_regulator_runs_everything(tree: Path, to_run: Callable, shown: set[str]) -> None:
    with edited(tree, (SMOKE, "gain_study:", "control: {weight: 500.0}\ngain_study:")):
        found = to_run()
    gains = {job for job in found if job.startswith("gains_")}
    assert "gains_schedule" in gains
    # The grid varies the weight itself.
    assert found - gains == {"stability", *EVERY_RUN, *shown} - {"gain_grid_gains"}


# Code.

LINE = "from __future__ import annotations\n"


def test_an_edited_figure_table_or_claim_is_made_alone(tree: Path, to_run: Callable) -> None:
    more = "(study: Study) -> {0}:\n", "(study: Study) -> {0}:\n    print(study)\n"
    edits = [
        (f"src/hiersched/study/{file}", *(f"def {name}{text.format(kind)}" for text in more))
        for file, name, kind in (
            ("figures/rates.py", "draw_sampling", "Figure"),
            ("tables/policies.py", "score_table", "pd.DataFrame"),
            ("claims/judged.py", "queues_over_scale", "Judged"),
        )
    ]
    with edited(tree, *edits):
        assert to_run() == {"figure_fig6_sampling", "table_scores", "claim5", "claims"}


def test_a_plugin_runs_what_it_is_used_for(tree: Path, to_run: Callable) -> None:
    """One that only adds a figure draws that figure; a rule's, every job that loads it."""
    with edited(tree, ("my_figures.py", "return None", "return 1")):
        assert to_run() == {"figure_mine"}
    with edited(tree, ("my_rules.py", "+ 1.0", "+ 2.0")):
        assert {"evaluate_classical", "load_classical", "measure_classical"} <= to_run()


@pytest.mark.parametrize(
    ("modules", "jobs"),
    [
        (["learning/ddpg.py"], LEARNED),
        (["experiments/bound.py", "experiments/stability.py"], {"bound", "stability"}),
        (
            ["study/measure.py"],
            {name for name in EVERY_RUN if name.startswith("measure_")} | {"growth"},
        ),
        (["policies/index_rules.py"], {"kernels", "stability", *EVERY_RUN}),
    ],
)
def test_code_runs_its_dependents(
    tree: Path, to_run: Callable, shown: set[str], modules: list[str], jobs: set[str]
) -> None:
    new = (LINE, f"{LINE}\nNEW = 1\n")  # the workflow itself imports some of them
    with edited(tree, *((f"src/hiersched/{module}", *new) for module in modules)):
        found = to_run()
    ours = {job for job in found if not job.startswith(("table_", "figure_", "claim", "gains_"))}
    assert ours == jobs
    assert (found - ours) & shown


def test_a_missing_log_is_made_again(tree: Path, to_run: Callable) -> None:
    log = tree / "results/mine/runs/evaluate/pf/seed101.mcap"
    content, stat = log.read_bytes(), log.stat()
    log.unlink()
    try:
        found = to_run()
    finally:
        log.write_bytes(content)
        os.utime(log, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    ours = {job for job in found if not job.startswith(("table_", "figure_", "claim"))}
    assert ours == {"evaluate_classical", "measure_classical", *OF_RUNS}
    assert {"table_policies", "table_bound", "claim10"} <= found
    assert not {"table_table1_parameters", "table_gains", "claim1"} & found
