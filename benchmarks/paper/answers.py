"""Sentences that a reader can quote: what the runs say of the paper's claims."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pandas as pd
from scipy import stats

from benchmarks.paper.published import NAMES, TABLE_2, TABLE_3, TABLE_4, in_order, neighbors
from benchmarks.paper.rows import Rows
from benchmarks.paper.tables import OTHER_ARMS, difference
from training.statistics import detectable, holm

Found = Mapping[str, pd.DataFrame]
"""Measures of each run, by arm."""


def answers(rows: Rows, found: Found) -> list[str]:
    """Return an answer to each question that has its runs."""
    made = (order(found), against_per(found), training_time(rows), spread(found))
    return [answer for answer in made if answer]


def order(found: Found) -> str:
    """Say whether the paper's order of the methods is ours, too."""
    taus = []
    for number, paper in ((2, TABLE_2), (4, TABLE_4)):
        names = in_order(paper)
        if any(f"ddpg-{name}" not in found for name in names):
            return ""
        ours = [found[f"ddpg-{name}"]["success"].mean() for name in names]
        tau = stats.kendalltau([paper[name].success for name in names], ours).statistic
        taus.append(f"{tau:+.2f} in Table {number}")
    made = [difference(found, f"ddpg-{a}", f"ddpg-{b}") for a, b in neighbors()]
    corrected = holm(np.array([1.0 if each is None else each.p for each in made]))
    seen = [
        each is not None and each.gap.value > 0 and p < 0.05
        for each, p in zip(made, corrected, strict=True)
    ]
    return (
        f"The paper's order of the methods is {'' if all(seen) else 'not '}confirmed. "
        f"Of {len(seen)} pairs of neighbors in this order {sum(seen)} differ as in the paper. "
        f"Kendall's rank correlation between the paper's success and ours is {' and '.join(taus)}."
    )


def against_per(found: Found) -> str:
    """Say whether MPFA-PER reaches more goals than PER, and which differences are excluded."""
    made = difference(found, "ddpg-mpfa_per", "ddpg-per")
    if made is None:
        return ""
    ours, theirs = (found[f"ddpg-{name}"]["success"].mean() for name in ("mpfa_per", "per"))
    value, low, high = (100 * each for each in (made.gap.value, made.gap.low, made.gap.high))
    published = 100 * (TABLE_2["mpfa_per"].success - TABLE_2["per"].success)
    better = "is better" if low > 0 else "is worse" if high < 0 else "was not seen to be better"
    text = (
        f"MPFA-PER {better} than PER: {ours:.1%} of the goals and {theirs:.1%}. "
        f"The difference is {value:+.1f} points, 95 % [{low:+.1f}, {high:+.1f}], p = {made.p:.3f}. "
        f"The paper's {published:+.0f} points are "
        f"{'inside the interval' if low <= published <= high else 'excluded'}."
    )
    if low <= 0.0 <= high and math.isfinite(made.detectable):
        deviation = made.detectable / detectable(1.0, made.seeds)
        seeds = next(n for n in range(3, 100_000) if detectable(deviation, n) <= 0.01)
        text += f" A difference of one point would take {seeds} seeds to find with 80 % power."
    return text


def training_time(rows: Rows) -> str:
    """Say whether MPFA-PER trains in fewer steps and less time than the methods of Table 3."""
    steps = {
        name: float(np.mean([each["total_steps"].iloc[-1] for each in runs.values()]))
        for name in TABLE_3
        if (runs := rows.episodes(f"ddpg-{name}"))
    }
    if len(steps) < len(TABLE_3):
        return ""
    longer = sum(each > steps["mpfa_per"] for each in steps.values())
    text = (
        f"{longer} of the {len(steps) - 1} other methods of Table 3 take more training steps than "
        "MPFA-PER. In the paper all of them do."
    )
    minutes = rows.times.groupby("arm")["minutes"].mean()
    if len(minutes) == len(TABLE_3):
        others = minutes.drop("ddpg-mpfa_per")
        text += (
            f" Training takes {minutes['ddpg-mpfa_per']:.1f} minutes with MPFA-PER and "
            f"{others.min():.1f} to {others.max():.1f} with the others."
        )
    return text


def spread(found: Found) -> str:
    """Say how much the success differs by the method, the seed and the learner's additions."""
    runs = [found[f"ddpg-{name}"]["success"] for name in NAMES if f"ddpg-{name}" in found]
    if len(runs) < len(NAMES) or min(map(len, runs)) < 2:
        return ""
    means = [each.mean() for each in runs]
    deviation = 100 * float(np.sqrt(np.mean([each.var(ddof=1) for each in runs])))
    text = (
        f"The thirteen methods reach {min(means):.1%} to {max(means):.1%}. "
        f"Runs of one method, which differ by their seed alone, vary by {deviation:.1f} points "
        "(standard deviation)."
    )
    arms = [(arm, f"ddpg-{arm.split('-')[1]}") for arm in OTHER_ARMS["letter"].values()]
    both = [
        [found[arm]["success"].mean() for arm in pair]
        for pair in arms
        if all(arm in found for arm in pair)
    ]
    if both:
        letter, ours = zip(*both, strict=True)
        text += (
            f" To the letter of the paper its methods reach {min(letter):.1%} to {max(letter):.1%};"
            f" with the additions that keep DDPG from collapsing they reach {min(ours):.1%} to "
            f"{max(ours):.1%}."
        )
    return text
