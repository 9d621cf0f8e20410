"""From a scenario and a gain schedule to the constants and the state of the slot loop."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from hiersched.allocation.objective import UserTerms
from hiersched.models.model import Belief, Setup, num_model_values
from hiersched.models.plant.feedback import LoopConstants
from hiersched.scenario.schema import Scenario


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


class SlotConstants(NamedTuple):
    """What does not change during a run. Arrays have shape (U,), URLLC users first.

    Attributes
    ----------
    num_urllc, num_prb
        R and K.
    slot_s
        Length of a slot [s].
    deadline_s, deadline_slots, late_share
        Deadline [s] and [slots], and the share of packets that may miss it.
    offered_mbps, rate_sensitivity, arrival_packets_per_mbps, mean_due_packets
        What the base station expects of the arrivals (`models.model.Belief`).
    service_packets_per_mbps, service_coefficient_mbps
        Packets a slot at 1 Mbit/s; beta of the service r - beta DI.
    penalty_weight, epsilon, delay_exponent_per_mbps, violation_share, measured_constraint
        V, epsilon, alpha_1 D_max and 1 - chi of the objective; whether the constraint is on late
        shares.
    average_forgetting
        1 / window of the moving average rate.
    reward_scale
        Rewards are divided by it.
    loop
        Gains, delays and latency of the robots' loops.
    """

    num_urllc: int
    num_prb: int
    slot_s: float
    deadline_s: NDArray[np.float64]
    deadline_slots: NDArray[np.float64]
    late_share: NDArray[np.float64]
    offered_mbps: NDArray[np.float64]
    rate_sensitivity: NDArray[np.float64]
    arrival_packets_per_mbps: NDArray[np.float64]
    mean_due_packets: NDArray[np.float64]
    service_packets_per_mbps: float
    service_coefficient_mbps: float
    penalty_weight: float
    epsilon: float
    delay_exponent_per_mbps: float
    violation_share: float
    measured_constraint: bool
    average_forgetting: float
    reward_scale: float
    loop: LoopConstants


class SlotState(NamedTuple):
    """What evolves, one row an environment; the channel is that of the coming slot.

    Attributes
    ----------
    key, slot
        World, and index of the coming slot, shape (E,).
    snr
        Signal-to-noise ratio at unit fading power, each user's K times, shape (E, U K), linear.
    fading_power
        Squared amplitudes, shape (E, U, K), float32.
    prb_rate_mbps, reported_rate_mbps
        What each PRB carries for each user and what policies are told, shape (E, U, K), float32:
        one array where nothing reports.
    backlog_packets, hol_delay_s, average_rate_mbps, rate_mbps
        At the start of the coming slot; the last is that of the slot before; shape (E, U).
    multiplier
        Of each URLLC user's delay constraint, shape (E, R).
    weight, index_weight, need_mbps
        Factors of the utilities by a policy, what the rule's utilities are multiplied with (or
        urgencies), and the rate that a user can use of the slot, shape (E, U).
    delay_s, dexterity_index, gain_delay_steps
        In force for each robot, shape (E, R); the last is the delay whose adjusted gain is in
        force, 0 for the nominal gain.
    robot_state
        Of each robot at the end of the last slot, shape (E, R, N).
    model_values
        What models add to the record of the slot (`Model.log_fields`), shape (E, X); 0 until
        written.
    """

    key: NDArray[np.uint64]
    slot: NDArray[np.int64]
    snr: NDArray[np.float64]
    fading_power: NDArray[np.float32]
    prb_rate_mbps: NDArray[np.float32]
    reported_rate_mbps: NDArray[np.float32]
    backlog_packets: NDArray[np.float64]
    hol_delay_s: NDArray[np.float64]
    average_rate_mbps: NDArray[np.float64]
    rate_mbps: NDArray[np.float64]
    multiplier: NDArray[np.float64]
    weight: NDArray[np.float64]
    index_weight: NDArray[np.float64]
    need_mbps: NDArray[np.float64]
    delay_s: NDArray[np.float64]
    dexterity_index: NDArray[np.float64]
    gain_delay_steps: NDArray[np.uint32]
    robot_state: NDArray[np.float64]
    model_values: NDArray[np.float64]


class SlotScratch(NamedTuple):
    """Work arrays of the slot loop."""

    terms: UserTerms


def slot_constants(scenario: Scenario, gains: Gains) -> SlotConstants:
    """Constants of a run.

    Parameters
    ----------
    scenario
        The validated scenario.
    gains
        Gains for every delay up to `scenario.max_delay_steps`.

    Raises
    ------
    ValueError
        If the gains do not cover the scenario's delays, or the belief is not one of every user.
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
        loop=loop_constants(scenario, gains),
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


def loop_constants(scenario: Scenario, gains: Gains) -> LoopConstants:
    """Constants of the robots' loops.

    Raises
    ------
    ValueError
        If the gains do not cover the scenario's delays.
    """
    count = scenario.max_delay_steps + 1
    n, m, _ = scenario.robot_sizes
    shapes = {
        "local_gains": (count, m, n),
        "network_gains": (count, m, n),
        "input_gains": (count, count - 1, m, m),
    }
    tables = {}
    for name, shape in shapes.items():
        # A schedule's own arrays are read-only: another type, for which the kernels would be
        # compiled once more.
        table = np.array(getattr(gains, name), np.float64)
        if table.shape != shape:
            raise ValueError(f"{name}: shape {table.shape}, must be {shape}")
        tables[name.removesuffix("s")] = table
    return LoopConstants(
        sampling_s=scenario.control.sampling_s,
        core_latency_s=scenario.robot.core_latency_s,
        max_delay_steps=scenario.max_delay_steps,
        **tables,
        has_memory=bool(tables["input_gain"].any()),
        hold_samples=scenario.control.hold_samples,
        adjusted_delay_steps=np.where(gains.adjusted, np.arange(count), 0).astype(np.uint32),
    )


def slot_state(setup: Setup, *, has_report: bool) -> SlotState:
    """Arrays of a run's state; `reset_state` fills them."""
    scenario, num_envs = setup.scenario, setup.num_envs
    num_users, num_prb = scenario.num_users, scenario.radio.num_prb
    num_robots, num_states = scenario.users.num_urllc, scenario.robot_sizes[0]

    def users() -> NDArray[np.float64]:
        return np.zeros((num_envs, num_users))

    def robots() -> NDArray[np.float64]:
        return np.zeros((num_envs, num_robots))

    def prbs() -> NDArray[np.float32]:
        return np.zeros((num_envs, num_users, num_prb), np.float32)

    rate = prbs()
    return SlotState(
        key=np.zeros(num_envs, np.uint64),
        slot=np.zeros(num_envs, np.int64),
        snr=np.zeros((num_envs, num_users * num_prb)),
        fading_power=prbs(),
        prb_rate_mbps=rate,
        reported_rate_mbps=prbs() if has_report else rate,
        backlog_packets=users(),
        hol_delay_s=users(),
        average_rate_mbps=users(),
        rate_mbps=users(),
        multiplier=robots(),
        weight=users(),
        index_weight=users(),
        need_mbps=users(),
        delay_s=robots(),
        dexterity_index=robots(),
        gain_delay_steps=np.zeros((num_envs, num_robots), np.uint32),
        robot_state=np.zeros((num_envs, num_robots, num_states)),
        model_values=np.zeros((num_envs, num_model_values(scenario))),
    )


def reset_state(state: SlotState, scenario: Scenario, keys: NDArray[np.uint64]) -> None:
    """Empty queues and robots on their reference in the worlds `keys` (E,), in place.

    The signal-to-noise ratios and the channel of slot 0 are not there yet: `Simulator` does that.
    """
    for values in state:
        values[...] = 0
    state.key[:] = keys
    state.weight[:] = 1.0
    state.delay_s[:] = scenario.robot.core_latency_s  # until the network has delivered something
    state.dexterity_index[:] = scenario.robot.initial_dexterity_index
