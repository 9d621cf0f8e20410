"""A run that was killed goes on by itself, and ends with the files of one that was not."""

from __future__ import annotations

import hashlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hiersched.log import log_digest

pytestmark = pytest.mark.nightly

KILLS = 16


def start(folder: Path, root: Path) -> subprocess.Popen[bytes]:
    snakefile = root / "src/hiersched/workflow/Snakefile"
    words = ["--snakefile", str(snakefile), "--cores", "2", "--config", "scenarios=[smoke]"]
    return subprocess.Popen(
        [sys.executable, "-m", "snakemake", *words],
        cwd=folder,
        env={**os.environ, "PYTHONHASHSEED": "0", "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=open(folder / "stderr.txt", "wb"),
        start_new_session=True,
    )


def contents(folder: Path) -> dict[str, str]:
    """Digest of every log, hash of every table, figure and verdict."""
    found = {}
    for path in sorted((folder / "results/smoke").rglob("*")):
        name = str(path.relative_to(folder))
        if path.suffix == ".mcap":
            found[name] = log_digest(path)
        elif path.suffix in (".csv", ".md", ".png", ".json") and "progress" not in name:
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def test_sixteen_kills_at_random_moments(tmp_path: Path, project_root: Path) -> None:
    """Of the run alone, whose jobs are left behind, and of the run and all its jobs."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for folder in (whole, killed):
        folder.mkdir()
    began = time.monotonic()
    assert start(whole, project_root).wait() == 0, (whole / "stderr.txt").read_text()[-3000:]
    seconds = time.monotonic() - began
    rng = random.Random(16)
    for number in range(KILLS):
        run = start(killed, project_root)
        try:
            run.wait(rng.uniform(0.02, 0.12) * seconds + 6.0)
            break
        except subprocess.TimeoutExpired:
            if number % 2:
                os.killpg(run.pid, signal.SIGKILL)
            else:
                run.kill()
            run.wait()
    assert number > KILLS // 2
    assert start(killed, project_root).wait() == 0, (killed / "stderr.txt").read_text()[-3000:]
    assert contents(killed) == contents(whole)
    assert len(contents(whole)) > 150
