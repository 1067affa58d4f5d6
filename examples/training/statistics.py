"""Statistics of which the unit is the run: intervals, tests, corrections, power.

The episodes of one policy are not independent: whether the policy found the path around a bar
decides many of them. So each run counts as one number.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from mpfa_envs.evaluation.results import Interval

Array = NDArray[np.float64]
_PERMUTATIONS = 50_000
"""Permutations of runs: all of them up to nine runs against nine, else a sample."""
_EXACT = 20
"""Most pairs of which all permutations of signs are counted: a million."""

FEWEST = 3
"""Fewest runs with an interval: that of two runs would be 13 times as wide as their distance."""
_PAIRED = 6
"""Fewest pairs whose test can give a p below 0.05."""


def mean_interval(runs: Array) -> Interval:
    """Return the mean of runs with Student's 95 % interval; NaN ends for one run.

    Examples:
        >>> found = mean_interval(np.array([1.0, 2.0, 3.0]))
        >>> round(found.low, 2), found.value, round(found.high, 2)
        (-0.48, 2.0, 4.48)
    """
    middle = float(runs.mean())
    if len(runs) < 2:
        return Interval(middle, math.nan, math.nan)
    reach = float(stats.t.ppf(0.975, len(runs) - 1) * stats.sem(runs))
    return Interval(middle, middle - reach, middle + reach)


def difference_interval(ours: Array, theirs: Array) -> Interval:
    """Return the difference of two means with Welch's 95 % interval; NaN ends for one run."""
    gap = float(ours.mean() - theirs.mean())
    if min(len(ours), len(theirs)) < 2:
        return Interval(gap, math.nan, math.nan)
    # SciPy's interval warns of a side whose runs are all equal.
    parts = np.array([runs.var(ddof=1) / len(runs) for runs in (ours, theirs)])
    if not parts.sum():
        return Interval(gap, gap, gap)
    freedom = parts.sum() ** 2 / (parts**2 / (np.array([len(ours), len(theirs)]) - 1)).sum()
    reach = float(stats.t.ppf(0.975, freedom) * math.sqrt(parts.sum()))
    return Interval(gap, gap - reach, gap + reach)


def permutation_p(ours: Array, theirs: Array) -> float:
    """Return p of the two-sided permutation test of the difference between means.

    Examples:
        >>> permutation_p(np.array([3.0, 4.0, 5.0]), np.array([0.0, 1.0, 2.0]))
        0.1
    """
    if min(len(ours), len(theirs)) == 1:
        # SciPy takes no single run: each run of all is the single one in turn.
        runs = np.concatenate([ours, theirs] if len(ours) == 1 else [theirs, ours])
        gaps = abs(runs - (runs.sum() - runs) / (len(runs) - 1)).round(12)
        return float((gaps >= gaps[0]).mean())

    def gap(x: Array, y: Array, axis: int) -> Array:
        # What is equal but for rounding counts as equal.
        return np.asarray(abs(x.mean(axis=axis) - y.mean(axis=axis)).round(12))

    if math.comb(len(ours) + len(theirs), len(ours)) > _PERMUTATIONS:
        # As SciPy would, which makes an index of each permutation and takes twice as long.
        both = np.tile(np.concatenate([ours, theirs]), (_PERMUTATIONS, 1))
        dealt = np.random.default_rng(0).permuted(both, axis=1)
        gaps = gap(dealt[:, : len(ours)], dealt[:, len(ours) :], 1)
        return float((1 + (gaps >= gap(ours, theirs, 0)).sum()) / (1 + _PERMUTATIONS))
    return _share((ours, theirs), gap, permutation_type="independent")


def sign_p(gaps: Array) -> float:
    """Return p of the two-sided permutation test of the signs of differences, one a seed.

    Where neither method is better, the difference of a seed may as well have the other sign.

    Examples:
        >>> sign_p(np.array([1.0, 2.0, 3.0]))
        0.25
    """
    if len(gaps) == 1:
        return 1.0
    if len(gaps) <= _EXACT:
        sums = np.zeros(1)
        for gap in gaps:
            sums = np.concatenate([sums - gap, sums + gap])
        # What is equal but for rounding counts as equal.
        sizes = abs(sums / len(gaps)).round(12)
        return float((sizes >= abs(gaps.mean()).round(12)).mean())

    def size(x: Array, axis: int) -> Array:
        return np.asarray(abs(x.mean(axis=axis)).round(12))

    return _share((gaps,), size, permutation_type="samples")


@dataclass(frozen=True)
class Difference:
    """The difference of two means of runs, and its test."""

    gap: Interval
    """Difference with its 95 % interval; ends are NaN for fewer than three runs a side."""
    p: float
    least: float
    """Least p that so few runs can have."""


def permuted_difference(ours: Mapping[str, float], theirs: Mapping[str, float]) -> Difference:
    """Test the difference of two means by permutations.

    Runs are paired by name where both sides have the same six runs or more.

    Args:
        ours: The value of each run by its name, as a rule its seed.
        theirs: The values of other runs.

    Examples:
        >>> found = permuted_difference({"0": 1.0, "1": 2.0}, {"0": 3.0, "1": 4.0})
        >>> found.gap.value, round(found.p, 3), round(found.least, 3)
        (-2.0, 0.333, 0.333)
    """
    if ours.keys() == theirs.keys() and len(ours) >= _PAIRED:
        gaps = np.array([ours[name] - theirs[name] for name in ours])
        return Difference(mean_interval(gaps), sign_p(gaps), 0.5 ** (len(gaps) - 1))
    a, b = (np.array(list(each.values())) for each in (ours, theirs))
    gap = difference_interval(a, b)
    if min(len(a), len(b)) < FEWEST:
        gap = Interval(gap.value, math.nan, math.nan)
    # Of two groups of one size, each arrangement has a mirror image with the same difference.
    least = (1 + (len(a) == len(b))) / math.comb(len(a) + len(b), len(a))
    return Difference(gap, permutation_p(a, b), least)


def _share(samples: tuple[Array, ...], statistic: Any, **options: Any) -> float:
    """Share of permutations whose statistic is at least that of the samples."""
    options |= {"alternative": "greater", "vectorized": True, "rng": 0}
    found = stats.permutation_test(samples, statistic, n_resamples=_PERMUTATIONS, **options)
    return float(found.pvalue)


def holm(p: Array) -> Array:
    """Correct p-values for their number by Holm's method, in the same order.

    Where all below 0.05 are called differences, the chance that any of them is none is at most 5 %.

    Examples:
        >>> holm(np.array([0.01, 0.04, 0.03])).round(2).tolist()
        [0.03, 0.06, 0.06]
    """
    order = np.argsort(p)
    factors = len(p) - np.arange(len(p))
    corrected = np.empty(len(p))
    corrected[order] = np.minimum(1.0, np.maximum.accumulate(factors * p[order]))
    return corrected


def chance(gap: float, deviation: float, seeds: int, *, level: float = 0.05) -> float:
    """Return the chance that a two-sided t-test of paired runs finds a mean difference.

    The deviation is that of the difference from seed to seed.

    Examples:
        >>> round(chance(1.0, 1.0, 10), 1)
        0.8
    """
    bound = stats.t.ppf(1 - level / 2, seeds - 1)
    return float(stats.nct.sf(bound, seeds - 1, gap / deviation * math.sqrt(seeds)))


def detectable(deviation: float, seeds: int, *, level: float = 0.05, power: float = 0.8) -> float:
    """Return the mean difference that a two-sided t-test of paired runs finds with some power.

    The deviation is that of the difference from seed to seed.

    Examples:
        >>> round(detectable(1.0, 10), 1)
        1.0
    """
    low, high = 0.0, 100.0 / math.sqrt(seeds)
    for _ in range(50):
        middle = (low + high) / 2
        found = chance(middle, 1.0, seeds, level=level) >= power
        low, high = (low, middle) if found else (middle, high)
    return deviation * high
