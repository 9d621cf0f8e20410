from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from hiersched.models.traffic.poisson import (
    LANES,
    MAX_MEAN,
    MEAN,
    NUM_ARRIVAL_LANES,
    QUANTILE,
    UNIFORM,
    poisson_quantiles,
)


def quantiles_of(uniform, mean):
    out = np.empty(len(uniform))
    for begin in range(0, len(uniform), LANES):
        lanes = np.full(NUM_ARRIVAL_LANES, np.nan)
        lanes[UNIFORM : UNIFORM + LANES] = lanes[MEAN : MEAN + LANES] = 0.0
        block = slice(begin, min(begin + LANES, len(uniform)))
        count = block.stop - begin
        lanes[UNIFORM : UNIFORM + count] = uniform[block]
        lanes[MEAN : MEAN + count] = mean[block]
        poisson_quantiles(lanes)
        out[block] = lanes[QUANTILE : QUANTILE + count]
        assert (lanes[QUANTILE + count : QUANTILE + LANES] == 0.0).all()
    return out


def test_quantile_is_scipys():
    rng = np.random.default_rng(1)
    mean = np.concatenate([10 ** rng.uniform(-3, np.log10(MAX_MEAN), 40_000), [1e-9, MAX_MEAN]])
    uniform = rng.uniform(size=len(mean))
    np.testing.assert_array_equal(quantiles_of(uniform, mean), stats.poisson.ppf(uniform, mean))


def test_quantile_is_scipys_in_the_tails():
    """At 1 − 1e-12 the sums differ by rounding: one packet of difference is allowed there."""
    rng = np.random.default_rng(2)
    mean = 10 ** rng.uniform(-3, np.log10(MAX_MEAN), 5000)
    tail = 10 ** rng.uniform(-12, -3, 5000)
    low, high = quantiles_of(tail, mean), quantiles_of(1 - tail, mean)
    np.testing.assert_array_equal(low, stats.poisson.ppf(tail, mean))
    assert np.abs(high - stats.poisson.ppf(1 - tail, mean)).max() <= 1


def test_no_mean_no_arrivals_and_no_endless_sum():
    one = np.array([1 - 2.0**-53])
    assert quantiles_of(one, np.zeros(1))[0] == 0
    assert MAX_MEAN < quantiles_of(one, np.array([MAX_MEAN]))[0] < 1000


@pytest.mark.parametrize("mean", [0.05, 3.7, 90.0])
def test_counts_have_the_mean_and_variance(mean):
    uniform = np.random.default_rng(3).uniform(size=100_000)
    counts = quantiles_of(uniform, np.full(100_000, mean))
    assert counts.mean() == pytest.approx(mean, abs=4 * np.sqrt(mean / 1e5))
    spread = np.sqrt((mean + 2 * mean**2) / 1e5)
    assert counts.var() == pytest.approx(mean, abs=4 * spread)
