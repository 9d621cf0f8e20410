"""What the tests of the workflow share: Snakemake, and a small study that has been run."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

Snakemake = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def snakemake(project_root: Path) -> Snakemake:
    """Run Snakemake on scenarios in a folder, with the package of a source folder."""

    def run(
        folder: Path, *words: str, scenario: str, source: Path = project_root / "src"
    ) -> subprocess.CompletedProcess[str]:
        workflow = source / "hiersched/workflow/Snakefile"
        command = ["-m", "snakemake", "--snakefile", str(workflow), *words]
        return subprocess.run(
            [sys.executable, *command, "--config", f"scenarios=[{scenario}]"],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(source)},
            capture_output=True,
            text=True,
            check=False,
        )

    return run


@pytest.fixture(scope="session")
def planned() -> Callable[[subprocess.CompletedProcess[str]], set[str]]:
    """Return the jobs of a dry run, but for those that put everything together."""

    def jobs(done: subprocess.CompletedProcess[str]) -> set[str]:
        assert done.returncode == 0, done.stdout + done.stderr
        text = done.stdout + done.stderr
        if "Nothing to be done" in text:
            return set()
        table = text.split("Job stats:")[1].split("total")[0]
        return set(re.findall(r"^([\w.]+) +\d+$", table, re.MULTILINE)) - {"all"}

    return jobs


@pytest.fixture(scope="session")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a study of classical schedulers and a plug-in: ``mine.yaml``."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "mine.yaml").write_text(MINE, encoding="utf-8")
    (folder / "my_channel.py").write_text(PLUGIN, encoding="utf-8")
    return folder


@pytest.fixture(scope="session")
def finished(study: Path, snakemake: Snakemake) -> Path:
    """The folder of the results of the study: its runs, measures and two tables."""
    shown = ["tables/sweeps.csv", "tables/mine.csv"]
    wanted = [f"results/mine/{name}" for name in shown]
    done = snakemake(study, "--cores", "1", *wanted, scenario="mine.yaml")
    assert done.returncode == 0, done.stdout + done.stderr
    return study / "results/mine"


MINE = """
plugins: [my_channel.py]
users: {num_urllc: 2, num_embb: 2}
radio: {bandwidth_hz: 2.0e+6, num_prb: 5, path_loss: {model: my_power_law}}
traffic: {urllc_offered_mbps: [20.0, 30.0]}
control: {max_delay_s: 0.04}
evaluate: {seeds: [11, 12], warmup_s: 0.0, duration_s: 1.0, full_logs: 0, policies: [pf, edf]}
sweeps:
  seeds: [21, 22]
  warmup_s: 0.0
  duration_s: 1.0
  policies: [pf, edf]
  axes:
    rayleigh_scale: null
    sampling_s: null
    reference: null
    load: null
    load_ratio: null
    service_coefficient_mbps: null
    traffic.packet_bits: [1.0e+4, 2.0e+4]
    loss: {vary: {radio.path_loss: [{model: none}, {model: my_power_law, exponent: 3.0}]}}
    both: {vary: {radio.path_loss.exponent: [2.0, 3.0], users.num_embb: [1, 2]}, policies: [pf]}
generalise: {cells: []}
gain_study: {methods: []}
bound: {slots_per_log: 0}
"""

PLUGIN = """
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd

from hiersched.models.model import PATH_LOSS, PathLoss
from hiersched.study.registry import figure, table


@PATH_LOSS.model
@dataclass(frozen=True, kw_only=True)
class MyPowerLaw(PathLoss):
    model: Literal["my_power_law"]
    exponent: float = 1.0

    def gain(self, key, num_users):
        return np.full(num_users, 10.0 ** -self.exponent)

    def least_gain_db(self):
        return -10.0 * self.exponent


@table("mine", title="Mine.", reads=("runs",))
def my_table(study):
    return study.runs.groupby("policy", as_index=False)["urllc_rate_mbps"].mean()


@figure("mine", title="Mine.", reads=("runs",))
def my_figure(study):
    from matplotlib.figure import Figure

    drawn = Figure()
    drawn.subplots().plot(study.evaluation["urllc_rate_mbps"])
    return drawn
"""
