from __future__ import annotations

import numpy as np
import pytest
import torch

from hiersched.learning.stack import Layers
from hiersched.policies.learned import num_parameters


def drawn(layers, count=4, rows=6):
    rng = np.random.default_rng(1)
    parameters = np.stack([layers.initial(rng, zero_output=False) for _ in range(count)])
    inputs = rng.normal(size=(count, rows, layers.sizes[0])).astype(np.float32)
    return torch.from_numpy(parameters), torch.from_numpy(inputs)


def by_autograd(layers, parameters, inputs):
    """The networks one by one, with operations that autograd differentiates itself."""
    outputs = []
    for flat, hidden in zip(parameters, inputs, strict=True):
        start = 0
        for place, (rows, columns) in enumerate(
            zip(layers.sizes[:-1], layers.sizes[1:], strict=True)
        ):
            bias = flat[start : start + columns]
            weight = flat[start + columns : start + (rows + 1) * columns].reshape(rows, columns)
            start += (rows + 1) * columns
            hidden = hidden @ weight + bias
            hidden = hidden.relu() if place < len(layers.sizes) - 2 else hidden
        outputs.append(hidden)
        assert start == num_parameters(layers.sizes)
    return torch.stack(outputs)


@pytest.mark.parametrize("sizes", [(5, 7, 3, 1), (5, 7, 4), (2, 1), (3, 6, 6, 6, 2)])
def test_forward_and_backward_are_those_of_autograd(sizes):
    layers = Layers(sizes)
    parameters, inputs = drawn(layers)
    weight = torch.from_numpy(np.random.default_rng(2).normal(size=(4, 6, sizes[-1]))).float()
    found = []
    for evaluate in (layers.forward, lambda p, x: by_autograd(layers, p, x)):
        leaves = parameters.clone().requires_grad_(), inputs.clone().requires_grad_()
        outputs = evaluate(*leaves)
        found.append((outputs.detach(), *torch.autograd.grad((outputs * weight).sum(), leaves)))
    for mine, wanted in zip(*found, strict=True):
        np.testing.assert_allclose(mine.numpy(), wanted.numpy(), rtol=1e-4, atol=1e-5)
        assert np.abs(wanted.numpy()).max() > 0.01


def test_only_the_gradient_that_is_asked_for_is_formed():
    layers = Layers((5, 7, 1))
    parameters, inputs = drawn(layers)
    outputs = layers.forward(parameters, inputs.requires_grad_())
    (gradient,) = torch.autograd.grad(outputs.sum(), inputs)
    assert gradient.shape == inputs.shape
    assert not parameters.requires_grad
