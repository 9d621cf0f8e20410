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

_RUN, _JOBS, _ELSEWHERE = "hiersched.run", "hiersched.jobs", "hiersched.elsewhere"
_VARIABLE = "HIERSCHED_RUN"
_held: list[IO[str]] = []
"""Open files: their locks are held until the process ends."""


def begin_run(folder: Path) -> bool:
    """Take the turn of this process as the run in a folder, Snakemake's own ``.snakemake``.

    If no other run is alive, its jobs are waited for, which end a second after it, and the locks
    that Snakemake has left are removed; not if it had jobs on other machines, which may be alive:
    ``snakemake --unlock`` is for whoever knows that they are not. Returns whether it is this run's
    turn: if not, Snakemake says who has it.
    """
    os.environ[_VARIABLE] = f"{os.getpid()} {platform.node()}"
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
    locks, elsewhere = list((folder / "locks").glob("*.lock")), folder / _ELSEWHERE
    if elsewhere.exists() and locks:  # jobs on other machines may be alive: who knows, unlocks
        return True
    elsewhere.unlink(missing_ok=True)
    for lock in locks:
        lock.unlink(missing_ok=True)
    return True


def run_node() -> str:
    """Name of the machine that the run was started on, of which this process may be a job."""
    return os.environ.get(_VARIABLE, "").partition(" ")[2] or platform.node()


def join_run(folder: Path) -> None:
    """Take part in the run that started this process as a job, if one did: end when it does."""
    pid, _, node = os.environ.get(_VARIABLE, "").partition(" ")
    if not pid:
        return
    if node != platform.node():
        (folder / _ELSEWHERE).touch()
        return
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
