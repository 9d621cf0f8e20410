from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from hiersched.study.statistics import (
    bootstrap_interval,
    effect_size,
    interquartile_interval,
    interquartile_mean,
    mean_interval,
    paired_difference,
    paired_ratio,
    probability_of_improvement,
)

A = np.array([1.2, 0.8, 1.5, 0.9, 1.1])
B = np.array([2.1, 1.9, 2.8, 2.0, 2.4])


def test_mean_interval_is_the_one_sample_t_interval() -> None:
    bounds = stats.ttest_1samp(A, 0.0).confidence_interval(0.95)
    assert mean_interval(A) == pytest.approx((A.mean(), bounds.low, bounds.high))


def test_another_level() -> None:
    bounds = stats.ttest_1samp(A, 0.0).confidence_interval(0.8)
    assert mean_interval(A, 0.8)[1:] == pytest.approx((bounds.low, bounds.high))


def test_a_single_seed_has_no_interval() -> None:
    mean, lo, hi = mean_interval([3.0])
    assert mean == 3.0
    assert math.isnan(lo)
    assert math.isnan(hi)


def test_paired_difference_is_the_paired_t_interval() -> None:
    bounds = stats.ttest_rel(A, B).confidence_interval(0.95)
    expected = (A.mean() - B.mean(), bounds.low, bounds.high)
    assert paired_difference(A, B) == pytest.approx(expected)


def test_bounds_of_a_ratio_are_where_the_t_test_turns() -> None:
    """Fieller's set in its definition: at the bounds q, a - q b differs from 0 at exactly 5 %."""
    ratio, lo, hi = paired_ratio(A, B)
    assert ratio == pytest.approx(A.mean() / B.mean())
    for bound in (lo, hi):
        assert stats.ttest_1samp(A - bound * B, 0.0).pvalue == pytest.approx(0.05)
    assert stats.ttest_1samp(A - ratio * B, 0.0).pvalue > 0.05
    assert lo < ratio < hi


def test_a_ratio_of_zeros_is_zero() -> None:
    ratio, lo, hi = paired_ratio(np.zeros(5), B)
    assert (ratio, lo, hi) == pytest.approx((0.0, 0.0, 0.0))


def test_a_ratio_is_unbounded_where_the_baseline_may_be_zero() -> None:
    assert paired_ratio(A, np.array([-1.0, 2.0, -0.5, 1.0, 0.1]))[1:] == (-math.inf, math.inf)


@given(st.floats(0.01, 100.0), st.floats(0.01, 100.0))
def test_a_ratio_scales_with_its_samples(scale_a: float, scale_b: float) -> None:
    scaled = np.array(paired_ratio(scale_a * A, scale_b * B))
    assert scaled == pytest.approx(np.array(paired_ratio(A, B)) * scale_a / scale_b)


def test_the_t_interval_covers_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    inside = [lo <= 0.0 <= hi for _, lo, hi in map(mean_interval, rng.normal(size=(4000, 5)))]
    assert np.mean(inside) == pytest.approx(0.95, abs=0.012)


def test_bootstrap_interval_is_scipys_and_repeats() -> None:
    values = np.random.default_rng(2).exponential(size=30)
    got = bootstrap_interval(values)
    assert got == bootstrap_interval(values)
    reference = stats.bootstrap((values,), np.mean, method="BCa", rng=5, n_resamples=20000)
    bounds = reference.confidence_interval
    assert got[1:] == pytest.approx((bounds.low, bounds.high), rel=0.02)


def test_bootstrap_of_equal_values() -> None:
    assert bootstrap_interval([2.0, 2.0, 2.0]) == (2.0, 2.0, 2.0)


def test_bootstrap_of_no_number_has_no_bounds() -> None:
    assert all(np.isnan(bootstrap_interval([1.0, math.nan, 2.0])))


def test_interquartile_mean() -> None:
    values = np.random.default_rng(3).normal(size=20)
    assert interquartile_mean(values) == pytest.approx(stats.trim_mean(values, 0.25))
    # Five values: a quarter is 1.25, so 1, 3/4 and then nothing is left of each end.
    assert interquartile_mean([0.0, 10.0, 20.0, 40.0, 1000.0]) == pytest.approx(
        (0.75 * 10.0 + 20.0 + 0.75 * 40.0) / 2.5
    )


@pytest.mark.parametrize("values", [[], [[1.0]]])
def test_a_sample_of_another_shape_is_refused(values: list[object]) -> None:
    with pytest.raises(ValueError, match="shape"):
        mean_interval(np.array(values, dtype=float))


def test_samples_of_different_worlds_are_refused() -> None:
    with pytest.raises(ValueError, match="5 values against 4"):
        paired_ratio(A, B[:4])


def test_stratified_bootstrap_keeps_the_strata_apart() -> None:
    """Two strata far apart: resampled within, the share of each stays one half."""
    rng = np.random.default_rng(4)
    low, high = rng.normal(0.0, 1.0, 12), rng.normal(100.0, 1.0, 12)
    got = interquartile_interval([low, high])
    assert got == interquartile_interval([low, high])
    assert got.mean == interquartile_mean(np.concatenate([low, high]))
    pooled = interquartile_interval([np.concatenate([low, high])])
    assert got.hi - got.lo < 5.0 < pooled.hi - pooled.lo
    draws = [
        stats.trim_mean(np.concatenate([rng.choice(low, 12), rng.choice(high, 12)]), 0.25)
        for _ in range(4000)
    ]
    assert got[1:] == pytest.approx(np.quantile(draws, [0.025, 0.975]), abs=0.12)


def test_strata_without_values_are_refused() -> None:
    with pytest.raises(ValueError, match="strata"):
        interquartile_interval([])
    with pytest.raises(ValueError, match="shape"):
        interquartile_interval([A, []])
    assert math.isnan(interquartile_interval([[1.0], [2.0]]).lo)


def test_probability_of_improvement_is_mann_whitneys() -> None:
    a, b = np.array([1.0, 2.0, 3.0, 4.0]), np.array([2.0, 3.5, 5.0])
    # 1 < all three; 2 = 2 and < two; 3 < two; 4 < one: (3 + 2.5 + 2 + 1) / 12
    got = probability_of_improvement(a, b)
    assert got.mean == pytest.approx(8.5 / 12.0)
    assert got.mean == pytest.approx(stats.mannwhitneyu(b, a).statistic / 12.0)
    assert got.mean == pytest.approx(1.0 - probability_of_improvement(b, a).mean)
    assert 0.0 < got.lo < got.mean < got.hi <= 1.0
    assert probability_of_improvement(A, A + 5.0) == (1.0, 1.0, 1.0)
    assert math.isnan(probability_of_improvement([1.0, math.nan], b).mean)


def test_effect_size_is_the_t_statistic_over_root_n() -> None:
    statistic = stats.ttest_rel(A, B).statistic
    assert effect_size(A - B) == pytest.approx(statistic / math.sqrt(len(A)))
    assert effect_size([2.0, 2.0]) == math.inf
    assert effect_size([0.0, 0.0]) == 0.0
    assert math.isnan(effect_size([1.0]))
