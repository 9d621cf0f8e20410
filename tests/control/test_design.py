from __future__ import annotations

import logging

import numpy as np
import pytest

from hiersched.control import DelayedPlant, certify, design_gain, network_plant
from hiersched.control.design import GainDesigner


def test_a_certified_nominal_gain_is_kept_to_the_bit(make_network_plant):
    plant = make_network_plant()
    design = design_gain(plant, 3)
    assert design.status == "nominal"
    assert design.certified
    np.testing.assert_array_equal(design.gain, plant.nominal_gain)
    assert design.deviation == 0.0


def test_an_unstable_nominal_gain_is_adjusted(make_network_plant):
    plant = make_network_plant()
    design = design_gain(plant, 4)
    assert design.status == "adjusted"
    assert design.certified
    assert all(margin > 0 for margin in design.margins.values())
    assert design.deviation == pytest.approx(np.linalg.norm(design.gain - plant.nominal_gain))
    assert design.deviation == pytest.approx(5.0, rel=0.03)
    assert design.solve_time_s > 0


@pytest.mark.nightly
def test_a_designer_repeats_single_designs(make_network_plant):
    plant = make_network_plant()
    designer = GainDesigner(plant)
    for steps in (6, 2, 4):  # the order must not matter
        alone, shared = design_gain(plant, steps), designer.design(steps)
        assert alone.status == shared.status
        np.testing.assert_array_equal(alone.gain, shared.gain)


def test_c1_on_the_network_plant_is_infeasible_and_says_so(make_network_plant, caplog):
    plant = make_network_plant()
    with caplog.at_level(logging.WARNING):
        design = design_gain(plant, 2, method="razumikhin")
    assert design.status == "infeasible"
    assert not design.certified
    np.testing.assert_array_equal(design.gain, plant.nominal_gain)
    assert "no certified gain: method=razumikhin plant=network T=2" in caplog.text


def test_a_gain_that_fails_its_certificate_is_not_used(make_network_plant, monkeypatch, caplog):
    """The solver is not trusted: here it returns the unstable nominal gain as its solution."""
    plant = make_network_plant()
    designer = GainDesigner(plant)
    good = designer.design(2).certificate.witness
    monkeypatch.setattr(designer, "_minimal_deviation", lambda T: (1.01 * plant.nominal_gain, good))
    with caplog.at_level(logging.WARNING):
        design = designer.design(6)
    assert design.status == "infeasible"
    np.testing.assert_array_equal(design.gain, plant.nominal_gain)
    assert "no certified gain" in caplog.text


def test_c1_on_the_split_plant(make_split_plant):
    kept = design_gain(make_split_plant(100.0, 0.3), 5, method="razumikhin", decay_rate=0.01)
    assert kept.status == "nominal"
    moved = design_gain(make_split_plant(100.0, 0.3), 5, method="razumikhin", decay_rate=0.03)
    assert moved.status == "adjusted"
    assert moved.certified
    assert moved.certificate.spectral_radii.max() <= np.sqrt(1 - 0.03)


def test_random_plants_never_yield_an_uncertified_adjusted_gain():
    rng = np.random.default_rng(2)
    seen = set()
    for _ in range(6):
        n, m = int(rng.integers(1, 4)), int(rng.integers(1, 3))
        A = rng.standard_normal((n, n))
        A *= rng.uniform(0.9, 1.15) / np.abs(np.linalg.eigvals(A)).max()
        B = rng.standard_normal((n, m))
        plant = network_plant(A, B, np.eye(n), 0.01 * np.eye(m), sampling_s=0.1)
        design = design_gain(plant, 2)
        seen.add(design.status)
        loop = plant.closed_loop(design.gain)
        again = certify(*loop, 2, design.certificate.witness)
        assert again.certified == design.certified == (design.status != "infeasible")
    assert "adjusted" in seen


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "magic"}, "method is 'magic'"),
        ({"delay_steps": -1}, "delay_steps is -1"),
        ({"delay_steps": 2.0}, "delay_steps is 2.0"),
        ({"decay_rate": 0.0}, "decay_rate is 0.0"),
    ],
)
def test_design_rejects(make_network_plant, options, message):
    with pytest.raises(ValueError, match=message):
        design_gain(make_network_plant(), **({"delay_steps": 2} | options))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "wireless"}, "kind is 'wireless'"),
        ({"A_d": np.eye(2)}, "A_d is given for a network plant"),
        ({"kind": "split"}, "A_d is missing for a split plant"),
        ({"nominal_gain": np.ones((2, 2))}, r"nominal_gain has shape \(2, 2\)"),
        ({"sampling_s": 0.0}, "sampling_s is 0.0"),
        ({"A": np.ones((2, 3))}, r"A has shape \(2, 3\); it must be square"),
        ({"B": np.array([[1.0], [np.nan]])}, r"B\[1, 0\] is nan; every entry must be finite"),
        ({"Q": np.diag([1.0, -1.0])}, "Q is not positive semidefinite: smallest eigenvalue -1"),
        ({"R": np.zeros((1, 1))}, "R is not positive definite"),
        ({"operator_gain": np.ones((1, 2))}, "operator_gain is given for a network plant"),
        (
            {"kind": "split", "A_d": np.eye(2), "operator_gain": np.ones((1, 2))},
            "A_d is not -B operator_gain: they differ by up to 2",
        ),
        (
            {"kind": "split", "A_d": np.eye(2), "operator_gain": np.ones((2, 2))},
            r"operator_gain has shape \(2, 2\); it must be \(1, 2\)",
        ),
    ],
)
def test_plant_rejects(changes, message):
    arguments = {
        "A": np.eye(2),
        "B": np.ones((2, 1)),
        "Q": np.eye(2),
        "R": np.eye(1),
        "kind": "network",
        "nominal_gain": np.ones((1, 2)),
        "sampling_s": 0.1,
    } | changes
    with pytest.raises(ValueError, match=message):
        DelayedPlant(**arguments)


def test_split_plant_without_delay_is_the_regulators_loop(make_split_plant, make_network_plant):
    network = make_network_plant(100.0)
    whole = network.A - network.B @ network.nominal_gain
    for share in (0.0, 0.4, 1.0):
        plant = make_split_plant(100.0, share)
        A_c, A_d = plant.closed_loop(plant.nominal_gain)
        np.testing.assert_allclose(A_c + A_d, whole, atol=1e-13)


@pytest.mark.parametrize(("share", "first_unstable"), [(0.5, 30), (0.7, 18), (1.0, 11)])
def test_first_unstable_delay_of_the_split_plant(make_split_plant, share, first_unstable):
    plant = make_split_plant(100.0, share)
    radii = certify(*plant.closed_loop(plant.nominal_gain), 30, None).spectral_radii
    assert int(np.argmax(radii >= 1)) == first_unstable


def test_a_pair_that_no_gain_stabilises_is_named():
    A, B = np.diag([1.2, 0.5]), np.array([[0.0], [1.0]])
    with pytest.raises(ValueError, match=r"\(A, B\) is not stabilisable: no input moves the mode"):
        network_plant(A, B, np.eye(2), np.eye(1), sampling_s=0.1)
    given = DelayedPlant(
        A=A,
        B=B,
        Q=np.eye(2),
        R=np.eye(1),
        kind="network",
        nominal_gain=np.ones((1, 2)),
        sampling_s=0.1,
    )
    with pytest.raises(ValueError, match=r"\(A, B\) is not stabilisable"):
        design_gain(given, 1)
