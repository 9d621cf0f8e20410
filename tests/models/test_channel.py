from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from hiersched.core.compiled import kernel
from hiersched.core.pointer import Pointer
from hiersched.core.randomness import world_keys
from hiersched.models.channel.path_loss import Macro
from hiersched.models.link.shannon import ShannonWords, rate_prbs
from hiersched.scenario import load_scenario
from hiersched.simulator import Simulator
from hiersched.simulator.loop_gains import nominal_gains

PRB_MHZ = 10e6 / 25 * 1e-6


class State(NamedTuple):
    """What rates follow from, and where they go: one world with one user."""

    fading_power: np.ndarray
    snr: np.ndarray
    prb_rate_mbps: np.ndarray


@kernel()
def rate_world(me, state):
    rate_prbs(me, 0, state, 0, 0)


def rates(fading_power, snr, prb_mhz=PRB_MHZ):
    count = len(fading_power)
    out = np.empty((1, 1, count), np.float32)
    state = State(fading_power.reshape(1, 1, count), np.full((1, count), snr), out)
    rate_world(Pointer(ShannonWords(prb_mhz)), Pointer(state))
    return out[0, 0]


def test_paper_link_budget_is_130_db():
    """20 dBm a PRB over −110 dBm of noise."""
    scenario = load_scenario("paper")
    world = Simulator(scenario, nominal_gains(scenario), world_keys("test", 1, 1), 1)
    np.testing.assert_allclose(10 * np.log10(world.state.snr), 130.0, atol=1e-12)


def test_one_prb_of_the_paper_carries_17_mbps():
    """10 MHz over 25 PRBs is 400 kHz; E log2(1 + 1e13 h^2) with h^2 ~ 2 Exp(1).

    Euler's constant g: E ln(2 Exp(1)) = ln 2 − g, so 0.4 (log2(1e13) + 1 − g / ln 2) Mbit/s.
    """
    expected = 0.4 * (13 * np.log2(10) + 1 - np.euler_gamma / np.log(2))
    assert expected == pytest.approx(17.34, abs=0.01)
    h2 = (2 * np.random.default_rng(1).exponential(size=200_000)).astype(np.float32)
    got = rates(h2, 1e13).astype(np.float64)
    assert got.mean() == pytest.approx(expected, abs=4 * got.std() / np.sqrt(h2.size))


@pytest.mark.parametrize("snr_db", [-20.0, 0.0, 15.0, 130.0])
def test_rates_are_the_equation_rounded_to_float32(snr_db):
    h2 = (2 * np.random.default_rng(2).exponential(size=100_000)).astype(np.float32)
    snr = 10 ** (snr_db / 10)
    expected = (PRB_MHZ * np.log2(1.0 + snr * h2.astype(np.float64))).astype(np.float32)
    np.testing.assert_array_equal(rates(h2, snr), expected)


def test_rate_at_hand_computed_points():
    h2 = np.array([1.0, 3.0, 7.0], np.float32)
    np.testing.assert_array_equal(rates(h2, 1.0, 0.5), [0.5, 1.0, 1.5])


def gains(key, users=4000, shadowing_db=0.0):
    keys = {"cell_radius_m": 400.0, "min_distance_m": 35.0, "shadowing_db": shadowing_db}
    return Macro(model="macro", **keys).gain(key, users)


def test_users_are_uniform_over_the_disc():
    """Share of users within d: (d² − 35²) / (400² − 35²)."""
    loss_db = -10 * np.log10(gains(1))
    distance_m = 1000 * 10 ** ((loss_db - 128.1) / 37.6)
    assert distance_m.min() >= 35.0 * (1 - 1e-12)
    assert distance_m.max() <= 400.0 * (1 + 1e-12)
    for d in (100.0, 200.0, 300.0):
        share = (d**2 - 35**2) / (400**2 - 35**2)
        spread = 4 * np.sqrt(share * (1 - share) / len(distance_m))
        assert np.mean(distance_m < d) == pytest.approx(share, abs=spread)


def test_shadowing_is_normal_in_decibels():
    shadow_db = 10 * np.log10(gains(1)) - 10 * np.log10(gains(1, shadowing_db=8.0))
    assert shadow_db.mean() == pytest.approx(0.0, abs=4 * 8 / np.sqrt(4000))
    assert shadow_db.std() == pytest.approx(8.0, abs=4 * 8 / np.sqrt(8000))


def test_places_belong_to_the_world():
    np.testing.assert_array_equal(gains(1, 10), gains(1, 10))
    assert not np.array_equal(gains(1, 10), gains(2, 10))
