from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hiersched.learning.relaxation import prb_shares


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
