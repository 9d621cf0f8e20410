"""How the loops of a study grow over the delays that they had: table ``growth`` of its measures.

A row is a point of an experiment under a policy (of the gain study a gain), and there a `span` of
its windows, ``violated`` or ``calm``: `loop_growth` and the word for it, `loop`. Of an evaluation
and of the gain study it is that of the loop as it runs; of the rest that of the loop without a hold
of its gains, whose chain has a tenth of the states. Of an evaluation the row has the `robot` that
is the worst without a hold, and its `nominal`, `followed` and `in_force` of `LoopGrowth`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from hiersched.control import GainSchedule
from hiersched.control.checks import FloatArray
from hiersched.control.second_moments import transition_counts
from hiersched.core.files import write_parquet
from hiersched.experiments import files
from hiersched.experiments.gains import design_of
from hiersched.experiments.points import Experiment, Point, experiments
from hiersched.experiments.run import gain_variant
from hiersched.scenario import Scenario
from hiersched.simulator.gain_source import read_gains
from hiersched.simulator.loop_growth import greatest_growth, worst_growth, worst_unheld
from hiersched.study.measure import chain_files

SPANS = "violated", "calm"
"""Windows of the gain study."""
LOCAL, UNKNOWN, SHRINKS, GROWS = "local", "not known", "shrinks", "grows"
"""What a loop may be called."""


def has_network_loop(scenario: Scenario) -> bool:
    """Whether all feedback crosses the network, so that its delays decide what the loop does."""
    return scenario.loop_kind == "network"


def write_growth(scenario: Scenario, results: Path) -> None:
    """Follow the loops of every point over its chains, and write the table."""
    of_run: dict[Any, pd.DataFrame] = {}
    for name in chain_files(scenario):
        chains = pd.read_parquet(results / name)
        if len(chains):
            by = ["experiment", "value", "gain" if "gain" in chains else "policy"]
            of_run |= dict(iter(chains.groupby(by)))
    schedules: dict[str, GainSchedule] = {}

    def schedule_of(variant: Scenario) -> GainSchedule:
        name = files.gain_file(design_of(scenario, variant))
        if name not in schedules:  # reading recomputes its certificates
            schedules[name] = read_gains(results / name, variant)
        return schedules[name]

    rows = []
    for experiment in experiments(scenario).values():
        for point, policy in experiment.runs(experiment.policies):
            own = of_run.get((experiment.name, point.value, policy))
            labels = {"experiment": experiment.name, "value": point.value, "policy": policy}
            rows += [
                {**labels, **row, "loop": loop_word(row["loop_growth"], point.scenario)}
                for row in _growths(schedule_of, experiment, point, policy, own)
            ]
    write_parquet(results / files.GROWTH, pd.DataFrame(rows))


def loop_word(growth: float, scenario: Scenario) -> str:
    """Say what a loop with some growth does, in a scenario."""
    if scenario.loop_kind == "local":
        return LOCAL
    if math.isnan(growth):
        return UNKNOWN
    return SHRINKS if growth < 1.0 else GROWS


def _growths(
    schedule_of: Callable[[Scenario], GainSchedule],
    experiment: Experiment,
    point: Point,
    policy: str,
    chains: pd.DataFrame | None,
) -> Iterator[dict[str, Any]]:
    """Yield the rows of a policy at a point: one, under forced delays one a span."""
    variant = point.scenario
    if variant.loop_kind == "local":
        yield {"span": "", "loop_growth": math.nan}
        return
    schedule = schedule_of(variant)
    if experiment.forced:
        # Delays of all robots are drawn alike: together they are one chain.
        variant = gain_variant(point, policy)  # type: ignore[arg-type]  # one of GAINS
        for span in SPANS:  # windows of one sample have no pair of samples
            own = pd.DataFrame() if chains is None else chains[chains["span"] == span]
            of_span = math.nan
            if len(own):
                of_span = greatest_growth(variant, schedule, counts_of(own))
            yield {"span": span, "loop_growth": of_span}
        return
    if chains is None:  # runs of one sample
        yield {"span": "", "loop_growth": math.nan}
        return
    counts = robot_counts(chains)
    if experiment.stage == "evaluate":
        robot, growth = worst_growth(variant, schedule, counts)
        yield {"span": "", "robot": robot, "loop_growth": growth.in_force, **growth._asdict()}
        return
    robot, unheld = worst_unheld(variant, schedule, counts)
    yield {"span": "", "robot": robot, "loop_growth": unheld}


def counts_of(chains: pd.DataFrame) -> FloatArray:
    """Return how often each delay followed another."""
    return transition_counts(*(chains[name] for name in ("delay_steps", "next_steps", "count")))


def robot_counts(chains: pd.DataFrame) -> list[FloatArray]:
    """Return how often each delay of a robot followed another, robot by robot."""
    return [counts_of(own) for _, own in chains.groupby("robot")]
