"""How the kernels are compiled, and where the machine code is kept."""

from __future__ import annotations

import hashlib
import os
from functools import partial
from pathlib import Path

import numba
from numba import njit

_PACKAGE = Path(__file__).parent
_SOURCES = ("numerics.py", "randomness.py", "compiled.py", "radio", "network", "robot", "simulator")


def _cache_folder() -> Path:
    """Folder of the machine code, one for each state of the kernels' sources.

    Numba looks at the file of a function alone: a change in a function that it calls from another
    file would go unnoticed. The hash of all the kernels' sources in the folder's name takes care of
    that.
    """
    digest = hashlib.sha256()
    for name in _SOURCES:
        path = _PACKAGE / name
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(file.read_bytes())
    home = _PACKAGE / "__pycache__"
    if not os.access(home if home.exists() else _PACKAGE, os.W_OK):
        home = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "hiersched"
    return home / f"kernels-{digest.hexdigest()[:16]}"


if not os.environ.get("NUMBA_CACHE_DIR"):
    numba.config.CACHE_DIR = str(_cache_folder())  # type: ignore[attr-defined]

kernel = partial(njit, error_model="numpy", _nrt=False, cache=True)
"""Decorator of the kernels, compiled once a machine.

No reference counting: the kernels allocate nothing, and counting every view of an array took a
third of the slot loop's time. Division by zero is that of IEEE 754.
"""
