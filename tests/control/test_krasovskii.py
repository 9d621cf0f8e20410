from __future__ import annotations

import numpy as np
import pytest

from hiersched.control import certify
from hiersched.control.krasovskii import KrasovskiiSynthesis, analyse_krasovskii


@pytest.mark.parametrize("steps", [0, 1, 8, 14, 15])
def test_fridmans_example_is_certified_up_to_15(fridman, steps):
    assert certify(*fridman, steps, analyse_krasovskii(*fridman, steps)).certified


@pytest.mark.parametrize("steps", [16, 17, 18])
def test_fridmans_example_is_not_certified_from_16_on(fridman, steps):
    # Constant delays are stable up to 18: the condition is conservative there, not wrong.
    certificate = certify(*fridman, steps, analyse_krasovskii(*fridman, steps))
    assert not certificate.certified
    assert (certificate.spectral_radii < 1).all()


def test_analysis_does_not_depend_on_the_units_of_the_state(fridman):
    scale = np.diag([1e3, 1e-2])
    A, A1 = (scale @ M @ np.linalg.inv(scale) for M in fridman)
    for steps, expected in ((14, True), (17, False)):
        assert certify(A, A1, steps, analyse_krasovskii(A, A1, steps)).certified == expected


def test_certified_loops_survive_varying_delays(simulate):
    rng = np.random.default_rng(4)
    T, certified = 3, 0
    for _ in range(12):
        n = int(rng.integers(1, 4))
        A_c, A_d = rng.standard_normal((n, n)), rng.standard_normal((n, n))
        A_c *= rng.uniform(0.5, 1.0) / np.abs(np.linalg.eigvals(A_c)).max()
        A_d *= rng.uniform(0.05, 0.4) / np.linalg.norm(A_d, 2)
        certificate = certify(A_c, A_d, T, analyse_krasovskii(A_c, A_d, T))
        if not certificate.certified:
            continue
        certified += 1
        for _ in range(5):
            states = simulate(A_c, A_d, rng.integers(0, T + 1, 3000), rng.standard_normal(n))
            assert np.linalg.norm(states[-1]) < 1e-3 * np.linalg.norm(states[0])
    assert certified >= 5


def test_unstable_loops_are_never_certified():
    assert analyse_krasovskii(np.diag([1.01, 0.5]), np.zeros((2, 2)), 2) is None
    # Stable without delay, unstable from one sample on: x+ = x - 1.5 x(k-1).
    assert not certify([[1.0]], [[-1.5]], 1, analyse_krasovskii([[1.0]], [[-1.5]], 1)).certified
    assert certify([[1.0]], [[-1.5]], 0, analyse_krasovskii([[1.0]], [[-1.5]], 0)).certified


def test_synthesis_for_the_network_plant_at_one_delay(make_network_plant, simulate):
    plant = make_network_plant()
    gain, witness = KrasovskiiSynthesis(plant).minimal_deviation(6)
    loop = plant.closed_loop(gain)
    assert certify(*loop, 6, witness).certified
    assert np.linalg.norm(gain - plant.nominal_gain) == pytest.approx(12.2, rel=0.03)
    # Only couplings within the longitudinal and the lateral loop: the plant has no others.
    assert np.abs(gain[0, [1, 2, 4]]).max() < 1e-4
    assert np.abs(gain[1, [0, 3]]).max() < 1e-4
    rng = np.random.default_rng(8)
    states = simulate(*loop, rng.integers(0, 7, 4000), np.array([0.1, 0.1, 0.1, 0.0, 0.0]))
    assert np.linalg.norm(states[-1]) < 1e-6


def test_synthesis_for_the_split_plant(make_split_plant):
    plant = make_split_plant(100.0, 1.0)
    nominal = plant.closed_loop(plant.nominal_gain)
    steps = 13  # the nominal loop is unstable at a constant delay of 11 samples and more
    assert certify(*nominal, steps, None).spectral_radii.max() > 1
    gain, witness = KrasovskiiSynthesis(plant).minimal_deviation(steps)
    certificate = certify(*plant.closed_loop(gain), steps, witness)
    assert certificate.certified
    assert (certificate.spectral_radii < 1).all()


@pytest.mark.nightly
def test_reaching_for_a_shorter_delay_moves_the_gain_less(make_network_plant):
    plant = make_network_plant()
    synthesis = KrasovskiiSynthesis(plant)
    deviations = [
        np.linalg.norm(synthesis.minimal_deviation(T)[0] - plant.nominal_gain) for T in (1, 4, 8)
    ]
    assert deviations[0] < 1e-3
    assert deviations == sorted(deviations)
