from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from hiersched.study.statistics import (
    effect_size,
    halvings,
    log_ratios,
    mean_interval,
    paired_difference,
    paired_log_ratio,
    probability_of_improvement,
    skewed_interval,
    smallest_mean,
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


def test_a_paired_log_ratio_is_the_t_interval_of_the_logarithms() -> None:
    bounds = stats.ttest_rel(np.log(A), np.log(B)).confidence_interval(0.95)
    expected = np.exp([np.log(A / B).mean(), bounds.low, bounds.high])
    assert paired_log_ratio(A, B) == pytest.approx(tuple(expected))
    assert paired_log_ratio(A, B).mean == pytest.approx(stats.gmean(A / B))
    assert log_ratios(A, B) == pytest.approx(np.log(A) - np.log(B))


def test_a_ratio_turned_round_is_its_inverse() -> None:
    mean, lo, hi = paired_log_ratio(A, B)
    assert paired_log_ratio(B, A) == pytest.approx((1.0 / mean, 1.0 / hi, 1.0 / lo))


def test_equal_samples_have_a_ratio_of_exactly_1() -> None:
    assert paired_log_ratio(A, A) == (1.0, 1.0, 1.0)


def test_values_of_0_leave_an_upper_bound_of_the_ratio() -> None:
    """A world without late packets counts as one in which as few as can be seen are late."""
    shares, least = np.array([0.0, 1e-4, 3e-4, 0.0, 2e-4]), 1e-5
    mean, lo, hi = paired_log_ratio(shares, B, resolution=least)
    shown = paired_log_ratio(np.maximum(shares, least), B)
    assert (mean, lo, hi) == (shown.mean, 0.0, shown.hi)
    assert paired_log_ratio(np.zeros(5), B, resolution=least).lo == 0.0
    assert np.isnan(paired_log_ratio(shares, B)).all()  # without a resolution nothing bounds it


def test_baselines_of_0_leave_a_lower_bound_of_the_ratio() -> None:
    shares, least = np.array([0.0, 1e-4, 3e-4, 0.0, 2e-4]), 1e-5
    mean, lo, hi = paired_log_ratio(B, shares, resolution=least)
    shown = paired_log_ratio(B, np.maximum(shares, least))
    assert (mean, lo, hi) == (shown.mean, shown.lo, math.inf)
    above = paired_log_ratio(shares, B, resolution=least)
    assert (1.0 / mean, 1.0 / lo) == pytest.approx((above.mean, above.hi))
    assert np.isnan(paired_log_ratio(B, shares)).all()


def test_zeros_on_both_sides_leave_no_ratio() -> None:
    """Nothing bounds it, be it that both are 0 in the same world or in different ones."""
    a, b = A.copy(), B.copy()
    a[0] = b[1] = 0.0
    assert np.isnan(paired_log_ratio(a, b, resolution=1e-5)).all()
    assert np.isnan(paired_log_ratio(np.zeros(5), np.zeros(5), resolution=1e-5)).all()
    assert np.isnan(log_ratios([0.0, 1.0], [0.0, 1.0], 1e-5)).tolist() == [True, False]


def test_measures_below_0_have_no_ratio() -> None:
    assert np.isnan(paired_log_ratio([-1.0, 2.0], [1.0, 1.0], resolution=0.5)).all()


@given(st.floats(0.01, 100.0), st.floats(0.01, 100.0))
def test_a_ratio_scales_with_its_samples(scale_a: float, scale_b: float) -> None:
    scaled = np.array(paired_log_ratio(scale_a * A, scale_b * B))
    assert scaled == pytest.approx(np.array(paired_log_ratio(A, B)) * scale_a / scale_b)


def test_the_t_interval_covers_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    inside = [lo <= 0.0 <= hi for _, lo, hi in map(mean_interval, rng.normal(size=(4000, 5)))]
    assert np.mean(inside) == pytest.approx(0.95, abs=0.012)


@given(st.floats(1e-9, 1e6))
def test_a_skewed_interval_scales_with_its_sample(scale: float) -> None:
    scaled = np.array(skewed_interval(scale * A))
    assert scaled == pytest.approx(scale * np.array(skewed_interval(A)), rel=1e-5)


def test_zeros_in_all_worlds_have_an_upper_bound() -> None:
    """The share of worlds of which ten show none 1 time in 20, each of the least share."""
    mean, lo, hi = skewed_interval(np.zeros(10), resolution=2e-5)
    assert (mean, lo) == (0.0, 0.0)
    assert hi == smallest_mean(10, 2e-5)
    share = hi / 2e-5
    assert stats.binom.pmf(0, 10, share) == pytest.approx(0.05)
    assert skewed_interval(np.zeros(10), resolution=9.0, most=1.0).hi == 1.0


def test_one_share_above_0_bounds_the_mean_from_above_alone() -> None:
    sample = np.array([0.0] * 9 + [1e-5])
    mean, lo, hi = skewed_interval(sample, resolution=1e-5, most=1.0)
    assert (mean, lo) == (pytest.approx(1e-6), 0.0)
    assert smallest_mean(10, 1e-5) < hi < 1.0


def test_skewed_bounds_end_at_the_most_there_can_be() -> None:
    shares = np.array([0.9, 0.01, 0.5, 0.002, 0.3])
    assert skewed_interval(shares).hi > 1.0
    assert skewed_interval(shares, most=1.0).hi == 1.0
    assert skewed_interval(shares, most=1.0).lo == skewed_interval(shares).lo


def test_equal_values_have_no_width() -> None:
    assert skewed_interval([0.25, 0.25, 0.25]) == (0.25, 0.25, 0.25)


def test_what_has_no_skewed_interval() -> None:
    assert np.isnan(skewed_interval([1.0, math.nan, 2.0])).all()
    assert skewed_interval([3.0]).mean == 3.0
    assert np.isnan(skewed_interval([3.0])[1:]).all()
    for wrong in (-1.0, math.inf):
        with pytest.raises(ValueError, match=f"{wrong:g}, must be 0 or above and finite"):
            skewed_interval([1.0, wrong])


@pytest.mark.parametrize(("count", "ways"), [(0, 0), (1, 0), (2, 1), (3, 3), (4, 3), (10, 126)])
def test_all_ways_to_halve_few_seeds(count: int, ways: int) -> None:
    halves = halvings(count)
    assert len(halves) == ways
    for a, b in halves:
        assert sorted([*a, *b]) == list(range(count))
        assert len(b) - len(a) == count % 2
    assert len({frozenset((tuple(a), tuple(b))) for a, b in halves}) == ways
    # Beside a seed, each of the others is in count / 2 - 1 of count - 1 places of its half.
    together = sum(set(a) >= {0, 1} or set(b) >= {0, 1} for a, b in halves)
    if count > 2 and count % 2 == 0:
        assert together / ways == pytest.approx((count / 2 - 1) / (count - 1))


@pytest.mark.parametrize("count", [15, 20, 40])
def test_many_seeds_are_halved_in_a_thousand_different_ways(count: int) -> None:
    halves = halvings(count)
    assert len({tuple(a) for a, _ in halves}) == 1000
    first = np.mean([np.isin(np.arange(count), a) for a, _ in halves], axis=0)
    # Seed 0 is always in the first half of an even number; the others as often in each.
    assert first[1 - count % 2 :] == pytest.approx(
        (count // 2 - 1 + count % 2) / (count - 1 + count % 2), abs=0.1
    )


@pytest.mark.parametrize("values", [[], [[[1.0]]]])
def test_a_sample_of_another_shape_is_refused(values: list[object]) -> None:
    with pytest.raises(ValueError, match="shape"):
        mean_interval(np.array(values, dtype=float))


def test_samples_of_different_worlds_are_refused() -> None:
    with pytest.raises(ValueError, match="5 values against 4"):
        paired_log_ratio(A, B[:4])


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
