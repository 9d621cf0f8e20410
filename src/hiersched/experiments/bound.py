"""Sampled slots of the evaluation: what was decided there, and the exact optimum."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from hiersched.allocation.exact import exact_allocation, lagrangian, owned_rates
from hiersched.allocation.objective import UserTerms, slot_terms
from hiersched.core.files import csv_text, write_bytes
from hiersched.experiments import files
from hiersched.experiments.gains import load_gains
from hiersched.experiments.logged import read_slots
from hiersched.experiments.points import experiments
from hiersched.experiments.worlds import seed_worlds
from hiersched.log import LogError
from hiersched.policies.index_rules import CLASSICAL
from hiersched.scenario import Scenario
from hiersched.simulator import Simulator

TIME_LIMIT_S = 20.0
"""Of one programme; the bound holds where it runs out."""

_SEEN = (
    *("fading_power", "backlog_packets", "average_rate_mbps", "hol_delay_s"),
    *("multiplier", "dexterity_index", "prb_owner", "rate_mbps"),
)
"""What a scheduler sees of a slot, and what it decided."""

REFERENCE = "drift_plus_penalty"
"""In the states of this policy every classical scheduler is asked what it would do."""


class Moment(NamedTuple):
    """A slot as its scheduler saw it: arrays of shape (U,), rates (U, K)."""

    slot: int
    rate_mbps: NDArray[np.float32]
    terms: UserTerms
    prb_owner: NDArray[np.uint32]


def sampled_slots(num_slots: int, count: int) -> NDArray[np.int64]:
    """Return the middles of `count` equal parts of a run, fewer if it has fewer slots."""
    count = min(count, num_slots)
    return (2 * np.arange(count) + 1) * num_slots // (2 * count)


def compute_bound(scenario: Scenario, results: Path, output: Path) -> None:
    """Write one row for every decision in a sampled slot: its Lagrangian and the optimum's.

    Columns: policy (whose states they are), seed, slot, decider, value, exact, bound, and of the
    assignment of first PRBs alone the costs exact and greedy, by Lagrangian and by log rate.
    `results` is the folder of the study, with its evaluation logs; `output` is a CSV file.

    LogError if a log is damaged, or its rates do not follow from channel and allocation.
    """
    _, gains = load_gains(results / files.gain_file("schedule"), scenario)
    evaluation = experiments(scenario)["evaluate"]
    (point,) = evaluation.points
    num_slots, _ = evaluation.num_slots(scenario)
    rows: list[dict[str, Any]] = []
    for policy in scenario.evaluate.policies:
        for seed in scenario.evaluate.seeds:
            world = Simulator(scenario, gains, seed_worlds("evaluate", [seed]), num_slots)
            path = results / files.run_log(evaluation, point, policy, seed)
            for moment in read_moments(path, world, scenario.bound.slots_per_log):
                rows += _rows(moment, world, {"policy": policy, "seed": seed})
        print(f"bound {policy}: {scenario.bound.slots_per_log} slots a world", flush=True)
    write_bytes(output, csv_text(pd.DataFrame(rows)).encode())


def read_moments(path: Path, world: Simulator, count: int) -> Iterator[Moment]:
    """Read `count` evenly spaced slots of a log, behind the warm-up.

    `world` is of the log's world alone, and stands in each moment as the scheduler met it. LogError
    if the log is damaged, or its rates do not follow from channel and allocation.
    """
    run = read_slots(path, _SEEN)
    fields, warmup = run.fields, run.warmup_slots
    num_slots = len(fields["fading_power"])
    for slot in (warmup + sampled_slots(num_slots - warmup, count)).tolist():
        _stand(world, fields, slot)
        rate = world.state.prb_rate_mbps[0].copy()
        owner = np.ascontiguousarray(fields["prb_owner"][slot])
        if not np.array_equal(owned_rates(rate, owner), fields["rate_mbps"][slot]):
            raise LogError(path, 0, f"slot {slot}: its rates do not follow from its channel")
        terms = slot_terms(
            world.constants,
            fields["backlog_packets"][slot],
            fields["dexterity_index"][slot],
            fields["multiplier"][slot],
            np.ones(len(rate)),
            np.zeros((2, len(rate))),
        )
        yield Moment(slot, rate, terms, owner)


def _stand(world: Simulator, fields: Mapping[str, NDArray[Any]], slot: int) -> None:
    """Put a world into a slot of its log, as far as schedulers see it."""
    state = world.state
    state.slot[0] = slot
    for name in ("backlog_packets", "average_rate_mbps", "hol_delay_s", "dexterity_index"):
        getattr(state, name)[0] = fields[name][slot]
    state.rate_mbps[0] = fields["rate_mbps"][slot - 1] if slot else 0.0
    world.set_channel(fields["fading_power"][None, slot])


def greedy_assignment(cost: NDArray[np.float64]) -> float:
    """Return the total cost of giving every user one PRB, the cheapest pair first.

    `cost` is that of each user with each PRB alone, shape (U, K).
    """
    left = cost.copy()
    total = 0.0
    for _ in range(len(cost)):
        user, prb = np.unravel_index(int(left.argmin()), left.shape)
        total += float(cost[user, prb])
        left[user, :] = np.inf
        left[:, prb] = np.inf
    return total


def _rows(moment: Moment, world: Simulator, labels: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Rows of one slot: the policy itself, the greedy rule, and others in states of reference."""
    terms = moment.terms
    best = exact_allocation(moment.rate_mbps, terms, time_limit_s=TIME_LIMIT_S)
    deciders = {labels["policy"]: moment.prb_owner}
    for name in CLASSICAL if labels["policy"] == REFERENCE else (REFERENCE,):
        if name not in deciders:
            multipliers = terms.multiplier[: world.constants.num_urllc]
            deciders[name] = world.decide(world.rule(name), multipliers)[0]
    for decider, owner in deciders.items():
        rates = owned_rates(moment.rate_mbps, owner)
        value = float(lagrangian(terms, np.arange(len(rates)), rates)[0].sum())
        yield {
            **labels,
            "slot": moment.slot,
            "decider": decider,
            "value": value,
            "exact": best.value,
            "bound": best.bound,
            **_assignment(moment),
        }


def _assignment(moment: Moment) -> dict[str, float]:
    """Costs of one PRB for everyone, exact and greedy, by Lagrangian and by minus log rate."""
    rate = moment.rate_mbps.astype(np.float64)
    costs = {
        "lagrangian": lagrangian(moment.terms, np.arange(len(rate))[:, None], rate)[0],
        "log_rate": -np.log(rate),
    }
    result = {}
    for name, cost in costs.items():
        result[f"first_{name}_exact"] = float(cost[linear_sum_assignment(cost)].sum())
        result[f"first_{name}_greedy"] = greedy_assignment(cost)
    return result
