"""Small networks applied to every user of a slice, stacked in one flat parameter tensor.

The networks of a stack are those of the seeds times two agents, entry 2 * seed + agent, with agent
0 = URLLC and agent 1 = eMBB. Slices of different size are padded to the larger one (`Slices`).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hiersched.env.features import NEED_SCALE, NUM_FEATURES

NUM_AGENTS = 2
ACTOR_INPUTS = 3 * NUM_FEATURES
"""A user's own features, the mean of its slice and the mean of the other slice."""
CRITIC_INPUTS = ACTOR_INPUTS + 1
"""Likewise, and the PRBs that the user was given."""


@dataclass(frozen=True)
class Slices:
    """Users of both slices as an array of two equally long rows: (..., U, *) <-> (..., 2, n, *)."""

    num_urllc: int
    num_embb: int

    @property
    def width(self) -> int:
        """n, users of the larger slice."""
        return max(self.num_urllc, self.num_embb)

    def split(self, users: Tensor) -> Tensor:
        """Form the rows of both slices, (..., 2, n, F) from (..., U, F); 0 where no user is."""
        parts = users.split_with_sizes((self.num_urllc, self.num_embb), dim=-2)
        return torch.stack(
            [functional.pad(part, (0, 0, 0, self.width - part.shape[-2])) for part in parts], dim=-3
        )

    def join(self, rows: Tensor) -> Tensor:
        """Inverse of `split` for one number per user: shape (..., U) from (..., 2, n)."""
        return torch.cat((rows[..., 0, : self.num_urllc], rows[..., 1, : self.num_embb]), dim=-1)

    def shares(self) -> Tensor:
        """1 / users of the slice, 0 where no user is, shape (2, n): sums with it are means."""
        shares = torch.zeros(NUM_AGENTS, self.width)
        shares[0, : self.num_urllc] = 1.0 / self.num_urllc
        shares[1, : self.num_embb] = 1.0 / self.num_embb
        return shares


def network_inputs(features: Tensor, slices: Slices) -> Tensor:
    """Form what the actors see, (seeds * 2, B * n, ACTOR_INPUTS), from (seeds, B, U, F)."""
    rows = slices.split(features)
    means = torch.einsum("sbanf,an->sbaf", rows, slices.shares())
    own_mean = means.unsqueeze(3).expand_as(rows)
    other_mean = means.flip(2).unsqueeze(3).expand_as(rows)
    inputs = torch.cat((rows, own_mean, other_mean), dim=-1).transpose(1, 2)
    return inputs.reshape(NUM_AGENTS * features.shape[0], -1, ACTOR_INPUTS)


def count_input(prb_count: Tensor, slices: Slices) -> Tensor:
    """Form the critics' last input, (seeds * 2, B * n, 1), from PRB counts (seeds, B, U)."""
    rows = slices.split(prb_count.unsqueeze(-1)).transpose(1, 2) / NEED_SCALE
    return rows.reshape(NUM_AGENTS * prb_count.shape[0], -1, 1)


@dataclass(frozen=True)
class Layers:
    """Sizes of a stack of equal multilayer perceptrons with one output."""

    sizes: tuple[int, ...]

    @property
    def num_parameters(self) -> int:
        """P, parameters of one network."""
        return sum((rows + 1) * columns for rows, columns in pairwise(self.sizes))

    def initial(self, rng: np.random.Generator, *, zero_output: bool) -> NDArray[np.float32]:
        """Draw one network, shape (P,): uniform within 1/sqrt(inputs); last layer 0 if asked."""
        blocks = []
        for place, (rows, columns) in enumerate(pairwise(self.sizes)):
            bound = rows**-0.5
            if zero_output and place == len(self.sizes) - 2:
                bound = 0.0
            blocks.append(rng.uniform(-bound, bound, (rows + 1) * columns))
        return np.concatenate(blocks).astype(np.float32)

    def forward(self, parameters: Tensor, inputs: Tensor) -> Tensor:
        """Evaluate the stack, shape (S, N), for parameters (S, P) and inputs (S, N, first size)."""
        stack = parameters.shape[0]
        sizes = [
            size for rows, columns in pairwise(self.sizes) for size in (columns, rows * columns)
        ]
        parts = parameters.split_with_sizes(sizes, dim=1)
        hidden = inputs
        for place, (rows, columns) in enumerate(pairwise(self.sizes)):
            bias = parts[2 * place].view(stack, 1, columns)
            weight = parts[2 * place + 1].view(stack, rows, columns)
            hidden = torch.baddbmm(bias, hidden, weight)
            if place < len(self.sizes) - 2:
                hidden = hidden.relu_()
        return hidden.squeeze(2)
