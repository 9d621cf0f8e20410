"""Loops whose filter believes another plant: steps by simulation, functions that fall, cells."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest
from scipy.linalg import expm

from hiersched.control import FilterModel, age_certificate, design_lqg, network_plant
from hiersched.control.age_certificate import (
    PlantFamily,
    age_function_margin,
    age_mode,
    age_steps,
    certify_age_functions,
    remainder_bounds,
)
from hiersched.control.age_functions import search_age_functions
from hiersched.models.plant.error_model import discretise, unicycle_error_model, unicycle_family

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
    truth = 1.02 * A, 0.8 * B
    ages = [1, 2, 3, 1, 1, 2, 1, 2, 3, 3, 2, 3]
    x = {k: np.array([1.0, -0.5]) for k in range(-3, 1)}
    u = dict.fromkeys(range(-3, 0), np.zeros(1))
    estimate, stamp = np.array([1.0, -0.5]), -1  # right at the stamp k - 1
    xi = np.concatenate([x[0], estimate, u[-1]])
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
        xi = age_mode(lqg, truth, age, after) @ xi
        past = [x[k + 1 - i] for i in range(after)], [u[k - i] for i in range(after)]
        expected = np.concatenate([*past[0], estimate, *past[1]])
        np.testing.assert_allclose(xi, expected, rtol=1e-10, atol=1e-12)


def test_functions_fall_for_the_plants_that_they_were_made_for(lqg):
    plants = [(A, gain * B) for gain in (0.8, 1.25)]
    functions = search_age_functions(lqg, plants, 3)
    assert functions is not None
    assert age_function_margin(lqg, plants, functions) > 0.0
    assert age_function_margin(lqg, [(A, B)], functions) > 0.0
    assert age_function_margin(lqg, [(A, 6.0 * B)], functions) < 0.0


def test_there_is_none_where_a_constant_age_is_unstable(lqg):
    worse = A, 6.0 * B
    assert np.abs(np.linalg.eigvals(age_mode(lqg, worse, 3, 3))).max() > 1.0
    assert search_age_functions(lqg, [(A, B), worse], 3) is None


def test_ages_rise_by_one_and_fall_at_once():
    assert age_steps(2) == [(1, 1), (1, 2), (2, 1), (2, 2)]
    assert (1, 3) not in age_steps(3)
    assert (3, 1) in age_steps(3)


# The plants of a box.


UNICYCLE = unicycle_family(1.0, 0.02)
WIDE = ((-4.0, 4.0), (1 / 0.15, 1 / 0.07))


def test_the_family_is_the_unicycle():
    """The parameters are the turn rate in rad/s and 1 / lag in 1/s."""
    generators = UNICYCLE.generators()
    exact = discretise(*unicycle_error_model(1.0, 1.7, 0.11), 0.02)
    block = expm(generators[0] + 1.7 * generators[1] + generators[2] / 0.11)
    np.testing.assert_allclose(block[:5], np.hstack(exact), atol=1e-15)
    assert not block[5:, :5].any()


@pytest.mark.parametrize("interval", [0.02, 0.2])
def test_no_plant_of_a_cell_is_farther_from_the_interpolation_than_the_bound(interval):
    """1000 points of cells of all sizes, in coordinates that stretch and that do not."""
    random = np.random.default_rng(0)
    generators, tightest = unicycle_family(1.0, interval).generators(), 0.0
    for _ in range(100):
        weights = 10.0 ** random.uniform(-1.0, 1.0, 7) if random.random() < 0.5 else np.ones(7)
        cell = tuple(
            tuple(np.sort(random.uniform(*side, 2)).tolist()) for side in ((-4.0, 4.0), (2.0, 15.0))
        )
        bound = sum(remainder_bounds(generators, weights, cell))
        for share in random.random((10, 2)):
            corners = product(*zip(1.0 - share, share, strict=True))
            thetas = product(*cell)
            mean = sum(
                np.prod(part) * expm(generators[0] + np.tensordot(theta, generators[1:], 1))
                for part, theta in zip(corners, thetas, strict=True)
            )
            inside = [
                least + (most - least) * s for (least, most), s in zip(cell, share, strict=True)
            ]
            error = expm(generators[0] + np.tensordot(inside, generators[1:], 1)) - mean
            size = np.linalg.norm(error * weights[:, None] / weights, 2)
            assert size <= bound
            tightest = max(tightest, size / bound)
    assert tightest > 0.1  # and it says something


def test_the_bound_of_a_scalar_by_hand():
    """x' = theta x: exp(h theta) errs by about (h s)^2 / 8 exp(h theta) half-way along a side s."""
    generators = np.array([[[0.0]], [[0.1]]])
    (bound,) = remainder_bounds(generators, np.ones(1), ((20.0, 21.0),))
    assert bound == pytest.approx(0.1**2 / 8.0 * np.exp(2.1), rel=1e-12)
    error = (np.exp(2.0) + np.exp(2.1)) / 2.0 - np.exp(2.05)
    assert 0.9 * bound < error < bound


@pytest.fixture(scope="module")
def turning():
    """x' = theta J x - 0.2 x + u, J a quarter turn; the filter believes that theta is 0."""
    still = -0.2 * np.eye(2), np.eye(2)
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]]), np.zeros((2, 2))
    plant = network_plant(*discretise(*still, 0.1), np.eye(2), 0.1 * np.eye(2), sampling_s=0.1)
    model = FilterModel(
        A=plant.A,
        B=plant.B,
        process_covariance=1e-3 * np.eye(2),
        measurement_variance=np.array([1e-2, 1e-2]),
    )
    family = PlantFamily(A_c=[still[0], turn[0]], B_c=[still[1], turn[1]], sampling_s=0.1)
    return design_lqg(plant, model), family


def turning_at(theta):
    return discretise([[-0.2, theta], [-theta, -0.2]], np.eye(2), 0.1)


def test_what_falls_at_the_ends_and_not_between_is_refused(turning, monkeypatch):
    """A whole turn a sample is none: both ends of the box have the same A."""
    lqg, family = turning
    ends, between = [0.0, 2 * np.pi / 0.1], turning_at(np.pi / 0.1)
    functions = search_age_functions(lqg, [turning_at(theta) for theta in ends], 2)
    assert functions is not None
    assert age_function_margin(lqg, map(turning_at, ends), functions) > 0.0
    assert age_function_margin(lqg, [between], functions) < 0.0
    found = certify_age_functions(lqg, family, [tuple(ends)], functions)
    assert not found.certified
    assert not found.falls_at_corners
    ((least, most),) = found.open_cell
    corners = [turning_at(least), turning_at(most)]
    assert age_function_margin(lqg, corners, functions) < 0.0

    def no_remainder(generators, weights, cell):
        return [0.0] * len(cell)

    monkeypatch.setattr(age_certificate, "remainder_bounds", no_remainder)
    assert certify_age_functions(lqg, family, [tuple(ends)], functions).certified  # the planted bug


def test_a_box_is_covered_by_cells_and_falls_as_fast_as_it_says(turning):
    lqg, family = turning
    functions = search_age_functions(lqg, [turning_at(theta) for theta in (-1.0, 1.0)], 2)
    found = certify_age_functions(lqg, family, [(-1.0, 1.0)], functions)
    assert found.certified
    assert found.open_cell is None
    assert 0.5 < found.contraction < 1.0
    factors = {age: np.linalg.cholesky(P).T for age, P in functions.items()}
    random = np.random.default_rng(1)
    xi, age = random.standard_normal(6), 1
    value = np.linalg.norm(factors[age] @ xi)
    for _ in range(200):
        after = int(random.integers(1, min(age + 1, 2) + 1))
        plant = turning_at(random.uniform(-1.0, 1.0))
        xi, age = age_mode(lqg, plant, age, after) @ xi, after
        before, value = value, np.linalg.norm(factors[age] @ xi)
        assert value <= found.contraction * before
    assert value < 1e-3


def test_a_box_ends_where_functions_stop_falling(turning):
    lqg, family = turning
    functions = search_age_functions(lqg, [turning_at(theta) for theta in (-1.0, 1.0)], 1)
    falls, does_not = 1.0, 30.0
    while does_not - falls > 1e-4:
        middle = (falls + does_not) / 2.0
        if age_function_margin(lqg, [turning_at(middle)], functions) > 0.0:
            falls = middle
        else:
            does_not = middle
    assert certify_age_functions(lqg, family, [(0.0, falls - 1e-3)], functions).certified
    beyond = certify_age_functions(lqg, family, [(0.0, does_not)], functions)
    assert not beyond.certified
    assert not beyond.falls_at_corners


def test_the_unicycle_that_turns_is_certified_and_its_mirror_image_too():
    """Functions of the plants that turn left alone are found to fall for those that turn right."""
    h = 0.02
    plant = network_plant(
        *discretise(*unicycle_error_model(1.0, 0.0, 0.1), h), np.eye(5), np.eye(2), sampling_s=h
    )
    model = FilterModel(
        A=plant.A,
        B=plant.B,
        process_covariance=1e-6 * np.eye(5),
        measurement_variance=np.full(5, 1e-5),
    )
    lqg = design_lqg(plant, model)
    left = [discretise(*unicycle_error_model(1.0, 2.0, lag), h) for lag in (0.07, 0.15)]
    signs = [1, -1, -1, 1, -1], [1, -1]
    functions = search_age_functions(lqg, left, 1, mirror=signs)
    box = [(-2.0, 2.0), (1 / 0.15, 1 / 0.07)]
    found = certify_age_functions(lqg, UNICYCLE, box, functions)
    assert found.certified
    assert found.cells > 2
    assert functions[1][0, 1] == 0.0
    few = certify_age_functions(lqg, UNICYCLE, box, functions, max_cells=2)
    assert (few.certified, few.falls_at_corners, few.open_cell is None) == (False, True, False)
    far = certify_age_functions(lqg, UNICYCLE, [(-60.0, 60.0), box[1]], functions)
    assert not far.certified
    assert not far.falls_at_corners
    with pytest.raises(ValueError, match="mirror changes the filter"):
        search_age_functions(lqg, left, 1, mirror=([1, -1, 1, 1, -1], [1, -1]))


def test_what_is_malformed_is_named(turning):
    lqg, family = turning
    functions = {1: np.eye(6)}
    for box, fault in (
        ([], "box has 0 sides; there are 1"),
        ([(1.0, 0.0)], r"box\[0\] is \(1.0, 0.0\)"),
    ):
        with pytest.raises(ValueError, match=fault):
            certify_age_functions(lqg, family, box, functions)
    with pytest.raises(ValueError, match="they must be 1 to D"):
        certify_age_functions(lqg, family, [(0.0, 1.0)], {2: np.eye(10)})
    with pytest.raises(ValueError, match=r"functions\[1\] is not positive definite"):
        certify_age_functions(lqg, family, [(0.0, 1.0)], {1: -np.eye(6)})
    with pytest.raises(ValueError, match=r"plants have \(5, 2\)"):
        certify_age_functions(lqg, UNICYCLE, WIDE, functions)
    with pytest.raises(ValueError, match="one more than parameters"):
        PlantFamily(A_c=family.A_c, B_c=family.B_c[:1], sampling_s=0.1)
