"""What a number of runs can tell: the runs that a difference needs, the difference that they find.

Both are of a two-sided t-test, to which the permutation test of means comes very near.
"""

from __future__ import annotations

import math
from bisect import bisect_left

import numpy as np
from scipy import optimize, stats

MOST = 10_000
"""Runs that anyone is told to make."""
_EFFECTS = 1e-3, 1e3
"""The least and the greatest effect that is looked for, in standard deviations."""


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
    """True difference of means that a t-test would have found.

    Args:
        deviation: Standard deviation from run to run.
        ours: Runs of one method.
        theirs: Runs of the other.
        level: Level of the test; divided by their number where there are several.
        power: Chance to find it.

    Returns:
        The difference, in units of the deviation's; NaN for one run of each, and where not even a
        thousand deviations would be found.

    Examples:
        >>> round(difference_found(1.0, 20, 20), 3)
        0.909
    """
    if ours + theirs < 3:
        return math.nan
    shift = math.sqrt(ours * theirs / (ours + theirs))
    return deviation * _effect(ours + theirs - 2, shift, level, power)


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
        The difference, in units of the deviation's; NaN for one seed, and where not even a thousand
        deviations would be found.

    Examples:
        >>> round(paired_difference_found(1.0, 20), 3)
        0.66
    """
    if seeds < 2:
        return math.nan
    return deviation * _effect(seeds - 1, math.sqrt(seeds), level, power)


def _effect(freedom: int, shift: float, level: float, power: float) -> float:
    """Effect in standard deviations that is found with some chance; NaN beyond a thousand."""

    def missing(effect: float) -> float:
        return _chance(freedom, effect * shift, level) - power

    if not missing(_EFFECTS[0]) < 0.0 < missing(_EFFECTS[1]):
        return math.nan
    return float(optimize.brentq(missing, *_EFFECTS))


def _chance(freedom: int, shift: float, level: float) -> float:
    """Chance that a t-test finds what shifts its statistic by so much."""
    bound = stats.t.ppf(1.0 - level / 2, freedom)
    # The tail on the other side is computed as NaN where it is nothing.
    below = np.nan_to_num(stats.nct.cdf(-bound, freedom, shift))
    return float(stats.nct.sf(bound, freedom, shift) + below)
