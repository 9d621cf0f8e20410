"""All benchmarks, one after another, and their main figures in one table: `make bench`.

python benchmarks/run.py
"""

from __future__ import annotations

import os
import platform

# Before NumPy loads.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import bench_gains  # noqa: E402
import bench_learning  # noqa: E402
import bench_log  # noqa: E402
import bench_slots  # noqa: E402
import numba  # noqa: E402
import numpy as np  # noqa: E402
from tabulate import tabulate  # noqa: E402

LOG_GOALS = {
    ("write", "zstd"): "60,000 slots/s ",
    ("write", "none"): "150,000 slots/s ",
    ("read", "zstd"): "80,000 slots/s ",
}


def main() -> None:
    print(
        f"Python {platform.python_version()}, NumPy {np.__version__}, Numba {numba.__version__}, "
        f"{numba.config.CPU_NAME or platform.machine()}\n"  # type: ignore[attr-defined]
    )
    slots = bench_slots.run()
    print()
    log = bench_log.run()
    print()
    gains = bench_gains.run()
    print()
    learning = bench_learning.run()
    rows = [(name, f"{cpu:,.0f} slots/s", "") for name, (cpu, _) in slots.items()]
    goals = {
        "pf, batch of 64, 200 slots": "200,000 slots/s",
        "pf, one world, 200 slots a call": "100,000 slots/s",
        bench_slots.FLOOR: "(the trial kernel's: 1,130,000 slots/s)",
    }
    rows = [(name, speed, goals.get(name, "")) for name, speed, _ in rows]
    for packing in ("zstd", "none"):
        for what in ("write", "read"):
            ratio = log[f"{what} {packing}"] / log[f"stock {what} {packing}"]
            speed = f"{log[f'{what} {packing}']:,.0f} slots/s"
            goal = LOG_GOALS.get((what, packing), "")
            rows.append(
                (f"log, {what}, {packing}", speed, f"{goal}({ratio:.1f} x the stock {what} speed)")
            )
    for policy in ("pf", "ddpg", "all policies"):
        share = f"{100 * log[f'share {policy}']:.0f} %"
        rows.append((f"logging's share of an evaluation of {policy}", share, "33 %"))
    rows.append(("gain table, design", f"{gains['design']:.2f} s", "15 s"))
    rows.append(("gain table, from the cache", f"{gains['from the cache'] * 1e3:.1f} ms", ""))
    rows.append(("gain table, switching report", f"{gains['switching']:.2f} s", "60 s"))
    for name, (speed, minutes) in learning.items():
        goal = bench_learning.GOALS.get(name.split(",")[0], "")
        rows.append(
            (f"learning, {name}", f"{speed:,.0f} slots/s", f"{goal}({minutes:.1f} min in all)")
        )
    rows.append(("gain, look-up", f"{gains['look-up'] * 1e9:.0f} ns", "1000 ns"))
    print()
    print(tabulate(rows, headers=("on one core, CPU time", "measured", "goal (or compared)"),
                   disable_numparse=True, colalign=("left", "right", "left")))  # fmt: skip


if __name__ == "__main__":
    main()
