"""Second moments over chains of delays: by hand, dense, and against simulation."""

from __future__ import annotations

import numpy as np
import pytest

from hiersched.control import hold_delays, predictor_gains
from hiersched.control.second_moments import (
    Chain,
    chain_of_counts,
    count_transitions,
    second_moment_growth,
    simulate_chain,
)

SAW = np.array([1, *range(1, 13), 12])


def cycle(delays):
    """A chain that goes through delays in their order again and again."""
    delays = np.asarray(delays)
    return Chain(delays, delays, np.roll(np.eye(len(delays)), 1, axis=1))


def test_a_scalar_loop_without_delay_by_hand():
    """x⁺ = (1.5 − K_e) x with K = 0 or 1.2: half of the time each, factor (1.5² + 0.3²)/2."""
    gains = np.array([[[0.0]], [[1.2]]])
    drawn = Chain(np.array([0, 0]), np.array([0, 1]), np.full((2, 2), 0.5))
    growth = second_moment_growth([[1.5]], [[1.0]], gains, drawn)
    assert growth == pytest.approx((1.5**2 + 0.3**2) / 2.0, rel=1e-12)
    # One after the other they leave 1.5 · 0.3 in two samples.
    turns = Chain(np.array([0, 0]), np.array([0, 1]), np.array([[0.0, 1.0], [1.0, 0.0]]))
    growth = second_moment_growth([[1.5]], [[1.0]], gains, turns)
    assert growth == pytest.approx(1.5 * 0.3, rel=1e-9)


def test_large_recursions_agree_with_the_product_over_a_cycle(make_network_plant, schedule):
    """A cycle is deterministic: its factor is the spectral radius of the product of its modes."""
    plant, n, T = make_network_plant(), 5, 12
    product = np.eye(n * (T + 1))
    for delay in SAW:
        mode = np.eye(n * (T + 1), k=-n)
        mode[:n] = 0.0
        mode[:n, :n] = plant.A
        mode[:n, n * delay : n * (delay + 1)] -= plant.B @ schedule.gains[delay]
        product = mode @ product
    radius = np.abs(np.linalg.eigvals(product)).max() ** (1.0 / len(SAW))
    growth = second_moment_growth(plant.A, plant.B, schedule.gains, cycle(SAW))
    assert growth == pytest.approx(radius**2, rel=1e-5)
    assert 1.04 < radius < 1.07  # the sawtooth for which the schedule grows


def test_the_schedule_grows_in_a_linear_simulation_without_saturation(make_network_plant, schedule):
    plant = make_network_plant()
    growth = second_moment_growth(plant.A, plant.B, schedule.gains, cycle(SAW))
    means = simulate_chain(plant.A, plant.B, schedule.gains, cycle(SAW), samples=1400, runs=2)
    assert means[-1] > 1e20 * means[0]
    assert (means[-1] / means[-701]) ** (1.0 / 700.0) == pytest.approx(growth, rel=1e-3)


def test_a_simulation_of_drawn_delays_grows_as_predicted(make_network_plant):
    """The nominal gain where delays jump between 1 and 9 samples."""
    plant = make_network_plant()
    gains = np.repeat(plant.nominal_gain[None], 10, axis=0)
    chain = Chain(np.array([1, 9]), np.array([1, 9]), np.array([[0.7, 0.3], [0.4, 0.6]]))
    growth = second_moment_growth(plant.A, plant.B, gains, chain)
    means = simulate_chain(plant.A, plant.B, gains, chain, samples=400, runs=4000, seed=3)
    slope = np.polyfit(np.arange(100, 400), np.log(means[100:]), 1)[0]
    assert np.exp(slope) == pytest.approx(growth, rel=0.02)
    assert growth > 1.0


def test_holding_makes_the_chain_that_the_loop_walks(make_network_plant, schedule):
    """States of a held chain against `hold_delays`, over a history of delays."""
    rng = np.random.default_rng(4)
    delays = np.clip(np.cumsum(rng.integers(-1, 2, 4000)) % 13, 1, 12)
    chain = chain_of_counts(count_transitions(delays[:, None]), hold_samples=5)
    np.testing.assert_allclose(chain.transition.sum(axis=1), 1.0)
    held = hold_delays(delays, 5)
    pairs = set(zip(chain.delays.tolist(), chain.entries.tolist(), strict=True))
    assert set(zip(delays[1:].tolist(), held[1:].tolist(), strict=True)) <= pairs
    saw = chain_of_counts(count_transitions(np.resize(SAW, 20000)[:, None]), hold_samples=5)
    plant = make_network_plant()
    assert second_moment_growth(plant.A, plant.B, schedule.gains, saw) < 1.0


def test_a_right_predictor_has_the_growth_of_its_regulator(make_network_plant):
    plant = make_network_plant()
    G, H = predictor_gains(plant.A, plant.B, plant.nominal_gain, 3)
    gains, inputs = np.repeat(G[None], 4, axis=0), np.repeat(H[None], 4, axis=0)
    stays = Chain(np.array([3]), np.array([3]), np.eye(1))
    radius = np.abs(np.linalg.eigvals(plant.A - plant.B @ plant.nominal_gain)).max()
    growth = second_moment_growth(plant.A, plant.B, gains, stays, inputs)
    assert growth == pytest.approx(radius**2, rel=1e-6)


def test_a_split_plant_by_hand_and_lifted():
    """x(k+1) = (0.9 - 0.5 K) x(k) + 0.1 x(k-d): a local gain and a part that is delayed."""
    gains = np.full((3, 1, 1), 0.4)
    stays = Chain(np.array([2]), np.array([2]), np.eye(1))
    growth = second_moment_growth([[0.9]], [[0.5]], gains, stays, A_d=[[0.1]])
    lifted = np.array([[0.7, 0.0, 0.1], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert growth == pytest.approx(np.abs(np.linalg.eigvals(lifted)).max() ** 2, rel=1e-9)
    now = Chain(np.array([0]), np.array([0]), np.eye(1))
    growth = second_moment_growth([[0.9]], [[0.5]], gains, now, A_d=[[0.1]])
    assert growth == pytest.approx((0.7 + 0.1) ** 2)


def test_a_delay_couples_parts_that_nothing_else_does():
    """Two states that act on each other through A_d alone are one part."""
    A, A_d = np.diag([0.9, 0.9]), np.array([[0.0, 0.3], [0.3, 0.0]])
    gains, stays = np.zeros((2, 1, 2)), Chain(np.array([1]), np.array([1]), np.eye(1))
    growth = second_moment_growth(A, [[1.0], [0.0]], gains, stays, A_d=A_d)
    lifted = np.block([[A, A_d], [np.eye(2), np.zeros((2, 2))]])
    assert growth == pytest.approx(np.abs(np.linalg.eigvals(lifted)).max() ** 2, rel=1e-9)


def test_transitions_are_counted_and_checked():
    counts = count_transitions([[1], [2], [3], [2]])
    assert counts[1, 2] == counts[2, 3] == counts[3, 2] == 1.0
    assert counts.sum() == 3.0
    assert count_transitions([[1], [2], [100_000]]).shape == (1, 1)
    with pytest.raises(ValueError, match="no delay that recurs"):
        chain_of_counts(np.zeros((2, 2)))
    with pytest.raises(ValueError, match="counts must be square"):
        chain_of_counts(np.zeros((2, 3)))


def test_the_last_delay_of_a_run_decides_nothing(make_network_plant):
    """What follows it is not known: it is as if the run had ended before."""
    plant = make_network_plant()
    gains = np.repeat(plant.nominal_gain[None], 9, axis=0)
    calm = np.ones((1000, 1), int)
    ended = np.vstack([calm, [[8]]])
    growth = [
        second_moment_growth(plant.A, plant.B, gains, chain_of_counts(count_transitions(delays)))
        for delays in (calm, ended)
    ]
    assert growth[0] == growth[1] < 0.9


def test_delays_without_a_gain_have_that_of_the_longest(make_network_plant, schedule):
    """The gain for 6 samples, on measurements that are 20 old, is another loop than at 6."""
    plant = make_network_plant()
    delays = np.resize(np.repeat([6, 20], 30), 6000)[:, None]
    chain = chain_of_counts(count_transitions(delays), max_entry=6)
    assert chain.delays.max() == 20
    assert chain.entries.max() == 6
    assert second_moment_growth(plant.A, plant.B, schedule.gains[:7], chain) > 1.0
    short = chain_of_counts(count_transitions(np.minimum(delays, 6)))
    assert second_moment_growth(plant.A, plant.B, schedule.gains[:7], short) < 1.0


def test_what_is_too_large_is_said(make_network_plant):
    plant = make_network_plant()
    gains = np.repeat(plant.nominal_gain[None], 2, axis=0)
    rng = np.random.default_rng(0)
    delays = rng.integers(1, 300, (5000, 1))
    with pytest.raises(ValueError, match="is not followed"):
        second_moment_growth(
            plant.A, plant.B, gains, chain_of_counts(count_transitions(delays), max_entry=1)
        )
