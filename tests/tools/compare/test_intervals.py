"""Confidence intervals follow their formulas, and contain the true value as often as they
promise."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mitsuba_ext.compare import intervals
from mitsuba_ext.compare.intervals import Estimate


def test_mean_of_positive_values_has_a_factor_around_it():
    low, high = 1 / 2, 2
    estimate = intervals.mean([low, high])
    # Two values: t = 12.706, standard error of the mean logarithm = log(4) / √2 / √2
    factor = math.exp(12.706 * math.log(4) / 2)
    assert estimate.value == pytest.approx(1.25)
    assert estimate.high / estimate.value == pytest.approx(factor, rel=1e-3)
    assert estimate.value / estimate.low == pytest.approx(factor, rel=1e-3)


def test_values_that_are_not_positive_have_a_difference_around_them():
    estimate = intervals.mean([-1.0, 0.0, 1.0])
    assert estimate.value == 0
    assert estimate.high == pytest.approx(4.303 / math.sqrt(3), rel=1e-3)
    assert estimate.low == -estimate.high


def test_equal_values_have_no_spread():
    assert intervals.mean([3.0, 3.0]) == Estimate(3.0, 3.0, 3.0)
    assert intervals.mean([0.0, 0.0]) == Estimate(0.0, 0.0, 0.0)


def test_one_value_has_no_interval_and_an_empty_list_has_no_estimate():
    assert intervals.mean([2.0]) == Estimate(2.0)
    assert intervals.mean([]) is None
    assert intervals.mean([1.0, math.nan]) is None


def test_median_is_not_moved_by_one_slow_run():
    assert intervals.median([1.0, 1.1, 9.0]).value == 1.1


def test_noise_that_paired_runs_share_cancels_in_their_ratio():
    mood = [1.0, 2.0, 5.0]
    a, b = [2 * m for m in mood], mood
    ratio = intervals.ratio(intervals.mean(a), intervals.mean(b), zip(a, b))
    assert ratio.value == pytest.approx(2)
    assert (ratio.low, ratio.high) == (pytest.approx(2), pytest.approx(2))
    assert intervals.ratio(Estimate(1.0), Estimate(0.0), []) is None
    assert intervals.ratio(None, Estimate(1.0), []) is None


def test_slope_and_cost_of_an_exact_law():
    spp = [4, 16, 64, 256]
    error = [8 / n for n in spp]
    slope = intervals.slope(spp, error)
    assert slope == pytest.approx((-1, -1, -1))
    assert intervals.cost_of(0.25, spp, error) == pytest.approx((32, 32, 32))
    assert intervals.cost_of(0.25, spp, spp) is None  # the error grows
    assert intervals.cost_of(0.25, [4, 8, 16], [1, 3, 0.9]).low is None  # it may not fall
    assert intervals.slope([4, 4], [1, 2]) is None
    assert intervals.slope([4, 8], [1, 0.5]) == Estimate(pytest.approx(-1))


@pytest.mark.parametrize("count", [2, 3, 8])
def test_intervals_hold_the_truth_in_95_percent_of_cases(count):
    """Errors that vary by 10 %: the interval of their mean."""
    rng = np.random.default_rng(count)
    trials = 4000
    hits = 0
    for values in np.exp(0.1 * rng.standard_normal((trials, count))):
        estimate = intervals.mean(values.tolist())
        hits += estimate.low <= math.exp(0.1**2 / 2) <= estimate.high
    # Four standard errors of the share: 4 · √(0.95 · 0.05 / 4000) = 0.014; and the mean of few
    # logarithms lies slightly below the logarithm of the mean
    assert hits / trials == pytest.approx(0.95, abs=0.025)


def test_intervals_of_slope_and_cost_hold_the_truth_in_95_percent_of_cases():
    rng = np.random.default_rng(7)
    trials = 2000
    spp = np.repeat([4.0, 16.0, 64.0], 2)
    slope_hits = cost_hits = 0
    for noise in 0.2 * rng.standard_normal((trials, spp.size)):
        error = (1 / spp * np.exp(noise)).tolist()
        slope = intervals.slope(spp.tolist(), error)
        cost = intervals.cost_of(1 / 50, spp.tolist(), error)
        slope_hits += slope.low <= -1 <= slope.high
        cost_hits += cost.low <= 50 <= cost.high
    assert slope_hits / trials == pytest.approx(0.95, abs=0.02)
    assert cost_hits / trials == pytest.approx(0.95, abs=0.025)
