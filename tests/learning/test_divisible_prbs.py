from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hiersched.learning.divisible_prbs import max_weight_shares, prb_shares


def bisected(weights, num_prb):
    """Water-filling by bisection of the level."""
    low, high = 1e-12, sum(weights)
    for _ in range(200):
        level = (low + high) / 2
        if sum(max(1.0, w / level) for w in weights) > num_prb:
            low = level
        else:
            high = level
    return [max(1.0, w / high) for w in weights]


weight_lists = st.lists(st.floats(0.05, 20.0), min_size=1, max_size=12)


@given(weight_lists, st.integers(1, 20))
def test_shares_are_those_of_the_bisected_level(weights, extra):
    num_prb = len(weights) + extra
    shares = prb_shares(torch.tensor(weights, dtype=torch.float64), num_prb).numpy()
    np.testing.assert_allclose(shares, bisected(weights, num_prb), rtol=1e-9)
    assert shares.sum() == pytest.approx(num_prb)


@given(weight_lists, st.integers(1, 20), st.randoms(use_true_random=False))
def test_permuting_users_permutes_shares(weights, extra, random):
    order = list(range(len(weights)))
    random.shuffle(order)
    num_prb = len(weights) + extra
    w = torch.tensor(weights, dtype=torch.float64)
    np.testing.assert_allclose(
        prb_shares(w[order], num_prb).numpy(), prb_shares(w, num_prb).numpy()[order], rtol=1e-12
    )


def test_without_spare_prbs_everyone_has_one():
    weights = torch.tensor([1.0, 5.0, 0.1], requires_grad=True)
    assert prb_shares(weights, 3).tolist() == [1.0, 1.0, 1.0]


def test_gradient_is_that_of_finite_differences():
    rng = np.random.default_rng(2)
    weights = torch.tensor(np.exp(rng.normal(size=(4, 6))), requires_grad=True)
    assert torch.autograd.gradcheck(lambda w: prb_shares(w, 11), (weights,))


def test_a_held_user_gets_a_share_of_the_gradient_without_the_floor():
    """K w / sum w has the derivative n_i (delta_ij - n_j / K) / w_j; it is taken at the held n."""
    weights = torch.tensor([4.0, 2.0, 0.5], dtype=torch.float64, requires_grad=True)
    plain = torch.autograd.functional.jacobian(lambda w: prb_shares(w, 9), weights)
    both = torch.autograd.functional.jacobian(lambda w: prb_shares(w, 9, floor_slope=0.25), weights)
    n = np.array([16 / 3, 8 / 3, 1.0])
    free = (np.diag(n) - np.outer(n, n) / 9) / np.array([4.0, 2.0, 0.5])
    np.testing.assert_allclose((both - plain).numpy(), 0.25 * free, rtol=1e-9)
    assert plain[2, 2] == 0.0
    np.testing.assert_allclose(prb_shares(weights, 9, floor_slope=0.25).detach().numpy(), n)


def test_known_case():
    """Nine PRBs, weights 4, 2, 1/2: the last one is held at 1, the others share 8 as 2 to 1."""
    shares = prb_shares(torch.tensor([4.0, 2.0, 0.5]), 9)
    np.testing.assert_allclose(shares.numpy(), [16 / 3, 8 / 3, 1.0], rtol=1e-6)


def max_weight_features(queue_times_rate):
    """Features of users with the same rate 10 Mbit/s a PRB."""
    features = torch.zeros(len(queue_times_rate), 8, dtype=torch.float64)
    features[:, 0] = torch.tensor(queue_times_rate, dtype=torch.float64)
    return features


def test_relaxed_max_weight_by_hand():
    """Priorities 4, 2, 0 with weights 1/2, 1, 1: the first two share six PRBs, the last has one."""
    shares = max_weight_shares(
        torch.tensor([0.5, 1.0, 1.0], dtype=torch.float64), max_weight_features([4.0, 2.0, 0.0]), 9
    )
    np.testing.assert_allclose(shares.numpy(), [4.0, 4.0, 1.0], rtol=1e-9)


def test_relaxed_max_weight_values_a_rate_as_queue_times_rate():
    """need = q / r: twice the rate at half the need is the same queue, twice the rate."""
    features = max_weight_features([1.0, 0.5])
    features[1, 3] = np.log(2.0)
    shares = max_weight_shares(torch.tensor([1.0, 0.5], dtype=torch.float64), features, 6)
    np.testing.assert_allclose(shares.numpy(), [3.0, 3.0], rtol=1e-9)


def test_relaxed_max_weight_passes_a_gradient_even_without_queues():
    weights = torch.tensor(np.exp(np.random.default_rng(2).normal(size=5)), requires_grad=True)
    for need in ([0.0] * 5, [1.0, 0.5, 0.9, 0.0, 0.2]):
        features = max_weight_features(need)
        assert torch.autograd.gradcheck(lambda w, f=features: max_weight_shares(w, f, 9), weights)
        shares = max_weight_shares(weights, features, 9)
        assert shares.sum().item() == pytest.approx(9.0)
        assert (torch.autograd.grad(shares[0], weights)[0] != 0.0).any()
