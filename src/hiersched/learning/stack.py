"""Stacks of equal multilayer perceptrons in one flat tensor, with a hand-written backward pass."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_ADAM_DECAY, _ADAM_SQUARE_DECAY, _ADAM_EPSILON = 0.9, 0.999, 1e-8


@dataclass(frozen=True)
class Layers:
    """Sizes of a stack of equal multilayer perceptrons: inputs, hidden layers, outputs."""

    sizes: tuple[int, ...]

    def initial(self, rng: np.random.Generator, *, zero_output: bool) -> NDArray[np.float32]:
        """Draw one network, shape (P,): uniform within 1/sqrt(inputs); last layer 0 if asked."""
        blocks = []
        for place, (rows, columns) in enumerate(pairwise(self.sizes)):
            bound = rows**-0.5
            if zero_output and place == len(self.sizes) - 2:
                bound = 0.0
            blocks.append(rng.uniform(-bound, bound, (rows + 1) * columns))
        return np.concatenate(blocks).astype(np.float32)

    def split(self, parameters: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Split (S, P) by layer into bias (S, 1, columns) and weight (S, rows, columns), views."""
        views, start = [], 0
        for rows, columns in pairwise(self.sizes):
            middle, stop = start + columns, start + (rows + 1) * columns
            bias = parameters[:, start:middle].unsqueeze(1)
            weight = parameters[:, middle:stop].view(-1, rows, columns)
            views.append((bias, weight))
            start = stop
        return views

    def forward(self, parameters: Tensor, inputs: Tensor) -> Tensor:
        """Evaluate the stack: (S, N, outputs) for parameters (S, P) and inputs (S, N, rows)."""
        outputs: Tensor = _Perceptrons.apply(parameters, inputs, self)  # type: ignore[no-untyped-call]
        return outputs


class _Perceptrons(torch.autograd.Function):
    """ReLU networks. Half the work of what autograd would do on the narrow last layer is spared."""

    @staticmethod
    def forward(ctx: Any, parameters: Tensor, inputs: Tensor, layers: Layers) -> Tensor:
        hidden = [inputs]
        views = layers.split(parameters)
        for bias, weight in views[:-1]:
            hidden.append(torch.baddbmm(bias, hidden[-1], weight).relu_())
        ctx.layers = layers
        ctx.save_for_backward(parameters, *hidden)
        if len(views) == 1:
            return _affine(inputs, *views[0])
        return _last_layer(hidden[-1], *views[-1])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        parameters, *hidden = ctx.saved_tensors
        wanted = torch.empty_like(parameters) if ctx.needs_input_grad[0] else None
        into = None if wanted is None else ctx.layers.split(wanted)
        views = ctx.layers.split(parameters)
        for place in range(len(views) - 1, -1, -1):
            seen, weight = hidden[place], views[place][1]
            if into is not None:
                torch.sum(gradient, dim=1, keepdim=True, out=into[place][0])
                into[place][1].copy_(_weight_gradient(seen, gradient))
            if place == 0 and not ctx.needs_input_grad[1]:
                return wanted, None, None
            if weight.shape[2] == 1:
                gradient = gradient * weight.transpose(1, 2)
            else:
                gradient = torch.bmm(gradient, weight.transpose(1, 2))
            if place:
                gradient = torch.ops.aten.threshold_backward(gradient, seen, 0.0)
        return wanted, gradient, None


def _affine(inputs: Tensor, bias: Tensor, weight: Tensor) -> Tensor:
    """Affine, as a sum of doubles in the order of the inputs: the bits of `policies.learned`."""
    outputs = bias.double().expand(len(inputs), inputs.shape[1], -1)
    for place in range(inputs.shape[2]):
        value = inputs[:, :, place : place + 1].double()
        outputs = outputs + value * weight[:, place : place + 1].double()
    return outputs.float()


def _last_layer(hidden: Tensor, bias: Tensor, weight: Tensor) -> Tensor:
    """Affine; one output is a matrix times a vector, which the batched product does badly."""
    if weight.shape[2] > 1:
        return torch.baddbmm(bias, hidden, weight)
    outputs = hidden.new_empty(*hidden.shape[:2], 1)
    for entry in range(len(hidden)):
        torch.addmv(bias[entry, 0], hidden[entry], weight[entry, :, 0], out=outputs[entry, :, 0])
    return outputs


def _weight_gradient(seen: Tensor, gradient: Tensor) -> Tensor:
    """Sum over N of seen times gradient, shape (S, rows, columns)."""
    if gradient.shape[2] > 1:
        return torch.bmm(seen.transpose(1, 2), gradient)
    return torch.stack(
        [torch.mv(seen[entry].t(), gradient[entry, :, 0]) for entry in range(len(seen))]
    ).unsqueeze(2)


class StackedAdam:
    """Adam (Kingma and Ba 2015) on the rows of a flat tensor, each clipped to a gradient norm."""

    def __init__(self, parameters: Tensor, learning_rate: float, gradient_clip: float) -> None:
        self._learning_rate = learning_rate
        self._gradient_clip = gradient_clip
        self.mean = torch.zeros_like(parameters)
        self.square = torch.zeros_like(parameters)
        self.steps = 0

    def descend(self, leaf: Tensor, loss: Tensor) -> None:
        """Move parameters against the gradient of a loss; `leaf` is their view in its graph."""
        (gradient,) = torch.autograd.grad(loss, leaf)
        self.step(leaf.detach(), gradient)

    def step(self, parameters: Tensor, gradient: Tensor) -> None:
        """Move `parameters`, shape (S, P), against `gradient`, in place."""
        norm = torch.linalg.vector_norm(gradient, dim=1, keepdim=True)
        gradient = gradient * (self._gradient_clip / norm.clamp(min=self._gradient_clip))
        self.steps += 1
        self.mean.lerp_(gradient, 1.0 - _ADAM_DECAY)
        self.square.mul_(_ADAM_SQUARE_DECAY).addcmul_(
            gradient, gradient, value=1.0 - _ADAM_SQUARE_DECAY
        )
        unbias = (1.0 - _ADAM_SQUARE_DECAY**self.steps) ** 0.5
        rate = self._learning_rate / (1.0 - _ADAM_DECAY**self.steps)
        scale = self.square.sqrt().div_(unbias).add_(_ADAM_EPSILON)
        parameters.addcdiv_(self.mean, scale, value=-rate)

    def state(self) -> tuple[Tensor, Tensor, int]:
        """Everything needed to go on, for `load_state`."""
        return self.mean, self.square, self.steps

    def load_state(self, state: tuple[Tensor, Tensor, int]) -> None:
        """Take over what `state` returned."""
        self.mean, self.square, self.steps = state
