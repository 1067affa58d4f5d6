"""Tests of the difference between two methods, of which each run is one number.

Under the null hypothesis it does not matter which runs are called ours: a difference of means is as
rare as the share of all ways to deal the runs to the two sides that differ at least as much.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import combinations

import numpy as np
from scipy import stats

from benchmarks.study.intervals import Array

MOST_DEALS = 200_000
"""Deals that are tried: all of them up to ten runs against ten, a sample of more."""
MOST_FLIPS = 100_000
"""Choices of signs that are tried where there are more than twenty seeds."""
_ALL_FLIPS = 20
_AT_ONCE = 4_000_000
"""Differences that are in memory at once."""


def deal_p(ours: Array, theirs: Array, *, most: int = MOST_DEALS) -> Array:
    """Two-sided permutation test of the difference between means, of many sets of data at once.

    Args:
        ours: A number for each run, shape ``[..., runs]``.
        theirs: Shape ``[..., other runs]``.
        most: Deals at most. Where there are more, these are a sample that holds the one that there
            is, by which the test keeps its level (Phipson and Smyth, 2010,
            https://doi.org/10.2202/1544-6115.1585).

    Returns:
        The p-values, shape ``[...]``.

    Raises:
        ValueError: If a number is not finite.

    Examples:
        >>> float(deal_p(np.array([3.0, 4.0, 5.0]), np.array([0.0, 1.0, 2.0])))
        0.1
    """
    together = np.concatenate((ours, theirs), axis=-1)
    if not np.isfinite(together).all():
        raise ValueError("the runs must have finite numbers, got one that is not: use rank_p")
    ways = deals(ours.shape[-1], theirs.shape[-1], most)
    sets = together.reshape(-1, together.shape[-1])
    step = max(1, _AT_ONCE // len(ways))
    found = [_p(sets[i : i + step], ways) for i in range(0, len(sets), step)]
    return np.concatenate(found).reshape(together.shape[:-1])


def rank_p(ours: Array, theirs: Array, *, most: int = MOST_DEALS) -> Array:
    """As :func:`deal_p`, of ranks: the test of Wilcoxon, Mann and Whitney, with ties.

    Args:
        ours: A number for each run, which may be infinite, shape ``[..., runs]``.
        theirs: Shape ``[..., other runs]``.
        most: Deals at most.

    Returns:
        The p-values, shape ``[...]``.
    """
    ranks = stats.rankdata(np.concatenate((ours, theirs), axis=-1), axis=-1)
    return deal_p(ranks[..., : ours.shape[-1]], ranks[..., ours.shape[-1] :], most=most)


def flip_p(gaps: Array) -> Array:
    """Two-sided permutation test of differences between runs of the same seed.

    Where neither method is better, each difference may as well have the other sign.

    Args:
        gaps: The difference of each seed, shape ``[..., seeds]``.

    Returns:
        Share of all ways to choose the signs in which the mean is as far from zero, shape
        ``[...]``; of :data:`MOST_FLIPS` ways above twenty seeds.

    Raises:
        ValueError: If a difference is not finite.

    Examples:
        >>> float(flip_p(np.array([1.0, 2.0, 3.0])))
        0.25
    """
    if not np.isfinite(gaps).all():
        raise ValueError("differences must be finite, got one that is not")
    seeds = gaps.shape[-1]
    if seeds > _ALL_FLIPS:
        sums = gaps @ flips(seeds, MOST_FLIPS).T
    else:
        # The sign of the first may stay: the other half has the same sizes.
        sums = gaps[..., :1]
        for seed in range(1, seeds):
            gap = gaps[..., seed, None]
            sums = np.concatenate((sums + gap, sums - gap), axis=-1)
    return _as_far(np.abs(sums), np.abs(gaps).max(axis=-1))


def rank_flip_p(ours: Array, theirs: Array) -> Array:
    """As :func:`flip_p`, of the differences between ranks among all runs.

    Args:
        ours: A number for each seed, which may be infinite, shape ``[..., seeds]``.
        theirs: Of the same seeds, shape ``[..., seeds]``.

    Returns:
        The p-values, shape ``[...]``.
    """
    ranks = stats.rankdata(np.concatenate((ours, theirs), axis=-1), axis=-1)
    return flip_p(ranks[..., : ours.shape[-1]] - ranks[..., ours.shape[-1] :])


@lru_cache(maxsize=4)
def deals(ours: int, theirs: int, most: int) -> Array:
    """Weights that make the difference of means of each deal, that which there is first.

    Args:
        ours: Runs of one side.
        theirs: Runs of the other.
        most: Deals at most. If there are more, these are a sample.

    Returns:
        The weights, shape ``[deals, runs of both]``.
    """
    runs = ours + theirs
    if math.comb(runs, ours) <= most:
        chosen = np.array(list(combinations(range(runs), ours)))
    else:
        rng = np.random.default_rng(0)
        chosen = rng.random((most, runs)).argpartition(ours - 1, axis=1)[:, :ours]
        chosen[0] = np.arange(ours)
    weights = np.full((len(chosen), runs), -1.0 / theirs)
    np.put_along_axis(weights, chosen, 1.0 / ours, axis=1)
    return weights


def flips(seeds: int, most: int) -> Array:
    """Signs of differences, all of them positive first.

    Args:
        seeds: Differences.
        most: Choices at most. If there are more, these are a sample.

    Returns:
        The signs, shape ``[choices, seeds]``; all choices are half of them, as the others have the
        same sizes.
    """
    if 2 ** (seeds - 1) <= most:
        bits = np.arange(2 ** (seeds - 1))[:, None] >> np.arange(seeds)
        return np.where(bits & 1, -1.0, 1.0)
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (most, seeds))
    signs[0] = 1.0
    return signs


def least_flip_p(seeds: int) -> float:
    """Least value that :func:`flip_p` can have for this number of seeds."""
    return 2.0 ** (1 - seeds)


def least_p(ours: int, theirs: int) -> float:
    """Least value that :func:`deal_p` can have for these numbers of runs."""
    sides = 2 if ours == theirs else 1
    return min(1.0, sides / math.comb(ours + theirs, ours))


def holm(p: Array) -> Array:
    """p-values of several comparisons, corrected for their number by Holm's method.

    Args:
        p: Shape ``[comparisons]``.

    Returns:
        Corrected values in the same order: where all below 0.05 are called differences, the chance
        that any of them is none is at most 5 %.

    Examples:
        >>> holm(np.array([0.01, 0.04, 0.03])).round(2).tolist()
        [0.03, 0.06, 0.06]
    """
    order = np.argsort(p)
    factors = len(p) - np.arange(len(p))
    corrected = np.empty(len(p))
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(factors * p[order]))
    return corrected


def _p(sets: Array, ways: Array) -> Array:
    """Share of deals that differ as much as the first one, for each set of data."""
    return _as_far(np.abs(sets @ ways.T), np.abs(sets).max(axis=1))


def _as_far(sizes: Array, scale: Array) -> Array:
    """Share of sizes, shape ``[..., sizes]``, that are not below the first one."""
    # What is equal but for rounding counts as equal.
    found: Array = (sizes >= sizes[..., :1] - 1e-12 * scale[..., None]).mean(axis=-1)
    return found
