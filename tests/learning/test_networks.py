from __future__ import annotations

import numpy as np
import pytest
import torch

from hiersched.env import agent_views
from hiersched.learning.networks import FlatNetwork, SharedNetwork, Slices, initial_stack


def test_slices_of_different_size_are_padded_and_join_again():
    slices = Slices(2, 3)
    users = torch.arange(1.0, 6.0).reshape(1, 5, 1)
    rows = slices.split(users)
    assert rows[0, :, :, 0].tolist() == [[1.0, 2.0, 0.0], [3.0, 4.0, 5.0]]
    assert slices.join(rows[..., 0])[0].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]


def test_shared_inputs_are_what_the_agents_see():
    """The stacked inputs against the NumPy views that the adapters hand out."""
    rng = np.random.default_rng(3)
    features = rng.normal(size=(2, 4, 5, 8)).astype(np.float32)
    network = SharedNetwork(Slices(2, 3), 8, (4,))
    inputs = network.inputs(torch.from_numpy(features)).reshape(2, 2, 4, 3, 24).numpy()
    for seed in range(2):
        urllc, embb = agent_views(features[seed], 2)
        np.testing.assert_allclose(inputs[seed, 0, :, :2], urllc, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(inputs[seed, 1], embb, rtol=1e-5, atol=1e-6)


def test_flat_inputs_are_all_users_side_by_side_for_both_agents():
    features = torch.arange(2.0 * 3 * 5 * 8).reshape(2, 3, 5, 8)
    inputs = FlatNetwork(Slices(2, 3), 8, (4,)).inputs(features)
    assert inputs.shape == (4, 3, 40)
    for seed in range(2):
        for agent in range(2):
            assert torch.equal(inputs[2 * seed + agent, 1], features[seed, 1].reshape(-1))


@pytest.mark.parametrize("kind", [SharedNetwork, FlatNetwork])
def test_counts_and_rewards_stand_where_their_users_do(kind):
    network = kind(Slices(2, 3), 8, (4,))
    numbers = torch.tensor([[[1.0, 2.0, 3.0, 4.0, 5.0]]])
    counts = network.count_inputs(numbers) * 4.0
    pooled = network.pool(numbers)[0, :, 0]
    means = (network.pool(numbers)[0, :, 0] * network.value_shares()).sum(1).tolist()
    assert means == pytest.approx([1.5, 4.0])
    if kind is SharedNetwork:
        assert counts.reshape(2, 3).tolist() == [[1.0, 2.0, 0.0], [3.0, 4.0, 5.0]]
        assert pooled.tolist() == [[1.0, 2.0, 0.0], [3.0, 4.0, 5.0]]
    else:
        assert counts[:, 0].tolist() == [[1.0, 2.0, 3.0, 4.0, 5.0]] * 2


@pytest.mark.parametrize("kind", [SharedNetwork, FlatNetwork])
def test_each_agent_acts_for_its_own_users(kind):
    """Other parameters of the URLLC actor change the URLLC users' actions and no others."""
    network = kind(Slices(2, 3), 8, (4,))
    features = torch.randn(1, 6, 5, 8, generator=torch.Generator().manual_seed(1))
    inputs = network.inputs(features)
    actors = initial_stack(network.actor, "t", (1,), zero_output=False)
    before = network.raw_actions(network.actor.forward(actors, inputs), 1)
    actors[0] += 0.1
    after = network.raw_actions(network.actor.forward(actors, inputs), 1)
    assert before.shape == (1, 6, 5)
    changed = (before != after).reshape(6, 5).all(0).tolist()
    assert changed == [True, True, False, False, False]
    assert torch.equal(before[..., 2:], after[..., 2:])
