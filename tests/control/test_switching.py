from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from hiersched.control import (
    GainDesigner,
    GainSchedule,
    analyse_krasovskii,
    build_schedule,
    certify,
    hold_delays,
    lift,
    switching_report,
)
from hiersched.control.common_functional import common_functional
from hiersched.control.functional import (
    contraction,
    extended,
    jump,
    krasovskii_form,
    lifted_modes,
    worst_period,
)
from hiersched.control.switching import _level


def _symmetric(rng, n):
    factor = rng.standard_normal((n, n))
    return factor @ factor.T + 0.1 * np.eye(n)


def _functional(x, P, S, R, limits):
    """V at the newest of the states x(k), x(k-1), ..., as its sums are written."""
    value, start = x[0] @ P @ x[0], 0
    for S_s, R_s, stop in zip(S, R, limits, strict=True):
        for lag in range(start + 1, stop + 1):
            value += x[lag] @ S_s @ x[lag]
            for back in range(1, lag + 1):
                eta = x[back - 1] - x[back]
                value += (stop - start) * eta @ R_s @ eta
        start = stop
    return value


@pytest.mark.nightly
def test_form_equals_the_sums():
    rng, n = np.random.default_rng(0), 2
    for limits in ([3], [1, 4], [2, 3, 7], []):
        P = _symmetric(rng, n)
        S, R = ([_symmetric(rng, n) for _ in limits] for _ in range(2))
        form = krasovskii_form(P, S, R, limits)
        x = rng.standard_normal((max([0, *limits]) + 1, n))
        assert x.ravel() @ form @ x.ravel() == pytest.approx(_functional(x, P, S, R, limits))


@pytest.mark.nightly
def test_modes_are_the_lifts():
    rng = np.random.default_rng(1)
    A_c, A_d = rng.standard_normal((2, 3, 3))
    modes = lifted_modes(A_c, A_d, 4, 6)
    assert modes.shape == (5, 21, 21)
    np.testing.assert_array_equal(modes[4][:15, :15], lift(A_c, A_d, 4))
    states = rng.standard_normal((7, 3))
    for d in range(5):
        moved = (modes[d] @ states.ravel()).reshape(7, 3)
        np.testing.assert_allclose(moved[0], A_c @ states[0] + A_d @ states[d], atol=1e-12)
        np.testing.assert_array_equal(moved[1:], states[:-1])


@pytest.mark.nightly
def test_contraction_and_jump_by_hand():
    form = np.diag([1.0, 4.0])
    assert contraction(form, np.array([[[0.0, 1.0], [0.5, 0.0]]])) == pytest.approx(1.0, abs=1e-9)
    assert contraction(form, np.array([np.diag([0.5, 0.9])])) == pytest.approx(0.81, abs=1e-9)
    assert contraction(np.diag([1.0, -1.0]), np.zeros((1, 2, 2))) == np.inf
    assert jump(np.diag([3.0, 2.0]), form) == pytest.approx(3.0)


@pytest.mark.nightly
def test_the_extended_functional_falls_as_it_claims(fridman):
    rng, T, window = np.random.default_rng(2), 3, 8
    P = _symmetric(rng, 2)
    S, R = 0.1 * _symmetric(rng, 2), 0.01 * _symmetric(rng, 2)
    A_c, A_d = 0.1 * fridman[0], 0.1 * fridman[1]
    own = krasovskii_form(P, [S], [R], [T])
    rate = contraction(own, lifted_modes(A_c, A_d, T, T))
    if not rate < 1.0:
        own = krasovskii_form(P, [np.zeros((2, 2))], [np.zeros((2, 2))], [T])
        own += np.kron(np.diag([0.0, 0.3, 0.2, 0.1]), P)
        rate = contraction(own, lifted_modes(A_c, A_d, T, T))
    assert rate < 1.0
    form = extended(own, P, rate, window)
    assert contraction(form, lifted_modes(A_c, A_d, T, window)) <= (1.0 + rate) / 2.0 + 1e-9
    assert np.linalg.eigvalsh(form)[0] > 0.0


@pytest.mark.nightly
def test_fridmans_loop_has_a_functional_with_two_segments(fridman):
    """N = 2 is at least as good as C3, whose limit is 15; no functional exists past 18."""
    form = common_functional([fridman, fridman], [7, 15])
    assert contraction(form, lifted_modes(*fridman, 15, 15)) < 1.0
    form = common_functional([fridman, fridman], [7, 19])
    assert form is None or contraction(form, lifted_modes(*fridman, 19, 19)) >= 1.0


def test_functionals_of_two_gains_meet_on_one_window(make_network_plant):
    """That of a shorter delay is extended to the longer window, where it falls as it says."""
    plant = make_network_plant()
    schedule = SimpleNamespace(gains=[plant.nominal_gain] * 4)
    loop, window = plant.closed_loop(plant.nominal_gain), 3
    for T in (0, 1, window):
        level = _level(plant, schedule, T, window)
        assert level.form.shape == (plant.B.shape[0] * (window + 1),) * 2
        found = contraction(level.form, lifted_modes(*loop, T, window))  # rounding included
        assert found - 1e-6 < level.contraction < 1.0


def test_worst_period_by_hand():
    """Doubling for p samples and quartering for q grows by 2^((p - 2q) / (p + q)) a sample."""
    growth, p, q = worst_period(np.array([[2.0]]), np.array([[0.25]]), (1, 2, 3))
    assert (growth, p, q) == (pytest.approx(2.0**0.25), 3, 1)


@pytest.mark.nightly
def test_scalars_that_switch_unstably_have_no_common_functional():
    """Either gain alone is stable at its delay; alternating between them is not."""
    stiff, soft = ([[1.0]], [[-1.6]]), ([[1.0]], [[-0.55]])
    one, other = (tuple(np.array(M) for M in loop) for loop in (stiff, soft))
    first, second = lifted_modes(*one, 0, 2)[-1], lifted_modes(*other, 2, 2)[-1]
    for mode in (first, second):
        assert np.abs(np.linalg.eigvals(mode)).max() < 1.0
    growth, p, q = worst_period(first, second, (1, 2, 3, 4))
    product = np.linalg.matrix_power(first, p) @ np.linalg.matrix_power(second, q)
    assert growth ** (p + q) == pytest.approx(np.abs(np.linalg.eigvals(product)).max())
    assert growth > 1.0
    form = common_functional([one, other], [0, 2])
    modes = np.concatenate([lifted_modes(*one, 0, 2), lifted_modes(*other, 2, 2)])
    assert form is None or contraction(form, modes) >= 1.0


@pytest.fixture(scope="module")
def study(make_network_plant):
    """The gain study with three levels: K up to 3 samples, then K^(11), then K^(12)."""
    plant = make_network_plant()
    designer = GainDesigner(plant)
    long = {T: designer.design(T) for T in (11, 12)}
    gains = [plant.nominal_gain] * 4 + [long[11].gain] * 8 + [long[12].gain]
    loops = [plant.closed_loop(gain) for gain in gains]
    table = GainSchedule(
        gains=np.stack(gains),
        status=("nominal",) * 4 + ("adjusted",) * 9,
        certificates=tuple(
            certify(*loop, T, analyse_krasovskii(*loop, T)) for T, loop in enumerate(loops)
        ),
        nominal=plant.nominal_gain,
        kind="network",
        method="krasovskii",
        decay_rate=None,
        sampling_s=plant.sampling_s,
        key="three levels",
    )
    return plant, table, switching_report(plant, table)


@pytest.mark.nightly
def test_report_of_the_gain_study(study):
    _, _, report = study
    assert report.levels == (3, 11, 12)
    assert report.level_of == (3,) * 4 + (11,) * 8 + (12,)
    switches = {(s.shorter, s.longer): s for s in report.switches}
    assert set(switches) == {(3, 11), (3, 12), (11, 12)}
    for pair, switch in switches.items():
        assert (switch.growth > 1.0) == (pair[0] == 3)
        assert switch.covered_by == "hold"
        assert 0 < switch.hold_samples <= report.hold_samples
    free, held = report.covered(), report.covered(report.hold_samples)
    assert free.shape == (13, 13)
    assert free[:4, :4].all()
    assert free[4:12, 4:12].all()
    assert not free[:4, 4:].any()
    assert held.all()
    np.testing.assert_array_equal(held, held.T)


@pytest.mark.nightly
def test_switching_without_a_hold_diverges_and_a_hold_prevents_it(study):
    """The delays of the worst period, played to the table: unbounded, or decaying when held."""
    plant, table, report = study
    switch = next(s for s in report.switches if (s.shorter, s.longer) == (3, 12))
    short, long = switch.period
    delays = np.tile(np.repeat([3, 12], [short, long]), 60)
    sizes = {}
    for hold in (0, short):
        entries = hold_delays(delays, hold)
        states = [np.array([0.1, 0.1, 0.1, 0.0, 0.0])]
        for k, (delay, entry) in enumerate(zip(delays, entries, strict=True)):
            late = states[max(k - int(delay), 0)]
            states.append(plant.A @ states[-1] - plant.B @ table.gains[entry] @ late)
        sizes[hold] = np.linalg.norm(states, axis=1)
    grown = sizes[0][-1] / sizes[0][len(delays) // 2]
    assert np.log(grown) / (len(delays) // 2) == pytest.approx(np.log(switch.growth), rel=0.1)
    assert sizes[short][-1] < 0.1 * sizes[short][0]  # K^(12) stays in force: certified


@pytest.mark.nightly
def test_hold_is_least_that_the_functionals_prove(study):
    """At the reported N a round trip contracts, at N - 1 it does not: from the numbers alone."""
    plant, table, report = study
    for switch in report.switches:
        one, other = (_level(plant, table, T, 12) for T in (switch.shorter, switch.longer))
        up, down = jump(other.form, one.form), jump(one.form, other.form)
        trip = np.log(up * down * one.contraction)
        N = switch.hold_samples
        assert trip + (N + 1) * np.log(other.contraction) < 0.0
        assert trip + N * np.log(other.contraction) >= 0.0


@pytest.mark.nightly
def test_gains_of_c1_share_one_functional(make_split_plant):
    plant = make_split_plant(100.0, 0.3)
    table = build_schedule(plant, 2, "razumikhin", decay_rate=0.03)
    report = switching_report(plant, table)
    assert len(report.levels) == 3
    assert report.hold_samples == 0
    assert report.contraction < 1.0
    assert all(switch.covered_by == "common" for switch in report.switches)
    assert report.covered().all()


@pytest.mark.nightly
def test_gains_without_certificate_are_never_covered(make_network_plant):
    plant = make_network_plant()
    table = build_schedule(plant, 2, "predictor")
    report = switching_report(plant, table)
    assert report.level_of == (0, None, None)
    assert report.switches == ()
    assert report.covered(10**6).sum() == 1


@pytest.mark.nightly
def test_report_refuses_another_plants_schedule(study, make_network_plant):
    _, table, _ = study
    with pytest.raises(ValueError, match=r"sampling_s is 0\.02; it must be 0\.05"):
        switching_report(make_network_plant(sampling_s=0.05), table)
