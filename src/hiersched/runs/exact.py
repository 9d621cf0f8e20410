"""The slot as the exact optimum needs it, and the optimum as a policy for short evaluations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from hiersched.allocation.exact import exact_allocation
from hiersched.allocation.objective import UserTerms
from hiersched.runs.policies import WorldRun, seed_worlds
from hiersched.scenario import Scenario
from hiersched.simulator import Gains, Simulator, SlotConstants
from hiersched.simulator.setup import user_terms


def slot_terms(
    constants: SlotConstants,
    backlog_packets: NDArray[np.float64],
    dexterity_index: NDArray[np.float64],
    multiplier: NDArray[np.float64],
) -> UserTerms:
    """Return the terms of a slot's Lagrangian.

    Parameters
    ----------
    constants
        Of the run.
    backlog_packets
        At the start of the slot, shape (U,).
    dexterity_index, multiplier
        In force, shape (R,): one a URLLC user.
    """
    terms = user_terms(constants)
    num_urllc = constants.num_urllc
    terms.backlog_packets[:] = backlog_packets
    terms.service_offset_mbps[:num_urllc] = constants.service_coefficient_mbps * dexterity_index
    terms.multiplier[:num_urllc] = multiplier
    return terms


def run_exact(
    scenario: Scenario,
    gains: Gains,
    purpose: str,
    seeds: Sequence[int],
    num_slots: int,
) -> Iterator[WorldRun]:
    """Run the exact optimum of every slot, without multipliers.

    A slot of 20 users takes about a tenth of a second in every world.
    """
    simulator = Simulator(scenario, gains, seed_worlds(purpose, seeds), num_slots)
    whole = simulator.new_record(num_slots)
    one = simulator.new_record(1)
    none = np.zeros(scenario.users.num_urllc)
    owner = np.zeros((len(seeds), 1, scenario.radio.num_prb), np.uint32)
    for slot in range(num_slots):
        state = simulator.state
        for world in range(len(seeds)):
            dexterity = state.robots.dexterity_index[world]
            terms = slot_terms(simulator.constants, state.backlog_packets[world], dexterity, none)
            owner[world, 0] = exact_allocation(state.prb_rate_mbps[world], terms).prb_owner
        simulator.run_owners(owner, record=one)
        whole.rows[:, slot] = one.rows[:, 0]
    for index, seed in enumerate(seeds):
        yield WorldRun(seed=seed, fields=whole.environment(index))
