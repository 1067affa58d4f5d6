"""Estimates over few runs, with intervals of which the unit is the run.

The episodes of one policy are not independent: whether it found the way around a bar decides many
of them. So whole runs are resampled, or runs and pairs of start and goal at once; and methods are
compared by the means of their runs. Interquartile mean and probability of improvement are those of
Agarwal et al. (2021), https://arxiv.org/abs/2108.13264; their library, rliable, does not import
beside current versions of what it depends on. Scores are arrays of shape ``[runs, pairs]``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from mpfa_envs.evaluation.results import Interval, wilson

Array = NDArray[np.float64]
Statistic = Callable[..., Array]
_LEVEL = 0.95
_ENDS = (0.5 - _LEVEL / 2, 0.5 + _LEVEL / 2)
_RESAMPLES = 2000
_BATCH = 100
_OF_RUNS = 10_000
"""Resamples where each run is one number, which costs little."""


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


def mean_interval(scores: Array, *, rng: np.random.Generator) -> Interval:
    """Mean over runs with a bootstrap interval that holds for few runs.

    Args:
        scores: A number for each run, shape ``[runs]``.
        rng: Source of the resamples.

    Returns:
        The mean and its interval, which is NaN for one run.
    """
    low, high = widened_ends(resampled_means(scores, rng), len(scores))
    return Interval(float(scores.mean()), float(low), float(high))


def difference_interval(ours: Array, theirs: Array, *, rng: np.random.Generator) -> Interval:
    """Difference of the means of runs with a bootstrap interval that holds for few runs.

    Args:
        ours: A number for each run, shape ``[runs]``.
        theirs: Shape ``[other runs]``.
        rng: Source of the resamples.

    Returns:
        The difference and its interval, which is NaN if a side has one run.
    """
    found = resampled_means(ours, rng) - resampled_means(theirs, rng)
    low, high = widened_ends(found, len(ours), len(theirs))
    return Interval(float(ours.mean() - theirs.mean()), float(low), float(high))


def interquartile_interval(scores: Array, *, rng: np.random.Generator) -> Interval:
    """Mean of the middle half of runs, with a bootstrap interval that is widened for few of them.

    Args:
        scores: A number for each run, shape ``[runs]``; a quarter of the runs, rounded down, is cut
            at each end.
        rng: Source of the resamples.

    Returns:
        The mean and its interval, which is NaN for one run.
    """
    chosen = rng.integers(len(scores), size=(_OF_RUNS, len(scores)))
    found = np.asarray(stats.trim_mean(scores[chosen], 0.25, axis=-1))
    low, high = widened_ends(found, len(scores))
    return Interval(float(stats.trim_mean(scores, 0.25)), float(low), float(high))


def resampled_means(scores: Array, rng: np.random.Generator) -> Array:
    """Means of runs that are sampled with replacement.

    Args:
        scores: A number for each run, shape ``[..., runs]``.
        rng: Source of the resamples, which all sets of data have in common.

    Returns:
        The means, shape ``[..., resamples]``.
    """
    return scores @ _resampled(scores.shape[-1], rng).T


def widened_ends(resamples: Array, *runs: int) -> Array:
    """Ends of the 95 % interval of a difference of means, or of one mean.

    The percentiles of resamples of few runs are too near: their spread divides by n, not by n - 1,
    and is that of the normal distribution where Student's t is due. They are moved away from the
    middle by what both make (Hesterberg, 2015, https://doi.org/10.1080/00031305.2015.1089789).

    Args:
        resamples: Resampled differences or means, shape ``[..., resamples]``.
        *runs: Number of runs of each side, or of the only one.

    Returns:
        Both ends, shape ``[2, ...]``; NaN for one run.
    """
    if min(runs) < 2:
        return np.full((2, *resamples.shape[:-1]), math.nan)
    freedom = sum(each - 1 for each in runs)
    above = 0.5 + _LEVEL / 2
    factor = math.sqrt(min(runs) / (min(runs) - 1)) * stats.t.ppf(above, freedom)
    middle = resamples.mean(axis=-1)
    ends = np.quantile(resamples, _ENDS, axis=-1)
    return np.asarray(middle + (ends - middle) * factor / stats.norm.ppf(above))


def improvement_interval(
    ours: Array, theirs: Array, *, paired: bool, rng: np.random.Generator
) -> Interval:
    """Probability that a run of ours is better than one of theirs, with its interval.

    Args:
        ours: A number for each run, the higher the better; shape ``[runs]``.
        theirs: Shape ``[other runs]``.
        paired: Whether the runs are of the same seeds in the same order, resampled together. Runs
            of the same seed have much in common, and are not set against each other.
        rng: Source of the resamples.

    Returns:
        The probability and its 95 % interval, widened for few runs; ties count half. NaN if
        there is nothing to compare.
    """
    # What is equal but for rounding is equal.
    ours, theirs = ours.round(9), theirs.round(9)
    wins = (ours[:, None] > theirs) + 0.5 * (ours[:, None] == theirs)
    counted = 1.0 - np.eye(len(ours)) if paired else np.ones(wins.shape)
    if not counted.any():
        return Interval(math.nan, math.nan, math.nan)
    value = float((wins * counted).sum() / counted.sum())
    if min(wins.shape) < 2:
        return Interval(value, math.nan, math.nan)
    mine = _resampled(len(ours), rng)
    others = mine if paired else _resampled(len(theirs), rng)
    shares = ((mine @ counted) * others).sum(axis=1)
    found = ((mine @ (wins * counted)) * others).sum(axis=1)
    # A resample of one seed alone has no pairs.
    sides = (len(ours),) if paired else (len(ours), len(theirs))
    low, high = widened_ends(found[shares > 0.0] / shares[shares > 0.0], *sides)
    return Interval(value, max(0.0, float(low)), min(1.0, float(high)))


def mean_over_worlds(scores: Array, kinds: Sequence[str], *, rng: np.random.Generator) -> Interval:
    """Mean with an interval for other runs *and* worlds.

    Runs are resampled, and worlds in their kind (Owen, 2007, https://doi.org/10.1214/07-AOAS122);
    the interval is widened for few runs.

    Args:
        scores: Of two methods their difference, as both were tested in the same worlds; shape
            ``[runs, worlds]``.
        kinds: What each world is one of; kinds count the same, however many worlds they have.
        rng: Source of the resamples.

    Returns:
        The mean and its interval, which is NaN for one run or a kind with one world.
    """
    names = np.asarray(kinds)
    each = [names == name for name in np.unique(names)]
    value = float(np.mean([scores[:, kind].mean() for kind in each]))
    if min(len(scores), *(kind.sum() for kind in each)) < 2:
        return Interval(value, math.nan, math.nan)
    runs = _resampled(len(scores), rng)
    found = sum(
        ((runs @ scores[:, kind]) * _resampled(int(kind.sum()), rng)).sum(axis=1) for kind in each
    )
    low, high = widened_ends(np.asarray(found / len(each)), len(scores))
    return Interval(value, float(low), float(high))


def performance_profile(scores: Array, levels: Array) -> tuple[Array, Array, Array]:
    """Share of runs with a score above each of some levels, with Wilson's 95 % intervals.

    Args:
        scores: A number for each run, shape ``[runs]``.
        levels: Shape ``[levels]``.

    Returns:
        Share, lower and upper end, each of shape ``[levels]``.
    """
    above = (scores[:, None] > levels).sum(axis=0)
    runs = len(scores)
    of_counts = [wilson([True] * n + [False] * (runs - n)) for n in range(runs + 1)]
    share, low, high = (
        np.array([getattr(each, name) for each in of_counts]) for name in ("value", "low", "high")
    )
    return share[above], low[above], high[above]


def _resampled(runs: int, rng: np.random.Generator) -> Array:
    """Weights of runs that are sampled with replacement, shape ``[resamples, runs]``."""
    return rng.multinomial(runs, np.full(runs, 1.0 / runs), size=_OF_RUNS) / runs
