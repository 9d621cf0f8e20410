"""Schedulers by what the robots' task asks for, and their control-blind twins.

Most are drift plus penalty with a weight on the drift of URLLC users, k times a function of what a
base station may know (`simulator.SlotState`): v the speed of the newest set-point in the user's
queue, e the tracking error as last reported, W the wait of the oldest packet, lambda the packets a
slot, lambda_mean their mean over URLLC users. eMBB users have weight 1. `knows_task` says which of
them read the task. They run under the names of a scenario's `policies`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

from numba import njit

from hiersched.core.parameters import NonNegative, Note, Positive
from hiersched.models.model import Setup
from hiersched.policies.factor import Drift, Factor, Weighs, weigh_drift
from hiersched.policies.needs import order_by_deadline
from hiersched.policies.registry import RULES, Look, Rule
from hiersched.policies.seams import INDEX

ERROR_SCALE_M = 0.02
"""Error, or gap, that adds 1 to the floor of a weight."""
ACCELERATION_SCALE_MPS2 = 3.0
"""Acceleration that does so."""
LEAST_DEADLINE_S, GREATEST_DEADLINE_S = 0.005, 0.2
"""Bounds of a deadline made of a tolerance."""

Floor = Annotated[NonNegative, Note("1", "assumed", "weight at rest, before k")]
Speed = Annotated[
    Literal["newest", "waiting"],
    Note(
        "", "assumed", "v of the newest set-point, or the greatest since the oldest packet arrived"
    ),
]

NOTHING, NEWEST, WAITING, ACCELERATION, GAP, ERROR = range(6)
"""Code of what is squared in a weight."""
_SPEED = {"newest": NEWEST, "waiting": WAITING}


class TaskWords(NamedTuple):
    """Weight k (floor + (x / scale)^2), times (lambda_mean / lambda)^2 with `by_packets`."""

    factor: float
    floor: float
    what: int  # x
    scale: float
    by_packets: bool
    both: bool  # penalty too


@njit(inline="always")
def _speed_mps(state: Any, env: int, robot: int, what: int) -> float:
    newest, waiting = state.set_point_speed_mps, state.waiting_speed_mps
    return float(waiting[env, robot] if what == WAITING else newest[env, robot])


@njit(inline="always")
def _value(state: Any, env: int, robot: int, what: int) -> float:
    if what == NEWEST or what == WAITING:
        return _speed_mps(state, env, robot, what)
    if what == ACCELERATION:
        return float(state.set_point_acceleration_mps2[env, robot])
    if what == GAP:
        return float(state.set_point_gap_m[env, robot])
    if what == ERROR:
        return float(state.reported_error_m[env, robot])
    return 0.0


@INDEX.kernel(TaskWords)
def index_task(me: TaskWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Weights of the drift by the task; a user without packets has no lambda and counts as mean."""
    num_urllc, due = constants.num_urllc, constants.mean_due_packets
    mean = 0.0
    for user in range(num_urllc):
        mean += due[user] / num_urllc
    for user in range(state.index_weight.shape[1]):
        weight = 1.0
        if user < num_urllc:
            value = _value(state, env, user, me.what) / me.scale
            weight = me.factor * (me.floor + value * value)
            if me.by_packets and due[user] > 0.0:
                weight *= (mean / due[user]) * (mean / due[user])
        weigh_drift(state, env, user, weight, me.both)


class TaskWeight(Drift):
    """Weight k (floor + (x / scale)^2), times (lambda_mean / lambda)^2 with `by_packets`."""

    knows_task = True
    floor: float
    what: ClassVar[int] = NEWEST
    scale: ClassVar[float] = 1.0
    by_packets: ClassVar[bool] = False

    def words(self, setup: Setup) -> TaskWords:
        """As in `Model`."""
        what, both = self._what(), self.weighs == "both"
        return TaskWords(self.urllc_factor, self.floor, what, self.scale, self.by_packets, both)

    def _what(self) -> int:
        """Code of x."""
        return self.what


class SpeedWeight(TaskWeight):
    """Its x is the speed of a set-point."""

    speed: Speed

    def _what(self) -> int:
        return _SPEED[self.speed]


@RULES.model
@dataclass(frozen=True, kw_only=True)
class Urgency(SpeedWeight):
    """Weight k (floor + v^2), v in m/s: a late set-point is off by about v times its age.

    Urgency of information: Zheng, Zhou and Niu, IEEE Trans. Wireless Communications 19, 2020.
    A floor of 0.1 starves robots at rest above capacity.
    """

    model: Literal["urgency"] = "urgency"
    look: ClassVar[Look] = Look("urgency", "#882255", (0, (10, 1.5)), "*")
    urllc_factor: Factor = 1.0
    floor: Floor = 0.3
    speed: Speed = "newest"
    weighs: Weighs = "drift"


@RULES.model
@dataclass(frozen=True, kw_only=True)
class GeneralisedCMu(SpeedWeight):
    """Weight k (floor + v^2) (lambda_mean / lambda)^2: the cost of a lag F / lambda is (v lag)^2.

    The generalised c mu rule: Van Mieghem, Annals of Applied Probability 5(3), 1995; Mandelbaum and
    Stolyar, Operations Research 52(6), 2004.
    """

    model: Literal["cmu"] = "cmu"
    look: ClassVar[Look] = Look(
        "generalised c\N{GREEK SMALL LETTER MU}", "#CC6677", (0, (10, 1.5, 1, 1.5)), "d"
    )
    by_packets = True
    urllc_factor: Factor = 1.0
    floor: Floor = 0.05
    speed: Speed = "newest"
    weighs: Weighs = "drift"


@RULES.model
@dataclass(frozen=True, kw_only=True)
class ErrorWeight(TaskWeight):
    """Weight k (floor + e^2 / (2 cm)^2), e the tracking error as last reported.

    Error-dependent scheduling: Mamduhi, Molin, Tolic and Hirche, Automatica 81, 2017.
    """

    model: Literal["error_weight"] = "error_weight"
    look: ClassVar[Look] = Look("error", "#AA4499", (0, (10, 1.5, 1, 1.5, 1, 1.5)), "H")
    what, scale = ERROR, ERROR_SCALE_M
    urllc_factor: Factor = 1.0
    floor: Floor = 0.1
    weighs: Weighs = "drift"


@RULES.model
@dataclass(frozen=True, kw_only=True)
class GapWeight(TaskWeight):
    """Weight k (floor + g^2 / (2 cm)^2), g the distance of the newest and the held set-point.

    The error of try-once-discard: Walsh and Ye, IEEE Control Systems Magazine 21(1), 2001; value of
    information: Ayan et al., ICCPS 2019.
    """

    model: Literal["gap_weight"] = "gap_weight"
    look: ClassVar[Look] = Look("gap", "#6F4C9B", (0, (10, 1.5, 3, 1.5)), "8")
    what, scale = GAP, ERROR_SCALE_M
    reads_age = True
    urllc_factor: Factor = 1.0
    floor: Floor = 0.1
    weighs: Weighs = "drift"


@RULES.model
@dataclass(frozen=True, kw_only=True)
class Surprise(TaskWeight):
    """Weight k (floor + a^2 / (3 m/s^2)^2), a the acceleration of the newest set-point.

    For robots that extrapolate: they cannot predict it. Of this project.
    """

    model: Literal["surprise"] = "surprise"
    look: ClassVar[Look] = Look("surprise", "#A6761D", (0, (10, 1.5, 3, 1.5, 3, 1.5)), "P")
    what, scale = ACCELERATION, ACCELERATION_SCALE_MPS2
    urllc_factor: Factor = 1.0
    floor: Floor = 0.1
    weighs: Weighs = "drift"


@RULES.model
@dataclass(frozen=True, kw_only=True)
class Lag(Drift):
    """Weight k (lambda_mean / lambda)^2: what `cmu` knows without the task.

    Of this project.
    """

    model: Literal["lag"] = "lag"
    look: ClassVar[Look] = Look("lag", "#5F7F8F", (0, (1, 1)), "v")
    urllc_factor: Factor = 1.0
    weighs: Weighs = "drift"

    def words(self, setup: Setup) -> TaskWords:
        """As in `Model`."""
        return TaskWords(self.urllc_factor, 1.0, NOTHING, 1.0, True, self.weighs == "both")


class AgeWords(NamedTuple):
    """k, whether the weight is Whittle's index, and whether it is of the penalty too."""

    factor: float
    whittle: bool
    both: bool


@njit(inline="always")
def whittle_index(age: float, delivery: float) -> float:
    """Whittle's index p h (h + (2 - p) / p) / 2 of the age h in slots, p the share delivered.

    It is the charge for a transmission at which sending from the age h on costs as much as sending
    from h + 1 on; the age falls to 1 with what is delivered.
    """
    return 0.5 * delivery * age * (age + (2.0 - delivery) / delivery)


@INDEX.kernel(AgeWords)
def index_age(me: AgeWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Weights of the drift by the age of the held set-point in slots, one at least."""
    for user in range(state.index_weight.shape[1]):
        weight = 1.0
        if user < constants.num_urllc:
            age = max(1.0, state.set_point_age_s[env, user] / constants.slot_s)
            weight = me.factor * (whittle_index(age, 1.0) if me.whittle else age)
        weigh_drift(state, env, user, weight, me.both)


@RULES.model
@dataclass(frozen=True, kw_only=True)
class Age(Drift):
    """Weight k h, h the age of the held set-point in slots, or k h (h + 1) / 2, Whittle's index.

    Kadota, Sinha, Uysal-Biyikoglu, Singh and Modiano, IEEE/ACM Trans. Networking 26(6), 2018; their
    channel delivers with probability p, here 1: what is served arrives.
    """

    model: Literal["age"] = "age"
    look: ClassVar[Look] = Look("age of information", "#8F8F5F", (0, (2, 1, 1, 1)), "^")
    reads_age = True
    urllc_factor: Factor = 1.0
    index: Annotated[
        Literal["age", "whittle"], Note("", "assumed", "the age itself, or Whittle's index of it")
    ] = "age"
    weighs: Weighs = "drift"

    def words(self, setup: Setup) -> AgeWords:
        """As in `Model`."""
        return AgeWords(self.urllc_factor, self.index == "whittle", self.weighs == "both")


class ToleranceWords(NamedTuple):
    """Tolerance, and code of the speed."""

    tolerance_m: float
    speed: int


@INDEX.kernel(ToleranceWords)
def index_task_edf(me: ToleranceWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """W - D, D of the task for URLLC users, and the rate that empties the queue."""
    for user in range(state.index_weight.shape[1]):
        deadline = constants.deadline_s[user]
        if user < constants.num_urllc:
            speed = _speed_mps(state, env, user, me.speed)
            deadline = GREATEST_DEADLINE_S
            if speed * deadline > me.tolerance_m:
                deadline = max(LEAST_DEADLINE_S, me.tolerance_m / speed)
            deadline -= constants.loop.core_latency_s
        order_by_deadline(constants, state, env, user, deadline)


@RULES.model
@dataclass(frozen=True, kw_only=True)
class TaskDeadlineFirst(Rule):
    """EDF with the deadlines clip(tolerance / v, 5 ms, 200 ms) - core latency for URLLC users.

    In that time a set-point moves by the tolerance. eMBB users keep their deadline. Of this
    project.
    """

    model: Literal["task_edf"] = "task_edf"
    look: ClassVar[Look] = Look("EDF by task", "#B2182B", (0, (10, 1.5, 5, 1.5)), "h")
    knob: ClassVar[str | None] = "tolerance_m"
    knows_task = True
    allocation = "by_urgency"
    tolerance_m: Annotated[Positive, Note("m", "assumed", "how far a set-point may move on")] = 0.02
    speed: Speed = "newest"

    def words(self, setup: Setup) -> ToleranceWords:
        """As in `Model`."""
        return ToleranceWords(self.tolerance_m, _SPEED[self.speed])


class GapWords(NamedTuple):
    """No parameters."""

    none: int = 0


@INDEX.kernel(GapWords)
def index_try_once_discard(me: GapWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Gaps, and EDF's W - D shifted below 0 for eMBB users; the rate that empties the queue."""
    num_urllc, num_users = constants.num_urllc, state.index_weight.shape[1]
    urgency = state.index_weight[env]
    for user in range(num_users):
        order_by_deadline(constants, state, env, user, constants.deadline_s[user])
        if user < num_urllc:
            urgency[user] = state.set_point_gap_m[env, user]
    largest = 0.0
    for user in range(num_urllc, num_users):
        largest = max(largest, urgency[user])
    for user in range(num_urllc, num_users):
        urgency[user] -= largest + 1.0


@RULES.model
@dataclass(frozen=True, kw_only=True)
class TryOnceDiscard(Rule):
    """URLLC users in the order of g, each until its backlog is served, then eMBB users as in EDF.

    The protocol itself: Walsh, Ye and Bushnell, IEEE Trans. Control Systems Technology 10(3), 2002.
    Users with equal gaps are served in their order.
    """

    model: Literal["try_once_discard"] = "try_once_discard"
    look: ClassVar[Look] = Look("try once, discard", "#543005", (0, (10, 1.5, 5, 1.5, 1, 1.5)), "X")
    reads_age = True
    knows_task = True
    allocation = "by_urgency"

    def words(self, setup: Setup) -> GapWords:
        """As in `Model`."""
        return GapWords()


TASK_RULES = (
    "urgency",
    "cmu",
    "error_weight",
    "gap_weight",
    "surprise",
    "task_edf",
    "try_once_discard",
    "lag",
    "age",
)
"""The rules of this module; the last two are control-blind."""
