"""PRBs that weights buy, smoothly: what carries the gradient through the allocation."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from hiersched.policies.features import FEATURES, NEED_SCALE

_NEED, _LOG_PRB_RATE = FEATURES.index("need"), FEATURES.index("log_prb_rate")

MAX_WEIGHT_SHARPNESS = 8.0
"""How sharply the relaxed MaxWeight prefers the user with the largest queue times rate."""

_LEAST_PRIORITY = 1e-3
"""Of an empty queue, relative to the largest: its user would otherwise pass no gradient."""


def prb_shares(weights: Tensor, num_prb: int, floor_slope: float = 0.0) -> Tensor:
    """PRBs of every user under weighted proportional fairness, were PRBs divisible.

    Maximises sum w_i log n_i subject to sum n_i = K and n_i >= 1: water-filling,
    n_i = max(1, w_i / mu), shape (..., U) as the positive weights, differentiable; K >= U.

    A user held at 1 has no gradient, so an actor that starves it could never learn better: the
    share `floor_slope` of the gradient that all users would have without the floor is added.
    """
    num_users = weights.shape[-1]
    if num_users == num_prb:
        return torch.ones_like(weights)
    with torch.no_grad():
        ordered = weights.sort(dim=-1, descending=True).values
        count = torch.arange(1, num_users + 1, dtype=weights.dtype)
        level = ordered.cumsum(-1) / (num_prb - num_users + count)
        num_above = (ordered > level).sum(-1, keepdim=True)
        above = weights > level.gather(-1, num_above - 1)
        left = num_prb - num_users + num_above
    filled = torch.where(above, weights, 0.0)
    shares = torch.where(above, filled * (left / filled.sum(-1, keepdim=True)), 1.0)
    if floor_slope == 0.0 or not weights.requires_grad:
        return shares
    held = shares.detach()
    free = held * (weights / weights.detach())
    free = free * (num_prb / free.sum(-1, keepdim=True))
    return shares + floor_slope * (free - free.detach())


def max_weight_shares(
    weights: Tensor, features: Tensor, num_prb: int, floor_slope: float = 0.0
) -> Tensor:
    """PRBs under weighted MaxWeight: one each, the others as a soft maximum shares them.

    MaxWeight gives a PRB to the largest w q r. Fading makes that a matter of chance; here the
    chances are (w q r)^s over their sum, with s = MAX_WEIGHT_SHARPNESS and r the mean rate. The cap
    of the scheduler at what a user needs is left out, so the gradient overrates PRBs beyond it.
    Queue and rate are formed from the features (..., U, F); `floor_slope` is not used, since nobody
    is without a gradient.
    """
    # need = q / (r per PRB), so that q r is need r^2 up to a constant.
    need = NEED_SCALE * features[..., _NEED]
    priority = need * torch.exp(2.0 * features[..., _LOG_PRB_RATE])
    largest = priority.amax(dim=-1, keepdim=True).clamp(min=torch.finfo(priority.dtype).tiny)
    relative = (priority / largest).clamp(min=_LEAST_PRIORITY)
    chance = torch.softmax(MAX_WEIGHT_SHARPNESS * (weights.log() + relative.log()), dim=-1)
    return 1.0 + (num_prb - weights.shape[-1]) * chance


RELAXATIONS: dict[str, Callable[..., Tensor]] = {
    "pf": lambda weights, features, *rest: prb_shares(weights, *rest),  # whatever the features
    "max_weight": max_weight_shares,
}
"""Relaxed allocation by the scheduler from which the residual starts: (weights (..., U), features
(..., U, F), num_prb, floor_slope) -> PRBs (..., U)."""
