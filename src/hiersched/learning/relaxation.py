"""How many PRBs a weight buys, as a smooth function: what carries the actor's gradient through the allocation."""

from __future__ import annotations

import torch
from torch import Tensor


def prb_shares(weights: Tensor, num_prb: int) -> Tensor:
    """PRBs of every user under weighted proportional fairness, were PRBs divisible and rates equal.

    Maximises sum w_i log n_i subject to sum n_i = K and n_i >= 1: water-filling, n_i = max(1, w_i / mu).

    Parameters
    ----------
    weights
        Positive, shape (..., U).
    num_prb
        K, at least U.

    Returns
    -------
    shares
        n_i, shape (..., U), differentiable; a user held at 1 gets no gradient.
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
    return torch.where(above, filled * (left / filled.sum(-1, keepdim=True)), 1.0)
