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
    TESTS,
    neighbors,
)
from benchmarks.paper.rows import Rows
from benchmarks.paper.tables import FEWEST, OTHER_ARMS, difference
from training.statistics import chance, detectable, holm, mean_interval

Found = Mapping[str, pd.DataFrame]
"""Measures of each run, by arm."""


class Answer(NamedTuple):
    """What the runs say of a claim."""

    said: str
    """In words."""
    numbers: list[tuple[str, str, str]]
    """Claims, what the paper has, and what the runs have."""


def answers(rows: Rows, found: Found, *, decided: bool) -> list[Answer]:
    """Return an answer to each question that has its runs.

    Args:
        rows: Of the tables.
        found: Measures of their runs.
        decided: True if new seeds have answered whether MPFA-PER fails less often than PER: what
            these seeds say of that stands in the table of claims alone.
    """
    of_per = against_per(found)
    if of_per and decided:
        of_per = of_per._replace(said="")
    made = (order(found), of_per, hardest(rows), training_time(rows), spread(found))
    return [answer for answer in made if answer]


def order(found: Found) -> Answer | None:
    """Say whether steps of the paper's order of the methods are ours, too."""
    both = {**TABLE_2, **TABLE_4}
    if any(f"ddpg-{name}" not in found for name in both):
        return None
    pairs = {2: neighbors(TABLE_2), 4: neighbors(TABLE_4)}
    every = [pair for table in pairs.values() for pair in table]
    level = 0.05 / len(every)
    differences = [difference(found, f"ddpg-{a}", f"ddpg-{b}", tests=len(every)) for a, b in every]
    corrected = holm(np.array([1.0 if gap is None else gap.p for gap in differences]))
    confirmed, small, none = {}, [], 1.0
    for (a, b), gap, p in zip(every, differences, corrected, strict=True):
        points = PUBLISHED[b] - PUBLISHED[a]
        confirmed[a, b] = gap is not None and gap.gap.value > 0 and bool(p < 0.05)
        paired = gap is not None and math.isfinite(gap.detectable)
        small.append(gap is not None and paired and points < gap.detectable)
        if gap is not None and paired and gap.detectable:
            deviation = gap.detectable / detectable(1.0, gap.seeds, level=level)
            failures = 1.0 - float(found[f"ddpg-{b}"]["success"].mean())
            gone = failures * (1.0 - PUBLISHED[a] / PUBLISHED[b])
            none *= 1.0 - chance(gone, deviation, gap.seeds, level=level)
    steps = "Each step" if all(confirmed.values()) else "No step"
    if any(confirmed.values()) and not all(confirmed.values()):
        steps = f"A part of the steps ({_of(sum(confirmed.values()), every)})"
    seeds = min(len(found[f"ddpg-{name}"]) for name in both)
    said = (
        f"In the {seeds} seeds of the tables {steps[0].lower()}{steps[1:]} of the paper's order of "
        f"the methods{MARK} is confirmed."
    )
    if all(small) and not any(confirmed.values()):
        said += (
            " That was likely, whether the paper is right or not: each step is smaller than what "
            "these seeds find with 80 % power."
        )
    numbers = []
    for number, table in pairs.items():
        ahead = sum(PUBLISHED[b] - PUBLISHED[a] > 1e-9 for a, b in table)
        numbers.append(
            (
                f"neighbors of Table {number}{_mark(number)} of which the paper's better one is "
                "better; ours: corrected p < 0.05",
                f"{_of(ahead, table)}, untested",
                _of(sum(confirmed[pair] for pair in table), table),
            )
        )
    numbers += [
        (
            f"neighbors{MARK} whose difference in the paper is below what we find with 80 % power",
            "",
            _of(sum(small), small),
        ),
        (
            f"chance to find no neighbors{MARK} that differ, if the paper's ratios of failures "
            "hold and the steps are independent",
            "",
            f"{none:.0%}",
        ),
    ]
    for number, rows in ((2, TABLE_2), (4, TABLE_4), (0, both)):
        tau, p = stats.kendalltau(
            [row.success for row in rows.values()],
            # Rounded, as equal counts must tie.
            [round(float(found[f"ddpg-{name}"]["success"].mean()), 9) for name in rows],
        )
        what = f"Table {number}{_mark(number)}" if number else f"both tables{MARK}"
        claim = f"Kendall's rank correlation with the order of {what}, exploratory"
        numbers.append((claim, "", f"{tau:+.2f}, p = {p:.3f}"))
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
        "MPFA-PER fails less often than PER"
        if low > 0
        else "MPFA-PER fails more often than PER"
        if high < 0
        else "That MPFA-PER fails less often than PER was not established"
    )
    points = 100 * (claimed[1] - claimed[0])
    hits = [
        found[f"ddpg-{name}"]["collision"].to_numpy(dtype=float) for name in ("mpfa_per", "per")
    ]
    times = [found[f"ddpg-{name}"]["time"] for name in ("mpfa_per", "per")]
    slower = mean_interval((times[0] - times[1]).dropna().to_numpy(dtype=float))
    collided = ratio_interval(*hits, paired=made.seeds >= FEWEST)
    said = (
        f"{seen}, in {made.seeds} seeds. The paper's difference of success in points lies "
        f"{_where(points, low, high)} our interval, and its ratio of failures "
        f"{_where(ratio, made.ratio.low, made.ratio.high)} it. In the paper every failure is a "
        f"collision. In ours MPFA-PER collides {collided.value:.2f} times as often as PER."
    )
    numbers = [
        (
            "failures of MPFA-PER and of PER",
            " and ".join(f"{share:.1%}" for share in claimed),
            f"{ours.mean():.1%} and {theirs.mean():.1%}",
        ),
        ("ratio of failures MPFA-PER / PER, 95 %", f"{ratio:.2f}", ratio_text(made.ratio)),
        ("the same of collisions alone", f"{ratio:.2f}", ratio_text(collided)),
    ]
    if made.seeds >= FEWEST:
        common = ours.index.intersection(theirs.index)
        pair = (runs[common].to_numpy(dtype=float) for runs in (ours, theirs))
        text = ratio_text(ratio_interval(*pair, paired=True, odds=True))
        numbers.append(("ratio of the odds of failure, 95 %", f"{odds:.2f}", text))
    numbers += [
        (
            "success, MPFA-PER − PER [points], 95 %, p",
            f"{points:+.1f}",
            f"{value:+.1f} [{low:+.1f}, {high:+.1f}], p = {made.p:.3f}",
        ),
        (
            "time of a successful test, MPFA-PER − PER [s], 95 %",
            f"{TABLE_2['mpfa_per'].time - TABLE_2['per'].time:+.1f}",
            f"{slower.value:+.1f} [{slower.low:+.1f}, {slower.high:+.1f}]",
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
            (
                "pairs of seeds that find one point with 80 % power, at a level of 5 %",
                "",
                f"{seeds}",
            )
        )
    return Answer(said, numbers)


def hardest(rows: Rows) -> Answer:
    """Say how far the failures depend on few pairs of start and goal."""
    tests = rows.tests[rows.tests["arm"].isin(["ddpg-mpfa_per", "ddpg-per"])]
    failures = (1 - tests["success"]).groupby(tests["episode"]).sum()
    share = failures.nlargest(10).sum() / max(failures.sum(), 1)
    claim = f"failures of MPFA-PER and PER in the ten hardest of {TESTS} tests"
    return Answer("", [(claim, "", f"{share:.0%}")])


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
    rank = {len(others): "the fewest", 0: "the most"}.get(longer, "neither the fewest nor the most")
    said = (
        f"In the mean of its runs MPFA-PER takes {rank} training steps of Table 3{MARK}, and in "
        "the paper the fewest. No test compares the steps, and those of unfinished episodes count."
    )
    claim = f"methods{MARK} of Table 3 with more training steps than MPFA-PER, in the mean"
    numbers = [(claim, _of(len(others), others), _of(longer, others))]
    minutes = rows.times.groupby("arm")["minutes"].mean()
    if len(minutes) == len(TABLE_3):
        rest = minutes.drop("ddpg-mpfa_per")
        taken = f"{minutes['ddpg-mpfa_per']:.1f}, {rest.min():.1f} to {rest.max():.1f}"
        theirs = [TABLE_3[name].minutes for name in others]
        published = f"{TABLE_3['mpfa_per'].minutes}, {min(theirs):,} to {max(theirs):,}"
        numbers.append((f"minutes of training, MPFA-PER and the others{MARK}", published, taken))
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
    beyond = "A" if p < 0.05 else "No"
    said = (
        f"{beyond} share of the method{MARK} in the variance was found beyond chance. Part of the "
        f"rest is from only {TESTS} tests a run."
    )
    published = [row.success for paper in (TABLE_2, TABLE_4) for row in paper.values()]
    numbers = [
        (f"success of the methods{MARK}", _ends(published), _ends([each.mean() for each in runs])),
        (f"standard deviation of runs of one method{MARK} [points]", "", f"{deviation:.1f}"),
        (
            f"variance that the method{MARK} explains, and by chance alone, exploratory",
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
        claim = "success closer to the paper, and with our additions to DDPG"
        numbers.append((claim, "", f"{_ends(letter)}, and {_ends(ours)}"))
    return Answer(said, numbers)


def _mark(number: int) -> str:
    """Mark Table 4, whose neighbors are reconstructions."""
    return MARK if number == 4 else ""


def _where(value: float, low: float, high: float) -> str:
    return "inside" if low <= value <= high else "outside of"


def _odds(share: float) -> float:
    return share / (1.0 - share)


def _of(count: int, every: Sequence[object]) -> str:
    return f"{count} of {len(every)}"


def _ends(shares: Sequence[float]) -> str:
    return f"{min(shares):.1%} to {max(shares):.1%}"
