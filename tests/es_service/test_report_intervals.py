"""Intervals of medians over seeds: equal to a count of all resamples, and honest about few seeds."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.special import erfinv

from es_service.report.statistics import WHOLE_RANGE, _medians, coverage, median_interval


def counted(values):
    """The interval by drawing in all n^n ways."""
    medians = np.sort([np.median(drawn) for drawn in itertools.product(values, repeat=len(values))])
    outside = int(0.025 * len(medians) - 1e-9)  # so many on each side are outside
    return medians[outside], medians[-1 - outside]


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 3, 4, 5, 6])
def test_an_interval_is_that_of_all_resamples(n):
    rng = np.random.default_rng(n)
    y_R_K = np.stack([rng.normal(size=n), rng.exponential(size=n) * 1e6, np.round(rng.normal(size=n))], axis=1)
    found = median_interval(y_R_K)
    for k, values in enumerate(y_R_K.T):
        assert found[:, k] == pytest.approx(counted(values), rel=1e-12)
    if n <= WHOLE_RANGE:
        np.testing.assert_array_equal(found, [y_R_K.min(axis=0), y_R_K.max(axis=0)])
    else:
        assert (found[0] > y_R_K.min(axis=0))[:2].all()


@pytest.mark.parametrize("n", [2, 3, 7, 10, 31, 64])
def test_all_ways_to_draw_are_counted(n):
    lower_M, upper_M, share_M = _medians(n)
    assert share_M.sum() == pytest.approx(1, abs=1e-12)
    assert (share_M > 0).all()
    assert ((lower_M == upper_M).all()) == bool(n % 2)
    mirrored = {(n - 1 - high, n - 1 - low): share for low, high, share in zip(lower_M, upper_M, share_M, strict=True)}
    for low, high, share in zip(lower_M, upper_M, share_M, strict=True):
        assert share == pytest.approx(mirrored[low, high], rel=1e-9)


def test_an_interval_holds_the_median_and_shrinks_with_seeds():
    """To that of a normal distribution: 1.96 standard errors of its median, 1.2533 / sqrt(n)."""
    quantiles = (np.arange(200) + 0.5) / 200
    y_R = np.sqrt(2) * erfinv(2 * quantiles - 1)
    low, high = median_interval(y_R[:, None])[:, 0]
    assert (-low, high) == pytest.approx((1.96 * 1.2533 / np.sqrt(200),) * 2, rel=0.08)
    assert median_interval(y_R[::10, None])[1, 0] > 2 * high


def test_a_point_without_a_value_of_each_run_has_no_interval():
    y_R_K = np.array([[1.0, np.nan], [2.0, 2.0]])
    np.testing.assert_array_equal(median_interval(y_R_K), [[1.0, np.nan], [2.0, np.nan]])


def test_the_coverage_of_the_whole_range_is_that_of_fresh_seeds():
    rng = np.random.default_rng(0)
    for seeds in range(2, WHOLE_RANGE + 1):
        y_N_R = rng.exponential(size=(20_000, seeds))
        low_N, high_N = y_N_R.min(axis=1), y_N_R.max(axis=1)
        median = np.log(2)
        assert np.mean((low_N < median) & (median < high_N)) == pytest.approx(coverage(seeds), abs=0.015)
