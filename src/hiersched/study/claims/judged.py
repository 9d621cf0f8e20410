"""The ten claims of the paper, each judged by the measures of a study.

The margins are read from the words of the claims and stay as they are whatever comes out:
"comparable" is within 10 %, "hardly" within 5 % over a whole axis for rates (10 % for queues, which
vary more), "far less" is less than half.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pandas as pd

from hiersched.experiments.points import BASELINE, STUDY_PLANTS
from hiersched.study.claims.conditions import by_coefficient, evaluated, swept, trained
from hiersched.study.claims.effects import (
    PAIRED,
    Sample,
    change_in_training,
    difference,
    doublings,
    ends,
    in_the_same_worlds,
    mean,
    ratio,
    slope,
    steps,
    tenths_of_dexterity,
)
from hiersched.study.claims.verdicts import Condition, Judged, Statement
from hiersched.study.registry import claim, has_gain_study, has_learners, varies
from hiersched.study.samples import resolution, sample_of
from hiersched.study.study import Study
from hiersched.study.tables.gains import runs_by_method
from hiersched.study.tables.policies import SCALE

SAMPLING, REFERENCE = "control.sampling_s", "robot.reference"
COMPARABLE = 0.10
HARDLY = 0.05
HARDLY_QUEUE = 0.10
FAR_LESS = 0.5


def percent(share: float) -> str:
    """Return a share as text in per cent."""
    return f"{100.0 * share:g} %"


def within(margin: float) -> dict[str, float]:
    """Return the range of ratios that differ from 1 by less than a margin."""
    return {"above": 1.0 - margin, "below": 1.0 + margin}


@claim(
    1,
    reference="Fig. 2",
    paper="the rewards of both agents converge",
    measured="Mean reward of the policies without noise in fixed worlds, at the start and "
    "during training, paired over seeds: it has risen, by more than that of actors that learn "
    f"nothing, and the last step is within {percent(COMPARABLE)} of the rise.",
    unswept="Training is not repeated along the sweeps.",
    reads=("episodes",),
    when=has_learners,
)
def rewards_converge(study: Study) -> Judged:
    """Judge noise-free checkpoints: the rise of the rewards, and the last step."""
    return _changes(study, "reward", "reward", "1", _last_step, above=0.0)


@claim(
    2,
    reference="Fig. 3",
    paper="the queues of both slices shrink over training",
    measured="Mean backlog per user under the policies without noise in fixed worlds, at the "
    "end of training minus at its start, paired over seeds, and beyond that of actors that "
    "learn nothing.",
    unswept="Training is not repeated along the sweeps.",
    reads=("episodes",),
    when=has_learners,
)
def queues_shrink(study: Study) -> Judged:
    """Judge noise-free checkpoints: the fall of the queues."""
    return _changes(study, "backlog_packets", "queue", "packets", below=0.0)


def _changes(
    study: Study,
    measure: str,
    name: str,
    unit: str,
    more: Callable[[Sample, str], list[Statement]] = lambda values, label: [],
    **claimed: float,
) -> Judged:
    """Judge how much a measure of both slices changes in training, and beyond the control's.

    `more` gives further statements from the measure at the checkpoints, shape (seeds, n).
    """

    def checkpoints(own: pd.DataFrame, control: pd.DataFrame | None) -> tuple[Statement, ...]:
        statements = []
        for part, label in PAIRED:
            values = steps(own, f"{part}_{measure}")
            change, what = values[:, -1] - values[:, 0], f"{label} {name}"
            statements.append(mean(change).statement(f"{what}, last − first", unit, **claimed))
            statements += more(values, what)
            if control is not None:
                idle = steps(control, f"{part}_{measure}")
                beyond = mean(change - (idle[:, -1] - idle[:, 0]))
                text = f"{what}, that − the same without learning"
                statements.append(beyond.statement(text, unit, **claimed))
        return tuple(statements)

    def noisy(training: pd.DataFrame, block: int) -> tuple[Statement, ...]:
        return tuple(
            change_in_training(training, f"{part}_{measure}", block).statement(
                f"{label} {name}, last fifth − first fifth", unit, **claimed
            )
            for part, label in PAIRED
        )

    return trained(study, checkpoints, noisy)


def _last_step(values: Sample, what: str) -> list[Statement]:
    """State that the step to the last checkpoint is small beside the whole rise."""
    rise, late = values[:, -1] - values[:, 0], values[:, -1] - values[:, -2]
    part = f"{percent(COMPARABLE)} of that"
    return [
        mean(late - COMPARABLE * rise).statement(f"{what}, last step − {part}", "1", below=0.0),
        mean(late + COMPARABLE * rise).statement(f"{what}, last step + {part}", "1", above=0.0),
    ]


@claim(
    3,
    reference="Fig. 4",
    paper="the distribution of eMBB rates lies right of that of URLLC rates",
    measured="Mean rate of eMBB users minus that of URLLC users, world by world: a "
    "distribution that lies right of another has the greater mean. The loads decide it: "
    "the sweep of their ratio says where.",
    reads=("runs",),
    when=has_learners,
)
def embb_rates_are_higher(study: Study) -> Judged:
    """Judge the difference of mean rates, world by world."""

    def measure(runs: pd.DataFrame, policy: str) -> tuple[Statement, ...]:
        own = runs[runs["policy"] == policy]
        embb, urllc = (sample_of(own, f"{part}_rate_mbps") for part in ("embb", "urllc"))
        apart = difference(embb, urllc)
        return (apart.statement("eMBB rate − URLLC rate", "Mbit/s", above=0.0),)

    return evaluated(study, measure, beside=True)


@claim(
    4,
    reference="Fig. 5a",
    paper="rates rise with the Rayleigh scale",
    measured="Least-squares slope of the mean rate against log₂ of the scale, world by world.",
    unswept="The scale is swept at one load.",
    reads=("runs",),
    when=varies(SCALE),
)
def rates_rise_with_scale(study: Study) -> Judged:
    """Judge the slope of the rates against the scale."""
    return _slopes_of_rates(study, SCALE, doublings, "doubling", above=0.0)


@claim(
    5,
    reference="Fig. 5b",
    paper="the eMBB queue rises slowly with the scale, the URLLC queue hardly moves",
    measured="Slope of the mean eMBB backlog against log₂ of the scale, and the ratio of URLLC "
    f"backlogs at its ends, within {percent(HARDLY_QUEUE)} of 1.",
    unswept="The scale is swept at one load.",
    reads=("runs",),
    when=varies(SCALE),
)
def queues_over_scale(study: Study) -> Judged:
    """Judge the slope of the eMBB queue, and the ratio of the URLLC queues."""

    def measure(along: pd.DataFrame, policy: str) -> tuple[Statement, ...]:
        rise = slope(along, policy, "embb_backlog_packets", doublings)
        low, high = ends(along, policy, "urllc_backlog_packets")
        name = "URLLC queue, greatest scale / least"
        return (
            rise.statement("eMBB queue per doubling", "packets", above=0.0),
            ratio(high, low).statement(name, "1", **within(HARDLY_QUEUE)),
        )

    return swept(study, SCALE, measure)


@claim(
    6,
    reference="Fig. 6",
    paper="rates hardly depend on the sampling interval",
    measured=f"Ratio of rates at the ends of the sweep, within {percent(HARDLY)} of 1. With a "
    "β of 1 Mbit/s it can hardly be otherwise: sampling reaches the network by β·DI alone.",
    unswept="The interval is swept at one load.",
    reads=("runs",),
    when=varies(SAMPLING),
)
def rates_over_sampling(study: Study) -> Judged:
    """Judge the ratio of the rates at the ends of the sampling interval."""

    def measure(along: pd.DataFrame, policy: str) -> tuple[Statement, ...]:
        statements = []
        for part, label in PAIRED:
            low, high = ends(along, policy, f"{part}_rate_mbps")
            name = f"{label} rate, longest interval / shortest"
            statements.append(ratio(high, low).statement(name, "1", **within(HARDLY)))
        return tuple(statements)

    base, others = swept(study, SAMPLING, measure)
    return Judged(base, others + by_coefficient(study, measure))


@claim(
    7,
    reference="Fig. 7",
    paper="a lower dexterity index gives higher rates",
    measured="Least-squares slope of the mean rate against the measured index over the "
    "references, world by world.",
    unswept="The references are swept at one load.",
    reads=("runs",),
    when=varies(REFERENCE),
)
def rates_over_dexterity(study: Study) -> Judged:
    """Judge the slope of the rates against the measured index."""
    return _slopes_of_rates(study, REFERENCE, tenths_of_dexterity, "0.1 DI", below=0.0)


def _slopes_of_rates(
    study: Study, key: str, position: Callable[[pd.DataFrame], Sample], step: str, **claimed: float
) -> Judged:
    """Judge the slopes of both slices' rates along the axis of a key, per `step` of `position`."""

    def measure(along: pd.DataFrame, policy: str) -> tuple[Statement, ...]:
        return tuple(
            slope(along, policy, f"{part}_rate_mbps", position).statement(
                f"{label} rate per {step}", "Mbit/s", **claimed
            )
            for part, label in PAIRED
        )

    return swept(study, key, measure)


@claim(
    8,
    reference="Table II",
    paper="adjusted gains cut the tracking error in slots of violated delay",
    measured="Ratio of mean tracking errors under the same forced delays, in each of the "
    "violated slots.",
    unswept="The grid over q and delay is in the gain study.",
    reads=("windows",),
    when=has_gain_study,
)
def adjusted_gains_help(study: Study) -> Judged:
    """Judge the ratio of errors in every violated slot, method by method."""
    statements: dict[str, list[Statement]] = {}
    for method, slot, runs in runs_by_method(study):
        if slot in study.scenario.gain_study.violation_windows:
            errors = runs.pivot(index="seed", columns="gain", values="error_cm")
            over = ratio(errors["adjusted"].to_numpy(), errors["nominal"].to_numpy())
            name = f"tracking error, adjusted / nominal, slot {slot}"
            own = statements.setdefault(f"{method}, {STUDY_PLANTS[method]}", [])
            own.append(over.statement(name, "1", below=1.0))
    base, *others = (
        Condition("control.method, control.loop", value, "none", tuple(own))
        for value, own in statements.items()
    )
    return Judged(replace(base, axis=""), tuple(others))


@claim(
    9,
    reference="Table III",
    paper="DRL's rate is comparable with PF's",
    measured="Ratio of the mean URLLC rates in the same worlds, within "
    f"{percent(COMPARABLE)} of 1 (the paper's own rows: 0.92, 1.02, 0.99).",
    reads=("runs",),
    when=has_learners,
)
def rates_comparable(study: Study) -> Judged:
    """Judge the ratio of the URLLC rates in the same worlds."""

    def measure(runs: pd.DataFrame, policy: str) -> tuple[Statement, ...]:
        over = ratio(*in_the_same_worlds(runs, policy, BASELINE, "urllc_rate_mbps"))
        return (over.statement("URLLC rate / PF's", "1", **within(COMPARABLE)),)

    return evaluated(study, measure, needs=BASELINE)


@claim(
    10,
    reference="Fig. 8",
    paper="DRL violates the delay constraint far less than PF",
    measured=f"Ratio of the shares of late URLLC packets in the same worlds, below {FAR_LESS:g}.",
    reads=("runs",),
    when=has_learners,
)
def fewer_violations(study: Study) -> Judged:
    """Judge the ratio of the late shares in the same worlds."""
    late = "urllc_late_share"

    def measure(runs: pd.DataFrame, policy: str) -> tuple[Statement, ...]:
        own, other = in_the_same_worlds(runs, policy, BASELINE, late)
        trained = runs[runs["policy"] == policy]
        least = resolution(late, trained, study.scenario_of(trained))
        return (ratio(own, other, least).statement("late share / PF's", "1", below=FAR_LESS),)

    return evaluated(study, measure, needs=BASELINE)
