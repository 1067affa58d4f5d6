"""How often methods fail, as ratios: success near 100 % leaves differences no room, ratios have it.

A run fails in a test that does not reach its goal, by a collision or by the time limit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
import pandas as pd

from benchmarks.paper.published import NAMES, TABLE_2, TABLE_4
from benchmarks.paper.rows import Rows
from benchmarks.paper.runs import CLAIMS, question
from mpfa_envs.evaluation.results import Interval
from training.comparison.report import table
from training.statistics import Array, chance, holm, permutation_p

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
    low, high = np.quantile(ratios[:-1], (0.025, 0.975), method="inverted_cdf")
    return Interval(float(ratios[-1]), float(low), float(high))


def ratio_text(ratio: Interval) -> str:
    """Format a ratio with its interval."""
    return f"{ratio.value:.2f} [{ratio.low:.2f}, {ratio.high:.2f}]"


def question_left(rows: Rows) -> int:
    """Return the number of planned runs of the question that have no rows."""
    return len({job.name for job in question(rows.folder).jobs} - rows.runs)


KINDS: dict[str, Callable[[pd.DataFrame], pd.Series]] = {
    "failures": lambda runs: 1.0 - runs["success"],
    "collisions": lambda runs: runs["collision"],
    "out of time": lambda runs: (1.0 - runs["success"] - runs["collision"]).abs().round(9),
}
"""Shares of each run's tests that count, by name."""
SPLIT = ("collisions", "out of time")
"""The kinds of failures, which add up to all of them."""


def question_table(
    new: Mapping[str, pd.DataFrame], found: Mapping[str, pd.DataFrame]
) -> tuple[str, list[tuple[Interval, float]]]:
    """Return the table of the question, and the ratio and p of each row, once all runs are made."""
    every = {
        f"ddpg-{name}": pd.concat([found[f"ddpg-{name}"], new[f"ddpg-{name}"]]) for name in CLAIMS
    }

    def shares(
        measured: Mapping[str, pd.DataFrame], pair: tuple[str, str], kind: str
    ) -> list[Array]:
        return [KINDS[kind](measured[f"ddpg-{name}"]).to_numpy(dtype=float) for name in pair]

    asked = [(pair, "failures") for pair in PAIRS]
    asked += [(pair, kind) for pair in PAIRS for kind in SPLIT]
    ps = [permutation_p(*shares(new, *what)) for what in asked]
    corrected = {1 + number: p for number, p in enumerate(holm(np.array(ps[1 : len(PAIRS)])))}
    ratios = [ratio_interval(*shares(new, *what), paired=False) for what in asked]
    lines = []
    for number, (pair, kind) in enumerate(asked):
        ours, whole = shares(new, pair, kind), shares(every, pair, kind)
        known = all(name in PUBLISHED for name in pair) and kind != "out of time"
        planned = number < len(PAIRS)
        order = ("secondary" if number else "primary") if planned else "exploratory"
        lines.append(
            [
                f"{NAMES[pair[0]]} / {NAMES[pair[1]]}, {kind}, {order}",
                f"{PUBLISHED[pair[0]] / PUBLISHED[pair[1]]:.2f}" if known else "",
                " and ".join(f"{runs.mean():.2%}" for runs in ours),
                ratio_text(ratios[number]),
                f"{ps[number]:.3f}",
                f"{corrected[number]:.3f}" if number in corrected else "",
                f"{ratio_text(ratio_interval(*whole, paired=False))}, "
                f"p = {permutation_p(*whole):.3f}",
            ]
        )
    head = ["", "paper", "shares of tests", "ratio, 95 %", "p", "p corrected"]
    text = table([*head, "all 46 seeds, exploratory"], lines)
    final = [float(corrected.get(number, p)) for number, p in enumerate(ps)]
    return text, list(zip(ratios, final, strict=True))


def question_power(new: Mapping[str, pd.DataFrame], ratio: float) -> float:
    """Return the chance to find a true ratio MPFA-PER / PER, given PER's failures in these runs.

    As in the design, MPFA-PER deviates in proportion to its mean.
    """
    per = KINDS["failures"](new["ddpg-per"])
    deviation = float(per.std(ddof=1)) * math.hypot(1.0, ratio)
    return chance(float(per.mean()) * (1.0 - ratio), deviation, len(per))
