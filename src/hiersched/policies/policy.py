"""What a policy is: from what a base station may know to weights, or to owners.

There are three forms, all of which `Simulator.run` takes:

- a `Rule`, compiled (`policies.registry`);
- a `Weigher`, compiled: factors of a base rule's utilities, such as a trained network;
- anything with `decide(view)`, in Python, called once a slot for all worlds.
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

    Attributes
    ----------
    slot
        Index of the slot, shape (E,).
    rate_mbps
        Reported rate of each user on each PRB, shape (E, U, K).
    backlog_packets, hol_delay_s
        Queue, and wait of its oldest packet, shape (E, U).
    average_rate_mbps, last_rate_mbps
        Moving average, and rate of the slot before, shape (E, U).
    multiplier
        Of each URLLC user's delay constraint, shape (E, R).
    dexterity_index
        As last reported by the robots, shape (E, R).
    constants
        Deadlines, slices, what is expected of the arrivals: `simulator.SlotConstants`.
    """

    slot: NDArray[np.int64]
    rate_mbps: NDArray[np.float32]
    backlog_packets: NDArray[np.float64]
    hol_delay_s: NDArray[np.float64]
    average_rate_mbps: NDArray[np.float64]
    last_rate_mbps: NDArray[np.float64]
    multiplier: NDArray[np.float64]
    dexterity_index: NDArray[np.float64]
    constants: SlotConstants


class Weights(NamedTuple):
    """Factors of the utilities of a rule, positive, shape (E, U)."""

    values: NDArray[np.float64]
    rule: str = "pf"


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
    """A compiled policy that weighs the users of a base rule.

    Its words have a kernel of the seam `policies.seams.WEIGH`.

    Attributes
    ----------
    rule
        Name of the base rule.
    multipliers
        Of each URLLC user's delay constraint, shape (R,), as long as the policy runs.
    """

    rule: str
    multipliers: NDArray[np.float64]

    def words(self, setup: Setup) -> Any:
        """Return the NamedTuple that its kernel gets."""
        raise NotImplementedError

    def reset(self, words: Any, keys: NDArray[np.uint64]) -> None:
        """Bring the words back to the start of an episode in the worlds `keys` (E,), in place."""


class FunctionPolicy:
    """A Python function of a view as a policy.

    Parameters
    ----------
    function
        Takes a `View` and `parameters`; returns `Weights`, `Owners`, or factors of the utilities,
        shape (E, U).
    rule
        Base rule of returned factors.
    parameters
        Further arguments.
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


class LoggedWeights:
    """The weights of a log, slot by slot: factors of a rule's utilities, shape (E, T, U)."""

    def __init__(self, values: NDArray[np.float64], rule: str) -> None:
        self._values, self._rule, self._slot = values, rule, 0

    def decide(self, view: View) -> Weights:
        """As in `Policy`."""
        self._slot += 1
        return Weights(self._values[:, self._slot - 1], self._rule)


class LoggedDecisions(NamedTuple):
    """The decisions of a log: owners, shape (E, T, K), of the coming T slots."""

    prb_owner: NDArray[np.uint32]
