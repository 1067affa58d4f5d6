"""How often methods fail, as ratios: success near 100 % leaves differences no room, ratios have it.

A run fails in a test that does not reach its goal, by a collision or by the time limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pandas as pd

from benchmarks.paper.published import NAMES, TABLE_2, TABLE_4
from benchmarks.paper.rows import Rows
from benchmarks.paper.runs import CLAIMS, question
from mpfa_envs.evaluation.results import Interval
from training.comparison.report import table
from training.statistics import Array, holm, permutation_p

PUBLISHED = {name: 1.0 - row.success for name, row in {**TABLE_2, **TABLE_4}.items()}
"""Shares of failures in the paper."""
PAIRS = (("mpfa_per", "per"), ("mpfa_per", "uniform"), ("per", "uniform"))
"""The primary pair of the question, then the secondary ones."""
_RESAMPLES = 10_000


def ratio_interval(ours: Array, theirs: Array, *, paired: bool, odds: bool = False) -> Interval:
    """Return the ratio of two means of failures, or of their odds, with its 95 % interval.

    The ends are percentiles of a bootstrap over runs, by seed if the runs are paired. All are NaN
    where the other side has no failure.

    Examples:
        >>> ratio = ratio_interval(np.array([0.1, 0.2]), np.array([0.2, 0.4]), paired=True)
        >>> round(ratio.value, 3), round(ratio.low, 3), round(ratio.high, 3)
        (0.5, 0.5, 0.5)
    """
    if not theirs.any():
        return Interval(math.nan, math.nan, math.nan)
    rng = np.random.default_rng(0)
    rows = rng.integers(len(ours), size=(_RESAMPLES, len(ours)))
    others = rows if paired else rng.integers(len(theirs), size=(_RESAMPLES, len(theirs)))
    # The last pair of means is that of all runs.
    a = np.append(ours[rows].mean(axis=1), ours.mean())
    b = np.append(theirs[others].mean(axis=1), theirs.mean())
    if odds:
        a, b = a / (1.0 - a), b / (1.0 - b)
    # A resample without failures has no ratio.
    ratios = np.divide(a, b, out=np.full_like(a, math.inf), where=b > 0.0)
    low, high = np.quantile(ratios[:-1], (0.025, 0.975))
    return Interval(float(ratios[-1]), float(low), float(high))


def ratio_text(ratio: Interval) -> str:
    """Format a ratio with its interval."""
    return f"{ratio.value:.2f} [{ratio.low:.2f}, {ratio.high:.2f}]"


def question_left(rows: Rows) -> int:
    """Return the number of planned runs of the question that have no rows."""
    return len({job.name for job in question(rows.folder).jobs} - rows.runs)


def question_table(
    new: Mapping[str, pd.DataFrame], found: Mapping[str, pd.DataFrame]
) -> tuple[str, Interval, float]:
    """Return the table of the question, and its primary ratio with p, once all runs are made."""

    def failures(measured: Mapping[str, pd.DataFrame], method: str) -> Array:
        return 1.0 - measured[f"ddpg-{method}"]["success"].to_numpy(dtype=float)

    every = {
        f"ddpg-{name}": pd.concat([found[f"ddpg-{name}"], new[f"ddpg-{name}"]]) for name in CLAIMS
    }
    lines, ratios, ps = [], [], []
    for a, b in PAIRS:
        ours, theirs = failures(new, a), failures(new, b)
        ratios.append(ratio_interval(ours, theirs, paired=False))
        ps.append(permutation_p(ours, theirs))
    corrected = [ps[0], *holm(np.array(ps[1:]))]
    for number, (a, b) in enumerate(PAIRS):
        both = failures(every, a), failures(every, b)
        whole = ratio_text(ratio_interval(*both, paired=False))
        published = f"{PUBLISHED[a] / PUBLISHED[b]:.2f}" if b in PUBLISHED else ""
        lines.append(
            [
                f"{NAMES[a]} / {NAMES[b]}, {'secondary' if number else 'primary'}",
                published,
                " and ".join(f"{failures(new, name).mean():.2%}" for name in (a, b)),
                ratio_text(ratios[number]),
                f"{ps[number]:.3f}",
                f"{corrected[number]:.3f}",
                f"{whole}, p = {permutation_p(*both):.3f}",
            ]
        )
    head = ["", "paper", "failures", "ratio, 95 %", "p", "p corrected"]
    return table([*head, "all 46 seeds, exploratory"], lines), ratios[0], ps[0]
