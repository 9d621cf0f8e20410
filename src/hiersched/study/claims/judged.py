"""The ten claims of the paper, each judged by the logs of a study.

The margins are read from the words of the claims and stay as they are whatever comes out:
"comparable" is within 10 %, "hardly" within 5 % over a whole axis for rates (10 % for queues, which
vary more), "far less" is less than half.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from hiersched.experiments.points import BASELINE
from hiersched.study.claims.conditions import Noisy, by_coefficient, evaluated, swept, trained
from hiersched.study.claims.effects import (
    PAIRED,
    change_in_training,
    difference,
    doublings,
    ends,
    in_the_same_worlds,
    mean,
    percent,
    ratio,
    slope,
    steps,
    tenths_of_dexterity,
)
from hiersched.study.claims.verdicts import Condition, Judged, Statement
from hiersched.study.intervals import resolution
from hiersched.study.registry import claim, has_gain_study, has_learners, varies
from hiersched.study.samples import sample_of
from hiersched.study.study import Study
from hiersched.study.tables.gains import gain_errors
from hiersched.study.tables.policies import SCALE

SAMPLING, REFERENCE = "control.sampling_s", "robot.reference"
COMPARABLE = 0.10
HARDLY = 0.05
HARDLY_QUEUE = 0.10
FAR_LESS = 0.5


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

    def measure(own: pd.DataFrame, control: pd.DataFrame | None) -> tuple[Statement, ...]:
        statements = []
        for part, label in PAIRED:
            reward = steps(own, f"{part}_reward")
            rise, late = reward[:, -1] - reward[:, 0], reward[:, -1] - reward[:, -2]
            statements += [
                mean(rise).statement(f"{label} reward, last − first", "1", above=0.0),
                mean(late - COMPARABLE * rise).statement(
                    f"{label} reward, last step − {percent(COMPARABLE)} of that", "1", below=0.0
                ),
                mean(late + COMPARABLE * rise).statement(
                    f"{label} reward, last step + {percent(COMPARABLE)} of that", "1", above=0.0
                ),
            ]
            statements += _beyond(rise, control, f"{part}_reward", f"{label} reward", above=0.0)
        return tuple(statements)

    noisy = _fifths_apart("reward", "reward", "1", above=0.0)
    base, others = trained(study, measure, noisy)
    return Judged(base, others)


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

    def measure(own: pd.DataFrame, control: pd.DataFrame | None) -> tuple[Statement, ...]:
        statements = []
        for part, label in PAIRED:
            backlog = steps(own, f"{part}_backlog_packets")
            fall = backlog[:, -1] - backlog[:, 0]
            statements.append(
                mean(fall).statement(f"{label} queue, last − first", "packets", below=0.0)
            )
            statements += _beyond(
                fall, control, f"{part}_backlog_packets", f"{label} queue", "packets", below=0.0
            )
        return tuple(statements)

    noisy = _fifths_apart("backlog_packets", "queue", "packets", below=0.0)
    base, others = trained(study, measure, noisy)
    return Judged(base, others)


def _fifths_apart(measure: str, name: str, unit: str, **claimed: float) -> Noisy:
    """Return what states how much a measure of both slices changes in a training with its noise."""

    def noisy(training: pd.DataFrame, block: int) -> tuple[Statement, ...]:
        return tuple(
            change_in_training(training, f"{part}_{measure}", block).statement(
                f"{label} {name}, last fifth − first fifth", unit, **claimed
            )
            for part, label in PAIRED
        )

    return noisy


def _beyond(
    change: NDArray[np.float64],
    control: pd.DataFrame | None,
    measure: str,
    label: str,
    unit: str = "1",
    **claimed: float,
) -> list[Statement]:
    """Return the statement that a change goes beyond that of the control, if there is one."""
    if control is None:
        return []
    idle = steps(control, measure)
    beyond = change - (idle[:, -1] - idle[:, 0])
    return [mean(beyond).statement(f"{label}, that − the same without learning", unit, **claimed)]


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
        sample = difference(embb, urllc)
        return (sample.statement("eMBB rate − URLLC rate", "Mbit/s", above=0.0),)

    base, others = evaluated(study, measure, beside=True)
    return Judged(base, others)


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

    def measure(along: pd.DataFrame, policy: str) -> tuple[Statement, ...]:
        return tuple(
            slope(along, policy, f"{part}_rate_mbps", doublings).statement(
                f"{label} rate per doubling", "Mbit/s", above=0.0
            )
            for part, label in PAIRED
        )

    base, others = swept(study, SCALE, measure)
    return Judged(base, others)


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
        return (
            rise.statement("eMBB queue per doubling", "packets", above=0.0),
            ratio(high, low).statement(
                "URLLC queue, greatest scale / least",
                "1",
                above=1.0 - HARDLY_QUEUE,
                below=1.0 + HARDLY_QUEUE,
            ),
        )

    base, others = swept(study, SCALE, measure)
    return Judged(base, others)


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
            statements.append(
                ratio(high, low).statement(
                    f"{label} rate, longest interval / shortest",
                    "1",
                    above=1.0 - HARDLY,
                    below=1.0 + HARDLY,
                )
            )
        return tuple(statements)

    base, others = swept(study, SAMPLING, measure)
    others += by_coefficient(study, measure)
    return Judged(base, others)


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

    def measure(along: pd.DataFrame, policy: str) -> tuple[Statement, ...]:
        return tuple(
            slope(along, policy, f"{part}_rate_mbps", tenths_of_dexterity).statement(
                f"{label} rate per 0.1 DI", "Mbit/s", below=0.0
            )
            for part, label in PAIRED
        )

    base, others = swept(study, REFERENCE, measure)
    return Judged(base, others)


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
    conditions = []
    for (method, plant), group in gain_errors(study).groupby(["method", "plant"], sort=False):
        statements = []
        for slot, rows in group[group["violated"]].groupby("slot"):
            errors = rows.pivot(index="seed", columns="gain", values="error_cm")
            statements.append(
                ratio(errors["adjusted"].to_numpy(), errors["nominal"].to_numpy()).statement(
                    f"tracking error, adjusted / nominal, slot {slot}", "1", below=1.0
                )
            )
        conditions.append(
            Condition(
                axis="control.method, control.loop",
                value=f"{method}, {plant}",
                policy="none",
                statements=tuple(statements),
            )
        )
    first = conditions[0]
    base = Condition(axis="", value=first.value, policy="none", statements=first.statements)
    return Judged(base, tuple(conditions[1:]))


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
        own, other = in_the_same_worlds(runs, policy, BASELINE, "urllc_rate_mbps")
        return (
            ratio(own, other).statement(
                "URLLC rate / PF's", "1", above=1.0 - COMPARABLE, below=1.0 + COMPARABLE
            ),
        )

    base, others = evaluated(study, measure, needs=BASELINE)
    return Judged(base, others)


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
    scenario = study.scenario

    def measure(runs: pd.DataFrame, policy: str) -> tuple[Statement, ...]:
        own, other = in_the_same_worlds(runs, policy, BASELINE, "urllc_late_share")
        least = resolution("urllc_late_share", runs[runs["policy"] == policy], scenario)
        return (ratio(own, other, least).statement("late share / PF's", "1", below=FAR_LESS),)

    base, others = evaluated(study, measure, needs=BASELINE)
    return Judged(base, others)
