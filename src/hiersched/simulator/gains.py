"""From a scenario to its plant, and from a gain schedule to the gains of the loop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hiersched.control import (
    DelayedPlant,
    GainSchedule,
    dlqr,
    network_plant,
    split_plant,
    tracking_weights,
)
from hiersched.robot.plant import discretise, unicycle_error_model
from hiersched.scenario.schema import Scenario

POSE_STATES = (0, 1, 2)
"""What the operator of a split plant feeds back: the pose that the video shows."""


@dataclass(frozen=True, kw_only=True)
class LoopGains:
    """Gains on the present and on the delayed measurement, shape (T_max + 1, 2, 5) each."""

    local_gains: NDArray[np.float64]
    network_gains: NDArray[np.float64]


def plant_of(scenario: Scenario) -> DelayedPlant:
    """Plant for which the gains are designed: straight reference, sampling interval h."""
    robot, control = scenario.robot, scenario.control
    A, B = discretise(
        *unicycle_error_model(robot.speed_mps, 0.0, robot.actuator_lag_s), control.sampling_s
    )
    Q, R = tracking_weights(control.weight, control.sampling_s)
    if control.plant == "network":
        return network_plant(A, B, Q, R, sampling_s=control.sampling_s)
    return split_plant(
        A,
        B,
        Q,
        R,
        operator_share=control.operator_share,
        operator_states=POSE_STATES,
        sampling_s=control.sampling_s,
    )


def loop_gains(schedule: GainSchedule, plant: DelayedPlant) -> LoopGains:
    """Gains of the loop: all over the network or, split plant, the scheduled part on the robot."""
    zeros = np.zeros_like(schedule.gains)
    if schedule.kind == "network":
        return LoopGains(local_gains=zeros, network_gains=schedule.gains)
    regulator = dlqr(plant.A, plant.B, plant.Q, plant.R)[0]
    operator = np.broadcast_to(regulator - plant.nominal_gain, schedule.gains.shape)
    return LoopGains(local_gains=schedule.gains, network_gains=operator.copy())
