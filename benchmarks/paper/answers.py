"""What the runs say of the paper's claims: sentences that a reader can quote, and their numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from benchmarks.paper.published import NAMES, TABLE_2, TABLE_3, TABLE_4, in_order, neighbors
from benchmarks.paper.rows import Rows
from benchmarks.paper.tables import OTHER_ARMS, difference
from training.statistics import detectable, holm

Found = Mapping[str, pd.DataFrame]
"""Measures of each run, by arm."""


class Answer(NamedTuple):
    """What the runs say of a claim."""

    said: str
    """In words."""
    numbers: list[tuple[str, str, str]]
    """Claims, what the paper has, and what the runs have."""


def answers(rows: Rows, found: Found) -> list[Answer]:
    """Return an answer to each question that has its runs."""
    made = (order(found), against_per(found), training_time(rows), spread(found))
    return [answer for answer in made if answer]


def order(found: Found) -> Answer | None:
    """Say whether the paper's order of the methods is ours, too."""
    taus = []
    for number, paper in ((2, TABLE_2), (4, TABLE_4)):
        names = in_order(paper)
        if any(f"ddpg-{name}" not in found for name in names):
            return None
        ours = [found[f"ddpg-{name}"]["success"].mean() for name in names]
        tau, p = stats.kendalltau([paper[name].success for name in names], ours)
        claim = f"Kendall's rank correlation with the order of Table {number}, exploratory"
        taus.append((claim, "+1.00", f"{tau:+.2f}, p = {p:.3f}"))
    made = [difference(found, f"ddpg-{a}", f"ddpg-{b}") for a, b in neighbors()]
    corrected = holm(np.array([1.0 if each is None else each.p for each in made]))
    seen = [
        each is not None and each.gap.value > 0 and p < 0.05
        for each, p in zip(made, corrected, strict=True)
    ]
    claim = "neighbors of which the paper's better one is better, corrected p < 0.05"
    pairs = claim, _of(len(seen), seen), _of(sum(seen), seen)
    said = f"The paper's order of the methods is {'' if all(seen) else 'not '}confirmed."
    return Answer(said, [pairs, *taus])


def against_per(found: Found) -> Answer | None:
    """Say whether MPFA-PER reaches more goals than PER, and which differences are excluded."""
    made = difference(found, "ddpg-mpfa_per", "ddpg-per")
    if made is None:
        return None
    ours, theirs = (found[f"ddpg-{name}"]["success"].mean() for name in ("mpfa_per", "per"))
    value, low, high = (100 * each for each in (made.gap.value, made.gap.low, made.gap.high))
    claimed = [TABLE_2[name].success for name in ("mpfa_per", "per")]
    published = 100 * (claimed[0] - claimed[1])
    better = "is better" if low > 0 else "is worse" if high < 0 else "was not seen to be better"
    where = "inside the interval" if low <= published <= high else "excluded"
    said = f"MPFA-PER {better} than PER, and the paper's difference is {where}."
    numbers = [
        (
            "success of MPFA-PER and of PER",
            " and ".join(f"{each:.1%}" for each in claimed),
            f"{ours:.1%} and {theirs:.1%}",
        ),
        (
            "MPFA-PER − PER [points], 95 %, p",
            f"{published:+.1f}",
            f"{value:+.1f} [{low:+.1f}, {high:+.1f}], p = {made.p:.3f}",
        ),
    ]
    if low <= 0.0 <= high and math.isfinite(made.detectable):
        deviation = made.detectable / detectable(1.0, made.seeds)
        seeds = next(n for n in range(3, 100_000) if detectable(deviation, n) <= 0.01)
        numbers.append(
            ("seeds that find one point with 80 % power, at a level of 5 %", "", f"{seeds}")
        )
    return Answer(said, numbers)


def training_time(rows: Rows) -> Answer | None:
    """Say whether MPFA-PER trains in fewer steps and less time than the methods of Table 3."""
    steps = {
        name: float(np.mean([each["total_steps"].iloc[-1] for each in runs.values()]))
        for name in TABLE_3
        if (runs := rows.episodes(f"ddpg-{name}"))
    }
    if len(steps) < len(TABLE_3):
        return None
    others = [name for name in TABLE_3 if name != "mpfa_per"]
    longer = sum(steps[name] > steps["mpfa_per"] for name in others)
    most = {0: "the most", len(others): "the fewest"}.get(longer, "neither the most nor the fewest")
    said = (
        f"In the mean of its runs MPFA-PER takes {most} training steps of Table 3, and in the "
        "paper the fewest. No test compares the steps."
    )
    claim = "methods of Table 3 with more training steps than MPFA-PER, in the mean"
    numbers = [(claim, _of(len(others), others), _of(longer, others))]
    minutes = rows.times.groupby("arm")["minutes"].mean()
    if len(minutes) == len(TABLE_3):
        rest = minutes.drop("ddpg-mpfa_per")
        taken = f"{minutes['ddpg-mpfa_per']:.1f}, {rest.min():.1f} to {rest.max():.1f}"
        numbers.append(("minutes of training, MPFA-PER and the others", "", taken))
    return Answer(said, numbers)


def spread(found: Found) -> Answer | None:
    """Say whether the method or the run decides success, and what the additions do."""
    runs = [found[f"ddpg-{name}"]["success"] for name in NAMES if f"ddpg-{name}" in found]
    if len(runs) < len(NAMES) or min(map(len, runs)) < 2:
        return None
    deviation = 100 * float(np.sqrt(np.mean([each.var(ddof=1) for each in runs])))
    every = np.concatenate(runs)
    whole = float(((every - every.mean()) ** 2).sum())
    within = sum(float(((each - each.mean()) ** 2).sum()) for each in runs)
    share = 1.0 - within / whole if whole else 0.0
    groups, rest = len(runs) - 1, len(every) - len(runs)
    # The test of an analysis of variance, which the share decides without a quotient by zero.
    p = stats.beta.sf(share, groups / 2, rest / 2)
    decides = "method" if share > 0.5 else "run"
    said = (
        f"The {decides} decides success: {1 - share:.0%} of the variance lies between runs of one "
        "method."
    )
    published = [row.success for paper in (TABLE_2, TABLE_4) for row in paper.values()]
    numbers = [
        ("success of the methods", _ends(published), _ends([each.mean() for each in runs])),
        ("standard deviation of runs of one method [points]", "", f"{deviation:.1f}"),
        (
            "share of the variance that the method explains, and by chance alone, exploratory",
            "",
            f"{share:.1%} and {groups / (groups + rest):.1%}, p = {p:.3f}",
        ),
    ]
    arms = [(arm, f"ddpg-{arm.split('-')[1]}") for arm in OTHER_ARMS["letter"].values()]
    both = [
        [float(found[arm]["success"].mean()) for arm in pair]
        for pair in arms
        if all(arm in found for arm in pair)
    ]
    if both:
        letter, ours = zip(*both, strict=True)
        claim = "success to the letter of the paper, and with what keeps DDPG from collapsing"
        numbers.append((claim, "", f"{_ends(letter)}, and {_ends(ours)}"))
    return Answer(said, numbers)


def _of(count: int, every: Sequence[object]) -> str:
    return f"{count} of {len(every)}"


def _ends(shares: Sequence[float]) -> str:
    return f"{min(shares):.1%} to {max(shares):.1%}"
