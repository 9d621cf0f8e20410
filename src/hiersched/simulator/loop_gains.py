"""From a scenario to its plant, and from a gain schedule to the gains of the loop."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hiersched.control import DelayedPlant, GainSchedule
from hiersched.control.lqg import FilterModel, Lqg
from hiersched.scenario import Scenario, kinds_of_robots


@dataclass(frozen=True, kw_only=True)
class Gains:
    """Tables of u(k) = -local x(k) - network x(k-d) - sum_i input_i u(k-1-i).

    There are n states and m inputs, and delays of up to T_max samples.
    """

    local_gains: NDArray[np.float64]  # (T_max + 1, m, n) on the present measurement
    network_gains: NDArray[np.float64]  # (T_max + 1, m, n) on the delayed measurement
    input_gains: NDArray[np.float64]  # (T_max + 1, T_max, m, m) on past commands, the newest first
    adjusted: NDArray[np.bool_]  # (T_max + 1,) whether an entry is not the nominal gain
    lqg: Lqg | None = None  # filter and regulator, in place of the tables
    kinds: tuple[Gains, ...] = ()  # of the other kinds of robots (`Scenario.robot_kinds`)

    @classmethod
    def memoryless(
        cls, network_gains: NDArray[np.float64], local_gains: NDArray[np.float64] | None = None
    ) -> Gains:
        """Return gains without memory, nominal at T = 0: all over the network unless given."""
        local = np.zeros_like(network_gains) if local_gains is None else local_gains
        differs = (network_gains != network_gains[:1]) | (local != local[:1])
        count, inputs = network_gains.shape[:2]
        return cls(
            local_gains=local,
            network_gains=network_gains,
            input_gains=np.zeros((count, count - 1, inputs, inputs)),
            adjusted=differs.any(axis=(1, 2)),
        )


def plant_of(scenario: Scenario) -> DelayedPlant:
    """Plant for which the gains are designed: that of the scenario, or a unicycle on a line."""
    return scenario.plant.design(scenario)


def filter_model_of(scenario: Scenario) -> FilterModel | None:
    """Return what the filter of the scenario's method believes; None for methods without one."""
    return scenario.plant.filter_model(scenario) if scenario.control.method == "lqg" else None


def loop_gains(schedule: GainSchedule, gain: Literal["adjusted", "nominal"]) -> Gains:
    """Tables of a schedule for the loops, or those of its nominal gain, whatever the delay."""
    local, network = schedule.local_gains, schedule.network_gains
    inputs = schedule.input_gains.copy()
    differs = (schedule.gains != schedule.nominal).any(axis=(1, 2)) | inputs.any(axis=(1, 2, 3))
    lqg = schedule.lqg
    if lqg is not None:
        differs[1:] = True  # it acts on an estimate, not on what is measured
    if gain == "nominal":
        lqg = None
        (network if schedule.kind == "network" else local)[:] = schedule.nominal
        inputs[:] = 0.0
        differs[:] = False
    return Gains(
        local_gains=local,
        network_gains=network,
        input_gains=inputs,
        adjusted=differs,
        lqg=lqg,
        kinds=tuple(loop_gains(kind, gain) for kind in schedule.kinds),
    )


def nominal_gains(scenario: Scenario) -> Gains:
    """Tables of the nominal gain at every delay, without designing any other."""
    own, *kinds = (_nominal_gains(kind) for kind in kinds_of_robots(scenario))
    return replace(own, kinds=tuple(kinds))


def _nominal_gains(scenario: Scenario) -> Gains:
    plant = plant_of(scenario)
    nominal, operator = plant.nominal_gain, plant.operator_gain
    if plant.kind == "network":
        local, network = np.zeros_like(nominal), nominal
    else:
        local, network = nominal, np.zeros_like(nominal) if operator is None else operator
    count = scenario.max_delay_steps + 1
    return Gains.memoryless(*(np.repeat(gain[None], count, axis=0) for gain in (network, local)))
