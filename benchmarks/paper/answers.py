"""What the runs say of the paper's claims: sentences that a reader can quote, and their numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from benchmarks.paper.failures import PUBLISHED, ratio_interval, ratio_text
from benchmarks.paper.published import (
    MARK,
    NAMES,
    TABLE_2,
    TABLE_3,
    TABLE_4,
    in_order,
    neighbors,
)
from benchmarks.paper.rows import Rows
from benchmarks.paper.tables import FEWEST, OTHER_ARMS, difference
from training.statistics import chance, detectable, holm

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
        mark = MARK if number == 4 else ""
        claim = f"Kendall's rank correlation with the order of Table {number}{mark}, exploratory"
        taus.append((claim, "", f"{tau:+.2f}, p = {p:.3f}"))
    pairs = neighbors()
    differences = [difference(found, f"ddpg-{a}", f"ddpg-{b}", tests=len(pairs)) for a, b in pairs]
    corrected = holm(np.array([1.0 if gap is None else gap.p for gap in differences]))
    seen = [
        gap is not None and gap.gap.value > 0 and p < 0.05
        for gap, p in zip(differences, corrected, strict=True)
    ]
    published = [PUBLISHED[b] - PUBLISHED[a] for a, b in pairs]
    level = 0.05 / len(pairs)
    small, none = [], 1.0
    for gap, points in zip(differences, published, strict=True):
        if gap is None or not math.isfinite(gap.detectable):
            small.append(False)
            continue
        small.append(points < gap.detectable)
        if gap.detectable:
            deviation = gap.detectable / detectable(1.0, gap.seeds, level=level)
            none *= 1.0 - chance(points, deviation, gap.seeds, level=level)
    ahead = sum(points > 1e-9 for points in published)
    said = f"The paper's order of the methods is {'' if all(seen) else 'not '}confirmed."
    if all(small) and not any(seen):
        said += (
            f" None of {len(small)} neighbors was found to differ. That was likely, whether the "
            f"paper is right or not: with its differences the chance is {none:.0%}, as each is "
            "smaller than what our seeds find with 80 % power."
        )
    numbers = [
        (
            f"neighbors{MARK} of which the paper's better one is better; ours: corrected p < 0.05",
            f"{_of(ahead, pairs)}, untested",
            _of(sum(seen), seen),
        ),
        (
            f"neighbors{MARK} whose difference in the paper is below what we find with 80 % power",
            "",
            _of(sum(small), small),
        ),
        (
            f"chance to find no neighbors{MARK} that differ, if the paper's differences are true",
            "",
            f"{none:.0%}",
        ),
        *taus,
    ]
    return Answer(said, numbers)


def against_per(found: Found) -> Answer | None:
    """Say whether MPFA-PER fails less often than PER, and where the paper's ratio lies."""
    made = difference(found, "ddpg-mpfa_per", "ddpg-per")
    if made is None:
        return None
    ours, theirs = (1.0 - found[f"ddpg-{name}"]["success"] for name in ("mpfa_per", "per"))
    value, low, high = (100 * end for end in (made.gap.value, made.gap.low, made.gap.high))
    claimed = [PUBLISHED[name] for name in ("mpfa_per", "per")]
    ratio, odds = claimed[0] / claimed[1], _odds(claimed[0]) / _odds(claimed[1])
    seen = (
        "fails less often than PER"
        if low > 0
        else "fails more often than PER"
        if high < 0
        else "was not seen to fail less often than PER"
    )
    where = "inside" if made.ratio.low <= ratio <= made.ratio.high else "outside of"
    said = (
        f"MPFA-PER {seen}, in {made.seeds} seeds. The paper's ratio of failures lies {where} our "
        "interval."
    )
    numbers = [
        (
            "failures of MPFA-PER and of PER",
            " and ".join(f"{share:.1%}" for share in claimed),
            f"{ours.mean():.1%} and {theirs.mean():.1%}",
        ),
        ("ratio of failures MPFA-PER / PER, 95 %", f"{ratio:.2f}", ratio_text(made.ratio)),
    ]
    if made.seeds >= FEWEST:
        common = ours.index.intersection(theirs.index)
        pair = (runs[common].to_numpy(dtype=float) for runs in (ours, theirs))
        text = ratio_text(ratio_interval(*pair, paired=True, odds=True))
        numbers.append(("ratio of the odds of failure, 95 %", f"{odds:.2f}", text))
    numbers += [
        (
            "success, MPFA-PER − PER [points], 95 %, p",
            f"{100 * (claimed[1] - claimed[0]):+.1f}",
            f"{value:+.1f} [{low:+.1f}, {high:+.1f}], p = {made.p:.3f}",
        ),
        (
            "from PER's success to the ceiling of 100 % [points]",
            f"{100 * claimed[1]:.1f}",
            f"{100 * theirs.mean():.1f}",
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
        f"paper the fewest. No test compares the steps, and the {len(others)} others are "
        f"reconstructions{MARK}."
    )
    claim = f"methods{MARK} of Table 3 with more training steps than MPFA-PER, in the mean"
    numbers = [(claim, _of(len(others), others), _of(longer, others))]
    minutes = rows.times.groupby("arm")["minutes"].mean()
    if len(minutes) == len(TABLE_3):
        rest = minutes.drop("ddpg-mpfa_per")
        taken = f"{minutes['ddpg-mpfa_per']:.1f}, {rest.min():.1f} to {rest.max():.1f}"
        numbers.append((f"minutes of training, MPFA-PER and the others{MARK}", "", taken))
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


def _odds(share: float) -> float:
    return share / (1.0 - share)


def _of(count: int, every: Sequence[object]) -> str:
    return f"{count} of {len(every)}"


def _ends(shares: Sequence[float]) -> str:
    return f"{min(shares):.1%} to {max(shares):.1%}"
