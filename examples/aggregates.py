"""Aggregates over few runs, as defined by Agarwal et al. (2021), https://arxiv.org/abs/2108.13264.

Their library, rliable, does not import beside current versions of what it depends on; these are its
definitions. Scores are arrays of shape ``[runs, tasks]``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def interquartile_mean(scores: Array) -> float:
    """Mean of the middle half of all scores, of all runs and tasks together.

    Args:
        scores: Shape ``[runs, tasks]``.

    Returns:
        The mean; a quarter of the scores, rounded down, is cut at each end.
    """
    values = np.sort(scores, axis=None)
    cut = values.size // 4
    return float(values[cut : values.size - cut].mean())


def probability_of_improvement(ours: Array, theirs: Array) -> float:
    """Probability that a run of ours beats one of theirs on a task drawn at random.

    Args:
        ours: Shape ``[runs, tasks]``.
        theirs: Shape ``[other runs, tasks]``.

    Returns:
        The probability; ties count half.
    """
    gaps = ours[:, None, :] - theirs[None, :, :]
    return float((gaps > 0).mean() + 0.5 * (gaps == 0).mean())


def stratified_bootstrap(
    statistic: Callable[..., float],
    *scores: Array,
    rng: np.random.Generator,
    draws: int = 2000,
) -> tuple[float, float]:
    """95 % interval of a statistic: runs are drawn anew for each task by itself.

    Args:
        statistic: Function of as many arrays as are given.
        *scores: Each of shape ``[runs, tasks]``.
        rng: Source of the draws.
        draws: Number of resamples.

    Returns:
        Lower and upper end.
    """
    found = []
    for _ in range(draws):
        drawn = [
            np.take_along_axis(each, rng.integers(len(each), size=each.shape), axis=0)
            for each in scores
        ]
        found.append(statistic(*drawn))
    low, high = np.percentile(found, [2.5, 97.5])
    return float(low), float(high)
