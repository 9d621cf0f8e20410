from __future__ import annotations

import numpy as np
import torch

from hiersched.env import agent_views
from hiersched.learning.networks import Layers, Slices, count_input, network_inputs


def test_a_stack_is_its_networks_one_by_one():
    layers = Layers((5, 7, 3, 1))
    rng = np.random.default_rng(1)
    parameters = np.stack([layers.initial(rng, zero_output=False) for _ in range(4)])
    inputs = rng.normal(size=(4, 6, 5)).astype(np.float32)
    outputs = layers.forward(torch.from_numpy(parameters), torch.from_numpy(inputs)).numpy()
    for entry in range(4):
        flat = parameters[entry].astype(np.float64)
        hidden, start = inputs[entry].astype(np.float64), 0
        for rows, columns, last in ((5, 7, False), (7, 3, False), (3, 1, True)):
            bias = flat[start : start + columns]
            start += columns
            weight = flat[start : start + rows * columns].reshape(rows, columns)
            start += rows * columns
            hidden = hidden @ weight + bias
            hidden = hidden if last else np.maximum(hidden, 0.0)
        assert start == layers.num_parameters
        np.testing.assert_allclose(outputs[entry], hidden[:, 0], rtol=1e-5, atol=1e-6)


def test_slices_of_different_size_are_padded_and_join_again():
    slices = Slices(2, 3)
    users = torch.arange(1.0, 6.0).reshape(1, 5, 1)
    rows = slices.split(users)
    assert rows[0, :, :, 0].tolist() == [[1.0, 2.0, 0.0], [3.0, 4.0, 5.0]]
    assert slices.join(rows[..., 0])[0].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]


def test_network_inputs_are_what_the_agents_see():
    """The stacked inputs against the NumPy views that the adapters hand out."""
    rng = np.random.default_rng(3)
    features = rng.normal(size=(2, 4, 5, 8)).astype(np.float32)
    slices = Slices(2, 3)
    inputs = network_inputs(torch.from_numpy(features), slices).reshape(2, 2, 4, 3, 24).numpy()
    for seed in range(2):
        urllc, embb = agent_views(features[seed], 2)
        np.testing.assert_allclose(inputs[seed, 0, :, :2], urllc, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(inputs[seed, 1], embb, rtol=1e-5, atol=1e-6)


def test_counts_stand_beside_their_users():
    counts = torch.tensor([[[1.0, 2.0, 3.0, 4.0, 5.0]]])
    rows = count_input(counts, Slices(2, 3)).reshape(2, 3) * 4.0
    assert rows.tolist() == [[1.0, 2.0, 0.0], [3.0, 4.0, 5.0]]
