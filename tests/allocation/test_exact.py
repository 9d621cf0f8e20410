"""The exact optimum against enumeration, its bound, and its own Lagrangian against the kernel's."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from hiersched.allocation.exact import convex_from, exact_allocation, lagrangian, owned_rates
from hiersched.allocation.objective import UserTerms, user_lagrangian


def terms_of(rng: np.random.Generator, num_users: int, multiplier: float = 0.0) -> UserTerms:
    """Random slot: backlogs, loads; the first half are URLLC users."""
    urllc = np.arange(num_users) < num_users // 2
    return UserTerms(
        backlog_packets=rng.uniform(0.0, 60.0, num_users),
        offered_mbps=rng.uniform(3.0, 25.0, num_users),
        rate_sensitivity=np.where(urllc, 0.1, 0.0),
        arrival_packets_per_mbps=np.where(urllc, 3.0, 1.0),
        service_offset_mbps=np.where(urllc, 0.7, 0.0),
        service_packets_per_mbps=1.0,
        penalty_weight=100.0,
        epsilon=0.01,
        multiplier=np.where(urllc, multiplier, 0.0),
        delay_exponent_per_mbps=0.16,
        violation_share=0.05,
        drift_weight=rng.uniform(0.5, 2.0, num_users),
    )


def cheapest(rate: np.ndarray, terms: UserTerms) -> float:
    """Least sum over every allocation that leaves no user without a PRB, by the kernel."""
    num_users, num_prb = rate.shape
    best = math.inf
    for owner in itertools.product(range(num_users), repeat=num_prb):
        if len(set(owner)) == num_users:
            rates = owned_rates(rate, np.array(owner, dtype=np.uint32))
            total = sum(user_lagrangian(terms, u, rates[u]) for u in range(num_users))
            best = min(best, total)
    return best


@pytest.mark.parametrize("multiplier", [0.0, 500.0])
@pytest.mark.parametrize("seed", range(4))
def test_no_allocation_is_cheaper(seed: int, multiplier: float) -> None:
    rng = np.random.default_rng(seed)
    rate = rng.uniform(4.0, 20.0, (3, 6)).astype(np.float32)
    terms = terms_of(rng, 3, multiplier)
    found = exact_allocation(rate, terms)
    assert set(found.prb_owner) == {0, 1, 2}
    assert found.value == pytest.approx(cheapest(rate, terms), rel=1e-6, abs=1e-6)
    assert found.value - found.bound <= 1e-6 * (1.0 + abs(found.value))
    assert found.bound <= found.value
    rates = owned_rates(rate, found.prb_owner)
    assert sum(user_lagrangian(terms, u, rates[u]) for u in range(3)) == pytest.approx(found.value)


def test_the_bound_holds_where_the_lagrangian_is_not_convex() -> None:
    """Rates below the service offset, as in a deep fade: a bound still, though not a tight one."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        rate = rng.uniform(0.02, 2.0, (2, 5)).astype(np.float32)
        # Nothing waits and 1 / (r^2 + epsilon) is concave below 2: tangents would lie above it.
        terms = terms_of(rng, 2)._replace(
            backlog_packets=np.zeros(2), offered_mbps=np.zeros(2), epsilon=12.0
        )
        assert (rate.min(axis=1) < convex_from(terms)).any()
        found = exact_allocation(rate, terms)
        assert found.bound <= cheapest(rate, terms) + 1e-9 <= found.value + 2e-9


def test_its_lagrangian_is_the_kernels_and_its_slope_the_derivative() -> None:
    rng = np.random.default_rng(1)
    terms, users = terms_of(rng, 8, 50.0), np.arange(8)
    for rate in rng.uniform(0.2, 60.0, (30, 8)):
        value, slope = lagrangian(terms, users, rate)
        kernel = [user_lagrangian(terms, u, rate[u]) for u in users]
        assert value == pytest.approx(kernel, rel=1e-12, abs=1e-9)
        up, down = (lagrangian(terms, users, rate + h)[0] for h in (1e-5, -1e-5))
        assert slope == pytest.approx((up - down) / 2e-5, rel=1e-4, abs=1e-3)


def test_the_lagrangian_falls_and_is_convex_where_it_says() -> None:
    """What the bound rests on: slopes are negative everywhere and rise beyond `convex_from`."""
    terms, users = terms_of(np.random.default_rng(2), 8, 50.0), np.arange(8)
    start = convex_from(terms)
    grid = start + np.linspace(0.0, 60.0, 4001)[:, None]
    value, slope = lagrangian(terms, users, grid)
    assert (np.diff(slope, axis=0) >= -1e-9).all()
    below = np.linspace(0.01, 1.0, 200)[:, None] * start
    assert (np.diff(lagrangian(terms, users, below)[0], axis=0) <= 1e-12).all()
    assert (np.diff(value, axis=0) <= 1e-12).all()


def test_more_users_than_prbs_are_refused() -> None:
    with pytest.raises(ValueError, match="3 users: at most 2"):
        exact_allocation(np.ones((3, 2), np.float32), terms_of(np.random.default_rng(0), 3))
