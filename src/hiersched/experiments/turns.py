"""Runs of the workflow in a folder take turns, also after one that was killed.

Snakemake locks a folder by files that outlive a killed process, and its jobs outlive it too. Here a
run and its jobs hold locks of the system, which end with the process that holds them.
"""

from __future__ import annotations

import fcntl
import os
import platform
import sys
import threading
import time
from pathlib import Path
from typing import IO

_RUN, _JOBS = "hiersched.run", "hiersched.jobs"
_VARIABLE = "HIERSCHED_RUN"
_held: list[IO[str]] = []
"""Open files: their locks are held until the process ends."""


def begin_run(folder: Path) -> bool:
    """Take the turn of this process as the run in a folder, Snakemake's own ``.snakemake``.

    If no other run is alive, its jobs are waited for, which end a second after it, and the locks
    that Snakemake has left are removed. Returns whether it is this run's turn: if not, Snakemake
    says who has it.
    """
    folder.mkdir(exist_ok=True)
    turn = open(folder / _RUN, "a")
    _held.append(turn)
    try:
        fcntl.flock(turn, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    with open(folder / _JOBS, "a") as jobs:
        try:
            fcntl.flock(jobs, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            print("waiting for jobs of a run that was killed", file=sys.stderr, flush=True)
            fcntl.flock(jobs, fcntl.LOCK_EX)
    for lock in (folder / "locks").glob("*.lock"):
        lock.unlink(missing_ok=True)
    os.environ[_VARIABLE] = f"{os.getpid()} {platform.node()}"
    return True


def join_run(folder: Path) -> None:
    """Take part in the run that started this process as a job, if one did: end when it does."""
    pid, _, node = os.environ.get(_VARIABLE, "").partition(" ")
    if not pid or node != platform.node():
        return  # no run, or one on another machine
    jobs = open(folder / _JOBS, "a")
    _held.append(jobs)
    fcntl.flock(jobs, fcntl.LOCK_SH)
    _end_without(int(pid))
    threading.Thread(target=_watch, args=(int(pid),), daemon=True).start()


def _watch(pid: int) -> None:
    while True:
        time.sleep(1.0)
        _end_without(pid)


def _end_without(pid: int) -> None:
    """End this process, whatever it does, if another one is not alive."""
    try:
        os.kill(pid, 0)
    except OSError:
        os._exit(1)
