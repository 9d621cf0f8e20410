from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hiersched.control import DelayedPlant, certify, spectral_radius_by_delay
from hiersched.control.lmi import balance
from hiersched.control.razumikhin import (
    LargestMargin,
    RazumikhinSynthesis,
    WeightedMap,
    analyse_delay_razumikhin,
    analyse_razumikhin,
    razumikhin_gamma,
)


@given(st.floats(0.001, 0.5), st.integers(0, 40))
def test_gamma_exceeds_its_first_order_truncation(rate, steps):
    assert razumikhin_gamma(rate, steps) >= (1 + rate * steps) * (1 - 1e-12)


@pytest.mark.parametrize(
    ("rate", "steps", "promised", "actual"),
    [
        (0.05, 5, 0.950, 0.9545),
        (0.1, 10, 0.900, 0.9275),
        (0.2, 5, 0.800, 0.8500),
        (0.2, 20, 0.800, 0.9111),
    ],
)
def test_the_truncated_gamma_does_not_certify_the_rate(rate, steps, promised, actual):
    """Tight scalar loops a + d sqrt(g) = sqrt(1 - rate): with 1 + a T the loop is slower."""
    a = 0.5 * np.sqrt(1 - rate)
    for gamma, slow in ((1 + rate * steps, True), (razumikhin_gamma(rate, steps), False)):
        d = (np.sqrt(1 - rate) - a) / np.sqrt(gamma)
        decay = spectral_radius_by_delay([[a]], [[d]], steps)[-1] ** 2
        assert (decay > promised + 1e-6) == slow
    # The reference values hold for the slowest such loop, a -> 0.
    d = np.sqrt((1 - rate) / (1 + rate * steps))
    slowest = max(
        spectral_radius_by_delay([[a]], [[d * (1 - a / np.sqrt(1 - rate))]], steps)[-1] ** 2
        for a in np.linspace(0, np.sqrt(1 - rate), 200)
    )
    assert slowest >= actual - 5e-4


def test_certified_loops_survive_every_delay_and_keep_the_rate(simulate):
    """Random systems that C1 certifies: constant and varying delays, V decays as promised."""
    rng = np.random.default_rng(1)
    rate, T, certified = 0.02, 4, 0
    for _ in range(15):
        n = int(rng.integers(1, 4))
        A_c, A_d = rng.standard_normal((n, n)), rng.standard_normal((n, n))
        A_c *= rng.uniform(0.3, 0.9) / np.abs(np.linalg.eigvals(A_c)).max()
        A_d *= rng.uniform(0.05, 0.4) / np.linalg.norm(A_d, 2)
        witness = analyse_razumikhin(A_c, A_d, T, rate)
        certificate = certify(A_c, A_d, T, witness)
        if not certificate.certified:
            continue
        certified += 1
        assert certificate.spectral_radii.max() <= np.sqrt(1 - rate) + 1e-9
        for _ in range(5):
            x0 = rng.standard_normal(n)
            states = simulate(A_c, A_d, rng.integers(0, T + 1, 80), x0)
            V = np.einsum("ki,ij,kj->k", states, witness.P, states)
            assert (V <= V[0] * (1 - rate) ** np.arange(81) * (1 + 1e-9)).all()
    assert certified >= 5


@pytest.mark.parametrize(
    ("share", "largest_rate"), [(0.1, 0.0650), (0.2, 0.0378), (0.3, 0.0135), (0.4, None)]
)
def test_largest_rate_of_the_split_plant(make_split_plant, share, largest_rate):
    plant = make_split_plant(100.0, share)
    loop = plant.closed_loop(plant.nominal_gain)

    def certified(rate):
        return certify(*loop, 5, analyse_razumikhin(*loop, 5, rate)).certified

    if largest_rate is None:
        assert not certified(1e-4)
    else:
        assert certified(largest_rate - 5e-4)
        assert not certified(largest_rate + 5e-4)


def test_c2_on_fridmans_example(fridman):
    assert certify(*fridman, 8, analyse_delay_razumikhin(*fridman, 8)).certified
    assert not certify(*fridman, 9, analyse_delay_razumikhin(*fridman, 9)).certified


@pytest.mark.parametrize("last", [[[0.8, 0.0], [0.05, 0.9]], [[0.8, 0.0], [0.0, 0.91]]])
def test_c2_on_the_loops_of_published_tables(last):
    """The loops by which papers compare bounds on the delay.

    A P that is next to singular makes the largest margin next to 0 whatever the weights: a search
    along that margin stays there, with a witness that no certificate accepts, and ends at 8.
    """
    A_c = np.array(last)
    A_d = np.array([[-0.1, 0.0], [-0.2 if last[1][0] else -0.1, -0.1]])
    assert certify(A_c, A_d, 9, analyse_delay_razumikhin(A_c, A_d, 9), simulations=8).certified
    assert analyse_delay_razumikhin(A_c, A_d, 10) is None


@pytest.mark.parametrize(("share", "longest"), [(0.5, 11), (0.7, 7), (1.0, 5)])
def test_c2_longest_delay_of_the_split_plant(make_split_plant, share, longest):
    plant = make_split_plant(100.0, share)
    loop = plant.closed_loop(plant.nominal_gain)
    assert certify(*loop, longest, analyse_delay_razumikhin(*loop, longest)).certified
    assert analyse_delay_razumikhin(*loop, longest + 1) is None


def _random_loop(rng):
    """Half of the loops are triangular: their P may come near to being singular."""
    n = int(rng.integers(1, 5))
    A_c, A_d = rng.standard_normal((2, n, n))
    if rng.random() < 0.5:
        A_c, A_d = np.tril(A_c), np.tril(A_d)
    A_c *= rng.uniform(0.5, 0.95) / np.abs(np.linalg.eigvals(A_c)).max()
    return A_c, A_d * rng.uniform(0.05, 0.5) / np.linalg.norm(A_d, 2)


def test_a_p_exists_where_the_spectral_radius_says_so():
    """The matrix inequality, solved for its P, agrees on both sides of the edge."""
    rng = np.random.default_rng(7)
    for _ in range(12):
        loop = _random_loop(rng)
        weighted, inequality = WeightedMap(loop), LargestMargin(np.hstack(loop))
        weights = rng.uniform(0.1, 1.0, 2)
        weights *= weighted.radius(*weights)  # the radius falls as the weights grow: now it is 1
        for factor, feasible in ((1.02, True), (0.98, False)):
            assert weighted.radius(*(factor * weights)) == pytest.approx(1.0 / factor)
            found = inequality.solve(*(factor * weights))
            assert found is not None
            assert (found[0] > 1e-7) == feasible
        P = weighted.solve(*(1.02 * weights))
        F = np.hstack(loop)
        decrease = np.kron(np.diag(1.02 * weights), P) - F.T @ P @ F
        assert np.linalg.eigvalsh(P)[0] > 0.0
        assert np.linalg.eigvalsh(decrease)[0] > 0.0


SHARES = 1.0 / (1.0 + 2.0 ** np.arange(-5.0, 5.5))


def _least_c1(A_c, A_d, T, rate):
    """Least radius on a grid of tau."""
    gamma, condition = razumikhin_gamma(rate, T), WeightedMap([A_c, A_d])
    taus = (1.0 - rate) / gamma * SHARES
    return min(condition.radius(1.0 - rate - tau * gamma, tau) for tau in taus)


def _least_c2(A_c, A_d, T, _):
    """Least radius on a grid of p and t1 / t2."""
    step = A_c - np.eye(len(A_c))
    condition = WeightedMap([A_c + A_d, -T * A_d @ step, -T * A_d @ A_d])
    return min(
        condition.radius(p, (1 - p) * first, (1 - p) * (1 - first))
        for p in SHARES
        for first in SHARES
    )


@pytest.mark.parametrize(
    ("least_radius", "analyse"),
    [
        (_least_c1, analyse_razumikhin),
        (_least_c2, lambda A_c, A_d, T, _: analyse_delay_razumikhin(A_c, A_d, T)),
    ],
    ids=["c1", "c2"],
)
def test_searches_find_what_a_grid_of_weights_finds_up_to_the_edge(least_radius, analyse):
    """A_d grows until some weights of the grid are only just good enough: the search has better."""
    rng = np.random.default_rng(11)
    for _ in range(30):
        A_c, A_d = _random_loop(rng)
        T, rate = int(rng.integers(1, 6)), 10.0 ** rng.uniform(-3.0, -2.0)
        low, high = 0.0, 1.0
        while least_radius(A_c, high * A_d, T, rate) < 0.999:
            high *= 2.0
        for _ in range(20):
            middle = (low + high) / 2
            good = least_radius(A_c, middle * A_d, T, rate) < 0.999
            low, high = (middle, high) if good else (low, middle)
        assert certify(A_c, low * A_d, T, analyse(A_c, low * A_d, T, rate)).certified


@pytest.mark.nightly
@pytest.mark.parametrize(
    "analyse",
    [lambda A_c, A_d, T: analyse_razumikhin(A_c, A_d, T, 0.003), analyse_delay_razumikhin],
    ids=["c1", "c2"],
)
def test_an_analysis_answers_at_the_edge_too(analyse):
    """The largest multiple of A_d that has a witness, to the last bit: rounding decides there."""
    rng = np.random.default_rng(21)
    for _ in range(8):
        A_c, A_d = _random_loop(rng)
        T = int(rng.integers(1, 6))
        low, high = 0.0, 64.0
        while low < (middle := (low + high) / 2) < high:
            witness = analyse(A_c, middle * A_d, T)
            certify(A_c, middle * A_d, T, witness)
            low, high = (middle, high) if witness is not None else (low, middle)
        assert certify(A_c, 0.999 * low * A_d, T, analyse(A_c, 0.999 * low * A_d, T)).certified


@pytest.mark.filterwarnings("ignore::scipy.linalg.LinAlgWarning")
def test_coordinates_of_a_loop_at_the_edge_of_stability():
    """With a spectral radius of 1 but for the last bit, rounding may leave none: that is None."""
    answers = set()
    for seed in range(20):
        M = np.random.default_rng(seed).standard_normal((3, 3))
        low, high = 0.0, 100.0
        while low < (middle := (low + high) / 2) < high:
            stable = np.abs(np.linalg.eigvals(middle * M)).max() < 1.0
            low, high = (middle, high) if stable else (low, middle)
        answers.add(balance(low * M) is None)
    assert answers == {True, False}


@pytest.mark.filterwarnings("ignore::scipy.linalg.LinAlgWarning")
@pytest.mark.parametrize("coupling", [[[0.0]], [[0.0, 1.0], [0.0, 0.0]]])
def test_c2_says_nothing_of_a_loop_that_is_stable_by_a_rounding_error(coupling):
    n = len(coupling)
    A_c, A_d = np.eye(n) + coupling, -1.2e-16 * np.eye(n)
    assert np.abs(np.linalg.eigvals(A_c + A_d)).max() < 1.0
    assert not certify(A_c, A_d, 3, analyse_delay_razumikhin(A_c, A_d, 3)).certified


def _double_integrator():
    A, B = np.array([[1.0, 0.02], [0.0, 1.0]]), np.array([[0.0002], [0.02]])
    K = np.array([[9.467, 5.282]])
    return DelayedPlant(
        A=A,
        B=B,
        Q=np.diag([100.0, 0.0]),
        R=np.eye(1),
        kind="split",
        nominal_gain=K / 2,
        A_d=-B @ K / 2,
        sampling_s=0.02,
    )


@pytest.mark.parametrize(("rate", "brute_force"), [(0.005, 1.88), (0.02, 2.81)])
def test_minimal_deviation_is_near_the_brute_force_optimum(rate, brute_force):
    """Reference: a grid over both gains, C1 analysis at each (computed separately)."""
    plant = _double_integrator()
    gain, witness = RazumikhinSynthesis(plant, rate).minimal_deviation(5)
    assert certify(*plant.closed_loop(gain), 5, witness).certified
    deviation = np.linalg.norm(gain - plant.nominal_gain)
    assert 0.97 * brute_force < deviation < 1.03 * brute_force
    # Halfway back to the nominal gain nothing is certified any more.
    halfway = plant.nominal_gain + 0.9 * (gain - plant.nominal_gain)
    loop = plant.closed_loop(halfway)
    assert not certify(*loop, 5, analyse_razumikhin(*loop, 5, rate)).certified


def test_adjusted_gains_of_the_split_robot(make_split_plant):
    plant = make_split_plant(100.0, 0.5)
    assert np.linalg.norm(plant.nominal_gain) == pytest.approx(7.37, abs=0.01)
    synthesis = RazumikhinSynthesis(plant, 0.02)
    gain, witness = synthesis.minimal_deviation(6)
    certificate = certify(*plant.closed_loop(gain), 6, witness)
    assert certificate.certified
    assert certificate.spectral_radii.max() <= np.sqrt(1 - 0.02)
    assert np.linalg.norm(gain - plant.nominal_gain) < 7.65  # without alternation


def test_synthesis_refuses_a_network_plant(make_network_plant):
    with pytest.raises(ValueError, match="needs a 'split' plant"):
        RazumikhinSynthesis(make_network_plant(), 0.02)


@pytest.mark.parametrize("rate", [0.0, 1.0, -0.1])
def test_rate_must_lie_between_0_and_1(rate):
    with pytest.raises(ValueError, match="decay_rate is"):
        analyse_razumikhin([[0.5]], [[0.1]], 3, rate)
