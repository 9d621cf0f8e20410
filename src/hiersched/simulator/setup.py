"""From a scenario and gains to the constants and the state of the slot loop."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hiersched.control.lqg import Lqg
from hiersched.models.model import Belief, Setup, model_fields, num_model_values
from hiersched.models.plant.command_link import LINKS, NO_LINK, LinkConstants
from hiersched.models.plant.estimator import FilterConstants, no_filter
from hiersched.models.plant.feedback import LoopConstants
from hiersched.models.queue.fifo import SUPERSEDING
from hiersched.scenario import Scenario, kinds_of_robots
from hiersched.simulator.loop_gains import Gains


class SlotConstants(NamedTuple):
    """What does not change during a run; R robots (one a URLLC user), U users, URLLC first."""

    num_urllc: int  # R
    num_prb: int  # K
    slot_s: float
    deadline_s: NDArray[np.float64]  # (U,)
    deadline_slots: NDArray[np.float64]  # (U,)
    late_share: NDArray[np.float64]  # (U,) share of packets that may miss the deadline
    offered_mbps: NDArray[np.float64]  # (U,) this and the next three: `models.model.Belief`
    rate_sensitivity: NDArray[np.float64]  # (U,)
    arrival_packets_per_mbps: NDArray[np.float64]  # (U,)
    mean_due_packets: NDArray[np.float64]  # (U,)
    service_packets_per_mbps: float  # packets a slot at 1 Mbit/s
    service_coefficient_mbps: float  # beta of the service r - beta DI
    penalty_weight: float  # V
    epsilon: float
    delay_exponent_per_mbps: float  # alpha_1 D_max
    violation_share: float  # 1 - chi
    measured_constraint: bool  # whether the constraint is on late shares
    average_forgetting: float  # 1 / window of the moving average rate
    reward_scale: float  # rewards are divided by it
    tracks_age: bool  # whether the queue follows the age of set-points, `SlotState.held_step`
    superseding: int  # code of `models.queue.fifo.SUPERSEDING`
    loop: LoopConstants  # gains, delays and latency of the robots' loops


class SlotState(NamedTuple):
    """What evolves, one row an environment; the channel is that of the coming slot."""

    key: NDArray[np.uint64]  # (E,) world
    slot: NDArray[np.int64]  # (E,) index of the coming slot
    snr: NDArray[np.float64]  # (E, U K) at unit fading power, each user's K times, linear
    fading_power: NDArray[np.float32]  # (E, U, K) squared amplitudes
    prb_rate_mbps: NDArray[np.float32]  # (E, U, K) what each PRB carries for each user
    reported_rate_mbps: NDArray[np.float32]  # (E, U, K) what policies are told of them
    backlog_packets: NDArray[np.float64]  # (E, U) at the start of the coming slot
    hol_delay_s: NDArray[np.float64]  # (E, U) likewise
    average_rate_mbps: NDArray[np.float64]  # (E, U) likewise
    rate_mbps: NDArray[np.float64]  # (E, U) of the slot before
    multiplier: NDArray[np.float64]  # (E, R) of each URLLC user's delay constraint
    weight: NDArray[np.float64]  # (E, U) factors of the utilities by a policy
    index_weight: NDArray[np.float64]  # (E, U) of the rule's utilities, or urgencies
    need_mbps: NDArray[np.float64]  # (E, U) rate that a user can use of the slot
    drift_weight: NDArray[np.float64]  # (E, U) factors of the drift in the Lagrangian by a rule
    delay_s: NDArray[np.float64]  # (E, R) in force
    dexterity_index: NDArray[np.float64]  # (E, R) in force
    gain_delay_steps: NDArray[np.uint32]  # (E, R) delay whose adjusted gain is in force, 0: nominal
    held_step: NDArray[np.int64]  # (E, R, S) step whose set-point is in force in each of the slot
    robot_state: NDArray[np.float64]  # (E, R, N) at the end of the last slot
    # What a base station may know of the robots' task at the start of the coming slot. Newest is
    # the last set-point that has reached its queue, held the one that the robot goes by.
    set_point_age_s: NDArray[np.float64]  # (E, R) of the held one
    set_point_speed_mps: NDArray[np.float64]  # (E, R) of the newest
    waiting_speed_mps: NDArray[np.float64]  # (E, R) greatest since the oldest packet arrived
    set_point_acceleration_mps2: NDArray[np.float64]  # (E, R) of the newest, magnitude
    set_point_gap_m: NDArray[np.float64]  # (E, R) distance of newest and held
    reported_error_m: NDArray[np.float64]  # (E, R) position error as last reported
    model_values: NDArray[np.float64]  # (E, X) for the record (`Model.log_fields`); 0 until written


TASK_STATE = (
    "set_point_age_s",
    "set_point_speed_mps",
    "waiting_speed_mps",
    "set_point_acceleration_mps2",
    "set_point_gap_m",
    "reported_error_m",
)
"""Fields of `SlotState` that say what the robots' task asks for."""


def slot_constants(scenario: Scenario, gains: Gains) -> SlotConstants:
    """Constants of a run.

    ValueError if the gains do not cover the delays up to `scenario.max_delay_steps`, or the belief
    is not one of every user.
    """
    radio, traffic, objective = scenario.radio, scenario.traffic, scenario.objective
    belief = _belief(scenario)
    of_slice = [scenario.users.num_urllc, scenario.users.num_embb]
    deadline_s = np.repeat([traffic.deadline_s, traffic.embb_deadline_s], of_slice)
    return SlotConstants(
        num_urllc=scenario.users.num_urllc,
        num_prb=radio.num_prb,
        slot_s=radio.slot_s,
        deadline_s=deadline_s,
        deadline_slots=_near_integer(deadline_s / radio.slot_s),
        late_share=1.0 - np.repeat([traffic.reliability, traffic.embb_reliability], of_slice),
        offered_mbps=belief.offered_mbps,
        rate_sensitivity=belief.rate_sensitivity,
        arrival_packets_per_mbps=belief.packets_per_mbps,
        mean_due_packets=belief.mean_due_packets,
        service_packets_per_mbps=radio.slot_s / (traffic.packet_bits * 1e-6),
        service_coefficient_mbps=traffic.service_coefficient_mbps,
        penalty_weight=objective.penalty_weight,
        epsilon=objective.epsilon,
        delay_exponent_per_mbps=objective.delay_exponent * traffic.deadline_s,
        violation_share=1.0 - traffic.reliability,
        measured_constraint=objective.constraint == "measured",
        average_forgetting=1.0 / scenario.schedulers.average_window_slots,
        reward_scale=scenario.learning.reward_scale,
        tracks_age=scenario.tracks_age,
        superseding=SUPERSEDING.index(scenario.robot.superseding),
        loop=_loop_constants(scenario, gains),
    )


def _belief(scenario: Scenario) -> Belief:
    """Return what the base station expects of the arrivals, in the types of the slot loop."""
    arrivals = scenario.traffic.arrivals
    shape = (scenario.num_users,)
    belief = Belief(*(np.array(values, np.float64) for values in arrivals.belief(scenario)))
    for name, values in belief._asdict().items():
        if values.shape != shape or not (np.isfinite(values).all() and (values >= 0.0).all()):
            raise ValueError(
                f"{type(arrivals).__module__}.{type(arrivals).__qualname__}.belief: {name} = "
                f"{values}: must be finite and not negative, shape {shape}"
            )
    return belief


def _near_integer(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round quotients within 1e-9 of an integer: 0.02 s / 0.01 s must be 2 slots."""
    rounded = np.round(values)
    return np.where(np.abs(values - rounded) < 1e-9 * np.maximum(1.0, rounded), rounded, values)


def _loop_constants(scenario: Scenario, gains: Gains) -> LoopConstants:
    """Return the constants of the robots' loops."""
    kinds = kinds_of_robots(scenario)
    if len(gains.kinds) != len(kinds) - 1:
        raise ValueError(f"gains.kinds: {len(gains.kinds)}, must be {len(kinds) - 1}, as of robots")
    of_kinds = (gains, *gains.kinds)
    count = scenario.max_delay_steps + 1
    n, m, _ = scenario.robot_sizes
    shapes = {
        "local_gains": (count, m, n),
        "network_gains": (count, m, n),
        "input_gains": (count, count - 1, m, m),
    }
    tables = {}
    for name, shape in shapes.items():
        # An array that is read-only would be another type, for which kernels are compiled anew.
        found = [np.array(getattr(own, name), np.float64) for own in of_kinds]
        if wrong := [table.shape for table in found if table.shape != shape]:
            raise ValueError(f"{name}: shape {wrong[0]}, must be {shape}")
        tables[name.removesuffix("s")] = np.concatenate(found)
    return LoopConstants(
        sampling_s=scenario.control.sampling_s,
        core_latency_s=scenario.robot.core_latency_s,
        max_delay_steps=scenario.max_delay_steps,
        kind=np.array(scenario.kind_of_robot, np.int64),
        **tables,
        has_memory=bool(tables["input_gain"].any()),
        hold_samples=scenario.control.hold_samples,
        stamp_error=scenario.control.stamp_error_samples,
        is_local=scenario.loop_kind == "local",
        by_age=scenario.control.delay == "age",
        adjusted_delay_steps=np.concatenate(
            [np.where(own.adjusted, np.arange(count), 0).astype(np.uint32) for own in of_kinds]
        ),
        filter=_filter_constants(scenario, kinds, [own.lqg for own in of_kinds]),
        link=_link_constants(scenario),
    )


def _filter_constants(
    scenario: Scenario, kinds: Sequence[Scenario], found: Sequence[Lqg | None]
) -> FilterConstants:
    """Return the constants of the robots' filters, those that were `found` for each kind."""
    size = scenario.filter_size
    if any((0 if lqg is None else len(lqg.model.A)) != size for lqg in found):
        raise ValueError(
            f"lqg: missing, given, or of another size: must be a filter of {size} states"
        )
    filters = [lqg for lqg in found if lqg is not None]
    if not filters:
        return no_filter(scenario.robot_sizes[1])
    if scenario.control.known_motion:
        models = [kind.plant.motion_models(kind) for kind in kinds]
    else:
        believed = [(lqg.model.A[None], lqg.model.B[None]) for lqg in filters]
        models = [(A, np.zeros_like(A), B, np.zeros_like(B)) for A, B in believed]
    A, A_speed, B, B_speed = (np.array(matrices) for matrices in zip(*models, strict=True))

    def of_kinds(name: str) -> NDArray[np.float64]:
        return np.array([attrgetter(name)(lqg) for lqg in filters], np.float64, order="C")

    return FilterConstants(
        is_on=True,
        is_known=scenario.control.known_motion,
        all_arrive=scenario.robot.superseding == "none" or scenario.sends_commands,
        A=A,
        A_speed=A_speed,
        B=B,
        B_speed=B_speed,
        process_covariance=of_kinds("model.process_covariance"),
        measurement_variance=of_kinds("model.measurement_variance"),
        gain=of_kinds("filter_gain"),
        regulator=of_kinds("regulator"),
        straight=of_kinds("model.A"),
        covariance=of_kinds("covariance"),
        position_states=np.array(scenario.plant.position_states(), np.int64),
        first_value=_first_value(scenario, "plant/estimate_0"),
    )


def _link_constants(scenario: Scenario) -> LinkConstants:
    """Return the constants of the robots' links."""
    if not scenario.sends_commands:
        return NO_LINK
    control = scenario.control
    return LinkConstants(
        kind=LINKS.index(control.link),
        latency_steps=scenario.latency_steps,
        playout_steps=scenario.playout_steps,
        horizon=scenario.packet_horizon,
        hold_steps=int(control.command_hold_s / control.sampling_s + 1e-9),
        first_value=_first_value(scenario, "plant/late_commands"),
    )


def _first_value(scenario: Scenario, name: str) -> int:
    return next(field.start for field in model_fields(scenario) if field.name == name)


def slot_state(setup: Setup, *, has_report: bool) -> SlotState:
    """Arrays of a run's state; `reset_state` fills them."""
    scenario, num_envs, num_prb = setup.scenario, setup.num_envs, setup.scenario.radio.num_prb
    of_users, of_robots = (num_envs, scenario.num_users), (num_envs, scenario.users.num_urllc)
    of_prbs = (*of_users, num_prb)
    shapes: dict[str, tuple[int, ...]] = {
        "key": (num_envs,),
        "slot": (num_envs,),
        "snr": (num_envs, scenario.num_users * num_prb),
        "fading_power": of_prbs,
        "prb_rate_mbps": of_prbs,
        "reported_rate_mbps": of_prbs,
        **dict.fromkeys(("multiplier", "delay_s", "dexterity_index"), of_robots),
        **dict.fromkeys(TASK_STATE, of_robots),
        "gain_delay_steps": of_robots,
        "held_step": (*of_robots, scenario.steps_per_slot),
        "robot_state": (*of_robots, scenario.robot_sizes[0]),
        "model_values": (num_envs, num_model_values(scenario)),
    }
    types: dict[str, Any] = {"key": np.uint64, "gain_delay_steps": np.uint32}
    types |= dict.fromkeys(("slot", "held_step"), np.int64)
    types |= dict.fromkeys(("fading_power", "prb_rate_mbps", "reported_rate_mbps"), np.float32)
    state = SlotState(
        *(
            np.zeros(shapes.get(name, of_users), types.get(name, np.float64))
            for name in SlotState._fields
        )
    )
    return state if has_report else state._replace(reported_rate_mbps=state.prb_rate_mbps)


def reset_state(state: SlotState, scenario: Scenario, keys: NDArray[np.uint64]) -> None:
    """Empty queues and robots on their reference in the worlds `keys` (E,), in place.

    The channel of slot 0 is not there yet.
    """
    for values in state:
        values[...] = 0
    state.key[:] = keys
    state.weight[:] = 1.0
    state.drift_weight[:] = 1.0
    state.delay_s[:] = scenario.robot.core_latency_s  # until the network has delivered something
    state.dexterity_index[:] = scenario.robot.initial_dexterity_index
    state.snr[:] = _snr_at_unit_fading(scenario, keys)


def _snr_at_unit_fading(scenario: Scenario, keys: NDArray[np.uint64]) -> NDArray[np.float64]:
    """Signal-to-noise ratios p g / noise, each user's K times, shape (E, U K), linear."""
    radio, shape = scenario.radio, (scenario.num_users,)
    power, noise = (
        1e-3 * math.pow(10.0, level_dbm / 10.0)
        for level_dbm in (radio.tx_power_dbm, radio.noise_dbm)
    )
    gains = [np.asarray(radio.path_loss.gain(int(key), scenario.num_users)) for key in keys]
    for gain in gains:
        if gain.shape != shape or not (np.isfinite(gain).all() and (gain > 0.0).all()):
            kind = type(radio.path_loss)
            raise ValueError(
                f"{kind.__module__}.{kind.__qualname__}.gain returned {gain}: must be positive and "
                f"finite, shape {shape}"
            )
    return np.repeat(power / noise * np.array(gains, np.float64), radio.num_prb, axis=1)
