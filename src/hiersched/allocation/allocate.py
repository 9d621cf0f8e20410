"""The allocations by name: the largest sum of utilities, or users in an order.

All have one form, `kernel(code, slot, rate, weight, need, terms, scratch, owner)`, and the slot
loop calls them by their address.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from hiersched.allocation.in_order import (
    OrderScratch,
    allocate_by_urgency,
    allocate_in_turn,
    order_scratch,
)
from hiersched.allocation.marginal import (
    UTILITY_CAPPED,
    UTILITY_LAGRANGIAN,
    UTILITY_LINEAR,
    UTILITY_LOG,
    AllocationScratch,
    allocate_by_utility,
    allocation_scratch,
)


class Allocation(NamedTuple):
    """A kernel and its code; `scratch` is the field of `AllocatorScratch` that it works in."""

    kernel: Any
    code: int
    scratch: str

    @property
    def has_utility(self) -> bool:
        """Whether weights are factors of a utility."""
        return self.scratch == "marginal"


ALLOCATIONS = {
    "log": Allocation(allocate_by_utility, UTILITY_LOG, "marginal"),
    "linear": Allocation(allocate_by_utility, UTILITY_LINEAR, "marginal"),
    "lagrangian": Allocation(allocate_by_utility, UTILITY_LAGRANGIAN, "marginal"),
    "capped": Allocation(allocate_by_utility, UTILITY_CAPPED, "marginal"),
    "by_urgency": Allocation(allocate_by_urgency, 0, "order"),
    "in_turn": Allocation(allocate_in_turn, 0, "order"),
}
"""Sum of w log r, w r, minus w times the Lagrangian, w min(r, need); users in the order of falling
weight; round robin."""


class AllocatorScratch(NamedTuple):
    """Work arrays of all allocations."""

    marginal: AllocationScratch
    order: OrderScratch


def allocator_scratch(num_users: int, num_prb: int) -> AllocatorScratch:
    """Work arrays for `num_users` users and `num_prb` PRBs; errors as `allocation_scratch`."""
    return AllocatorScratch(
        marginal=allocation_scratch(num_users, num_prb), order=order_scratch(num_users, num_prb)
    )
