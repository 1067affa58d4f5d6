"""The paper's Tables 2 to 4 with our numbers next to theirs, and the comparisons of methods."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from benchmarks.paper.failures import ratio_interval, ratio_text
from benchmarks.paper.published import NAMES, PHIS, TABLE_3, TESTS, Tested
from benchmarks.paper.rows import Rows
from benchmarks.paper.runs import CLAIMS, LETTER, ONE_ROBOT
from mpfa_envs.evaluation.results import Interval
from training.comparison.report import table
from training.statistics import (
    Array,
    detectable,
    difference_interval,
    holm,
    mean_interval,
    permutation_p,
    sign_p,
)

FEWEST = 6
"""Seeds in common from which two arms are compared seed by seed: the least p is 0.03."""


def measures(rows: Rows) -> dict[str, pd.DataFrame]:
    """Return collisions, success and time of each run in the unseen world, by arm and seed.

    The time is the mean of the tests that reached the goal [s].
    """
    tests = rows.tests.assign(time=rows.tests["time_s"].where(rows.tests["success"] == 1))
    found = tests.groupby(["arm", "seed"])[["collision", "success", "time"]].mean()
    return {str(arm): runs.droplevel("arm") for arm, runs in found.groupby("arm")}


def unseen_table(found: Mapping[str, pd.DataFrame], paper: Mapping[str, Tested]) -> str:
    """Return Table 2 or 4: collisions, success and time in the unseen world."""
    lines = []
    for method, row in paper.items():
        runs = found.get(f"ddpg-{method}")
        ours = (
            ["", "", ""]
            if runs is None
            else [
                number(TESTS * runs["collision"], "{:.1f}", highest=TESTS),
                share(runs["success"]),
                number(runs["time"], "{:.1f}"),
            ]
        )
        theirs = [f"{row.collisions}", f"{row.success:.1%}", f"{row.time:.1f}"]
        pairs = (cell for both in zip(theirs, ours, strict=True) for cell in both)
        lines.append([NAMES[method], *pairs, _count(runs)])
    ours_head = "ours, 95 %"
    head = ["", f"collisions of {TESTS}: paper", ours_head, "success: paper", ours_head]
    return table([*head, "time [s]: paper", ours_head, "runs"], lines)


def trained_table(rows: Rows) -> str:
    """Return Table 3: steps and time of the training."""
    lines = []
    for method, row in TABLE_3.items():
        arm = f"ddpg-{method}"
        steps = pd.Series([each["total_steps"].iloc[-1] for each in rows.episodes(arm).values()])
        minutes = rows.times.loc[rows.times["arm"] == arm, "minutes"]
        lines.append(
            [
                NAMES[method],
                f"{row.steps:,}",
                number(steps, "{:,.0f}"),
                str(len(steps)),
                f"{row.minutes:,}",
                number(minutes, "{:.2f}"),
                str(len(minutes)),
            ]
        )
    head = ["", "steps: paper", "ours, 95 %", "runs", "time [min]: paper", "ours, 95 %"]
    return table([*head, "runs alone"], lines)


def arms_table(found: Mapping[str, pd.DataFrame], arms: Mapping[str, str]) -> str:
    """Return success, collisions and time of arms by their names, those without runs left out."""
    lines = [
        [
            name,
            share(found[arm]["success"]),
            number(TESTS * found[arm]["collision"], "{:.1f}", highest=TESTS),
            number(found[arm]["time"], "{:.1f}"),
            _count(found[arm]),
        ]
        for name, arm in arms.items()
        if arm in found
    ]
    head = ["", "success, 95 %", f"collisions of {TESTS}, 95 %", "time [s], 95 %", "runs"]
    return table(head, lines) if lines else "No run is kept yet."


OTHER_ARMS = {
    "φ": {f"φ = {phi}": f"ddpg-mpfa_per-phi{phi}" for phi in PHIS},
    "letter": {NAMES[name]: f"plain-{name}-{LETTER.name}" for name in CLAIMS},
    "robots": {
        f"{NAMES[name]}, {robots}": f"ddpg-{name}{end}"
        for name in CLAIMS[:2]
        for robots, end in (("one robot", f"-{ONE_ROBOT.name}"), ("sixteen robots", ""))
    },
}
"""Arms in addition to the thirteen methods, by their names in the tables."""


@dataclass(frozen=True)
class Difference:
    """The difference in success between two arms, tested over runs."""

    ours: str
    theirs: str
    seeds: int
    """Seeds in common, or runs of the arm with fewer if the arms are not paired."""
    gap: Interval
    p: float
    """Of the permutation test."""
    detectable: float
    """Difference that a test at its level finds with 80 % power; NaN for arms not paired."""
    ratio: Interval
    """Ratio of failures; its ends are NaN for arms not paired."""


def difference(
    found: Mapping[str, pd.DataFrame], ours: str, theirs: str, *, tests: int = 1
) -> Difference | None:
    """Compare the success of two arms, by seed where they have enough seeds in common.

    Return None if an arm has fewer than two runs. ``tests`` comparisons are corrected together.
    """
    if ours not in found or theirs not in found:
        return None
    a, b = found[ours]["success"], found[theirs]["success"]
    common = a.index.intersection(b.index)
    if min(len(a), len(b)) < 2:
        return None
    if len(common) < FEWEST:
        x, y = a.to_numpy(), b.to_numpy()
        fewer = min(len(x), len(y))
        gap, p = difference_interval(x, y), permutation_p(x, y)
        whole = ratio_interval(1.0 - x, 1.0 - y, paired=False).value
        no_ends = Interval(whole, math.nan, math.nan)
        return Difference(ours, theirs, fewer, gap, p, math.nan, no_ends)
    gaps = (a[common] - b[common]).to_numpy()
    least = detectable(float(gaps.std(ddof=1)), len(gaps), level=0.05 / tests)
    x, y = (1.0 - runs[common].to_numpy(dtype=float) for runs in (a, b))
    ratio = ratio_interval(x, y, paired=True)
    return Difference(ours, theirs, len(gaps), mean_interval(gaps), sign_p(gaps), least, ratio)


def comparison_table(
    found: Mapping[str, pd.DataFrame],
    pairs: Sequence[tuple[str, str]],
    published: Mapping[str, float],
) -> str:
    """Return a table of pairs of arms, corrected by Holm's method, with the paper's success."""
    differences = [difference(found, *pair, tests=len(pairs)) for pair in pairs]
    corrected = holm(np.array([1.0 if gap is None else gap.p for gap in differences]))
    lines = []
    for pair, made, p in zip(pairs, differences, corrected, strict=True):
        theirs = [published[arm] for arm in pair if arm in published]
        ratio, points = "", ""
        if len(theirs) == 2:
            ratio = f"{(1.0 - theirs[0]) / (1.0 - theirs[1]):.2f}"
            points = _points(theirs[0] - theirs[1])
        cells = [" − ".join(map(_name, pair)), ratio]
        if made is None:
            lines.append([*cells, "", points, *[""] * 5])
            continue
        ends = f"[{_points(made.gap.low)}, {_points(made.gap.high)}]"
        single = f"{made.ratio.value:.2f}"
        failed = single if math.isnan(made.ratio.low) else ratio_text(made.ratio)
        least = "" if math.isnan(made.detectable) else f"{100 * made.detectable:.1f}"
        cells += [failed, points, f"{_points(made.gap.value)} {ends}"]
        lines.append([*cells, f"{made.p:.3f}", f"{p:.3f}", least, f"{made.seeds}"])
    head = ["", "ratio of failures: paper", "ours, 95 %", "success [points]: paper", "ours, 95 %"]
    head += ["p", f"p corrected for {len(pairs)}", "found with 80 % power [points]", "seeds"]
    return table(head, lines)


def number(runs: Iterable[float], form: str, *, highest: float = math.inf) -> str:
    """Format the mean of counts or times and its 95 % interval, from 0 to the highest."""
    values = np.asarray(list(runs), dtype=float)
    return _mean(values, form, lowest=0.0, highest=highest) if len(values) else ""


def share(runs: pd.Series) -> str:
    """Format the mean of shares and its 95 % interval, which ends at 0 and 100 %."""
    return _mean(runs.to_numpy(dtype=float), "{:.1%}", lowest=0.0, highest=1.0)


def _mean(runs: Array, form: str, *, lowest: float, highest: float) -> str:
    """Format the mean of runs and its 95 % interval within bounds."""
    found = mean_interval(runs)
    if math.isnan(found.low):
        return form.format(found.value)
    ends = max(found.low, lowest), min(found.high, highest)
    return f"{form.format(found.value)} [{form.format(ends[0])}, {form.format(ends[1])}]"


def _count(runs: pd.DataFrame | None) -> str:
    return "0" if runs is None else str(len(runs))


def _points(value: float) -> str:
    # Without the sign of a zero.
    return f"{100 * value:+.1f}".replace("-0.0", "+0.0")


def _name(arm: str) -> str:
    """Return the paper's name of an arm's method, with the arm's own name."""
    _, method, *rest = arm.split("-")
    kind = {"letter": "closer to the paper", "one_robot": "one robot"}
    words = [kind.get(each, each.replace("phi", "φ = ")) for each in rest]
    return ", ".join([NAMES[method], *words])
