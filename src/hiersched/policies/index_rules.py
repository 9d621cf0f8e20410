"""The classical schedulers as weights, utilities or orders of the one allocator.

Every rule reads what a base station knows at the start of a slot: backlog, head-of-line delay W,
moving average rate and the channel, never the slot's arrivals. Sources: Kelly 1998 (pf), Jalali et
al. 2000 (pf_average), Tassiulas and Ephremides 1992 (max_weight), Andrews et al. 2001 (m_lwdf),
Rhee et al. 2003 (exp_pf), Sadiq et al. 2009 (log_rule), Neely 2010 (drift_plus_penalty). Their knob
is `policies.factor`'s, EDF's a factor of the deadlines: at 1 a rule is that of its source.

MaxWeight, M-LWDF, EXP/PF and LOG maximise the sum of w min(r, need): a user can use no more of a
slot than its queue holds, and without the cap a rule that gives out many PRBs a slot goes on
feeding queues that are empty already (Andrews and Zhang, IEEE/ACM Trans. Networking 19(2), 2011).

EXP/PF gives URLLC users exp((a W - m) / (1 + sqrt m)) / R, m the mean a W of all URLLC users, those
without a packet (W = 0) among them, and eMBB users 1 / R, as LTE-Sim does (Piro et al. 2011).
LTE-Sim takes the mean over the users that have packets and cuts exponents below 0 to 0. Rhee et al.
multiply the eMBB users' weight by an adaptive w(t) / M(t), M the mean number of waiting real-time
packets, and w lowered by a step while a real-time packet waits too long, raised by a fraction of it
otherwise. LOG is LTE-Sim's, ln(1.1 + 5 W / deadline) / R, for the users of both slices; Sadiq et
al. have a factor b instead of 1 / R. docs/paper_notes.md (5a) says how much of this matters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

from pydantic import Field

from hiersched.core.parameters import Note, Positive
from hiersched.models.model import Setup
from hiersched.policies.factor import (
    Drift,
    Factor,
    Factored,
    Utility,
    Weighs,
    urllc_factor,
    weigh_drift,
)
from hiersched.policies.needs import (
    NEEDS,
    expected_packets,
    expected_wait_s,
    need_mbps,
    order_by_deadline,
)
from hiersched.policies.registry import RULES, Look, Rule
from hiersched.policies.seams import INDEX

if TYPE_CHECKING:
    from hiersched.scenario.schema import Scenario

Need = Literal["none", "backlog", "backlog_and_arrivals"]


class _NeedWords(NamedTuple):
    """Code of `NEEDS`, and k."""

    need: int
    factor: float


@RULES.model
@dataclass(frozen=True, kw_only=True)
class ProportionalFair(Utility):
    """Maximise the sum of log r, the paper's baseline."""

    model: Literal["pf"] = "pf"
    look: ClassVar[Look] = Look("PF", "#D55E00", (0, (4, 1.5)), "s")
    allocation = "log"
    urllc_factor: Factor = 1.0


@RULES.model
@dataclass(frozen=True, kw_only=True)
class DriftPlusPenalty(Drift):
    """Minimise the slot's Lagrangian, with the arrivals at their mean."""

    model: Literal["drift_plus_penalty"] = "drift_plus_penalty"
    look: ClassVar[Look] = Look("drift-plus-penalty", "#CC79A7", (0, (1, 1.2)), "D")
    urllc_factor: Factor = 1.0
    weighs: Weighs = "drift"

    def words(self, setup: Setup) -> DriftWords | None:
        """As in `Model`; None without a factor: then all users are alike."""
        if self.urllc_factor == 1.0:
            return None
        return DriftWords(self.urllc_factor, self.weighs == "both")


class DriftWords(NamedTuple):
    """k, and whether it is of the penalty too."""

    factor: float
    both: bool


@INDEX.kernel(DriftWords)
def index_drift(me: DriftWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Weigh the drift of URLLC users k times, or drift and penalty."""
    for user in range(state.index_weight.shape[1]):
        weigh_drift(state, env, user, urllc_factor(constants, user, me.factor), me.both)


@RULES.model
@dataclass(frozen=True, kw_only=True)
class RoundRobin(Rule):
    """PRBs go around the users."""

    model: Literal["round_robin"] = "round_robin"
    look: ClassVar[Look] = Look("round robin", "#56B4E9", (0, (2, 2)), "P")
    allocation = "in_turn"


@RULES.model
@dataclass(frozen=True, kw_only=True)
class MaxRate(Utility):
    """Maximise the sum of r."""

    model: Literal["max_rate"] = "max_rate"
    look: ClassVar[Look] = Look("max rate", "#999999", (0, (8, 2)), "X")
    urllc_factor: Factor = 1.0


@RULES.model
@dataclass(frozen=True, kw_only=True)
class AverageProportionalFair(Factored):
    """Maximise the sum of r / R, R the moving average: the textbook's PF."""

    model: Literal["pf_average"] = "pf_average"
    look: ClassVar[Look] = Look("PF, average rate", "#E69F00", (0, (3, 1, 1, 1, 1, 1)), "v")
    urllc_factor: Factor = 1.0

    def words(self, setup: Setup) -> AverageWords:
        """As in `Model`."""
        return AverageWords(self.urllc_factor)


class AverageWords(NamedTuple):
    """k."""

    factor: float


@INDEX.kernel(AverageWords)
def index_pf_average(me: AverageWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """1 / R, k times that for URLLC users."""
    for user in range(state.index_weight.shape[1]):
        factor = urllc_factor(constants, user, me.factor)
        state.index_weight[env, user] = factor / state.average_rate_mbps[env, user]


class _Capped(Factored):
    """Maximises the sum of w min(r, need); its own key `need` is that of `schedulers`."""

    need: Need
    words_of: ClassVar[type[_NeedWords]]

    @property
    def allocation(self) -> str:
        """As in `Rule`."""
        return "linear" if self.need == "none" else "capped"

    @classmethod
    def standard(cls, scenario: Scenario) -> Any:
        """As in `Rule`."""
        return cls(need=getattr(scenario.schedulers, f"{cls.model}_need"))  # type: ignore[call-arg]

    def words(self, setup: Setup) -> Any:
        """As in `Model`."""
        return self.words_of(NEEDS[self.need], self.urllc_factor)


class MaxWeightWords(_NeedWords):
    """Of `MaxWeight`."""


@RULES.model
@dataclass(frozen=True, kw_only=True)
class MaxWeight(_Capped):
    """w = F, the backlog."""

    model: Literal["max_weight"] = "max_weight"
    look: ClassVar[Look] = Look("max-weight", "#009E73", (0, (6, 1.5, 1, 1.5)), "^")
    words_of = MaxWeightWords
    need: Need = "backlog_and_arrivals"
    urllc_factor: Factor = 1.0


@INDEX.kernel(MaxWeightWords)
def index_max_weight(me: MaxWeightWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """F, k F for URLLC users."""
    for user in range(state.index_weight.shape[1]):
        packets = expected_packets(constants, state, env, user, me.need)
        state.need_mbps[env, user] = need_mbps(constants, state, env, user, packets)
        state.index_weight[env, user] = urllc_factor(constants, user, me.factor) * packets


class DelayFirstWords(_NeedWords):
    """Of `LargestWeightedDelayFirst`."""


@RULES.model
@dataclass(frozen=True, kw_only=True)
class LargestWeightedDelayFirst(_Capped):
    """M-LWDF: w = -log10(delta) / D W / R, delta the admitted late share, D the deadline."""

    model: Literal["m_lwdf"] = "m_lwdf"
    look: ClassVar[Look] = Look("M-LWDF", "#7a5195", (0, (5, 1, 1, 1)), "<")
    words_of = DelayFirstWords
    need: Need = "backlog"
    urllc_factor: Factor = 1.0


@INDEX.kernel(DelayFirstWords)
def index_m_lwdf(me: DelayFirstWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """-log10(delta) / D W / R, k times that for URLLC users."""
    for user in range(state.index_weight.shape[1]):
        packets = expected_packets(constants, state, env, user, me.need)
        wait_s = expected_wait_s(constants, state, env, user, me.need)
        state.need_mbps[env, user] = need_mbps(constants, state, env, user, packets)
        urgency = -math.log10(constants.late_share[user]) / constants.deadline_s[user] * wait_s
        urgency *= urllc_factor(constants, user, me.factor)
        state.index_weight[env, user] = urgency / state.average_rate_mbps[env, user]


@RULES.model
@dataclass(frozen=True, kw_only=True)
class LogRule(_Capped):
    """LOG: w = ln(c + a W / D) / R."""

    model: Literal["log_rule"] = "log_rule"
    look: ClassVar[Look] = Look("log rule", "#3b3b3b", (0, (1, 2.5)), "p")
    need: Need = "backlog_and_arrivals"
    offset: Annotated[float, Field(ge=1)] = 1.1
    gain: Annotated[float, Field(gt=0)] = 5.0
    urllc_factor: Factor = 1.0

    @classmethod
    def standard(cls, scenario: Scenario) -> LogRule:
        """As in `Rule`."""
        constants = scenario.schedulers
        rule: LogRule = super().standard(scenario)
        return replace(rule, offset=constants.log_rule_offset, gain=constants.log_rule_gain)

    def words(self, setup: Setup) -> LogWords:
        """As in `Model`."""
        return LogWords(NEEDS[self.need], self.offset, self.gain, self.urllc_factor)


class LogWords(NamedTuple):
    """Code of `NEEDS`, c, a and k."""

    need: int
    offset: float
    gain: float
    factor: float


@INDEX.kernel(LogWords)
def index_log_rule(me: LogWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """ln(c + a W / D) / R, k times that for URLLC users."""
    for user in range(state.index_weight.shape[1]):
        packets = expected_packets(constants, state, env, user, me.need)
        wait_s = expected_wait_s(constants, state, env, user, me.need)
        state.need_mbps[env, user] = need_mbps(constants, state, env, user, packets)
        urgency = math.log(me.offset + me.gain * wait_s / constants.deadline_s[user])
        urgency *= urllc_factor(constants, user, me.factor)
        state.index_weight[env, user] = urgency / state.average_rate_mbps[env, user]


class ExponentialWords(_NeedWords):
    """Of `ExponentialProportionalFair`."""


@RULES.model
@dataclass(frozen=True, kw_only=True)
class ExponentialProportionalFair(_Capped):
    """EXP/PF: exp((a W - m) / (1 + sqrt m)) / R for URLLC, m the mean a W; 1 / R for eMBB."""

    model: Literal["exp_pf"] = "exp_pf"
    look: ClassVar[Look] = Look("EXP/PF", "#8c6d31", (0, (3, 3)), ">")
    words_of = ExponentialWords
    need: Need = "backlog_and_arrivals"
    urllc_factor: Factor = 1.0


@INDEX.kernel(ExponentialWords)
def index_exp_pf(me: ExponentialWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """exp((a W - m) / (1 + sqrt m)) / R, k times that, or 1 / R."""
    num_urllc = constants.num_urllc
    index = state.index_weight[env]
    mean = 0.0
    for user in range(index.shape[0]):
        packets = expected_packets(constants, state, env, user, me.need)
        state.need_mbps[env, user] = need_mbps(constants, state, env, user, packets)
    for user in range(num_urllc):
        a = -math.log10(constants.late_share[user]) / constants.deadline_s[user]
        index[user] = a * expected_wait_s(constants, state, env, user, me.need)
        mean += index[user] / num_urllc
    largest = 0.0
    for user in range(num_urllc):
        index[user] = (index[user] - mean) / (1.0 + math.sqrt(mean))
        largest = max(largest, index[user])
    # The rule does not change when all weights are scaled: the largest exponent is taken out, so
    # none overflows.
    for user in range(index.shape[0]):
        exponent = index[user] if user < num_urllc else 0.0
        factor = urllc_factor(constants, user, me.factor)
        index[user] = factor * math.exp(exponent - largest) / state.average_rate_mbps[env, user]


@RULES.model
@dataclass(frozen=True, kw_only=True)
class EarliestDeadlineFirst(Rule):
    """EDF: users in the order of D - W, each until its backlog is served."""

    model: Literal["edf"] = "edf"
    look: ClassVar[Look] = Look("EDF", "#117733", (0, (7, 1, 2, 1)), "h")
    knob: ClassVar[str | None] = "deadline_factor"
    allocation = "by_urgency"
    deadline_factor: Annotated[
        Positive, Note("1", "assumed", "factor of the URLLC users' deadlines")
    ] = 1.0

    def words(self, setup: Setup) -> DeadlineWords:
        """As in `Model`."""
        return DeadlineWords(self.deadline_factor)


class DeadlineWords(NamedTuple):
    """Factor of URLLC users' deadlines."""

    factor: float


@INDEX.kernel(DeadlineWords)
def index_edf(me: DeadlineWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """W - D, and the rate that empties the queue."""
    for user in range(state.index_weight.shape[1]):
        deadline_s = urllc_factor(constants, user, me.factor) * constants.deadline_s[user]
        order_by_deadline(constants, state, env, user, deadline_s)


CLASSICAL = (
    "pf",
    "pf_average",
    "round_robin",
    "max_rate",
    "max_weight",
    "m_lwdf",
    "exp_pf",
    "log_rule",
    "edf",
    "drift_plus_penalty",
)
"""The classical schedulers: rules of this module that run under their own name."""
