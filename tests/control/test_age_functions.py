"""Loops whose filter believes another plant: steps by simulation, functions that fall."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from hiersched.control import FilterModel, design_lqg, network_plant
from hiersched.control.age_functions import (
    age_function_margin,
    age_mode,
    age_steps,
    search_age_functions,
)

A, B = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.005], [0.1]])


@pytest.fixture(scope="module")
def lqg():
    plant = network_plant(A, B, np.diag([10.0, 0.1]), [[0.1]], sampling_s=0.1)
    model = FilterModel(
        A=A, B=B, process_covariance=1e-3 * np.eye(2), measurement_variance=np.array([1e-2, 1e-2])
    )
    return design_lqg(plant, model)


def test_steps_are_those_of_filter_and_plant_written_out(lqg):
    """Ages that jump, a plant that is not the model's: the same states as sample by sample."""
    truth, D = (1.02 * A, 0.8 * B), 3
    ages = [1, 2, 3, 1, 1, 2, 1, 2, 3, 3, 2, 3]
    xi = np.zeros(2 * (D + 1) + 2 + D)
    xi[:8] = np.tile([1.0, -0.5], 4)
    xi[8:10] = [1.0, -0.5]  # right at the stamp k - 1
    x = {k: np.array([1.0, -0.5]) for k in range(-D, 1)}
    u = dict.fromkeys(range(-D, 0), np.zeros(1))
    estimate, stamp = np.array([1.0, -0.5]), -1
    for k, (age, after) in enumerate(pairwise(ages)):
        assert stamp == k - age
        now = estimate
        for j in range(stamp, k):
            now = A @ now + B @ u[j]
        u[k] = -lqg.regulator @ now
        x[k + 1] = truth[0] @ x[k] + truth[1] @ u[k]
        while stamp < k + 1 - after:
            before = A @ estimate + B @ u[stamp]
            stamp += 1
            estimate = before + lqg.filter_gain @ (x[stamp] - before)
        xi = age_mode(lqg, truth, age, after, D) @ xi
        np.testing.assert_allclose(xi[:2], x[k + 1], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(xi[8:10], estimate, rtol=1e-10, atol=1e-12)


def test_functions_fall_for_the_plants_that_they_were_made_for(lqg):
    plants = [(A, gain * B) for gain in (0.8, 1.25)]
    functions = search_age_functions(lqg, plants, 3)
    assert functions is not None
    assert age_function_margin(lqg, plants, functions) > 0.0
    assert age_function_margin(lqg, [(A, B)], functions) > 0.0
    assert age_function_margin(lqg, [(A, 6.0 * B)], functions) < 0.0


def test_there_is_none_where_a_constant_age_is_unstable(lqg):
    worse = A, 6.0 * B
    assert np.abs(np.linalg.eigvals(age_mode(lqg, worse, 3, 3, 3))).max() > 1.0
    assert search_age_functions(lqg, [(A, B), worse], 3) is None


def test_ages_rise_by_one_and_fall_at_once():
    assert age_steps(2) == [(1, 1), (1, 2), (2, 1), (2, 2)]
    assert (1, 3) not in age_steps(3)
    assert (3, 1) in age_steps(3)
