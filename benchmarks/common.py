"""What the benchmarks share: the scenario, CPU time, and a table that says what figures mean.

Figures are compared with something that is measured in the same run, because machines differ and
other work slows both alike. A limit is a bound on that ratio: half or twice of what one core of a
two-core machine gave in November 2026. Nothing fails by a limit.
"""

from __future__ import annotations

import argparse
import logging
import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

# Before NumPy loads: one thread, as in every other job of this project.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402
from tabulate import tabulate  # noqa: E402

from hiersched.learning.networks import learner_network  # noqa: E402
from hiersched.policies.learned import num_parameters  # noqa: E402
from hiersched.policies.trained import TrainedPolicy  # noqa: E402
from hiersched.scenario import Scenario, load_scenario  # noqa: E402

CONFIG = Path(__file__).resolve().parents[1] / "src/hiersched/config"
HEADERS = ("one core, CPU time", "measured", "compared with, in this run", "ratio", "limit", "kept")


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One measured figure.

    Attributes
    ----------
    name
        What was done.
    value, unit
        What it took.
    reference, ratio
        What it is compared with, and the figure as a multiple of that.
    at_least, at_most
        Limit of the ratio; None where there is none.
    """

    name: str
    value: float
    unit: str
    reference: str = ""
    ratio: float | None = None
    at_least: float | None = None
    at_most: float | None = None

    def row(self) -> tuple[str, ...]:
        """Cells of the table."""
        limit, kept = "", ""
        if self.ratio is not None:
            if self.at_least is not None:
                limit, kept = f"at least {self.at_least:g}", _word(self.ratio >= self.at_least)
            if self.at_most is not None:
                limit, kept = f"at most {self.at_most:g}", _word(self.ratio <= self.at_most)
        ratio = "" if self.ratio is None else f"{self.ratio:.3g}"
        measured = f"{_number(self.value)} {self.unit}"
        return self.name, measured, self.reference, ratio, limit, kept


def _word(kept: bool) -> str:
    return "yes" if kept else "NO"


def _number(value: float) -> str:
    return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"


def table(figures: Sequence[Figure], *, short: bool) -> str:
    """All figures; a short run leaves out the limits, which are for the whole work."""
    columns = slice(None, -2 if short else None)
    return tabulate(
        [figure.row()[columns] for figure in figures],
        headers=HEADERS[columns],
        disable_numparse=True,
        colalign=("left", "right", "left", "right", "left", "left")[columns],
    )


def speed_figures(
    speeds: Mapping[str, Sequence[float]], compared: Mapping[str, tuple[str, float | None]]
) -> list[Figure]:
    """Medians of slots per CPU-second: one without a reference first, then those compared.

    `speeds`: name -> rounds; `compared`: name -> the name of its reference, and the least ratio.
    """
    medians = {name: statistics.median(rounds) for name, rounds in speeds.items()}
    alone = [
        Figure(name=name, value=median, unit="slots/s")
        for name, median in medians.items()
        if name not in compared
    ]
    return alone + [
        Figure(
            name=name,
            value=medians[name],
            unit="slots/s",
            reference=reference,
            ratio=medians[name] / medians[reference],
            at_least=least,
        )
        for name, (reference, least) in compared.items()
        if name in medians
    ]


def cpu_seconds(work: Callable[[], object], rounds: int = 1) -> float:
    """Median CPU-seconds of a call."""
    seconds = []
    for _ in range(rounds):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return statistics.median(seconds)


def paper() -> Scenario:
    """The scenario `paper`."""
    return load_scenario(CONFIG / "scenarios/paper.yaml", defaults=CONFIG / "defaults.yaml")


def some_policy(scenario: Scenario, learner: str) -> TrainedPolicy:
    """A learner's policy with small random weights: it takes as long as a trained one."""
    learning, users = scenario.learned[learner], scenario.users
    network = learner_network(learning, users)
    shape = (2, num_parameters(network.actor.sizes))
    return TrainedPolicy(
        parameters=np.random.default_rng(0).normal(scale=0.05, size=shape).astype(np.float32),
        network=learning.network,
        hidden=learning.hidden,
        rule=learning.start,
        weighs=learning.weighs,
        observe_robots=learning.observe_robots,
        observe_demand=learning.observe_demand,
        num_embb=users.num_embb,
        weight_exponent=learning.weight_exponent,
        multipliers=np.zeros(users.num_urllc),
        seed=0,
        scenario_sha256="0" * 64,
    )


def main(run: Callable[[bool], list[Figure]], about: str) -> None:
    """Run one benchmark from the command line."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--short", action="store_true", help="less of everything: does it run?")
    short = parser.parse_args().short
    logging.getLogger("hiersched").setLevel(logging.ERROR)
    print(table(run(short), short=short))
