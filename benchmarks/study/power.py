"""What a number of runs can tell: the runs that a difference needs, the difference that they find.

The runs that are needed are those of a two-sided t-test. The difference that is found is that of
the permutation test which is made: it has a least p, and with few runs finds no difference at all
where many comparisons are corrected for each other.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from functools import lru_cache

import numpy as np
from scipy import stats

from benchmarks.study.intervals import Array
from benchmarks.study.permutation import deals, flips, least_flip_p, least_p

MOST = 10_000
"""Runs that anyone is told to make."""
_TRIALS = 1000
"""Sets of runs that power is measured with."""
_WAYS = 4096
"""Deals or signs of each at most."""


def runs_needed(deviation: float, difference: float, *, power: float = 0.8) -> int:
    """Runs of each of two methods until a t-test finds a difference between their means.

    Args:
        deviation: Standard deviation from run to run.
        difference: True difference of the means.
        power: Chance to find it at the level of 5 %.

    Returns:
        The number of runs of each; one more than :data:`MOST` if these are too few.

    Examples:
        >>> runs_needed(1.95, 2.0), runs_needed(1.95, 5.0)
        (16, 4)
    """

    def found(runs: int) -> float:
        return _chance(2 * runs - 2, difference / deviation * math.sqrt(runs / 2), 0.05)

    return bisect_left(range(MOST + 1), power, lo=2, key=found)


def difference_found(
    deviation: float, ours: int, theirs: int, *, level: float = 0.05, power: float = 0.8
) -> float:
    """True difference of means that the permutation test of runs would have found.

    Args:
        deviation: Standard deviation from run to run, of normally distributed runs.
        ours: Runs of one method.
        theirs: Runs of the other.
        level: Level of the test; divided by their number where there are several.
        power: Chance to find it.

    Returns:
        The difference, in units of the deviation's; infinite where the least p is above the level.

    Examples:
        >>> round(difference_found(1.0, 20, 20), 1), difference_found(1.0, 1, 18)
        (0.9, inf)
    """
    if least_p(ours, theirs) > level:
        return math.inf
    return deviation * _dealt_effect(ours, theirs, level, power)


def paired_difference_found(
    deviation: float, seeds: int, *, level: float = 0.05, power: float = 0.8
) -> float:
    """As :func:`difference_found`, where runs of the same seed are compared.

    Args:
        deviation: Standard deviation of the difference from seed to seed.
        seeds: Seeds that both methods have.
        level: Level of the test.
        power: Chance to find it.

    Returns:
        The difference, in units of the deviation's; infinite where the least p is above the level.

    Examples:
        >>> round(paired_difference_found(1.0, 20), 1), paired_difference_found(1.0, 5)
        (0.7, inf)
    """
    if least_flip_p(seeds) > level:
        return math.inf
    return deviation * _flipped_effect(seeds, level, power)


@lru_cache(maxsize=64)
def _dealt_effect(ours: int, theirs: int, level: float, power: float) -> float:
    return _effect(deals(ours, theirs, _WAYS), np.repeat([1.0, 0.0], (ours, theirs)), level, power)


@lru_cache(maxsize=64)
def _flipped_effect(seeds: int, level: float, power: float) -> float:
    return _effect(flips(seeds, _WAYS) / seeds, np.ones(seeds), level, power)


def _effect(ways: Array, moved: Array, level: float, power: float) -> float:
    """Effect in standard deviations that a test finds with some chance.

    Args:
        ways: Weights that make the statistic of each deal, that of the data first; shape
            ``[ways, runs]``.
        moved: 1 for runs that have the effect, 0 for the others; shape ``[runs]``.
        level: Of the test.
        power: The chance.

    Raises:
        ValueError: If so many ways are too few for such a level.
    """
    if level * len(ways) < 1.0:
        raise ValueError(f"level must be at least 1 / {len(ways)}, got {level}")
    runs = np.random.default_rng(0).standard_normal((_TRIALS, len(moved)))
    still, shift = runs @ ways.T, ways @ moved

    def found(effect: float) -> float:
        sizes = np.abs(still + effect * shift)
        p = (sizes >= sizes[:, :1] - 1e-9).mean(axis=1)
        return float((p <= level).mean())

    high = 1.0
    while found(high) < power:
        high *= 2.0
    low = high / 2.0 if high > 1.0 else 0.0
    for _ in range(9):
        middle = (low + high) / 2.0
        low, high = (low, middle) if found(middle) >= power else (middle, high)
    return high


def _chance(freedom: int, shift: float, level: float) -> float:
    """Chance that a t-test finds what shifts its statistic by so much."""
    bound = stats.t.ppf(1.0 - level / 2, freedom)
    # The tail on the other side is computed as NaN where it is nothing.
    below = np.nan_to_num(stats.nct.cdf(-bound, freedom, shift))
    return float(stats.nct.sf(bound, freedom, shift) + below)
