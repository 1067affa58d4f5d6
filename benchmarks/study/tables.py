"""Tables of the study in Markdown: the measures of each arm, and its comparisons."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill

import numpy as np
import pandas as pd

from benchmarks.study.intervals import (
    Array,
    difference_interval,
    improvement_interval,
    interquartile_interval,
    mean_interval,
    mean_over_worlds,
)
from benchmarks.study.permutation import deal_p, flip_p, holm, rank_flip_p, rank_p
from benchmarks.study.power import difference_found, paired_difference_found
from benchmarks.study.protocol import Pair, Table, short_names
from benchmarks.study.rows import GOAL, Rows, kinds_of, scores_of, worlds_of
from mpfa_envs.evaluation.results import Interval
from training.comparison.report import median_of
from training.comparison.report import table as markdown
from training.worlds import family

NOTES = """\
The unit is the run. Area: mean height of the curve of {height}, from zero on.
Actions to {goal}: those until the first evaluation that reaches it, median of the runs. {note}
Of an even number of runs the median is the lower of the two in the middle. Arms with at least {few}
seeds in common are compared by these, seed by seed; others by the means of all their runs. An arm
with fewer than {fewest} runs is not compared.

Intervals: bootstrap over seeds, or over seeds and worlds (of a single world: its pairs of start and
goal), widened for few runs. *p*: permutation test of the signs of the differences, or of the means
of runs; for actions to the goal, of ranks. Corrected by Holm's method within this table and
measure; comparisons without runs count with p = 1. The primary measure decides, and while runs are
missing every p is provisional. *Found with 80 %*: the true difference that this test would have
found with a probability of 80 %, at a level of 0.05 divided by the number of comparisons, if runs
are normally distributed; *none* if even the least p of so few runs is above that level. *Better
run*: probability that a run of the first arm is better than one of the second with another seed."""
MEASURES = {
    "area": "area under the curve of {height}",
    "success": "success of the last policy",
    "actions": "actions until {goal} of {height}",
}
"""What they are called, with what is over actions in a table, and how much of it is the goal."""
Scores = Mapping[str, pd.DataFrame]
FEWEST = 3
"""Runs that an arm must have to be compared."""
_PAIRS = 6
"""Seeds in common from which on the test of signs can find anything: its p is at least 2 / 2^6."""
_WIDTH = 100
"""Characters of a line of prose."""


@dataclass(frozen=True)
class Sides:
    """The runs of two arms, of the same seeds in the same order if they are paired."""

    ours: Array
    theirs: Array
    paired: bool


def sides_of(scores: Scores, pair: Pair, measure: str) -> Sides | None:
    """The runs of two arms that are compared; None where an arm has fewer than :data:`FEWEST`."""
    ours, theirs = (runs_of(scores, label, measure) for label in pair)
    if min(len(ours), len(theirs)) < FEWEST:
        return None
    common = ours.index.intersection(theirs.index)
    if len(common) < _PAIRS:
        return Sides(ours.to_numpy(), theirs.to_numpy(), paired=False)
    return Sides(ours[common].to_numpy(), theirs[common].to_numpy(), paired=True)


def runs_of(scores: Scores, label: str, measure: str) -> pd.Series:
    """A measure of the runs of an arm by their seed, of those that have it."""
    if label not in scores:
        return pd.Series(dtype=float)
    return scores[label][measure].dropna().sort_index()


def p_of(sides: Sides, measure: str) -> float:
    """Seed by seed if both have the same, else of the means of runs; of ranks for actions."""
    if measure == "actions":
        test = rank_flip_p if sides.paired else rank_p
        return float(test(sides.ours, sides.theirs))
    if sides.paired:
        return float(flip_p(sides.ours - sides.theirs))
    return float(deal_p(sides.ours, sides.theirs))


def comparison_lines(
    scores: Scores,
    pairs: Sequence[Pair],
    measure: str,
    worlds: Mapping[str, pd.DataFrame],
    *,
    absent: bool = True,
) -> str:
    """A table of comparisons that are corrected for each other.

    Args:
        scores: The measures of each run, by arm.
        pairs: Arms to compare; those that lack runs have empty cells, and count in the correction.
        measure: Of :data:`MEASURES`.
        worlds: Success in each world, by arm; it makes the interval for other runs and worlds.
        absent: Whether pairs that lack runs have lines.

    Returns:
        A table in Markdown; empty without a pair that has runs.
    """
    found = {pair: sides_of(scores, pair, measure) for pair in pairs}
    known = {pair: sides for pair, sides in found.items() if sides is not None}
    if not known:
        return ""
    p = {pair: p_of(sides, measure) for pair, sides in known.items()}
    # Those that are still missing are not left out of the correction.
    corrected = dict(zip(pairs, holm(np.array([p.get(pair, 1.0) for pair in pairs])), strict=True))
    lines = []
    short = short_names([label for pair in pairs for label in pair])
    for pair in pairs if absent else known:
        names = " − ".join(short[label] for label in pair)
        if pair not in known:
            counts = dict.fromkeys(str(len(runs_of(scores, label, measure))) for label in pair)
            lines.append([names, ", ".join(counts), *[""] * _width(measure)])
            continue
        sides = known[pair]
        # The same runs have the same interval in whatever table they are.
        rng = np.random.default_rng(0)
        runs = str(len(sides.ours)) if sides.paired else f"{len(sides.ours)}, {len(sides.theirs)}"
        better = _improvement(sides, measure, rng)
        lines.append(
            [
                *(names, runs),
                *_cells(sides, pair, measure, worlds, rng, level=0.05 / len(pairs)),
                *(_p(p[pair]), _p(corrected[pair])),
                f"{better.value:.2f} {_ends(better, '.2f')}",
            ]
        )
    if measure == "actions":
        head = ["median", "other median"]
    else:
        head = ["difference", "95 %, over runs", "found with 80 %"]
    if measure == "success":
        head.insert(2, "95 %, over runs and worlds")
    head += ["p", f"corrected for {len(pairs)}", "better run, 95 %"]
    return markdown(["", "runs", *head], lines)


def arm_lines(
    scores: Scores, labels: Sequence[str], primary: str, worlds: Mapping[str, pd.DataFrame]
) -> str:
    """A table of the measures of each arm, that with the highest primary measure first."""
    lines = []
    short = short_names(labels)
    there = [label for label in labels if label in scores]
    tested = any(scores[label]["success"].notna().any() for label in there)
    for label in sorted(there, key=lambda each: -_mean(scores[each][primary])):
        runs, rng = scores[label], np.random.default_rng(0)
        area, success = runs["area"].to_numpy(), runs["success"].dropna().to_numpy()
        of_area = _cut(mean_interval(area, rng=rng))
        middle = _cut(interquartile_interval(area, rng=rng))
        never = int(np.isinf(runs["actions"]).sum())
        cells = [short[label], str(len(runs))]
        cells += [f"{of_area.value:.3f} {_ends(of_area)}", f"{middle.value:.3f} {_ends(middle)}"]
        cells += [median_of(runs["actions"]), f"{never} of {len(runs)}"]
        if len(success):
            rate = _cut(mean_interval(success, rng=rng))
            both = _cut(mean_over_worlds(*_matrix(worlds[label]), rng=rng))
            cells += [f"{rate.value:.1%} {_ends(rate, '.1%')}", _ends(both, ".1%")]
        lines.append([*cells, *[""] * (8 - len(cells))] if tested else cells)
    head = ["runs", "area, 95 % over runs", "its interquartile mean", f"actions to {GOAL:.0%}"]
    head += ["never"]
    if tested:
        head += ["success of the last policy, 95 % over runs", "over runs and worlds"]
    return markdown(["", *head], lines) if lines else ""


def kind_lines(rows: Rows, labels: Sequence[str]) -> str:
    """A table of the success of last policies by kind of world, mean of the runs."""
    if not len(rows.tests):
        return ""
    kinds = rows.tests["world"].map(family).rename("kind")
    of_runs = rows.tests.groupby(["arm", kinds, "seed"], sort=False)["success"].mean()
    means = of_runs.groupby(level=[0, 1], sort=False).mean().unstack()
    short = short_names(labels)
    lines = [
        [
            short[label],
            *(
                "" if math.isnan(v) else f"{v:.1%}"
                for v in np.asarray(means.loc[label], dtype=float)
            ),
        ]
        for label in labels
        if label in means.index
    ]
    return markdown(["", *means.columns], lines) if lines else ""


def study_tables(table: Table, rows: Rows, *, absent: str) -> str:
    """Everything in words and numbers that the rows say on the question of a table."""
    scores, worlds = scores_of(rows, table), worlds_of(rows, table)
    labels = list(dict.fromkeys([*(a for panel in table.panels.values() for a in panel), *scores]))
    order = sorted(MEASURES, key=lambda name: name != table.primary)
    arms = arm_lines(scores, labels, table.primary, worlds)
    words = {"height": table.height, "goal": f"{GOAL:.0%}", "note": table.note}
    words |= {"few": str(_PAIRS), "fewest": str(FEWEST)}
    notes = map(_filled, NOTES.format(**words).split("\n\n"))
    parts = [f"# {table.name}: {table.question}", *notes, "## Arms", arms]
    if kinds := kind_lines(rows, labels):
        parts += ["## Success of the last policy by kind of world", kinds]
    for which, pairs in (("Planned", table.planned), ("Other", table.explored)):
        for measure in order:
            planned = which == "Planned"
            lines = comparison_lines(scores, pairs, measure, worlds, absent=planned)
            title = "primary measure, " if measure == table.primary else ""
            title += MEASURES[measure].format(**words)
            parts += [f"## {which} comparisons: {title}", lines] * bool(lines)
    if absent:
        parts += ["## Missing", *map(_filled, absent.split("\n\n"))]
    return "\n\n".join(part for part in parts if part)


def _filled(paragraph: str) -> str:
    """A paragraph, or a command, in lines that fit a page."""
    if not paragraph.startswith(" "):
        return fill(paragraph, _WIDTH)
    lines = ["   "]
    for word in shlex.split(paragraph):
        if len(lines[-1]) + len(shlex.quote(word)) > _WIDTH:
            lines[-1] += " \\"
            lines.append("       ")
        lines[-1] += f" {shlex.quote(word)}"
    return "\n".join(lines)


def _cells(
    sides: Sides,
    pair: Pair,
    measure: str,
    worlds: Mapping[str, pd.DataFrame],
    rng: np.random.Generator,
    *,
    level: float,
) -> list[str]:
    """Difference, intervals, and what could have been found; of actions the medians."""
    ours, theirs = sides.ours, sides.theirs
    if measure == "actions":
        return [median_of(ours), median_of(theirs)]
    if sides.paired:
        gap = mean_interval(ours - theirs, rng=rng)
        deviation = float((ours - theirs).std(ddof=1))
        least = paired_difference_found(deviation, len(ours), level=level)
    else:
        gap = difference_interval(ours, theirs, rng=rng)
        freedom = len(ours) + len(theirs) - 2
        squares = sum(float(((each - each.mean()) ** 2).sum()) for each in (ours, theirs))
        deviation = math.sqrt(squares / freedom)
        least = difference_found(deviation, len(ours), len(theirs), level=level)
    cells = [
        f"{gap.value:+.3f}",
        _ends(gap, "+.3f"),
        "none" if math.isinf(least) else f"{least:.3f}",
    ]
    if measure == "success":
        a, b = (worlds[label] for label in pair)
        both = ""
        if sides.paired:
            common = (a - b[a.columns]).dropna()
            both = _ends(mean_over_worlds(*_matrix(common), rng=rng), "+.3f")
        cells.insert(2, both)
    return cells


def _width(measure: str) -> int:
    return {"area": 6, "success": 7, "actions": 5}[measure]


def _improvement(sides: Sides, measure: str, rng: np.random.Generator) -> Interval:
    sign = -1.0 if measure == "actions" else 1.0
    return improvement_interval(
        sign * sides.ours, sign * sides.theirs, paired=sides.paired, rng=rng
    )


def _matrix(success: pd.DataFrame) -> tuple[Array, list[str]]:
    """Success by run and world, and the kind of each world."""
    return success.to_numpy(dtype=float), kinds_of(success)


def _mean(values: pd.Series) -> float:
    found = float(values.mean())
    return -math.inf if math.isnan(found) else found


def _cut(share: Interval) -> Interval:
    """The part of an interval that a share can lie in."""
    return Interval(share.value, *np.clip([share.low, share.high], 0.0, 1.0))


def _ends(interval: Interval, form: str = ".3f") -> str:
    if math.isnan(interval.low):
        return "one run"
    return f"[{interval.low:{form}}, {interval.high:{form}}]"


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else f"{value:.3f}"
