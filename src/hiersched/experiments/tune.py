"""Chooses the knob of every family of a cell, in design worlds that report nothing.

Every rule has a knob by which it favours URLLC against eMBB users, so rules compare only where eMBB
users get as much. A knob keeps the limit where the eMBB throughput is the share
`task_study.embb_share` or more of that of drift plus penalty at knob 1, in the same worlds. Where a
cell bounds lateness too (`bound_late`), the share of late eMBB packets may exceed that of drift
plus penalty by `task_study.embb_late_excess` at most: where waiting set-points are superseded URLLC
users need less than is there, and throughput binds nothing.
Of the knobs that keep the limit the one with the least mean
logarithm of the tracking error's root mean square is taken: the last before the limit where more
favour lowers the error, else the best one inside the range, which is widened while the best lies at
its end.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hiersched.core.faults import InputError
from hiersched.core.files import write_bytes
from hiersched.experiments import files
from hiersched.experiments.gains import design_of, load_gains
from hiersched.experiments.logging import RunLabel
from hiersched.experiments.points import (
    REFERENCE,
    TASK,
    Experiment,
    Point,
    cell_of,
    experiments,
    task_families,
    with_knob,
    with_rules,
)
from hiersched.experiments.run import Measure, slots_of
from hiersched.experiments.worlds import WorldRun, seed_worlds
from hiersched.policies.find import find_policy
from hiersched.policies.registry import Rule
from hiersched.scenario import Scenario
from hiersched.simulator import Simulator

DESIGN = "task_design"
"""Purpose of the design worlds: others than those of any stage, whatever their seeds."""
GRID_RATIO = 4.0
"""Greatest ratio of neighbouring knobs that are tried at first."""
PRECISION = 1.1
"""Ratio of the chosen knob and its neighbours at which the search ends."""
WIDENINGS = 3
"""By how many steps of `GRID_RATIO` either end of a range is widened at most."""

_AVERAGED = ("embb_mbps", "embb_late_share")


@dataclass(frozen=True, kw_only=True)
class Tried:
    """What a knob came to in the design worlds."""

    knob: float | None
    embb_share: float  # throughput over the reference's
    embb_late_share: float  # mean over worlds
    tracking_rms_cm: float  # geometric mean over worlds
    excess: float  # by how much the shares of throughput and lateness miss their limits, in sum

    @property
    def keeps_limit(self) -> bool:
        """Whether it misses none."""
        return self.excess == 0.0

    @property
    def order(self) -> tuple[bool, float, float]:
        """What is least for the best knob: without one that keeps the limit, the nearest to it.

        Of equal ones it is the one next to 1.
        """
        first = self.tracking_rms_cm if self.keeps_limit else self.excess
        return not self.keeps_limit, first, abs(math.log(self.knob or 1.0))


@dataclass(frozen=True, kw_only=True)
class Choice:
    """The knob of a family, and all that were tried, in their order.

    `edge` is the end of the range at which the best one lies after all widening: ``least``,
    ``greatest``, or empty.
    """

    best: Tried
    edge: str
    tried: tuple[Tried, ...]


class TuningError(InputError, ValueError):
    """A file of knobs that is not what `tune` writes."""


def choose_knob(evaluate: Callable[[float], Tried], least: float, greatest: float) -> Choice:
    """Search the knob of `Tried.order`'s least value.

    A grid over the range comes first. While the best knob is at an end of what was tried, the range
    is widened there. Then the gaps beside the best knob are halved, in ratios, until they are
    small: that is a bisection on the limit where the best knob is the last that keeps it.
    """
    count = math.ceil(math.log(greatest / least) / math.log(GRID_RATIO) - 1e-9) + 1
    tried = {float(k): evaluate(float(k)) for k in np.geomspace(least, greatest, count)}
    widest = least / GRID_RATIO**WIDENINGS, greatest * GRID_RATIO**WIDENINGS
    while True:
        knobs = sorted(tried)
        place = min(range(len(knobs)), key=lambda k: tried[knobs[k]].order)
        best = knobs[place]
        ends = {0: 1.0 / GRID_RATIO, len(knobs) - 1: GRID_RATIO}
        wider = best * ends.get(place, math.inf)
        if widest[0] * (1.0 - 1e-9) <= wider <= widest[1] * (1.0 + 1e-9):
            new = [wider]
        else:
            new = [math.sqrt(best * knob) for knob in _gaps(tried, knobs, place)]
        if not new:
            edge = {0: "least", len(knobs) - 1: "greatest"}.get(place, "")
            return Choice(best=tried[best], edge=edge, tried=tuple(tried[k] for k in knobs))
        tried |= {knob: evaluate(knob) for knob in new}


def _gaps(tried: Mapping[float, Tried], knobs: Sequence[float], place: int) -> list[float]:
    """Return the neighbours of the best knob between which and it a better one may lie.

    On the far side of a limit there is none where the error falls all the way up to it.
    """
    found = []
    for step in (-1, 1):
        ahead, back = place + step, place - step
        if not 0 <= ahead < len(knobs) or _ratio(knobs[ahead], knobs[place]) <= PRECISION:
            continue
        at_limit = 0 <= back < len(knobs) and not tried[knobs[back]].keeps_limit
        beyond = place + 2 * step
        falls = 0 <= beyond < len(knobs) and (
            tried[knobs[beyond]].order > tried[knobs[ahead]].order > tried[knobs[place]].order
        )
        if not (at_limit and falls):
            found.append(knobs[ahead])
    return found


def _ratio(a: float, b: float) -> float:
    return max(a / b, b / a)


def tune_cell(scenario: Scenario, results: Path, cell: str, measure: Measure) -> None:
    """Choose the knobs of all families of a cell and write them, with every knob tried.

    `measure` gives ``tracking_rms_cm``, ``embb_mbps`` and ``embb_late_share`` of a run.
    """
    study = scenario.task_study
    experiment = experiments(scenario)[f"{TASK}_{cell}"]
    base = experiment.points[0].scenario
    num_slots, warmup_slots = experiment.num_slots(base)
    _, gains = load_gains(results / files.gain_file(design_of(scenario, base)), base)
    keys = seed_worlds(DESIGN, study.design_seeds)
    simulator = Simulator(base, gains, keys, num_slots)
    record = simulator.new_record(num_slots)

    def run(rule: Rule) -> dict[str, Any]:
        simulator.reset(keys)
        simulator.run(rule, record=record)
        rows = []
        for place, seed in enumerate(study.design_seeds):
            label = RunLabel(stage=DESIGN, policy=rule.model, seed=seed)
            fields = record.environment(place)
            metadata = {"warmup_slots": str(warmup_slots)}
            own = WorldRun(seed=seed, fields=fields, metadata=metadata)
            rows.append(measure(slots_of(base, label, own), base))
        means = {name: float(np.mean([row[name] for row in rows])) for name in _AVERAGED}
        logs = [math.log(row["tracking_rms_cm"]) for row in rows]
        return {**means, "tracking_rms_cm": math.exp(float(np.mean(logs)))}

    reference = find_policy(scenario, REFERENCE)
    assert isinstance(reference, Rule)
    found = run(reference)
    bounded = study.cells[cell].bound_late
    most_late = found["embb_late_share"] + study.embb_late_excess if bounded else None

    def tried(rule: Rule, knob: float | None) -> Tried:
        own = run(rule if knob is None else with_knob(rule, knob))
        share, late = own["embb_mbps"] / found["embb_mbps"], own["embb_late_share"]
        excess = max(0.0, study.embb_share - share)
        if most_late is not None:
            excess += max(0.0, late - most_late)
        return Tried(
            knob=knob,
            embb_share=share,
            embb_late_share=late,
            tracking_rms_cm=own["tracking_rms_cm"],
            excess=excess,
        )

    families = {}
    for name, family in task_families(scenario, cell).items():
        rule = family.policy
        if family.range is None:
            one = tried(rule, None)
            choice = Choice(best=one, edge="", tried=(one,))
        else:
            choice = choose_knob(lambda knob, rule=rule: tried(rule, knob), *family.range)  # type: ignore[misc]
        families[name] = {"key": rule.knob, **_written(choice.best), "edge": choice.edge} | {
            "tried": [_written(one) for one in choice.tried]
        }
        print(f"{cell} {name}: {rule.knob} = {choice.best.knob}", flush=True)
    document = {
        "cell": cell,
        "worlds": {"purpose": DESIGN, "seeds": study.design_seeds, "slots": num_slots},
        "limits": {"embb_share": study.embb_share, "embb_late_share": most_late},
        "reference": {"policy": REFERENCE, **found},
        "families": families,
    }
    text = json.dumps(document, indent=1, allow_nan=False)
    write_bytes(results / files.tuning_file(cell), (text + "\n").encode())


def _written(one: Tried) -> dict[str, Any]:
    return {**asdict(one), "keeps_limit": one.keeps_limit}


def read_tuning(path: Path) -> dict[str, Any]:
    """Read what `tune_cell` wrote; TuningError if it is something else."""
    try:
        document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        for name, family in document["families"].items():
            knob = family["knob"]
            if knob is not None and not (isinstance(knob, float) and 0.0 < knob < math.inf):
                raise TuningError(f"{path}: {name}: knob = {knob!r}: must be a positive number")
    except TuningError:
        raise
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise TuningError(f"{path}: no knobs of a cell: {error}") from error
    return document


def tuned_scenario(results: Path, experiment: Experiment, point: Point, policy: str) -> Scenario:
    """Return the scenario of a run of a cell's policy: a family's rule has its tuned knob in it.

    It holds no other family, so that a log says which rule ran and can be run again.
    """
    others = {
        name: rule
        for name, rule in point.scenario.policies.items()
        if name == policy or name not in point.tuned
    }
    variant = replace(point.scenario, policies=others)
    rule = variant.policies.get(policy)
    if policy not in point.tuned or not isinstance(rule, Rule) or rule.knob is None:
        return variant
    path = results / files.tuning_file(cell_of(experiment))
    families = read_tuning(path)["families"]
    if policy not in families:
        raise TuningError(f"{path}: no knob of {policy}")
    return with_rules(variant, {policy: with_knob(rule, families[policy]["knob"])})
