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


C = np.array([[1.0, 2.0, 4.0], [3.0, 5.0, 9.0]])
"""Two policies in three worlds."""


def test_a_crossed_interval_by_hand() -> None:
    """Means of policies 7/3 and 17/3, of worlds 2, 3.5 and 6.5; variances 50/9 and 21/4."""
    mean, lo, hi = mean_interval(C)
    of_policies, of_worlds = 50.0 / 9.0 / 2.0, 21.0 / 4.0 / 3.0
    freedom = (of_policies + of_worlds) ** 2 / (of_policies**2 + of_worlds**2 / 2.0)
    half = stats.t.ppf(0.975, freedom) * math.sqrt(of_policies + of_worlds)
    assert (mean, lo, hi) == pytest.approx((4.0, 4.0 - half, 4.0 + half))
    assert mean_interval(C.T) == pytest.approx((mean, lo, hi))


def test_policies_that_are_all_alike_are_a_rule() -> None:
    alike = np.tile(A, (3, 1))
    for interval in (mean_interval, skewed_interval):
        assert interval(alike) == pytest.approx(interval(A))
        assert interval(alike.T) == pytest.approx(interval(A))
    assert mean_interval(np.full((3, 4), 0.1)) == (pytest.approx(0.1),) * 3
    assert skewed_interval(np.full((3, 4), 0.1)) == (pytest.approx(0.1),) * 3


def test_pairs_that_differ_alone_have_an_interval() -> None:
    pairs = np.array([[1.0, 3.0], [3.0, 1.0]])
    for interval in (mean_interval, skewed_interval):
        assert interval(pairs) == interval(pairs.ravel())
        mean, lo, hi = interval(pairs)
        assert lo < mean < hi


def test_a_single_policy_or_world_adds_no_part() -> None:
    for interval in (mean_interval, skewed_interval):
        assert interval(A[None]) == interval(A)
        assert interval(A[:, None]) == interval(A)
    assert np.isnan(mean_interval([[1.0]])[1:]).all()
    assert paired_difference(A[None], B) == paired_difference(A, B)


def test_crossed_values_are_paired_by_world_within_each_policy() -> None:
    baseline = np.array([1.0, 2.0, 4.0])
    assert paired_difference(C, baseline) == mean_interval(C - baseline)
    logs = mean_interval(np.log(C / baseline))
    assert paired_log_ratio(C, baseline) == pytest.approx(tuple(np.exp(logs)))
    assert paired_log_ratio(baseline, C).mean == pytest.approx(math.exp(-logs.mean))
    assert log_ratios(C, baseline).shape == (2, 3)
    assert paired_difference(C, C + 1.0) == pytest.approx((-1.0, -1.0, -1.0))
    with pytest.raises(ValueError, match="2 by 3 values against 2 of the baseline"):
        paired_difference(C, [1.0, 2.0])
    with pytest.raises(ValueError, match="2 by 3 values against 3 by 3"):
        paired_difference(C, np.ones((3, 3)))


def test_zeros_of_all_policies_in_all_worlds_have_the_bound_of_the_fewer() -> None:
    """Of 4 policies in 10 worlds 4 pairs share neither, and so are independent."""
    bound = skewed_interval(np.zeros((4, 10)), resolution=2e-5)
    assert bound == (0.0, 0.0, smallest_mean(4, 2e-5))
    one = np.zeros((4, 10))
    one[2, 3] = 1e-5
    mean, lo, hi = skewed_interval(one, resolution=1e-5, most=1.0)
    assert (mean, lo) == (pytest.approx(1e-5 / 40.0), 0.0)
    assert smallest_mean(4, 1e-5) < hi < 1.0


def test_a_missing_crossed_value_leaves_no_interval() -> None:
    hole = C.copy()
    hole[1, 1] = math.nan
    for interval in (mean_interval, skewed_interval):
        assert np.isnan(interval(hole)).all()
    assert math.isnan(effect_size(hole))


def test_the_spread_of_a_pair_is_of_all_three_parts() -> None:
    """By simulation: the variance is 1 + 4 + 9; the mean of its estimates is that."""
    rng = np.random.default_rng(1)
    spreads = []
    for _ in range(4000):
        parts = rng.normal(size=(4, 1)), 2.0 * rng.normal(size=(1, 5)), rng.normal(size=(4, 5))
        table = parts[0] + parts[1] + 3.0 * parts[2]
        spreads.append((table.mean() / effect_size(table)) ** 2)
    assert np.mean(spreads) == pytest.approx(14.0, abs=4.0 * np.std(spreads) / math.sqrt(4000))


def test_probability_of_improvement_of_crossed_values_draws_policies_and_worlds() -> None:
    """Half of the policies are always better: resampled policies decide, whatever the worlds."""
    own = np.repeat([0.0, 2.0], 5)[:, None] + np.zeros(10)
    got = probability_of_improvement(own, np.ones(10))
    shares = stats.binom.ppf([0.025, 0.975], 10, 0.5) / 10.0
    assert got == pytest.approx((0.5, *shares))
    assert probability_of_improvement(own.T, np.ones(10)) == pytest.approx(got, abs=0.1)
    other = probability_of_improvement(np.ones((10, 10)), own[:, 0])
    assert other == pytest.approx(got, abs=0.1)
    assert probability_of_improvement(C, [2.0, 4.0]).mean == pytest.approx(
        np.mean([[x < b, x == b] @ np.array([1.0, 0.5]) for x in C.ravel() for b in (2.0, 4.0)])
    )
