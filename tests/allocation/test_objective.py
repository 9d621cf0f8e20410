from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hiersched.allocation.objective import (
    delay_surrogate,
    mean_arrivals,
    offered_service,
    rate_penalty,
    user_lagrangian,
)


def test_constraint_is_satisfied_at_a_high_rate():
    """Chi = 95 %, alpha_1 D_max = 8 · 0.02 per Mbit/s: y = 0 at ln(20) / 0.16 = 18.72 Mbit/s.

    The paper prints the opposite sign, under which a high rate would violate the constraint.
    """
    assert delay_surrogate(20.0, 0.16, 0.05) == pytest.approx(0.05 - math.exp(-3.2))
    assert delay_surrogate(20.0, 0.16, 0.05) > 0 > delay_surrogate(18.0, 0.16, 0.05)
    assert delay_surrogate(math.log(20) / 0.16, 0.16, 0.05) == pytest.approx(0.0, abs=1e-15)
    assert delay_surrogate(0.0, 0.16, 0.05) == pytest.approx(-0.95)


@given(st.floats(0.0, 100.0), st.floats(0.1, 100.0))
def test_more_rate_never_hurts_the_constraint(rate, more):
    assert delay_surrogate(rate + more, 0.16, 0.05) > delay_surrogate(rate, 0.16, 0.05) or (
        delay_surrogate(rate, 0.16, 0.05) == pytest.approx(0.05, abs=1e-6)
    )


def test_arrivals_and_service_by_hand():
    assert mean_arrivals(20.0, 7.0, 0.1, 3.0) == pytest.approx((7.0 - 2.0) * 3.0)
    assert mean_arrivals(80.0, 7.0, 0.1, 3.0) == 0.0
    assert offered_service(20.0, 0.7, 1.0) == pytest.approx(19.3)
    assert offered_service(0.5, 0.7, 1.0) == 0.0
    assert rate_penalty(3.0, 0.01) == pytest.approx(1 / 9.01)


def test_lagrangian_by_hand(make_terms):
    """F = 10, A = (6 − 0.1 · 5) · 2 = 11, mu = (5 − 1) · 1 = 4, F' = 17: ΔL = (289 − 100) / 2.

    V h = 100 / 25.01 and λ y = 2 (0.05 − e^−0.8).
    """
    terms = make_terms(
        2,
        backlog_packets=[0.0, 10.0],
        offered_mbps=6.0,
        rate_sensitivity=0.1,
        arrival_packets_per_mbps=2.0,
        service_offset_mbps=1.0,
        penalty_weight=100.0,
        multiplier=[0.0, 2.0],
    )
    expected = 94.5 + 100 / 25.01 - 2 * (0.05 - math.exp(-0.8))
    assert user_lagrangian(terms, 1, 5.0) == pytest.approx(expected, rel=1e-14)
    empty = 0.5 * 7.0**2 + 100 / 25.01
    assert user_lagrangian(terms, 0, 5.0) == pytest.approx(empty, rel=1e-14)


def test_a_multiplier_makes_rate_worth_more(make_terms):
    free, priced = make_terms(1), make_terms(1, multiplier=5.0)
    rates = np.linspace(1, 30, 50)
    gains = [
        [user_lagrangian(t, 0, r) - user_lagrangian(t, 0, r + 1) for r in rates]
        for t in (free, priced)
    ]
    assert (np.array(gains[1]) > np.array(gains[0])).all()
