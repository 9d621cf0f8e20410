from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from hiersched.control import (
    analyse_delay_razumikhin,
    analyse_krasovskii,
    analyse_razumikhin,
    certify,
    lift,
    simulate_random_delays,
    spectral_radius_by_delay,
)
from hiersched.control.certificate import (
    DelayRazumikhinWitness,
    KrasovskiiWitness,
    RazumikhinWitness,
)


def _radius(matrix):
    return np.abs(np.linalg.eigvals(matrix)).max()


def test_lifted_system_repeats_the_recursion(simulate):
    rng = np.random.default_rng(3)
    A_c, A_d = rng.standard_normal((3, 3)) / 3, rng.standard_normal((3, 3)) / 3
    for delay in (0, 1, 4):
        states = simulate(A_c, A_d, [delay] * 9, rng.standard_normal(3))
        history = np.concatenate([states[0]] * (delay + 1))
        matrix = lift(A_c, A_d, delay)
        assert matrix.shape == (3 * (delay + 1),) * 2
        for expected in states[1:]:
            history = matrix @ history
            np.testing.assert_allclose(history[:3], expected, atol=1e-12)


@pytest.mark.parametrize("rank", [0, 1, 2, 4])
def test_spectral_radii_equal_those_of_the_full_lift(rank):
    rng = np.random.default_rng(rank)
    A_c = rng.standard_normal((4, 4)) / 3
    A_d = rng.standard_normal((4, rank)) @ rng.standard_normal((rank, 4)) / 4
    expected = [_radius(lift(A_c, A_d, delay)) for delay in range(7)]
    np.testing.assert_allclose(spectral_radius_by_delay(A_c, A_d, 6), expected, rtol=1e-9)


def test_scalar_delay_limit_by_hand():
    # x+ = x - k x(k-1) is stable for 0 < k < 1, and at k = 1 its roots are exp(+-i pi/3).
    radii = [spectral_radius_by_delay([[1.0]], [[-k]], 1)[1] for k in (0.9, 1.0, 1.1)]
    np.testing.assert_allclose(radii, np.sqrt([0.9, 1.0, 1.1]), rtol=1e-12)


def test_fridman_exact_limit_is_18(fridman):
    radii = spectral_radius_by_delay(*fridman, 19)
    assert (radii[:19] < 1.0).all()
    assert radii[19] > 1.0


def _scalar_c1(a, d, rate, tau, steps):
    """C1 of scalars, P = 1: the 2 x 2 matrix by hand."""
    gamma = (1 - rate) ** -steps
    matrix = np.array(
        [[1 - rate - tau * gamma - a * a, -a * d], [-a * d, tau - d * d]],
    )
    return np.linalg.eigvalsh(matrix)[0]


@pytest.mark.parametrize("P", [1.0, 7.0, 1e-6])
def test_c1_margin_by_hand_does_not_depend_on_the_scale_of_P(P):
    witness = RazumikhinWitness(P=np.array([[P]]), tau=0.1, decay_rate=0.05)
    certificate = certify([[0.6]], [[0.2]], 5, witness)
    assert certificate.margins["inequality"] == pytest.approx(_scalar_c1(0.6, 0.2, 0.05, 0.1, 5))
    assert certificate.certified
    assert certificate.spectral_radii.shape == (6,)


def test_c1_tight_scalar_case_fails_with_any_larger_rate():
    # a + d sqrt(gamma) = sqrt(1 - rate) is tight: tau = d sqrt(1 - rate) / sqrt(gamma).
    rate, steps, d = 0.05, 5, 0.1
    gamma = (1 - rate) ** -steps
    a = np.sqrt(1 - rate) - d * np.sqrt(gamma)
    tau = d * np.sqrt((1 - rate) / gamma)

    def certified(rate):
        witness = RazumikhinWitness(P=np.eye(1), tau=tau, decay_rate=rate)
        return certify([[a]], [[d]], steps, witness).certified

    assert certified(rate - 1e-6)
    assert not certified(rate + 1e-6)


def test_c2_margin_by_hand():
    # Scalars: M = a + d, B1 = -d (a - 1), B2 = -d d.
    a, d, steps, p, t1, t2 = 0.9, -0.2, 3, 0.6, 0.05, 0.2
    row = np.array([a + d, -steps * d * (a - 1), -steps * d * d])
    expected = np.linalg.eigvalsh(np.diag([p, t1, t2]) - np.outer(row, row))[0]
    witness = DelayRazumikhinWitness(P=np.array([[3.0]]), p=p, t1=t1, t2=t2)
    certificate = certify([[a]], [[d]], steps, witness)
    assert certificate.margins["inequality"] == pytest.approx(expected)
    assert certificate.margins["contraction"] == pytest.approx(0.15)
    assert certificate.certified == (expected > 0)


def _functional(history, T, P, S, R):
    """V of C3 at the newest state of a history, oldest first."""
    x = history[-1]
    value = x @ P @ x
    for i in range(1, T + 1):
        value += history[-1 - i] @ S @ history[-1 - i]
    for j in range(1, T + 1):
        for i in range(1, j + 1):
            eta = history[-i] - history[-1 - i]
            value += T * eta @ R @ eta
    return value


def _ramps(oldest, delayed, now, T, delay):
    """A history that runs straight from x(k-T) to x(k-d) to x(k): Jensen's bound is tight."""
    first = [oldest + (delayed - oldest) * i / (T - delay) for i in range(T - delay)]
    second = [delayed + (now - delayed) * i / delay for i in range(delay)]
    return [*first, *second, now]


def test_c3_margin_bounds_the_decrease_of_the_functional():
    """V written out as its sums falls by at least margin * |z|^2, whatever the witness.

    A margin may be negative: then V may rise, but by no more than that.
    """
    rng = np.random.default_rng(0)
    tightest = np.inf
    for _ in range(150):
        T, delay = int(rng.integers(1, 7)), 0
        A, A1 = rng.uniform(-1, 1, (2, 1, 1))
        P, S, R = 10.0 ** rng.uniform(-1, 1, (3, 1, 1))
        X = rng.uniform(-1, 1) * R
        witness = KrasovskiiWitness(P=P, S=S, R=R, X=X)
        margin = certify(A, A1, T, witness).margins["inequality"]
        for _ in range(100):
            delay = int(rng.integers(1, T + 1))
            now, delayed, oldest = rng.standard_normal((3, 1))
            if delay == T:
                delayed = oldest
            history = _ramps(oldest, delayed, now, T, delay)
            newer = A @ now + A1 @ delayed
            before = _functional(history, T, P, S, R)
            change = _functional([*history, newer], T, P, S, R) - before
            size = P[0, 0] * (now @ now + delayed @ delayed + oldest @ oldest)
            scale = abs(before) + abs(change)
            assert change <= -margin * size + 1e-9 * scale
            tightest = min(tightest, (-margin * size - change) / scale)
    assert tightest < 1e-2  # the bound is nearly reached: the test would see a looser one


def test_c3_at_zero_delay_is_lyapunovs_inequality():
    zero = np.zeros((2, 2))
    witness = KrasovskiiWitness(P=np.eye(2), S=zero, R=zero, X=zero)
    A_c, A_d = np.diag([0.9, 0.2]), np.diag([-0.4, 0.5])
    certificate = certify(A_c, A_d, 0, witness)
    assert certificate.margins == {"inequality": pytest.approx(1 - 0.7**2)}
    assert certificate.certified
    assert not certify(A_c, np.diag([0.2, 0.0]), 0, witness).certified


def test_indefinite_P_is_no_certificate():
    witness = RazumikhinWitness(P=np.diag([1.0, -1.0]), tau=0.1, decay_rate=0.01)
    certificate = certify(0.1 * np.eye(2), 0.1 * np.eye(2), 1, witness)
    assert not certificate.certified
    assert certificate.margins == {"P": -1.0}


def test_nothing_found_is_no_certificate_even_of_a_stable_loop():
    certificate = certify([[0.1]], [[0.1]], 2, None)
    assert not certificate.certified
    assert certificate.criterion == "none"
    assert (certificate.spectral_radii < 1).all()


@pytest.mark.parametrize(
    ("A_c", "A_d", "steps", "witness", "message"),
    [
        (np.ones((2, 3)), np.eye(2), 1, None, r"A_c has shape \(2, 3\)"),
        (np.eye(2), np.eye(3), 1, None, r"A_d has shape \(3, 3\); it must be \(2, 2\)"),
        (np.eye(2), np.full((2, 2), np.inf), 1, None, r"A_d\[0, 0\] is inf"),
        (np.eye(2), np.eye(2), -1, None, "delay_steps is -1; it must be at least 0"),
        (np.eye(2), np.eye(2), 1.5, None, "delay_steps is 1.5; it must be a whole number"),
        (
            np.eye(2),
            np.eye(2),
            1,
            RazumikhinWitness(P=np.array([[1.0, 1.0], [0.0, 1.0]]), tau=0.1, decay_rate=0.1),
            "P is not symmetric",
        ),
        (
            np.eye(2),
            np.eye(2),
            1,
            RazumikhinWitness(P=np.eye(3), tau=0.1, decay_rate=0.1),
            r"P has shape \(3, 3\)",
        ),
        (
            np.eye(2),
            np.eye(2),
            1,
            RazumikhinWitness(P=np.eye(2), tau=0.1, decay_rate=1.0),
            "decay_rate is 1.0",
        ),
        (
            np.eye(2),
            np.eye(2),
            1,
            RazumikhinWitness(P=np.eye(2), tau=np.nan, decay_rate=0.1),
            "tau is nan",
        ),
    ],
)
def test_certify_rejects_malformed_input(A_c, A_d, steps, witness, message):
    with pytest.raises(ValueError, match=message):
        certify(A_c, A_d, steps, witness)


def test_importing_the_room_loads_no_solver():
    code = (
        "import sys, hiersched.control;"
        "bad = {'cvxpy', 'clarabel', 'control'} & set(sys.modules);"
        "assert not bad, bad"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_random_delays_follow_the_recursion_and_cover_the_range(simulate):
    rng = np.random.default_rng(6)
    A_c, A_d = rng.standard_normal((2, 3, 3)) / 4
    states, delays = simulate_random_delays(A_c, A_d, 5, runs=6, samples=300, seed=4)
    assert states.shape == (301, 6, 3)
    assert delays.shape == (300, 6)
    np.testing.assert_allclose(np.linalg.norm(states[0], axis=1), 1.0)
    for run in range(6):
        expected = simulate(A_c, A_d, delays[:, run], states[0, run])
        np.testing.assert_allclose(states[:, run], expected, atol=1e-12)
    assert set(np.unique(delays)) == set(range(6))
    changes = (np.diff(delays, axis=0) != 0).sum(axis=0)
    assert changes[0] > 200  # at every sample; now and then the draw repeats
    assert changes[-1] < 30  # every 24 samples on average
    again, _ = simulate_random_delays(A_c, A_d, 5, runs=6, samples=300, seed=4)
    other, _ = simulate_random_delays(A_c, A_d, 5, runs=6, samples=300, seed=5)
    np.testing.assert_array_equal(states, again)
    assert not np.array_equal(states, other)
    with pytest.raises(ValueError, match="runs is 0; it must be at least 1"):
        simulate_random_delays(A_c, A_d, 5, runs=0)


@pytest.mark.parametrize("analyse", ["c1", "c2", "c3"])
def test_simulated_runs_keep_what_every_witness_promises(analyse, fridman):
    T = 8
    A_c, A_d = fridman
    if analyse == "c1":
        A_d = 0.05 * A_d
        witness = analyse_razumikhin(A_c, A_d, T, 0.002)
    elif analyse == "c2":
        witness = analyse_delay_razumikhin(A_c, A_d, T)
    else:
        witness = analyse_krasovskii(A_c, A_d, T)
    certificate = certify(A_c, A_d, T, witness, simulations=16)
    assert certificate.certified
    assert 0.0 < certificate.margins["simulation"] < 1.0
    assert certificate.margins == certify(A_c, A_d, T, witness, simulations=16).margins


@pytest.mark.parametrize("steps", [1, 30])
def test_a_wrong_condition_is_caught_by_the_simulation(steps, monkeypatch):
    """Were an inequality wrong and passed, the runs of a diverging loop would still fail."""
    module = sys.modules["hiersched.control.certificate"]
    monkeypatch.setattr(module, "_margins", lambda *args: ({"inequality": 1.0}, 1.0))
    witness = RazumikhinWitness(P=np.eye(1), tau=0.1, decay_rate=0.1)
    certificate = certify([[1.0]], [[-1.5]], steps, witness, simulations=4)
    assert certificate.margins["simulation"] < 0.0
    assert not certificate.certified
