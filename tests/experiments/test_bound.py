"""The exact optimum as a policy, and the bound on logged slots."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hiersched.allocation.exact import exact_allocation, lagrangian, owned_rates
from hiersched.allocation.objective import slot_terms
from hiersched.experiments import files
from hiersched.experiments.bound import compute_bound, greedy_assignment, sampled_slots
from hiersched.experiments.gains import load_gains
from hiersched.experiments.worlds import seed_worlds
from hiersched.scenario import Scenario
from hiersched.simulator import Simulator

Run = Callable[..., None]


def with_policies(scenario: Scenario, *policies: str) -> Scenario:
    evaluation = replace(scenario.evaluate, policies=policies, seeds=(11, 12), duration_s=0.1)
    return replace(scenario, evaluate=evaluation, bound=replace(scenario.bound, slots_per_log=3))


@pytest.fixture
def bound(tiny: Scenario, results: Path, run: Run) -> list[dict[str, str]]:
    scenario = with_policies(tiny, "drift_plus_penalty", "pf", "exact")
    run(scenario, "evaluate")
    compute_bound(scenario, results, results / files.BOUND)
    with (results / files.BOUND).open(newline="") as file:
        return list(csv.DictReader(file))


def test_nothing_falls_below_the_bound(bound: list[dict[str, str]]) -> None:
    for row in bound:
        value, exact, lower = (float(row[name]) for name in ("value", "exact", "bound"))
        assert lower <= exact <= value + 1e-6 * (1.0 + abs(value))
        assert exact - lower <= 1e-6 * (1.0 + abs(exact))
        for name in ("lagrangian", "log_rate"):
            first = [float(row[f"first_{name}_{how}"]) for how in ("exact", "greedy")]
            assert first[0] <= first[1] + 1e-9


def test_the_exact_policy_meets_the_bound_and_others_do_not(bound: list[dict[str, str]]) -> None:
    gaps: dict[str, list[float]] = {}
    for row in bound:
        if row["policy"] == row["decider"]:
            gap = float(row["value"]) - float(row["exact"])
            gaps.setdefault(row["policy"], []).append(gap)
    assert {len(found) for found in gaps.values()} == {2 * 3}
    assert max(gaps["exact"]) == pytest.approx(0.0, abs=1e-3)
    assert max(gaps["pf"]) > 1.0


def test_every_scheduler_is_asked_in_the_states_of_the_reference(
    bound: list[dict[str, str]],
) -> None:
    asked = {row["decider"] for row in bound if row["policy"] == "drift_plus_penalty"}
    assert {"pf", "edf", "max_weight", "round_robin"} <= asked
    assert {row["decider"] for row in bound if row["policy"] == "pf"} == {
        "pf",
        "drift_plus_penalty",
    }


def test_values_are_those_of_the_first_slot(tiny: Scenario, results: Path, run: Run) -> None:
    """Slot 0 from the simulator's own state: the optimum there, and what PF was worth."""
    scenario = with_policies(tiny, "pf")
    scenario = replace(scenario, evaluate=replace(scenario.evaluate, duration_s=0.01))
    run(scenario, "evaluate")
    compute_bound(scenario, results, results / files.BOUND)
    with (results / files.BOUND).open(newline="") as file:
        row = next(csv.DictReader(file))
    _, gains = load_gains(results / "gains/schedule.json", scenario)
    simulator = Simulator(scenario, gains, seed_worlds("evaluate", [11]), 1)
    rate = simulator.state.prb_rate_mbps[0].copy()
    robots = np.full(2, scenario.robot.initial_dexterity_index)
    terms = slot_terms(
        simulator.constants, np.zeros(4), robots, np.zeros(2), np.ones(4), np.zeros((2, 4))
    )
    best = exact_allocation(rate, terms)
    assert float(row["exact"]) == pytest.approx(best.value)
    rates = owned_rates(rate, simulator.run("pf").prb_owner[0, 0])
    assert float(row["value"]) == pytest.approx(lagrangian(terms, np.arange(4), rates)[0].sum())


def test_terms_of_a_slot_have_the_offset_of_the_dexterity_index(
    tiny: Scenario, results: Path
) -> None:
    _, gains = load_gains(results / "gains/schedule.json", tiny)
    constants = Simulator(tiny, gains, seed_worlds("evaluate", [11]), 1).constants
    backlog, multiplier = np.array([1.0, 2.0, 3.0, 4.0]), np.array([5.0, 6.0])
    dexterity = np.array([0.6, 0.8])
    terms = slot_terms(constants, backlog, dexterity, multiplier, np.ones(4), np.zeros((2, 4)))
    beta = tiny.traffic.service_coefficient_mbps
    assert terms.service_offset_mbps.tolist() == [beta * 0.6, beta * 0.8, 0.0, 0.0]
    assert terms.backlog_packets.tolist() == backlog.tolist()
    assert terms.multiplier.tolist() == [5.0, 6.0, 0.0, 0.0]


@pytest.mark.parametrize("profile", ["compact", "decisions"])
def test_slots_of_small_logs_are_computed_again(
    tiny: Scenario, results: Path, run: Run, profile: str
) -> None:
    texts = []
    for name in ("full", profile):
        scenario = replace(with_policies(tiny, "pf"), log=replace(tiny.log, evaluate_profile=name))
        run(scenario, "evaluate")
        compute_bound(scenario, results, results / files.BOUND)
        texts.append((results / files.BOUND).read_text())
    assert texts[0] == texts[1]


def test_only_slots_behind_the_warm_up_count(tiny: Scenario, results: Path, run: Run) -> None:
    scenario = with_policies(tiny, "pf")
    scenario = replace(scenario, evaluate=replace(scenario.evaluate, warmup_s=0.05))
    run(scenario, "evaluate")
    compute_bound(scenario, results, results / files.BOUND)
    with (results / files.BOUND).open(newline="") as file:
        slots = {int(row["slot"]) for row in csv.DictReader(file)}
    assert slots == {6, 10, 13}


def test_greedy_assignment_takes_the_cheapest_pair_first() -> None:
    cost = np.array([[1.0, 2.0, 9.0], [1.5, 8.0, 9.5]])  # 1.0 first leaves 8.0; the best is 3.5
    assert greedy_assignment(cost) == 9.0


def test_sampled_slots_are_the_middles_of_equal_parts() -> None:
    assert sampled_slots(1400, 4).tolist() == [175, 525, 875, 1225]
    assert sampled_slots(2, 5).tolist() == [0, 1]
