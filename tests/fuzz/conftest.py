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
from typing import Any

import pytest

LIMIT_S = 10.0
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


@pytest.fixture(scope="session")
def run_each() -> Callable[[Callable[[Any], int], Sequence[Any]], list[Outcome]]:
    """Call a function on every item, each in a fork of this process; its outcomes in order."""
    return lambda call, items: [_outcome(call, item) for item in items]
