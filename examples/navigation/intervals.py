"""Estimates over few runs, with intervals of which the unit is the run.

The episodes of one policy are not independent: whether it found the way around a bar decides many
of them. So whole runs are resampled, or runs and pairs of start and goal at once; and methods are
compared by the means of their runs. Interquartile mean and probability of improvement are those of
Agarwal et al. (2021), https://arxiv.org/abs/2108.13264; their library, rliable, does not import
beside current versions of what it depends on. Scores are arrays of shape ``[runs, pairs]``.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from mpfa_envs import Interval

Array = NDArray[np.float64]
Statistic = Callable[..., Array]
_LEVEL = 0.95
_RESAMPLES = 2000
_BATCH = 100
_ALL = 2**62
"""More than there are permutations, so that all of them are counted."""


def mean(scores: Array) -> Array:
    """Mean of all scores.

    Args:
        scores: Shape ``[..., runs, pairs]``.

    Returns:
        The mean, shape ``[...]``; it is that of the runs' means.
    """
    found: Array = scores.mean(axis=(-2, -1))
    return found


def interquartile_mean(scores: Array) -> Array:
    """Mean of the middle half of all scores, of all runs and pairs together.

    Args:
        scores: Shape ``[..., runs, pairs]``.

    Returns:
        The mean, shape ``[...]``; a quarter of the scores, rounded down, is cut at each end.
    """
    every = scores.reshape(*scores.shape[:-2], -1)
    return np.asarray(stats.trim_mean(every, 0.25, axis=-1))


def probability_of_improvement(ours: Array, theirs: Array) -> Array:
    """Probability that a run of ours beats one of theirs on a pair sampled at random.

    Args:
        ours: Shape ``[..., runs, pairs]``.
        theirs: Shape ``[..., other runs, pairs]``.

    Returns:
        The probability, shape ``[...]``; ties count half.
    """
    gaps = ours[..., :, None, :] - theirs[..., None, :, :]
    found: Array = (0.5 + 0.5 * np.sign(gaps)).mean(axis=(-3, -2, -1))
    return found


def t_interval(scores: Array) -> Interval:
    """Mean with the 95 % interval of Student's t over the means of the runs.

    Args:
        scores: Shape ``[runs, pairs]``.

    Returns:
        The mean and its interval, which is NaN for one run.
    """
    means = scores.mean(axis=1)
    middle = float(means.mean())
    if len(means) < 2:
        return Interval(middle, math.nan, math.nan)
    half = float(stats.t.ppf(0.5 + _LEVEL / 2, len(means) - 1) * stats.sem(means))
    return Interval(middle, middle - half, middle + half)


def bootstrap_runs(statistic: Statistic, *scores: Array, rng: np.random.Generator) -> Interval:
    """A statistic with its 95 % percentile interval, whole runs being resampled.

    Args:
        statistic: Function of as many arrays as are given.
        *scores: Each of shape ``[runs, pairs]``; the runs of each are resampled by themselves.
        rng: Source of the resamples.

    Returns:
        The estimate and its interval, which is NaN if an array has one run.
    """
    return _bootstrap(
        lambda *runs: statistic(*(each[i] for each, i in zip(scores, runs, strict=True))),
        *(len(each) for each in scores),
        rng=rng,
    )


def bootstrap_runs_and_pairs(
    statistic: Statistic, scores: Array, *, rng: np.random.Generator
) -> Interval:
    """As :func:`bootstrap_runs`, the pairs being resampled as well: for other runs *and* pairs.

    Args:
        statistic: Function of an array.
        scores: Shape ``[runs, pairs]``.
        rng: Source of the resamples.

    Returns:
        The estimate and its interval, which is NaN for one run or one pair.
    """
    return _bootstrap(
        lambda runs, pairs: statistic(scores[runs[..., :, None], pairs[..., None, :]]),
        *scores.shape,
        rng=rng,
    )


def _bootstrap(statistic: Statistic, *counts: int, rng: np.random.Generator) -> Interval:
    """Percentile interval of a function of resampled indices, of each count by themselves."""
    everything = [np.arange(count) for count in counts]
    value = float(statistic(*everything))
    if min(counts) < 2:
        return Interval(value, math.nan, math.nan)
    found = stats.bootstrap(
        everything,
        lambda *indices, axis: statistic(*indices),
        vectorized=True,
        n_resamples=_RESAMPLES,
        batch=_BATCH,
        confidence_level=_LEVEL,
        method="percentile",
        rng=rng,
    ).confidence_interval
    return Interval(value, float(found.low), float(found.high))


def permutation_p(ours: Array, theirs: Array) -> float:
    """Exact two-sided permutation test of the difference between the means of runs.

    Args:
        ours: Shape ``[runs, pairs]``.
        theirs: Shape ``[other runs, pairs]``.

    Returns:
        Share of all ways to deal the runs to the two sides that differ at least as much.
    """

    def distance(a: Array, b: Array, axis: int) -> Array:
        return np.abs(a.mean(axis=axis) - b.mean(axis=axis))

    found = stats.permutation_test(
        (ours.mean(axis=1), theirs.mean(axis=1)),
        distance,
        vectorized=True,
        n_resamples=_ALL,
        alternative="greater",
    )
    return float(found.pvalue)


def least_p(ours: int, theirs: int) -> float:
    """Least value that :func:`permutation_p` can have for these numbers of runs."""
    sides = 2 if ours == theirs else 1
    return min(1.0, sides / math.comb(ours + theirs, ours))


def runs_needed(deviation: float, difference: float, *, power: float = 0.8) -> int:
    """Runs of each of two methods until a t-test finds a difference between their means.

    Args:
        deviation: Standard deviation from run to run.
        difference: True difference of the means.
        power: Chance to find it at the level of 5 %.

    Returns:
        The number of runs of each.

    Examples:
        >>> runs_needed(1.95, 2.0), runs_needed(1.95, 5.0)
        (16, 4)
    """
    for runs in range(2, 10_000):
        freedom, shift = 2 * runs - 2, difference / deviation * math.sqrt(runs / 2)
        bound = stats.t.ppf(0.975, freedom)
        found = stats.nct.sf(bound, freedom, shift) + stats.nct.cdf(-bound, freedom, shift)
        if found >= power:
            return runs
    raise ValueError(f"difference must not vanish beside deviation, got {difference}, {deviation}")
