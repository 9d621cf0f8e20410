"""What a policy is: from what a base station may know to weights, or to owners.

There are four forms, all of which `Simulator.run` takes:

- a `Rule`, compiled (`policies.registry`);
- a `Weigher`, compiled: factors of a base rule's utilities, such as a trained network;
- anything with `decide(view)`, in Python, called once a slot for all worlds;
- an `Agent`, in Python likewise: it observes features and acts, as in the environments.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hiersched.models.model import Setup

if TYPE_CHECKING:
    from hiersched.simulator.setup import SlotConstants


class View(NamedTuple):
    """What a base station may know at the start of a slot, in E worlds; read-only.

    U users, URLLC first, R robots (one a URLLC user), K PRBs. There are no arrivals of the slot.
    """

    slot: NDArray[np.int64]  # (E,) index
    rate_mbps: NDArray[np.float32]  # (E, U, K) reported
    backlog_packets: NDArray[np.float64]  # (E, U)
    hol_delay_s: NDArray[np.float64]  # (E, U) wait of the oldest packet
    average_rate_mbps: NDArray[np.float64]  # (E, U) moving
    last_rate_mbps: NDArray[np.float64]  # (E, U) of the slot before
    multiplier: NDArray[np.float64]  # (E, R) of each URLLC user's delay constraint
    dexterity_index: NDArray[np.float64]  # (E, R) as last reported by the robots
    # The robots' task: newest is the last set-point in the queue, held the one in force.
    set_point_age_s: NDArray[np.float64]  # (E, R) of the held one
    set_point_speed_mps: NDArray[np.float64]  # (E, R) of the newest
    waiting_speed_mps: NDArray[np.float64]  # (E, R) greatest since the oldest packet arrived
    set_point_acceleration_mps2: NDArray[np.float64]  # (E, R) of the newest, magnitude
    set_point_gap_m: NDArray[np.float64]  # (E, R) distance of newest and held
    reported_error_m: NDArray[np.float64]  # (E, R) position error as last reported
    constants: SlotConstants  # deadlines, slices, what is expected of the arrivals


class Weights(NamedTuple):
    """Factors of the utilities of a rule, or of its drift, positive, shape (E, U)."""

    values: NDArray[np.float64]
    rule: str = "pf"
    weighs: str = "utility"  # or ``drift``, which drift-plus-penalty has


class Owners(NamedTuple):
    """Owner of each PRB, shape (E, K); every user owns one or more."""

    prb_owner: NDArray[np.integer[Any]]


@runtime_checkable
class Policy(Protocol):
    """A policy in Python."""

    def decide(self, view: View) -> Weights | Owners:
        """Decide the coming slot of all worlds."""
        ...


class Weigher:
    """A compiled policy that weighs the users of a base rule, by a kernel of the seam WEIGH."""

    rule: str  # name of the base rule
    weighs: str = "utility"  # what of it the weights are factors of
    multipliers: NDArray[np.float64]  # (R,) of each URLLC user's delay constraint, while it runs

    def words(self, setup: Setup) -> Any:
        """Return the NamedTuple that its kernel gets."""
        raise NotImplementedError

    def reset(self, words: Any, keys: NDArray[np.uint64]) -> None:
        """Bring the words back to the start of an episode in the worlds `keys` (E,), in place."""


class FunctionPolicy:
    """A Python function of a view, and `parameters`, as a policy.

    It returns `Weights`, `Owners`, or factors (E, U) of the utilities of `rule`.
    """

    def __init__(
        self, function: Callable[..., Any], rule: str, parameters: Mapping[str, Any]
    ) -> None:
        self._function, self._rule, self._parameters = function, rule, dict(parameters)

    def decide(self, view: View) -> Weights | Owners:
        """As in `Policy`."""
        decision = self._function(view, **self._parameters)
        if isinstance(decision, np.ndarray):
            return Weights(decision, self._rule)
        return decision  # the simulator looks at it


def action_weights(actions: NDArray[np.floating], weight_exponent: float) -> NDArray[np.float64]:
    """Turn actions a into weights w = exp(c a), any shape; float32 values, as the log has them."""
    exponent = np.float64(weight_exponent) * actions
    return np.exp(exponent).astype(np.float32).astype(np.float64)


class Agent:
    """A policy in Python that acts as agents do in the environments (`hiersched.env`)."""

    name: str  # in messages
    rule: str  # the scheduler whose utilities, or drift, its weights multiply
    weighs: str  # ``utility`` or ``drift``: which of them
    weight_exponent: float  # c of w = exp(c a)
    observe_robots: bool  # whether the features of the robots are observed
    observe_demand: bool  # whether those of their tasks' demand are

    def act(self, features: NDArray[np.float32]) -> NDArray[np.floating]:
        """Return a number in [-1, 1] for every user, shape (E, U), from features (E, U, F)."""
        raise NotImplementedError

    def weights(self, features: NDArray[np.float32]) -> Weights:
        """Return the weights of its actions; ValueError if one is outside [-1, 1], or no number."""
        actions = self.act(features)
        fine = np.abs(actions) <= 1.0  # one comparison that is false for NaN too
        if not fine.all():
            env, user = np.argwhere(~fine)[0].tolist()
            raise ValueError(
                f"{self.name}: actions must lie in [-1, 1] (a graph has to clip them itself); user "
                f"{user} of world {env} has {actions[env, user]}"
            )
        return Weights(action_weights(actions, self.weight_exponent), self.rule, self.weighs)


class LoggedWeights:
    """The weights of a log, slot by slot, shape (E, T, U), of a rule (`Weights`)."""

    def __init__(self, values: NDArray[np.float64], rule: str, weighs: str = "utility") -> None:
        self._values, self._rule, self._weighs, self._slot = values, rule, weighs, 0

    def decide(self, view: View) -> Weights:
        """As in `Policy`."""
        self._slot += 1
        return Weights(self._values[:, self._slot - 1], self._rule, self._weighs)


class LoggedDecisions(NamedTuple):
    """The decisions of a log: owners, shape (E, T, K), of the coming T slots."""

    prb_owner: NDArray[np.uint32]
