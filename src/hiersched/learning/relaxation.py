"""PRBs that weights buy, smoothly: what carries the gradient through the allocation."""

from __future__ import annotations

import torch
from torch import Tensor


def prb_shares(weights: Tensor, num_prb: int, *, floor_slope: float = 0.0) -> Tensor:
    """PRBs of every user under weighted proportional fairness, were PRBs divisible.

    Maximises sum w_i log n_i subject to sum n_i = K and n_i >= 1: water-filling,
    n_i = max(1, w_i / mu).

    Parameters
    ----------
    weights
        Positive, shape (..., U).
    num_prb
        K, at least U.
    floor_slope
        A user held at 1 has no gradient, so an actor that starves it could never learn better.
        This share of the gradient that all users would have without the floor is added.

    Returns
    -------
    shares
        n_i, shape (..., U), differentiable.
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
