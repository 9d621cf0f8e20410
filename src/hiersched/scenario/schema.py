"""The parameters of a scenario; `hiersched/config/defaults.yaml` documents every key."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Annotated, Any, Literal

from pydantic import Field

from hiersched.core.parameters import (
    STRICT,
    Count,
    NonEmpty,
    NonNegative,
    OwnKeys,
    Positive,
    Seed,
    Share,
)
from hiersched.models import model
from hiersched.policies.files import FilePolicy
from hiersched.policies.find import ImportedPolicy
from hiersched.policies.registry import Rule
from hiersched.scenario.choice import chosen_from, policy_entry, rule_entry

GainMethod = Literal["krasovskii", "razumikhin", "predictor", "latency_compensated", "h2", "lqg"]
Reference = Literal["straight", "arc", "figure_eight", "zigzag", "reach", "file"]
Range = tuple[Positive, Positive]
"""Least and greatest."""
Need = Literal["none", "backlog", "backlog_and_arrivals"]
LearnerName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=60)]
AxisName = Annotated[str, Field(pattern=r"^[a-z][A-Za-z0-9_.]*$", max_length=60)]
CellName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=60)]
PolicyName = LearnerName
"""A scheduler, a learner or one of `policies`; `consistency` knows which there are."""
LogProfile = Literal["full", "compact", "decisions"]
TrainProfile = Literal["full", "compact", "decisions", "none"]


class _Strict:
    """What a scenario consists of is read strictly."""

    __pydantic_config__ = STRICT


@dataclass(frozen=True, kw_only=True)
class Users(_Strict):
    """How many users each slice has."""

    num_urllc: Count
    num_embb: Count


@dataclass(frozen=True, kw_only=True)
class Radio(_Strict):
    """The cell's resource blocks and link budget; models of channel, report and link."""

    slot_s: Positive
    bandwidth_hz: Positive
    num_prb: Annotated[int, Field(ge=1, le=512)]
    tx_power_dbm: float
    noise_dbm: float
    path_loss: Annotated[model.PathLoss, chosen_from(model.PATH_LOSS)]
    fading: Annotated[model.Model, chosen_from(model.FADING)]
    report: Annotated[model.Model, chosen_from(model.REPORT)]
    link: Annotated[model.Model, chosen_from(model.LINK)]


@dataclass(frozen=True, kw_only=True)
class Traffic(_Strict):
    """Arrivals, service, deadlines."""

    packet_bits: Positive
    load: Positive
    load_ratio: Positive | None
    urllc_offered_mbps: Positive | Annotated[tuple[Positive, ...], NonEmpty]
    embb_offered_mbps: Positive | Annotated[tuple[Positive, ...], NonEmpty]
    service_coefficient_mbps: NonNegative
    deadline_s: Positive
    embb_deadline_s: Positive
    reliability: Share
    embb_reliability: Share
    reliability_levels: Annotated[tuple[Share, ...], NonEmpty]
    arrivals: Annotated[model.Arrivals, chosen_from(model.ARRIVALS)]
    queue: Annotated[model.Model, chosen_from(model.QUEUE)]


@dataclass(frozen=True, kw_only=True)
class Objective(_Strict):
    """Drift-plus-penalty objective, delay constraint and its multiplier."""

    penalty_weight: NonNegative
    epsilon: Positive
    delay_exponent: Positive
    constraint: Literal["surrogate", "measured"]
    multiplier_step: NonNegative
    multiplier_proportional: NonNegative
    multiplier_max: NonNegative


@dataclass(frozen=True, kw_only=True)
class Schedulers(_Strict):
    """Constants of the classical schedulers."""

    average_window_slots: Annotated[float, Field(ge=1)]
    log_rule_offset: Annotated[float, Field(ge=1)]
    log_rule_gain: Positive
    max_weight_need: Need
    m_lwdf_need: Need
    exp_pf_need: Need
    log_rule_need: Need


@dataclass(frozen=True, kw_only=True)
class Robot(_Strict):
    """The teleoperated robots and their world."""

    reference: Reference | Annotated[tuple[Reference, ...], NonEmpty]
    reference_scale: Positive | Annotated[tuple[Positive, ...], NonEmpty]
    reference_pace: Positive | Annotated[tuple[Positive, ...], NonEmpty]
    reference_shuffle: bool
    reference_file: str | None
    reference_points: tuple[tuple[float, float, float, float], ...] | None
    reference_repeat: bool
    arc_radius_m: Positive
    eight_half_width_m: Positive
    zigzag_heading_deg: Annotated[float, Field(gt=0, le=90)]
    zigzag_period_m: Positive
    reach_duration_s: Range
    reach_length_m: Range
    reach_turn_rad: NonNegative
    reach_pause_s: Range
    set_point: Literal["present", "hold", "extrapolate"]
    superseding: Literal["none", "packet", "batch"]
    speed_mps: Positive
    actuator_lag_s: Positive
    substep_s: Annotated[float, Field(gt=0, le=0.0025)]
    max_speed_mps: Positive
    max_turn_rate_radps: Positive
    slip_speed_mps: NonNegative
    slip_turn_rate_radps: NonNegative
    slip_time_s: Positive
    noise_position_m: NonNegative
    noise_heading_rad: NonNegative
    core_latency_s: NonNegative
    window_s: Positive
    initial_dexterity_index: Annotated[float, Field(ge=0, le=1)]


@dataclass(frozen=True, kw_only=True)
class RobotKind(_Strict):
    """Robots, by their numbers from 0 on, and what they have other than the rest: dotted keys."""

    robots: Annotated[tuple[Annotated[int, Field(ge=0)], ...], NonEmpty]
    values: Annotated[Mapping[str, Any], NonEmpty] = field(hash=False)


@dataclass(frozen=True, kw_only=True)
class Control(_Strict):
    """The lower level: sampling, weights and how gains are adjusted to the delay."""

    sampling_s: Positive
    weight: Positive
    max_delay_s: Positive
    loop: Literal["network", "split", "local"]
    delay: Literal["sojourn", "age"]
    sample_phases: Literal["aligned", "spread"]
    operator_share: Annotated[float, Field(gt=0, le=1)]
    method: GainMethod
    decay_rate: Annotated[float, Field(ge=0, lt=1)]
    gain: Literal["adjusted", "nominal"]
    hold_samples: Annotated[int, Field(ge=0)]
    link: Literal["measurements", "playout", "packetised"]
    playout_s: Positive
    packet_samples: Annotated[int, Field(ge=1, le=200)]
    command_hold_s: NonNegative
    known_motion: bool
    stamp_error_samples: Annotated[int, Field(ge=-1000, le=1000)]
    believed_lag_s: Positive | None
    believed_slip_speed_mps: NonNegative | None
    believed_slip_turn_rate_radps: NonNegative | None
    believed_slip_time_s: Positive | None


@dataclass(frozen=True, kw_only=True)
class Learning(_Strict):
    """The two agents and how they are trained."""

    algorithm: LearnerName
    network: Literal["shared", "mlp", "linear"]
    start: Literal["pf", "max_weight", "drift_plus_penalty"]
    weighs: Literal["utility", "drift"]
    reward: Literal["cooperative", "independent"]
    reward_terms: Literal["drift_plus_penalty", "control_drift"]
    task_weight: NonNegative
    observe_robots: bool
    observe_demand: bool
    frozen: bool
    seeds: Annotated[tuple[Seed, ...], NonEmpty]
    episodes: Count
    slots_per_episode: Count
    num_envs: Count
    checkpoints: Count
    checkpoint_worlds: Count
    hidden: Annotated[tuple[Count, ...], NonEmpty]
    weight_exponent: Annotated[float, Field(gt=0, le=20)]
    reward_scale: Positive
    discount: Annotated[float, Field(ge=0, lt=1)]
    rollout_slots: Count
    advantage: Literal["slice", "user", "counterfactual"]
    gae_decay: Annotated[float, Field(ge=0, le=1)]
    pairs: Count
    perturbation_std: Positive
    fitness: Literal["tracking", "reward"]
    shortfall_price: NonNegative
    batch_size: Count
    replay_capacity: Count
    warmup_slots: Annotated[int, Field(ge=0)]
    critic_warmup_updates: Annotated[int, Field(ge=0)]
    actor_lr: Positive
    critic_lr: Positive
    target_rate: Annotated[float, Field(gt=0, le=1)]
    exploration_std: NonNegative
    exploration_final_std: NonNegative
    gradient_clip: Positive
    floor_slope: Annotated[float, Field(ge=0, le=1)]
    action_penalty: NonNegative
    parameters: OwnKeys = field(hash=False)


@dataclass(frozen=True, kw_only=True)
class Worlds(_Strict):
    """Held-out worlds in which policies run: a warm-up, then what is measured."""

    seeds: Annotated[tuple[Seed, ...], NonEmpty]
    warmup_s: NonNegative
    duration_s: Positive
    policies: Annotated[tuple[PolicyName, ...], NonEmpty]


@dataclass(frozen=True, kw_only=True)
class Evaluation(Worlds):
    """Held-out worlds in which every policy is run."""

    full_logs: Annotated[int, Field(ge=0)]
    full_log_s: Positive


@dataclass(frozen=True, kw_only=True)
class Axis(_Strict):
    """What a sweep varies: every combination of the values of its keys."""

    vary: Annotated[Mapping[str, Annotated[tuple[Any, ...], NonEmpty]], NonEmpty] = field(
        hash=False
    )
    policies: Literal["all", "own"] | Annotated[tuple[PolicyName, ...], NonEmpty] | None


@dataclass(frozen=True, kw_only=True)
class Sweeps(Worlds):
    """One axis varied at a time."""

    axes: Mapping[AxisName, Axis] = field(hash=False)


@dataclass(frozen=True, kw_only=True)
class Bound(_Strict):
    """Slots of the evaluation whose exact optimum is computed."""

    slots_per_log: Annotated[int, Field(ge=0)]


@dataclass(frozen=True, kw_only=True)
class Generalise(Worlds):
    """Cells of other sizes, in which trained policies run as they are."""

    cells: tuple[tuple[Count, Count, Count], ...]


@dataclass(frozen=True, kw_only=True)
class Family(_Strict):
    """A rule without its knob, and the range in which the study of the task looks for that."""

    policy: Annotated[Rule, rule_entry()]
    range: Range | None = None


@dataclass(frozen=True, kw_only=True)
class TaskCell(_Strict):
    """Values of dotted keys, the families that run there, and whether with curves over knobs.

    With `bound_late` knobs keep the lateness of eMBB packets as well as their throughput.

    `expected_rms` and `expected_p99` are ranges for the ratio of the tracking errors of the first
    family that knows the task and the best that does not: fixed before a run, printed beside it.
    """

    values: Mapping[str, Any] = field(hash=False)
    families: Literal["all"] | Annotated[tuple[PolicyName, ...], NonEmpty] = "all"
    bound_late: bool = False
    pareto: bool = False
    expected_rms: Range | None = None
    expected_p99: Range | None = None


@dataclass(frozen=True, kw_only=True)
class TaskStudy(_Strict):
    """Families of rules at equal eMBB throughput: what knowing the robots' task is worth."""

    families: Mapping[PolicyName, Family] = field(hash=False)
    cells: Mapping[CellName, TaskCell] = field(hash=False)
    policies: tuple[PolicyName, ...]
    design_seeds: Annotated[tuple[Seed, ...], NonEmpty]
    seeds: Annotated[tuple[Seed, ...], NonEmpty]
    warmup_s: NonNegative
    duration_s: Positive
    embb_share: Annotated[float, Field(gt=0, le=1)]
    embb_late_excess: NonNegative
    pareto_knobs: Annotated[int, Field(ge=2, le=100)]


@dataclass(frozen=True, kw_only=True)
class LoopCell(_Strict):
    """Values of dotted keys under a delay that is constant, or that grows to it again and again."""

    values: Mapping[str, Any] = field(default_factory=dict, hash=False)
    delay_s: Positive
    sawtooth: bool = False
    methods: Annotated[tuple[GainMethod, ...], NonEmpty] | None = None


@dataclass(frozen=True, kw_only=True)
class GainStudy(_Strict):
    """Forced delays, nominal against adjusted gain: Table II and the sweeps around it."""

    seeds: Annotated[tuple[Seed, ...], NonEmpty]
    num_robots: Count
    num_windows: Count
    violation_windows: Annotated[tuple[Count, ...], NonEmpty]
    violation_delay_s: tuple[Positive, Positive]
    calm_delay_s: tuple[Positive, Positive]
    methods: tuple[GainMethod, ...]
    sweep_robots: Count
    sweep_windows: Annotated[int, Field(ge=2)]
    weight: tuple[Positive, ...]
    fixed_delay_s: tuple[Positive, ...]
    sampling_s: tuple[Positive, ...]
    noise_position_m: tuple[NonNegative, ...]
    noise_heading_rad: tuple[NonNegative, ...]
    cells: Mapping[CellName, LoopCell] = field(hash=False)
    cell_methods: tuple[GainMethod, ...]
    cell_windows: Annotated[int, Field(ge=2)]


@dataclass(frozen=True, kw_only=True)
class Log(_Strict):
    """What the MCAP files carry and how they are packed."""

    compression: Literal["zstd", "none"]
    chunk_bytes: Annotated[int, Field(ge=4096, le=2**28)]
    train_profile: TrainProfile
    evaluate_profile: LogProfile
    sweep_profile: LogProfile
    gain_study_profile: Literal["full", "robots"]


@dataclass(frozen=True, kw_only=True)
class Scenario(_Strict):
    """Everything that a run depends on; nothing is read from YAML later."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$", max_length=60)]
    plugins: tuple[str, ...]
    users: Users
    radio: Radio
    traffic: Traffic
    objective: Objective
    schedulers: Schedulers
    robot: Robot
    plant: Annotated[model.Plant, chosen_from(model.PLANT)]
    robot_kinds: Mapping[CellName, RobotKind] = field(hash=False)
    control: Control
    policies: Mapping[PolicyName, Annotated[Rule | ImportedPolicy | FilePolicy, policy_entry()]] = (
        field(hash=False)
    )
    learning: Learning
    learners: Mapping[LearnerName, Learning] = field(hash=False)
    evaluate: Evaluation
    sweeps: Sweeps
    bound: Bound
    generalise: Generalise
    task_study: TaskStudy
    gain_study: GainStudy
    log: Log

    @property
    def num_users(self) -> int:
        """Users of both slices, URLLC first."""
        return self.users.num_urllc + self.users.num_embb

    @property
    def learned(self) -> dict[str, Learning]:
        """Every learner by the name of its policies: the scenario's own, `learners` after it."""
        return {self.learning.algorithm: self.learning, **self.learners}

    @property
    def robot_sizes(self) -> tuple[int, int, int]:
        """States and inputs of a robot, and the standard normals that it takes a slot."""
        return self.plant.sizes(self)

    @property
    def kind_of_robot(self) -> tuple[int, ...]:
        """Return for each robot 0, or the place of its kind by name, from 1 on.

        By name, since mappings are equal whatever their order.
        """
        kinds = enumerate(sorted(self.robot_kinds), 1)
        own = {robot: n for n, name in kinds for robot in self.robot_kinds[name].robots}
        return tuple(own.get(robot, 0) for robot in range(self.users.num_urllc))

    def believed(self, name: str) -> float:
        """Return what the controller believes of a key of the robot, such as ``slip_time_s``."""
        value: float | None = getattr(self.control, "believed_" + name.removeprefix("actuator_"))
        return float(getattr(self.robot, name)) if value is None else value

    @property
    def sends_commands(self) -> bool:
        """Whether commands cross the network rather than measurements."""
        return self.filter_size > 0 and self.control.link != "measurements"

    @property
    def playout_steps(self) -> int:
        """Control samples from a command to its execution; 0 where it has no such time."""
        if not self.sends_commands or self.control.link != "playout":
            return 0
        return delay_steps(self.control.playout_s, self.control.sampling_s)

    @property
    def latency_steps(self) -> int:
        """Control samples of the fixed latency."""
        return delay_steps(self.robot.core_latency_s, self.control.sampling_s)

    @property
    def packet_horizon(self) -> int:
        """Control samples for which a packet has commands behind its own; 0 without packets."""
        if not self.sends_commands or self.control.link != "packetised":
            return 0
        return self.control.packet_samples

    @property
    def filter_size(self) -> int:
        """States of the filter in a robot's loop, 0 without one."""
        if self.control.method != "lqg" or self.control.gain == "nominal":
            return 0
        return self.robot_sizes[0] + self.plant.num_disturbances

    @property
    def loop_kind(self) -> Literal["network", "split", "local"]:
        """Whether all feedback crosses the network, a part of it, or none."""
        return self.plant.loop(self)

    @property
    def plant_name(self) -> str:
        """Name of the plant in tables: where `control.loop` decides, what crosses the network."""
        return self.loop_kind if self.plant.chooses_loop else self.plant.model

    @property
    def steps_per_slot(self) -> int:
        """Integration steps of a robot in a slot."""
        return round(self.radio.slot_s / self.robot.substep_s)

    @property
    def tracks_age(self) -> bool:
        """Whether the age of set-points matters: they are late, or the delay is an age."""
        return self.robot.set_point != "present" or self.control.delay == "age"

    @property
    def max_delay_steps(self) -> int:
        """T_max, the largest delay that a gain is designed for, in control samples."""
        if self.loop_kind == "local":
            return 0
        return delay_steps(self.control.max_delay_s, self.control.sampling_s)


def model_at(scenario: Scenario, key: str) -> model.Model:
    """Return the model at a dotted key of `models.model.SECTIONS`."""
    found: model.Model = attrgetter(key)(scenario)
    return found


def hold_of(method: str) -> int:
    """Return for how many samples gains of a method are held unless told otherwise.

    A gain for a long delay that stays for a while keeps a loop that delays make switch every few
    samples from growing. A prediction over T samples is right for the delay T alone.
    """
    return 0 if method in ("predictor", "lqg") else 5


def worlds_per_round(learning: Learning) -> int:
    """Worlds of a round of training: one an episode, or one for all members of a population."""
    if learning.algorithm != "es":
        return learning.num_envs
    return learning.num_envs // (2 * learning.pairs + 1)


def checkpoint_rounds(learning: Learning) -> tuple[int, ...]:
    """Return the rounds after which policies run without noise: from 0, the start, to the last."""
    rounds = learning.episodes // learning.num_envs
    count = learning.checkpoints
    return tuple(dict.fromkeys(round(rounds * i / count) for i in range(count + 1)))


def delay_steps(delay_s: float, sampling_s: float) -> int:
    """Delay in control samples, ceil(D/h); a ratio up to 1e-9 above an integer is that integer."""
    return int(-(-(delay_s / sampling_s - 1e-9) // 1))
