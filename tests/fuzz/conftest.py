"""Runs hostile input, each in a process of its own, and says what became of it."""

from __future__ import annotations

import contextlib
import io
import multiprocessing
import os
import resource
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hiersched.cli import main
from hiersched.core.randomness import world_keys
from hiersched.scenario import load_scenario
from hiersched.simulator import Simulator
from hiersched.simulator.loop_gains import nominal_gains

LIMIT_S = 10.0
NUM_SLOTS = 50
MEMORY_BYTES = 6 << 30
"""Beyond what the process has when it starts: more than any input here may take."""


@dataclass
class Outcome:
    """What a call on one input did."""

    status: int | str  # what the call returned, or "crashed", "stuck", "raised"
    printed: str = ""  # stdout and stderr
    seconds: float = 0.0


def _child(pipe: Any, call: Callable[[Any], int], item: Any) -> None:
    used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    printed = io.StringIO()
    status: int | str
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
            status = call(item)
    except SystemExit as end:
        status = int(end.code or 0)
    except BaseException:  # the finding
        status = "raised"
        printed.write(traceback.format_exc())
    pipe.send((status, printed.getvalue()))
    pipe.close()
    os._exit(0)


def _outcome(call: Callable[[Any], int], item: Any) -> Outcome:
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    began = time.perf_counter()
    process = context.Process(target=_child, args=(theirs, call, item))
    process.start()
    theirs.close()
    found: tuple[int | str, str] = ("stuck", "")
    if ours.poll(LIMIT_S):
        try:
            found = ours.recv()
        except EOFError:
            process.join()
            found = ("crashed", f"exit code {process.exitcode}")
    seconds = time.perf_counter() - began
    process.kill()
    process.join()
    return Outcome(*found, seconds)


def _run_slots(path: Path) -> int:
    """Check a scenario as the command does; run an accepted one for some slots."""
    status = main(["scenario", "check", str(path)])
    if status:
        return status
    scenario = load_scenario(path)
    simulator = Simulator(scenario, nominal_gains(scenario), world_keys("fuzz", 1, 1), NUM_SLOTS)
    for name, values in simulator.run("pf")._asdict().items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise AssertionError(f"{name} is not finite")
    return 0


@pytest.fixture(scope="session")
def refused_or_run() -> Callable[[Sequence[Path]], int]:
    """Check scenarios, run those that are accepted, each in a fork; return how many those are.

    No traceback, nothing that takes long, no control characters, no number that is not finite.
    """

    def judge(paths: Sequence[Path]) -> int:
        smoke = load_scenario("smoke")  # compiled once, before the forks
        Simulator(smoke, nominal_gains(smoke), world_keys("fuzz", 1, 1), 1).run("pf")
        faults, accepted = [], 0
        for path in paths:
            outcome = _outcome(_run_slots, path)
            controls = [c for c in outcome.printed if not c.isprintable() and c not in "\n\t"]
            is_one_message = outcome.status in (0, 2) and "Traceback" not in outcome.printed
            if not is_one_message or controls or outcome.seconds > LIMIT_S:
                printed = outcome.printed[-600:]
                faults.append(f"{path} {outcome.status} {outcome.seconds:.1f} s {printed!r}")
            accepted += outcome.status == 0
        assert not faults, "\n".join(faults)
        return accepted

    return judge
