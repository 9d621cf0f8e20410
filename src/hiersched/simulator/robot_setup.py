"""From a scenario and a gain schedule to the constants of its robots."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hiersched.models.plant.linear import Linear, LinearConstants
from hiersched.models.plant.reference import (
    PathShape,
    ReferenceTable,
    driven_table,
    reference_table,
)
from hiersched.models.plant.unicycle import RobotConstants
from hiersched.scenario.reference_file import arc_lengths, turns
from hiersched.scenario.schema import Robot, Scenario


class Gains(Protocol):
    """What the slot loop needs of a schedule: tables for T = 0 … T_max (`simulator.loop_gains`)."""

    @property
    def local_gains(self) -> NDArray[np.float64]:
        """Gains on the present measurement."""
        ...

    @property
    def network_gains(self) -> NDArray[np.float64]:
        """Gains on the delayed measurement."""
        ...

    @property
    def input_gains(self) -> NDArray[np.float64]:
        """Gains on past commands, the newest first."""
        ...

    @property
    def adjusted(self) -> NDArray[np.bool_]:
        """Whether an entry is another gain than the nominal one."""
        ...


def robot_constants(
    scenario: Scenario, gains: Gains, num_slots: int, num_robots: int
) -> RobotConstants:
    """Constants of `num_robots` robots over `num_slots` slots.

    Raises
    ------
    ValueError
        If the gains do not cover the scenario's delays.
    """
    robot, control, slot_s = scenario.robot, scenario.control, scenario.radio.slot_s
    step_s = robot.substep_s
    steps_per_slot = round(slot_s / step_s)
    needed = scenario.max_delay_steps + 1
    tables = _gain_tables(gains, needed, *scenario.robot_sizes[:2])
    table, offset = _reference(robot, num_slots * steps_per_slot, num_robots)
    decay = float(np.exp(-step_s / robot.actuator_lag_s))
    slip_decay = float(np.exp(-slot_s / robot.slip_time_s))
    slip_spread = float(np.sqrt(1.0 - slip_decay**2))
    return RobotConstants(
        step_s=step_s,
        steps_per_slot=steps_per_slot,
        steps_per_sample=round(control.sampling_s / step_s),
        steps_per_window=round(robot.window_s / step_s),
        sampling_s=control.sampling_s,
        lag_decay=decay,
        lag_mean=(1.0 - decay) * robot.actuator_lag_s / step_s,
        slip_decay=slip_decay,
        slip_gain_mps=robot.slip_speed_mps * slip_spread,
        slip_gain_radps=robot.slip_turn_rate_radps * slip_spread,
        noise_position_m=robot.noise_position_m,
        noise_heading_rad=robot.noise_heading_rad,
        max_speed_mps=robot.max_speed_mps,
        max_turn_rate_radps=robot.max_turn_rate_radps,
        core_latency_s=robot.core_latency_s,
        max_delay_steps=scenario.max_delay_steps,
        **tables,
        has_memory=bool(tables["input_gain"].any()),
        hold_samples=control.hold_samples,
        adjusted_delay_steps=np.where(gains.adjusted, np.arange(needed), 0).astype(np.uint32),
        path=table.rows(),
        pose=table.pose,
        offset=offset,
    )


def _reference(
    robot: Robot, num_steps: int, num_robots: int
) -> tuple[ReferenceTable, NDArray[np.int64]]:
    """Sample the reference of the robots and say where in it each of them starts."""
    if robot.reference == "file":
        points = np.array(robot.reference_points, dtype=np.float64)
        return driven_table(
            points[:, 0],
            np.concatenate([[0.0], np.cumsum(arc_lengths(points))]),
            points[0, 3] + np.concatenate([[0.0], np.cumsum(turns(points))]),
            points[0, 1:3],
            repeat=robot.reference_repeat,
            step_s=robot.substep_s,
            num_steps=num_steps,
            num_robots=num_robots,
        )
    shape = PathShape(
        arc_radius_m=robot.arc_radius_m,
        eight_half_width_m=robot.eight_half_width_m,
        zigzag_heading_rad=math.radians(robot.zigzag_heading_deg),
        zigzag_period_m=robot.zigzag_period_m,
    )
    return reference_table(
        robot.reference, shape, robot.speed_mps, robot.substep_s, num_steps, num_robots
    )


def linear_constants(scenario: Scenario) -> LinearConstants:
    """Return the matrices of linear plants, or empty ones for unicycles."""
    plant, (n, m, _) = scenario.plant, scenario.robot_sizes
    if not isinstance(plant, Linear):
        none = np.zeros((0, 0))
        empty = np.zeros(0)
        return LinearConstants(none, none, none, empty, empty, empty, np.zeros(0, np.int64))
    limits = plant.input_limits
    return LinearConstants(
        A=np.array(plant.A, np.float64),
        A_d=np.zeros((n, n)) if plant.A_d is None else np.array(plant.A_d, np.float64),
        B=np.array(plant.B, np.float64),
        process_noise=np.array(plant.process_noise, np.float64),
        measurement_noise=np.array(plant.measurement_noise, np.float64),
        input_limits=np.full(m, np.inf) if limits is None else np.array(limits, np.float64),
        error_states=np.array(plant.error_states, np.int64),
    )


def _gain_tables(gains: Gains, needed: int, n: int, m: int) -> dict[str, NDArray[np.float64]]:
    """Gain tables of `RobotConstants` by name, for `needed` delays, n states and m inputs."""
    shapes = {
        "local_gains": (needed, m, n),
        "network_gains": (needed, m, n),
        "input_gains": (needed, needed - 1, m, m),
    }
    tables = {}
    for name, shape in shapes.items():
        table = np.ascontiguousarray(getattr(gains, name))
        if table.shape != shape:
            raise ValueError(f"{name}: shape {table.shape}, must be {shape}")
        tables[name.removesuffix("s")] = table
    return tables
