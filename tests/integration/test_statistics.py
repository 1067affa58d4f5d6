"""Intervals, tests, corrections and power, against plain loops and simulations."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
import pytest
from scipy import stats

from training.statistics import (
    detectable,
    difference_interval,
    holm,
    mean_interval,
    permutation_p,
    permuted_difference,
    sign_p,
)


def test_the_least_p_is_that_of_runs_that_differ_as_much_as_they_can() -> None:
    for ours, theirs in ((2, 2), (2, 3), (1, 4), (6, 6)):
        a = {str(n): float(n) for n in range(ours)}
        b = {str(n): 100.0 + n for n in range(theirs)}
        found = permuted_difference(a, b)
        assert found.p == pytest.approx(found.least)


def test_permutation_p_of_many_runs_is_that_of_scipy_to_the_last_bit() -> None:
    rng = np.random.default_rng(0)
    ours, theirs = rng.normal(0.5, 1.0, 12), rng.normal(0.0, 1.0, 20)

    def gap(x: np.ndarray, y: np.ndarray, axis: int) -> np.ndarray:
        return abs(x.mean(axis=axis) - y.mean(axis=axis)).round(12)

    expected = stats.permutation_test(
        (ours, theirs), gap, n_resamples=50_000, alternative="greater", vectorized=True, rng=0
    )
    assert permutation_p(ours, theirs) == expected.pvalue


def test_difference_interval_is_that_of_scipy() -> None:
    rng = np.random.default_rng(0)
    ours, theirs = rng.normal(1.0, 3.0, 5), rng.normal(0.0, 1.0, 20)
    found = difference_interval(ours, theirs)
    expected = stats.ttest_ind(ours, theirs, equal_var=False).confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx(tuple(expected))


def test_intervals_of_one_run_have_no_ends() -> None:
    one, two = np.array([1.0]), np.array([1.0, 2.0])
    for found in (mean_interval(one), difference_interval(one, two), difference_interval(two, one)):
        assert np.isnan([found.low, found.high]).all()


@pytest.mark.parametrize("seeds", [1, 4, 9, 16])
def test_sign_p_is_the_share_of_all_signs_with_as_large_a_mean(seeds: int) -> None:
    gaps = np.random.default_rng(seeds).normal(0.5, 1.0, seeds)
    means = [abs(np.mean(signs * gaps)) for signs in product([-1, 1], repeat=seeds)]
    assert sign_p(gaps) == np.mean(np.array(means) >= abs(gaps.mean()) - 1e-12)


def test_equal_gaps_count_as_equal_despite_rounding() -> None:
    assert sign_p(np.full(10, 0.1)) == 2 / 2**10
    assert permutation_p(np.full(3, 0.3), np.full(3, 0.1)) == 0.1


@pytest.mark.parametrize(("ours", "theirs"), [(1, 1), (1, 4), (3, 1), (4, 5)])
def test_permutation_p_is_the_share_of_all_deals_that_differ_as_much(
    ours: int, theirs: int
) -> None:
    runs = np.random.default_rng(ours).normal(size=ours + theirs)
    gaps = [
        abs(runs[list(deal)].mean() - np.delete(runs, list(deal)).mean())
        for deal in combinations(range(len(runs)), ours)
    ]
    expected = np.mean(np.array(gaps) >= gaps[0] - 1e-12)
    assert permutation_p(runs[:ours], runs[ours:]) == pytest.approx(expected)


def test_holm_multiplies_by_the_comparisons_that_are_left() -> None:
    assert holm(np.array([0.01, 0.02, 0.5])).tolist() == [0.03, 0.04, 0.5]
    assert holm(np.array([0.3, 0.04, 0.035])) == pytest.approx(
        [0.3, 0.105, 0.105][0:1] + [0.105] * 2
    )
    assert holm(np.array([0.6, 0.9])).tolist() == [1.0, 1.0]


@pytest.mark.parametrize(("seeds", "level"), [(5, 0.05), (10, 0.05), (10, 0.05 / 11)])
def test_detectable_difference_is_found_as_often_as_said(seeds: int, level: float) -> None:
    rng = np.random.default_rng(0)
    shift = detectable(2.0, seeds, level=level)
    runs = rng.normal(shift, 2.0, (20_000, seeds))
    assert np.mean(stats.ttest_1samp(runs, 0.0, axis=1).pvalue <= level) == pytest.approx(
        0.8, abs=0.02
    )
