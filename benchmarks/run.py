"""All benchmarks, one after another, in one table: `make bench`, or `make bench-short`.

python benchmarks/run.py [--short]

The short form takes the same way with less work: it says whether everything still runs, and
nothing about speed.
"""

from __future__ import annotations

import platform

import common  # first: it sets the number of threads before NumPy loads

# isort: split
import bench_env
import bench_gains
import bench_learning
import bench_log
import bench_slots
import numba
import numpy as np

BENCHES = (bench_slots, bench_env, bench_log, bench_gains, bench_learning)


def run(short: bool) -> list[common.Figure]:
    """All figures; each benchmark says when it is done."""
    print(
        f"Python {platform.python_version()}, NumPy {np.__version__}, Numba {numba.__version__}, "
        f"{numba.config.CPU_NAME or platform.machine()}"  # type: ignore[attr-defined]
    )
    figures = []
    for bench in BENCHES:
        figures += bench.run(short)
        print(f"{bench.__name__}: done", flush=True)
    return figures


if __name__ == "__main__":
    common.main(run, __doc__)
