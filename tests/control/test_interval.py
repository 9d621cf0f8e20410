"""Delays of an interval: bounds, soundness, and a check that shares no formula."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hiersched.control import (
    analyse_interval,
    analyse_krasovskii,
    certify,
    certify_interval,
    spectral_radius_by_delay,
)

LOOP = np.array([[0.8, 0.0], [0.05, 0.9]]), np.array([[-0.1, 0.0], [-0.2, -0.1]])
"""By which most papers compare their bounds."""


def certified(loop, least, most):
    witness = analyse_interval(*loop, least, most)
    return certify_interval(*loop, least, most, witness).certified


@pytest.mark.parametrize(
    ("least", "most"), [(0, 20), (2, 20), (4, 21), (6, 21), (10, 23), (15, 25), (20, 29), (30, 36)]
)
def test_longest_delays_of_an_interval(least, most):
    assert certified(LOOP, least, most)
    assert not certified(LOOP, least, most + 1)


def test_it_is_stronger_than_c3_and_not_stronger_than_the_truth(fridman):
    """From 0 on C3 certifies 16 of this loop; 15 of Fridman's, whose constant limit is 18."""
    assert not certify(*LOOP, 17, analyse_krasovskii(*LOOP, 17)).certified
    assert certified(LOOP, 0, 17)
    assert certified(fridman, 0, 15)
    assert certified(fridman, 15, 17)
    assert spectral_radius_by_delay(*fridman, 19)[19] > 1.0
    assert not certified(fridman, 19, 19)


@pytest.mark.parametrize(("least", "most"), [(0, 3), (1, 1), (1, 2), (2, 2), (3, 9), (0, 0)])
def test_runs_within_a_certified_interval_decay(least, most):
    """Delays that jump within it at every sample, by the loop itself."""
    assert certified(LOOP, least, most)
    A_c, A_d = LOOP
    rng = np.random.default_rng(7)
    past = rng.standard_normal((most + 1, 50, 2))  # the newest first
    start = np.abs(past).max()
    for delay in rng.integers(least, most + 1, 600):
        past = np.concatenate([(past[0] @ A_c.T + past[delay] @ A_d.T)[None], past[:-1]])
    assert np.abs(past).max() < 1e-9 * start


def test_another_functional_is_not_certified():
    witness = analyse_interval(*LOOP, 4, 12)
    assert certify_interval(*LOOP, 4, 12, witness).certified
    for change in (
        {"R1": -witness.R1},
        {"R2": 30.0 * witness.R2},
        {"Q2": np.zeros((2, 2))},
        {"P": -witness.P},
    ):
        assert not certify_interval(*LOOP, 4, 12, replace(witness, **change)).certified
    # Made for 4 to 12, it does not hold for all from 0 on, nor far beyond.
    assert not certify_interval(*LOOP, 4, 60, analyse_interval(*LOOP, 4, 60)).certified
    assert not certify_interval(*LOOP, 4, 12, None).certified


def test_bounds_in_the_wrong_order_are_named():
    with pytest.raises(ValueError, match="least_steps is 5; it must be at most most_steps = 4"):
        analyse_interval(*LOOP, 5, 4)
