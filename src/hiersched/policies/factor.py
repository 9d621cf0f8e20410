"""The knob that rules with weights share: a factor on those of the URLLC users."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, NamedTuple

from numba import njit

from hiersched.core.parameters import Note, Positive
from hiersched.policies.registry import Rule
from hiersched.policies.seams import INDEX

Factor = Annotated[Positive, Note("1", "assumed", "k, factor of the URLLC users' weights")]
Weighs = Annotated[
    Literal["drift", "both"],
    Note("", "assumed", "what URLLC weights multiply: the drift, or drift and penalty"),
]


class Factored(Rule):
    """A rule whose knob is the key `urllc_factor`."""

    urllc_factor: float
    knob: ClassVar[str | None] = "urllc_factor"


class Utility(Factored):
    """Its users are alike but for the factor; without one it needs no kernel."""

    def words(self, setup: Any) -> Any:
        """As in `Model`."""
        return None if self.urllc_factor == 1.0 else UtilityWords(self.urllc_factor)


class UtilityWords(NamedTuple):
    """k."""

    factor: float


@INDEX.kernel(UtilityWords)
def index_utility(me: UtilityWords, constants: Any, state: Any, slot: Any, env: int) -> None:
    """Weigh URLLC users k times as much."""
    for user in range(state.index_weight.shape[1]):
        state.index_weight[env, user] = urllc_factor(constants, user, me.factor)


class Drift(Factored):
    """A rule of drift plus penalty with weights of the URLLC users' drift, or of both."""

    weighs: Weighs
    allocation = "lagrangian"


@njit(inline="always")
def urllc_factor(constants: Any, user: int, factor: float) -> float:
    """Return the factor for a URLLC user, 1 for others."""
    return factor if user < constants.num_urllc else 1.0


@njit(inline="always")
def weigh_drift(state: Any, env: int, user: int, weight: float, both: bool) -> None:
    """Weigh a user's drift in the Lagrangian, or drift and penalty."""
    if both:
        state.index_weight[env, user] = weight
    else:
        state.index_weight[env, user] = 1.0
        state.drift_weight[env, user] = weight
