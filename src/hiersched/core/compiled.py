"""How the kernels are compiled, and where the machine code is kept."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numba
from numba import njit
from numba.core import event
from numba.core.registry import CPUDispatcher

PACKAGE = Path(__file__).resolve().parents[1]
_SOURCES = ("core", "allocation", "models", "policies", "simulator")


def _cache_folder() -> Path:
    """Folder of the machine code, one for each state of the kernels' sources.

    Numba looks at the file of a function alone: a change in a function that it calls from another
    file would go unnoticed. The hash of all the kernels' sources in the folder's name takes care of
    that. Sources outside the package are not part of it: `core.seam` takes care of theirs.
    """
    digest = hashlib.sha256()
    for name in _SOURCES:
        for file in sorted((PACKAGE / name).rglob("*.py")):
            digest.update(file.read_bytes())
    home = PACKAGE / "__pycache__"
    if not os.access(home if home.exists() else PACKAGE, os.W_OK):
        home = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "hiersched"
    return home / f"kernels-{digest.hexdigest()[:16]}"


if not os.environ.get("NUMBA_CACHE_DIR"):
    numba.config.CACHE_DIR = str(_cache_folder())

kernel = partial(njit, error_model="numpy", _nrt=False, cache=True, no_cfunc_wrapper=True)
"""Decorator of the kernels, compiled once a machine.

No reference counting: the kernels allocate nothing, and counting every view of an array took a
third of the slot loop's time. Division by zero is that of IEEE 754. No entry for C callbacks, which
nobody uses and whose compilation takes a tenth of the whole.
"""


class _InnerKernel(CPUDispatcher):
    """A kernel without an entry for Python: a call from there would end the process."""

    __slots__ = ()

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        raise TypeError(f"{self.py_func.__qualname__} is called by other kernels only")


def inner_kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a kernel that other kernels call: it has no entry for Python, which costs time."""

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = kernel(no_cpython_wrapper=True, **options)(function)
        if isinstance(dispatcher, CPUDispatcher):  # else NUMBA_DISABLE_JIT is set
            dispatcher.__class__ = _InnerKernel
        return dispatcher

    return decorate


class _Notice(event.Listener):
    """Says once a process that kernels are being compiled, which takes a while."""

    def __init__(self) -> None:
        self._said = False

    def on_start(self, event: Any) -> None:
        """Numba begins to compile: not told where the cache has the kernel."""
        dispatcher = event.data["dispatcher"]
        if self._said or not dispatcher.targetoptions.get("no_cfunc_wrapper"):
            return
        self._said = True
        print(
            "hiersched: compiling kernels, once per machine and version (up to half a minute)",
            file=sys.stderr,
            flush=True,
        )

    def on_end(self, event: Any) -> None:
        """Nothing more to say."""


event.register("numba:compile", _Notice())
