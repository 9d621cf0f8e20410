"""What the two syntheses share: public functions, problems compiled once, fixed functionals."""

from __future__ import annotations

import numpy as np
import pytest

import hiersched.control
from hiersched.control import (
    KrasovskiiSynthesis,
    RazumikhinSynthesis,
    analyse_krasovskii,
    analyse_razumikhin,
    certify,
)
from hiersched.control.krasovskii import FixedFunctional
from hiersched.control.razumikhin import LargestMargin


def test_every_public_name_is_there():
    for name in hiersched.control.__all__:
        assert getattr(hiersched.control, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'magic'"):
        _ = hiersched.control.magic


def test_parametrised_problems_are_compiled_once(make_network_plant, make_split_plant):
    """DPP: cvxpy keeps the canonical form and only puts in the parameters."""
    razumikhin = RazumikhinSynthesis(make_split_plant(), 0.03)
    problems = [
        KrasovskiiSynthesis(make_network_plant())._problem,
        KrasovskiiSynthesis(make_split_plant())._problem,
        razumikhin._free,
        razumikhin._fixed,
        FixedFunctional(make_network_plant())._problem,
        FixedFunctional(make_split_plant())._problem,
        LargestMargin(np.ones((2, 4)))._problem,
    ]
    for problem in problems:
        assert problem.is_dcp(dpp=True)
        assert problem.parameters()


@pytest.mark.nightly
def test_re_solving_along_a_schedule_equals_solving_afresh(make_split_plant):
    plant = make_split_plant(100.0, 0.3)
    synthesis = RazumikhinSynthesis(plant, 0.03)
    for T in (5, 1):
        again, fresh = (
            synthesis.minimal_deviation(T),
            RazumikhinSynthesis(plant, 0.03).minimal_deviation(T),
        )
        np.testing.assert_array_equal(again[0], fresh[0])


@pytest.mark.nightly
def test_c3_synthesis_of_either_plant_passes_the_check(make_network_plant, make_split_plant):
    steps = 12  # both nominal loops are unstable there
    for plant in (make_network_plant(), make_split_plant(100.0, 1.0)):
        gain, witness = KrasovskiiSynthesis(plant).minimal_deviation(steps)
        assert certify(*plant.closed_loop(gain), steps, witness).certified


def test_c1_for_a_fixed_functional_is_exact(make_split_plant):
    """(a): certified by the P given, nearer than the gain it was found with, and tight."""
    plant, T = make_split_plant(100.0, 0.3), 5
    nominal = plant.nominal_gain
    faster, its_witness = RazumikhinSynthesis(plant, 0.04).minimal_deviation(T)
    synthesis = RazumikhinSynthesis(plant, 0.03)
    gain, witness = synthesis.closest_for(its_witness.P, T)
    np.testing.assert_allclose(witness.P, its_witness.P, rtol=1e-9)
    assert certify(*plant.closed_loop(gain), T, witness).certified
    assert np.linalg.norm(gain - nominal) < 0.9 * np.linalg.norm(faster - nominal)
    closer = plant.closed_loop(nominal + 0.97 * (gain - nominal))
    assert not certify(*closer, T, witness).certified
    with pytest.raises(ValueError, match="P is not positive definite"):
        synthesis.closest_for(-np.eye(5), T)
    # A functional of another kind admits no gain at all.
    assert synthesis.closest_for(np.diag([1.0, 1.0, 1.0, 1e6, 1e6]), T) is None


@pytest.mark.parametrize("kind", ["network", "split"])
def test_c3_for_a_fixed_functional_is_exact(make_network_plant, make_split_plant, kind):
    """(a): certified by the P and R given, nearer than the gain they were found with, and tight."""
    plant, T = (
        (make_network_plant(), 6) if kind == "network" else (make_split_plant(100.0, 1.0), 13)
    )
    nominal, synthesis = plant.nominal_gain, KrasovskiiSynthesis(plant)
    slower, its_witness = synthesis.minimal_deviation(T + 2)
    gain, witness = synthesis.closest_for(analyse_krasovskii(*plant.closed_loop(slower), T), T)
    assert certify(*plant.closed_loop(gain), T, witness).certified
    assert np.linalg.norm(gain - nominal) < 0.99 * np.linalg.norm(slower - nominal)
    closer = plant.closed_loop(nominal + 0.98 * (gain - nominal))
    assert not certify(*closer, T, witness).certified
    with pytest.raises(ValueError, match="delay_steps is 0; C3 with a fixed functional"):
        synthesis.closest_for(its_witness, 0)


@pytest.mark.nightly
def test_alternation_comes_closer_and_stays_certified(make_network_plant):
    plant = make_network_plant()
    synthesis = KrasovskiiSynthesis(plant)
    distances = []
    for rounds in (0, 10):
        gain, witness = synthesis.minimal_deviation(12, max_alternations=rounds)
        assert certify(*plant.closed_loop(gain), 12, witness).certified
        distances.append(np.linalg.norm(gain - plant.nominal_gain))
    assert distances[1] < 0.97 * distances[0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda A, D: analyse_krasovskii(A, D, -1), "delay_steps is -1"),
        (lambda A, D: analyse_krasovskii(A, D[:1], 1), r"A_d has shape \(1, 2\)"),
        (lambda A, D: analyse_razumikhin(A * np.nan, D, 1, 0.1), r"A_c\[0, 0\] is nan"),
        (lambda A, D: analyse_razumikhin(A, D, 1, 1.5), "decay_rate is 1.5"),
    ],
)
def test_analysis_rejects(fridman, call, message):
    with pytest.raises(ValueError, match=message):
        call(*fridman)


def test_synthesis_rejects(make_network_plant):
    with pytest.raises(ValueError, match=r"delay_steps is 1\.5"):
        KrasovskiiSynthesis(make_network_plant()).minimal_deviation(1.5)
    with pytest.raises(ValueError, match="needs a 'split' plant"):
        RazumikhinSynthesis(make_network_plant(), 0.03)
