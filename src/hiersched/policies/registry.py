"""Policies by name: compiled rules, and what a scenario adds to them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

from hiersched.allocation.in_order import TurnWords, urgency_words
from hiersched.allocation.marginal import CAPPED, LAGRANGIAN, LINEAR, LOG, marginal_words
from hiersched.models.model import Model, Section

if TYPE_CHECKING:
    from hiersched.scenario.schema import Scenario

R = TypeVar("R", bound="Rule")


class Look(NamedTuple):
    """How a series is drawn: label, colour (Okabe and Ito's palette), dashes, marker."""

    label: str
    color: str
    dashes: Any
    marker: str


class Rule(Model):
    """A compiled scheduler with keys of its own: an allocation, and the kernel of an index.

    Its words have a kernel of the seam `policies.seams.INDEX`; with the allocation ``own`` one of
    `ALLOCATE` instead, and with ``log`` and ``lagrangian`` it needs none. Its `faults` do not name
    its place in the scenario. `look` is how figures show the rule under its own name.

    `knob` is the key by which a study sets the rule's favour for URLLC against eMBB users, None
    where there is none; `knows_task` whether the rule reads the robots' task.
    """

    look: ClassVar[Look]
    knob: ClassVar[str | None] = None
    knows_task: ClassVar[bool] = False

    @property
    def allocation(self) -> str:
        """What the weights are of: one of `ALLOCATIONS`, or ``own``."""
        return "linear"

    @classmethod
    def standard(cls: type[R], scenario: Scenario) -> R:
        """Return the rule as it runs under its own name, by the scenario's `schedulers`."""
        return cls()


RULES = Section("policies.*", Rule, "max_weight")
"""Compiled schedulers by the name in their `model: Literal["name"]`."""

ALLOCATIONS: dict[str, Callable[[int, int], Any]] = {
    "log": partial(marginal_words, LOG),
    "linear": partial(marginal_words, LINEAR),
    "lagrangian": partial(marginal_words, LAGRANGIAN),
    "capped": partial(marginal_words, CAPPED),
    "by_urgency": urgency_words,
    "in_turn": lambda num_users, num_prb: TurnWords(),
}
"""Words of the allocations for U users and K PRBs: sum of w log r, w r, minus w times the
Lagrangian, w min(r, need); users in the order of falling weight; round robin."""
