"""Statistics of which each run is one number: against plain loops, known values, and chance."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats

from benchmarks.study.intervals import (
    Array,
    bootstrap_runs,
    bootstrap_runs_and_pairs,
    difference_interval,
    improvement_interval,
    interquartile_interval,
    interquartile_mean,
    mean,
    mean_interval,
    mean_over_worlds,
    performance_profile,
    probability_of_improvement,
    resampled_means,
    t_interval,
    widened_ends,
)
from benchmarks.study.permutation import (
    deal_p,
    flip_p,
    flips,
    holm,
    least_flip_p,
    least_p,
    rank_flip_p,
    rank_p,
)
from benchmarks.study.power import (
    MOST,
    difference_found,
    paired_difference_found,
    runs_needed,
)


def plain_p(ours: Array, theirs: Array) -> float:
    """All ways to deal the runs, one after the other."""
    values = np.concatenate((ours, theirs))
    gap = abs(ours.mean() - theirs.mean())
    everyone = range(len(values))
    as_far = []
    for chosen in itertools.combinations(everyone, len(ours)):
        others = [i for i in everyone if i not in chosen]
        far = abs(values[list(chosen)].mean() - values[others].mean())
        as_far.append(far >= gap - 1e-9)
    return float(np.mean(as_far))


@pytest.mark.parametrize(("ours", "theirs"), [(3, 3), (4, 2), (5, 5), (1, 6)])
def test_the_permutation_test_counts_every_way_to_deal_the_runs(ours: int, theirs: int) -> None:
    rng = np.random.default_rng(ours)
    for _ in range(5):
        # Whole numbers have ties.
        a, b = rng.integers(0, 6, ours) / 10, rng.integers(0, 6, theirs) / 10
        assert deal_p(a, b) == pytest.approx(plain_p(a, b))


def test_many_sets_of_data_at_once_have_the_values_of_each() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 3, 5)), rng.normal(size=(2, 3, 4))
    found = deal_p(a, b)
    assert found.shape == (2, 3)
    assert found[1, 2] == deal_p(a[1, 2], b[1, 2])


def test_a_sample_of_the_deals_comes_near_to_all_of_them() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(20, 8)), rng.normal(0.7, size=(20, 8))
    exact, sampled = deal_p(a, b), deal_p(a, b, most=10_000)
    assert not np.array_equal(exact, sampled)
    # Four standard errors of the sample.
    assert (abs(exact - sampled) < 4 * np.sqrt(exact * (1 - exact) / 10_000) + 1e-4).all()


def test_twenty_runs_against_twenty_are_told_apart_and_never_with_p_zero() -> None:
    apart = deal_p(np.arange(20.0), np.arange(100.0, 120.0))
    assert apart == pytest.approx(1 / 200_000)


@pytest.mark.parametrize("runs", [6, 20])
def test_of_methods_that_are_alike_five_in_a_hundred_are_called_different(runs: int) -> None:
    rng = np.random.default_rng(2)
    # Success is skewed: most runs are near the top, some fail.
    a, b = (rng.beta(5, 1, size=(1000, runs)) for _ in range(2))
    for test in (deal_p, rank_p):
        rate = (test(a, b, most=4000) < 0.05).mean()
        assert 0.03 <= rate <= 0.07, test


def test_the_test_of_ranks_is_that_of_mann_and_whitney() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=6), rng.normal(0.8, size=7)
    known = stats.mannwhitneyu(a, b, method="exact").pvalue
    assert rank_p(a, b) == pytest.approx(known)
    # Whatever never came so far is last, and all of it alike.
    never = np.array([1.0, 2.0, np.inf, np.inf])
    assert rank_p(never, np.array([1.5, 3.0, np.inf, 4.0])) == rank_p(
        np.array([1.0, 2.0, 9.0, 9.0]), np.array([1.5, 3.0, 9.0, 4.0])
    )
    with pytest.raises(ValueError, match="use rank_p"):
        deal_p(never, never)


def test_corrected_values_are_those_of_holm() -> None:
    assert holm(np.array([0.01, 0.02, 0.03, 0.04, 0.05])) == pytest.approx(
        [0.05, 0.08, 0.09, 0.09, 0.09]
    )
    rng = np.random.default_rng(4)
    for _ in range(10):
        p = rng.uniform(0, 0.4, 6)
        by_hand = []
        for mine in p:
            # No smaller value may be corrected to a larger one.
            before = [min(1.0, (p >= other).sum() * other) for other in p if other <= mine]
            by_hand.append(max(before))
        assert holm(p) == pytest.approx(by_hand)


def test_the_chance_of_any_false_difference_of_six_is_five_in_a_hundred() -> None:
    rng = np.random.default_rng(5)
    p = rng.uniform(size=(2000, 6))
    wrong = np.mean([(holm(row) < 0.05).any() for row in p])
    assert 0.035 <= wrong <= 0.065
    assert (p < 0.05).any(axis=1).mean() > 0.2


@pytest.mark.parametrize(("runs", "others"), [(5, 5), (10, 5), (20, 20)])
def test_the_intervals_cover_the_truth_as_often_as_they_say(runs: int, others: int) -> None:
    rng = np.random.default_rng(6)
    a, b = rng.normal(0.7, 0.1, (400, runs)), rng.normal(0.6, 0.1, (400, others))
    means, of_b = (resampled_means(each, rng) for each in (a, b))
    for truth, ends in (
        (0.7, widened_ends(means, runs)),
        (0.1, widened_ends(means - of_b, runs, others)),
    ):
        covered = ((ends[0] <= truth) & (truth <= ends[1])).mean()
        assert 0.925 <= covered <= 0.98
    # One set of data alone has the same interval, but for other resamples.
    one = difference_interval(a[0], b[0], rng=rng)
    assert (one.low, one.high) == pytest.approx(ends[:, 0], abs=0.02)
    assert one.value == pytest.approx(a[0].mean() - b[0].mean())
    assert mean_interval(a[0], rng=rng).value == pytest.approx(a[0].mean())


@pytest.mark.parametrize(
    ("runs", "least", "most"), [(5, 0.6, 0.8), (10, 0.84, 0.93), (20, 0.9, 0.97)]
)
def test_where_one_run_in_five_fails_the_intervals_of_few_runs_miss_it(
    runs: int, least: float, most: float
) -> None:
    # As docs/study.md says: no interval can know of a bad run that it has not seen.
    rng = np.random.default_rng(14)
    scores = np.where(rng.random((2000, runs)) < 0.2, 0.1, 0.9) + rng.normal(0, 0.02, (2000, runs))
    low, high = widened_ends(resampled_means(scores, rng), runs)
    assert least <= ((low <= 0.74) & (high >= 0.74)).mean() <= most


def test_an_interval_of_one_run_is_none() -> None:
    rng = np.random.default_rng(0)
    one = np.array([0.5])
    assert np.isnan(mean_interval(one, rng=rng).low)
    assert np.isnan(difference_interval(one, np.array([0.2, 0.4]), rng=rng).high)
    for scores in (np.full((1, 3), 0.5), np.full((3, 1), 0.5)):
        found = mean_over_worlds(scores, ["a"] * scores.shape[1], rng=rng)
        assert found.value == 0.5
        assert np.isnan(found.low)


def test_the_interval_for_other_runs_and_worlds_covers_the_truth() -> None:
    rng = np.random.default_rng(7)
    kinds = ["a"] * 20 + ["b"] * 10
    covered, widths = 0, []
    for _ in range(100):
        worlds, runs = rng.normal(0.05, 0.2, 30), rng.normal(0, 0.1, (8, 1))
        scores = runs + worlds + rng.normal(0, 0.3, (8, 30))
        found = mean_over_worlds(scores, kinds, rng=rng)
        covered += found.low <= 0.05 <= found.high
        widths.append(found.high - found.low)
        assert found.value == pytest.approx((scores[:, :20].mean() + scores[:, 20:].mean()) / 2)
    assert covered / 100 >= 0.92
    # Of each kind half: 40 worlds alike in the one, 20 in the other.
    spread = np.sqrt(0.1**2 / 8 + (0.2**2 + 0.3**2 / 8) * (1 / 80 + 1 / 40))
    assert 0.8 < np.mean(widths) / (2 * 1.96 * spread) < 1.6


def test_a_profile_is_the_share_of_runs_above_each_level() -> None:
    scores = np.array([0.2, 0.5, 0.5, 0.9])
    share, low, high = performance_profile(scores, np.array([0.0, 0.2, 0.5, 0.95]))
    assert share.tolist() == [1.0, 0.75, 0.25, 0.0]
    # Wilson's: 1 of 4.
    z, p, n = stats.norm.ppf(0.975), 0.25, 4
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    assert (low[2], high[2]) == pytest.approx((middle - half, middle + half))
    assert (low <= share).all() and (share <= high).all()


@pytest.mark.parametrize("paired", [False, True])
def test_improvement_counts_every_pair_of_runs(paired: bool) -> None:
    rng = np.random.default_rng(8)
    a, b = np.array([0.1, 0.5, 0.9, 0.7]), np.array([0.5, 0.2, 0.6, np.inf])
    wins = np.mean(
        [
            0.5 if x == y else float(x > y)
            for i, x in enumerate(a)
            for j, y in enumerate(b)
            # Runs of the same seed are not set against each other.
            if not (paired and i == j)
        ]
    )
    found = improvement_interval(a, b, paired=paired, rng=rng)
    assert found.value == pytest.approx(wins)
    assert 0.0 <= found.low < wins < found.high <= 1.0


def test_rates_that_are_equal_but_for_rounding_are_ties() -> None:
    a, b = np.full(6, 0.9333333333333335), np.full(6, 0.9333333333333332)
    assert (a > b).all()
    for paired in (True, False):
        assert improvement_interval(a, b, paired=paired, rng=np.random.default_rng(0)).value == 0.5


@pytest.mark.parametrize(
    ("runs", "chance"), [(10, 0.64), pytest.param(20, 0.76, marks=pytest.mark.slow)]
)
def test_the_interval_of_improvement_covers_the_truth(runs: int, chance: float) -> None:
    rng = np.random.default_rng(15)
    # Two normal runs, of which the first is better by a gap with this chance.
    gap = np.sqrt(2.0) * stats.norm.ppf(chance)
    covered = 0
    for _ in range(200):
        seeds = rng.normal(0, 1, runs)
        ours, theirs = (
            np.sqrt(0.5) * (seeds + rng.normal(0, 1, runs)) + shift for shift in (gap, 0.0)
        )
        found = improvement_interval(ours, theirs, paired=True, rng=rng)
        covered += found.low <= chance <= found.high
    assert covered / 200 >= 0.91


@pytest.mark.parametrize("runs", [6, 20])
def test_the_interval_of_the_middle_half_covers_the_truth(runs: int) -> None:
    rng = np.random.default_rng(16)
    sets = rng.normal(0.4, 0.2, (200, runs))
    ends = [interquartile_interval(each, rng=rng) for each in sets]
    assert np.mean([each.low <= 0.4 <= each.high for each in ends]) >= 0.91
    assert ends[0].value == pytest.approx(stats.trim_mean(sets[0], 0.25))
    assert np.isnan(interquartile_interval(sets[0, :1], rng=rng).low)


def test_what_runs_have_in_common_by_their_seed_does_not_widen_the_interval_of_improvement() -> (
    None
):
    rng = np.random.default_rng(8)
    seeds = rng.normal(0, 1, 20)
    a, b = (seeds + shift + rng.normal(0, 0.1, 20) for shift in (0.3, 0.0))
    widths = [
        found.high - found.low
        for found in (improvement_interval(a, b, paired=p, rng=rng) for p in (True, False))
    ]
    assert widths[0] < 0.7 * widths[1]


@pytest.mark.parametrize("seeds", [1, 2, 5, 7])
def test_the_test_of_signs_tries_them_all(seeds: int) -> None:
    rng = np.random.default_rng(seeds)
    gaps = rng.integers(-3, 5, (4, seeds)) / 10
    for row, p in zip(gaps, flip_p(gaps), strict=True):
        as_far = [
            abs(np.dot(signs, row)) >= abs(row.sum()) - 1e-9
            for signs in itertools.product((-1, 1), repeat=seeds)
        ]
        assert p == pytest.approx(np.mean(as_far))


def test_of_seeds_with_no_difference_five_in_a_hundred_are_called_different() -> None:
    rng = np.random.default_rng(11)
    gaps = rng.beta(5, 1, (1000, 12)) - rng.beta(5, 1, (1000, 12))
    assert 0.035 <= (flip_p(gaps) < 0.05).mean() <= 0.065
    # Twenty seeds are counted whole, more are sampled.
    twenty, more = rng.normal(0.5, 1, 20), rng.normal(0.3, 1, 24)
    known = stats.ttest_1samp(twenty, 0.0).pvalue
    assert flip_p(twenty) == pytest.approx(known, rel=0.2)
    assert flip_p(more) == pytest.approx(stats.ttest_1samp(more, 0.0).pvalue, rel=0.3)
    assert flip_p(np.ones(20)) == pytest.approx(2 / 2**20)
    with pytest.raises(ValueError, match="must be finite"):
        flip_p(np.array([np.inf]))


def test_seeds_that_never_came_so_far_are_last_and_alike() -> None:
    ours, theirs = np.array([1.0, 3.0, 4.0, np.inf]), np.array([2.0, np.inf, np.inf, np.inf])
    # Ranks 1, 3, 4, 6.5 and 2, 6.5, 6.5, 6.5: differences of -1, -3.5, -2.5 and 0.
    assert rank_flip_p(ours, theirs) == flip_p(np.array([-1.0, -3.5, -2.5, 0.0])) == 0.25


@pytest.mark.parametrize(("seeds", "level"), [(12, 0.05), (10, 0.05 / 12), (6, 0.05)])
def test_the_difference_that_seeds_can_find_is_found_as_often_as_promised(
    seeds: int, level: float
) -> None:
    rng = np.random.default_rng(10)
    gaps = rng.normal(paired_difference_found(0.3, seeds, level=level), 0.3, (500, seeds))
    assert 0.75 <= (flip_p(gaps) <= level).mean() <= 0.85


@pytest.mark.parametrize(("ours", "theirs", "level"), [(20, 20, 0.05), (10, 5, 0.05), (8, 8, 0.01)])
def test_the_difference_that_runs_can_find_is_found_as_often_as_promised(
    ours: int, theirs: int, level: float
) -> None:
    rng = np.random.default_rng(9)
    gap = difference_found(0.3, ours, theirs, level=level)
    a, b = rng.normal(gap, 0.3, (500, ours)), rng.normal(0.0, 0.3, (500, theirs))
    assert 0.75 <= (deal_p(a, b, most=4000) <= level).mean() <= 0.85


def test_the_runs_that_a_difference_needs_find_it_and_one_less_does_not() -> None:
    runs = runs_needed(1.95, 2.0)
    assert runs == 16
    # By the permutation test, which comes very near to that of Student.
    assert difference_found(1.95, runs, runs) == pytest.approx(2.0, rel=0.05)
    rng = np.random.default_rng(12)
    for count, enough in ((runs, True), (runs - 2, False)):
        a, b = rng.normal(2.0, 1.95, (20_000, count)), rng.normal(0.0, 1.95, (20_000, count))
        power = (stats.ttest_ind(a, b, axis=1).pvalue < 0.05).mean()
        assert (power >= 0.79) == enough


@pytest.mark.parametrize("deviation", [0.4, 0.5, 0.505, 0.51, 0.7, 1e9])
def test_runs_that_vary_much_need_more_than_anyone_makes(deviation: float) -> None:
    # For many runs the statistic is normal: 2.8 = 1.96 + 0.84 of its standard deviations.
    normal = 2 * (2.801585 * deviation / 0.02) ** 2
    runs = runs_needed(deviation, 0.02)
    assert runs == pytest.approx(min(normal, MOST + 1), abs=2)
    assert (runs > MOST) == (normal > MOST)


@pytest.mark.parametrize(("seeds", "comparisons"), [(1, 1), (5, 1), (6, 2), (10, 26), (20, 27_000)])
def test_where_all_signs_alike_are_not_rare_enough_nothing_is_found(
    seeds: int, comparisons: int
) -> None:
    assert np.isinf(paired_difference_found(1.0, seeds, level=0.05 / comparisons))
    assert least_flip_p(seeds) == flip_p(np.ones(seeds)) > 0.05 / comparisons


def test_a_level_below_what_the_samples_resolve_raises() -> None:
    for find in (
        lambda level: paired_difference_found(1.0, 20, level=level),
        lambda level: difference_found(1.0, 20, 20, level=level),
    ):
        assert np.isfinite(find(0.05 / 200))
        with pytest.raises(ValueError, match="level must be at least 1 / 4096, got"):
            find(0.05 / 300)


def test_one_run_against_eighteen_finds_nothing_and_against_twenty_at_most_alone() -> None:
    assert np.isinf(difference_found(1.0, 1, 1))
    assert np.isinf(difference_found(1.0, 1, 18))
    assert np.isinf(difference_found(1.0, 1, 20, level=0.05 / 2))
    assert np.isfinite(difference_found(1.0, 1, 20))


def test_the_signs_are_all_that_there_are_or_a_sample_that_begins_with_the_data() -> None:
    every = flips(5, 100)
    assert sorted(map(tuple, np.concatenate((every, -every)))) == sorted(
        itertools.product((-1.0, 1.0), repeat=5)
    )
    sample = flips(20, 1000)
    assert sample.shape == (1000, 20)
    for signs in (every, sample):
        assert (signs[0] == 1.0).all()
        assert set(np.unique(signs)) == {-1.0, 1.0}


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end() -> None:
    scores = np.array([[100.0, 1.0, 2.0, 3.0], [4.0, 5.0, 6.0, -100.0]])
    assert interquartile_mean(scores) == pytest.approx((2 + 3 + 4 + 5) / 4)


def test_ties_count_half_in_the_probability_of_improvement() -> None:
    ours, theirs = np.array([[1.0, 5.0]]), np.array([[1.0, 4.0], [2.0, 4.0]])
    # First task: a tie and a loss; second task: two wins.
    assert probability_of_improvement(ours, theirs) == pytest.approx((0.25 + 1.0) / 2)


def test_many_episodes_of_one_policy_do_not_narrow_the_interval_over_runs() -> None:
    # Each run has a level of its own, and all of its pairs have that.
    few = np.random.default_rng(0).normal(0.5, 0.1, (6, 1)) * np.ones((6, 4))
    many = np.repeat(few, 100, axis=1)
    for interval in (t_interval, lambda x: bootstrap_runs(mean, x, rng=np.random.default_rng(1))):
        a, b = interval(few), interval(many)
        assert (b.low, b.high) == pytest.approx((a.low, a.high))
        assert b.high - b.low > 0.05


@pytest.mark.parametrize("runs", [4, 12])
def test_the_t_interval_covers_the_mean_as_often_as_it_says(runs: int) -> None:
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(400):
        scores = rng.normal(0.3, 1.0, (runs, 1)) + rng.normal(0.0, 1.0, (runs, 5))
        interval = t_interval(scores)
        covered += interval.low <= 0.3 <= interval.high
    assert 0.92 <= covered / 400 <= 0.98


def test_resampling_pairs_as_well_widens_the_interval_where_pairs_differ() -> None:
    # All runs agree: other runs would say the same, other pairs would not.
    scores = np.tile(np.arange(10.0), (5, 1))
    rng = np.random.default_rng(0)
    runs = bootstrap_runs(mean, scores, rng=rng)
    both = bootstrap_runs_and_pairs(mean, scores, rng=rng)
    assert (runs.low, runs.high) == (4.5, 4.5)
    assert both.high - both.low > 2.0


def test_the_least_p_is_that_of_the_most_extreme_deal() -> None:
    assert least_p(3, 3) == pytest.approx(0.1)
    assert least_p(9, 3) == pytest.approx(1 / 220)
