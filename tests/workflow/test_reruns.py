"""Which jobs run again after which change: Snakemake decides, over files that are stand-ins."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hiersched.runs import paths
from hiersched.runs.variants import SWEPT_KEYS

from hiersched.scenario import Scenario, load_scenario

pytestmark = pytest.mark.slow

SMOKE = "src/hiersched/config/scenarios/smoke.yaml"
GROUPS = ("classical", "ddpg", "a2c")
ALWAYS = {"aggregate", "claims", "figures"}
DDPG = {"train_ddpg", "evaluate_ddpg", *(f"sweep_{axis}_ddpg" for axis in SWEPT_KEYS)}
DDPG |= {"generalise_ddpg", "measure_ddpg", "bound"}
A2C = {"train_a2c", "evaluate_a2c", "sweep_load_a2c", "generalise_a2c", "measure_a2c", "bound"}
LEARNED = DDPG | A2C | {"train_frozen", "train_frozen_a2c"}
CLASSICAL = {"evaluate_classical", *(f"sweep_{axis}_classical" for axis in SWEPT_KEYS)}
CLASSICAL |= {"generalise_classical", "measure_classical", "bound"}
MEASURES = {f"measure_{group}" for group in GROUPS}
GAIN_SWEEPS = {f"gain_sweep_{axis}" for axis in ("grid", "sampling_s", "noise")}
EVERY_RUN = {*LEARNED, *CLASSICAL, "gain_study", *GAIN_SWEEPS}


def snakemake(tree: Path, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "snakemake", *words, "--config", "scenarios=[smoke]"],
        cwd=tree,
        env={**os.environ, "PYTHONPATH": str(tree / "src")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def to_run(tree: Path) -> set[str]:
    """Jobs of a dry run, without the scenario's name; `all` and `resolve` follow every value."""
    text = snakemake(tree, "-n")
    if "Nothing to be done" in text:
        return set()
    table = text.split("Job stats:")[1].split("total")[0]
    names = set(re.findall(r"^(\w+) +\d+$", table, re.MULTILINE))
    return {name.removesuffix("_smoke") for name in names} - {"all", "resolve"}


def outputs(scenario: Scenario) -> list[str]:
    return [
        paths.SCENARIO,
        *map(paths.progress_file, scenario.learned),
        paths.STABILITY,
        *paths.all_gain_files(scenario),
        *(name for learner in scenario.learned for name in paths.policy_files(scenario, learner)),
        *paths.all_logs(scenario),
        *(name for group in GROUPS for name in paths.evaluation_outputs(scenario, group)),
        *(name for group in GROUPS for name in paths.measured_files(scenario, group)),
        *paths.measures_files(scenario),
        paths.RUNS,
        paths.BOUND,
        *paths.CLAIMS,
        *(f"figures/{name}.{end}" for name in paths.FIGURES for end in ("svg", "png")),
        *(f"tables/{name}.{end}" for name in paths.TABLES for end in ("csv", "md")),
    ]


@pytest.fixture(scope="module")
def tree(project_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the project whose results are stand-ins that Snakemake takes for made."""
    copy = tmp_path_factory.mktemp("project")
    shutil.copy(project_root / "Snakefile", copy)
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(project_root / "src", copy / "src", ignore=ignored)
    os.chdir(project_root)
    names = [f"results/smoke/{name}" for name in outputs(load_scenario("smoke"))]
    kernels = re.search(r"results/\.kernels/\w+\.txt", snakemake(copy, "-n"))
    assert kernels is not None
    for name in (*names, kernels[0]):
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        (copy / name).write_text("stand-in\n", encoding="utf-8")
    snakemake(copy, "--cores", "1", "--touch", "--forceall", "--quiet")
    return copy


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


def test_nothing_runs_when_nothing_changed(tree: Path) -> None:
    assert to_run(tree) == set()


def test_comments_and_the_order_of_keys_run_nothing(tree: Path) -> None:
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
        assert to_run(tree) == set()


def test_a_value_runs_its_dependents(tree: Path) -> None:
    with edited(tree, (SMOKE, "duration_s: 3.0", "duration_s: 4.0")):
        assert to_run(tree) == {
            "evaluate_classical",
            "evaluate_ddpg",
            "evaluate_a2c",
            "bound",
            *MEASURES,
            *ALWAYS,
        }


def test_two_swapped_values_are_a_change(tree: Path) -> None:
    with edited(
        tree,
        (SMOKE, "  episodes: ", "  actor_lr: 1.0e-3\n  critic_lr: 5.0e-4\n  episodes: "),
    ):
        assert to_run(tree) == {*LEARNED, *ALWAYS}


def test_a_learners_own_key_runs_that_learner(tree: Path) -> None:
    new = "a2c: {algorithm: a2c, actor_lr: 1.0e-3}"
    with edited(tree, (SMOKE, "a2c: {algorithm: a2c}", new)):
        assert to_run(tree) == {*A2C, *ALWAYS}


def test_a_new_point_of_a_sweep_runs_that_sweep(tree: Path) -> None:
    with edited(tree, (SMOKE, "load: [0.85, 1.0]", "load: [0.85, 0.95]")):
        assert to_run(tree) == {f"sweep_load_{group}" for group in GROUPS} | MEASURES | ALWAYS


def test_a_new_sampling_interval_designs_its_gains(tree: Path) -> None:
    with edited(tree, (SMOKE, "sampling_s: [0.02, 0.05]", "sampling_s: [0.02, 0.04]")):
        axes = ("sampling_s", "service_coefficient_mbps")
        pair = ("classical", "ddpg")
        sweeps = {f"sweep_{axis}_{group}" for axis in axes for group in pair}
        sweeps |= {f"measure_{group}" for group in pair}
        gains = {"gains", "gain_sweep_sampling_s", "stability"}
        assert to_run(tree) == {*gains, *sweeps, *ALWAYS}


def test_a_new_weight_of_the_gain_study_designs_its_gains(tree: Path) -> None:
    with edited(tree, (SMOKE, "weight: [100.0]", "weight: [100.0, 300.0]")):
        assert to_run(tree) == {"gains", "gain_sweep_grid", "stability", *ALWAYS}


def test_the_regulator_runs_everything(tree: Path) -> None:
    with edited(tree, (SMOKE, "gain_study:", "control: {weight: 500.0}\ngain_study:")):
        assert to_run(tree) == {"gains", "stability", *EVERY_RUN, *ALWAYS}


@pytest.mark.parametrize(
    ("modules", "jobs"),
    [
        (["study/figures.py"], {"figures"}),
        (
            ["learning/ddpg.py", "runs/gain_study.py"],
            {*LEARNED, "gain_study", *GAIN_SWEEPS, *ALWAYS},
        ),
        # Jobs of learned policies measure the runs that they do not log.
        (["study/metrics.py"], {j for j in LEARNED if "train" not in j} | MEASURES | ALWAYS),
        (["policies/index_rules.py"], {"gains", "kernels", "stability", *EVERY_RUN, *ALWAYS}),
    ],
)
def test_code_runs_its_dependents(tree: Path, modules: list[str], jobs: set[str]) -> None:
    line = "from __future__ import annotations\n"
    new = (line, f"{line}\nNEW = 1\n")  # the workflow itself imports some of them
    with edited(tree, *((f"src/hiersched/{module}", *new) for module in modules)):
        assert to_run(tree) == jobs


def test_a_missing_log_is_made_again(tree: Path) -> None:
    log = tree / "results/smoke/eval/pf/seed101.mcap"
    content, stat = log.read_bytes(), log.stat()
    log.unlink()
    try:
        assert to_run(tree) == {"evaluate_classical", "measure_classical", "bound", *ALWAYS}
    finally:
        log.write_bytes(content)
        os.utime(log, ns=(stat.st_atime_ns, stat.st_mtime_ns))
