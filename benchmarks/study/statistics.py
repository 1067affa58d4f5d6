"""Make every statistic of comparisons, from the rows that ``compare.py`` kept.

    python -m benchmarks.study statistics docs/results --output runs/results
    python -m benchmarks.study statistics docs/results docs/results/more --output runs/six

It writes what ``examples/report.py`` does, with more in ``tables.md``: bootstrap intervals over
runs and over runs and pairs, interquartile means, probabilities of improvement, the runs that a
difference needs, and the area under the curve of each run. ``docs/results/paper_task.md`` has the
tables of the rows in ``docs/results``.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
import pandas as pd

from benchmarks.study.intervals import (
    Array,
    bootstrap_runs,
    bootstrap_runs_and_pairs,
    interquartile_mean,
    mean,
    probability_of_improvement,
    t_interval,
)
from benchmarks.study.permutation import least_p
from benchmarks.study.power import MOST, runs_needed
from benchmarks.study.rows import GOAL
from mpfa_envs.evaluation.results import Interval
from training.comparison.report import (
    ARM,
    cells,
    columns_of,
    outcomes,
    permutation_p,
    rate_table,
    scores,
    table,
    write_report,
)
from training.records import area_under

_DIFFERENCES = (0.02, 0.05)


def interval_table(rows: pd.DataFrame) -> str:
    """Means of each arm with intervals for other runs, and for other runs and pairs."""
    rng = np.random.default_rng(0)
    lines = []
    for arm, found in rows.groupby("arm", sort=False):
        for column, label in (("success", "success"), ("spl", "SPL")):
            values = scores(found, column)
            intervals = (
                t_interval(values),
                bootstrap_runs(mean, values, rng=rng),
                bootstrap_runs_and_pairs(mean, values, rng=rng),
            )
            middle = bootstrap_runs(interquartile_mean, values, rng=rng)
            lines.append(
                [
                    str(arm),
                    f"{len(values)}",
                    label,
                    f"{values.mean():.3f}",
                    *(_ends(each) for each in intervals),
                    f"{middle.value:.3f} {_ends(middle)}" if column == "spl" else "",
                ]
            )
    head = ["", "runs", "", "mean", "t over runs", "bootstrap over runs", "over runs and pairs"]
    return table([*head, "interquartile mean, over runs"], lines)


def comparison_table(rows: pd.DataFrame) -> str:
    """Differences between arms, tested over runs; empty for one arm."""
    rng = np.random.default_rng(0)
    arms = {str(arm): found for arm, found in rows.groupby("arm", sort=False)}
    lines = []
    for a, b in combinations(arms, 2):
        success = [scores(arms[name], "success") for name in (a, b)]
        spl = [scores(arms[name], "spl") for name in (a, b)]
        better = bootstrap_runs(probability_of_improvement, *spl, rng=rng)
        lines.append(
            [
                f"{a} − {b}",
                *(_difference(*pair) for pair in (success, spl)),
                f"{least_p(len(spl[0]), len(spl[1])):.3f}",
                f"{better.value:.3f} {_ends(better)}",
            ]
        )
    if not lines:
        return ""
    head = ["", "success, p", "SPL, p", "smallest attainable p"]
    return table([*head, "SPL of a pair: probability of improvement, over runs"], lines)


def power_lines(rows: pd.DataFrame) -> str:
    """How many runs it takes to see a difference, by what each learner varies from run to run."""
    lines = []
    for learner, arms in rows.groupby("learner", sort=False):
        runs = [scores(rows, "success").mean(axis=1) for _, rows in arms.groupby("arm")]
        freedom = sum(len(each) - 1 for each in runs)
        squares = sum(float(((each - each.mean()) ** 2).sum()) for each in runs)
        if squares == 0.0:
            continue
        deviation = math.sqrt(squares / freedom)
        needed = ", ".join(
            f"{_count(runs_needed(deviation, difference))} for {100 * difference:g} points"
            for difference in _DIFFERENCES
        )
        lines.append(
            f"Success of {learner} varies from run to run by {100 * deviation:.2f} points "
            f"(standard deviation, {freedom} degrees of freedom).\nRuns per method for a "
            f"t-test to find a difference with 80 % power: {needed}."
        )
    return "\n\n".join(lines)


def speed_table(curves: Mapping[str, Mapping[str, pd.DataFrame]]) -> str:
    """Steps until nine of ten validation goals are found, and area under that curve."""
    lines = []
    width = columns_of(curves)
    for arm, runs in curves.items():
        firsts, areas = [], []
        for found in runs.values():
            reached = found.loc[found["success"] >= GOAL, "total_steps"]
            firsts.append(f"{reached.iloc[0]:,.0f}" if len(reached) else "never")
            areas.append(area_under(found["total_steps"], found["success"]))
        each = ", ".join(f"{value:.3f}" for value in areas)
        lines.append([*cells(arm, width), "; ".join(firsts), f"{np.mean(areas):.3f}", each])
    head = [*ARM[:width], f"steps to {GOAL:.0%}, each run", "area under the curve"]
    return table([*head, "of each run"], lines)


def _ends(interval: Interval) -> str:
    if math.isnan(interval.low):
        return "one run"
    if interval.low == interval.high:
        # Runs that all end alike, at 0 % or 100 % as a rule, do not tell how much others differ.
        return "none, no spread"
    return f"[{interval.low:.3f}, {interval.high:.3f}]"


def _count(runs: int) -> str:
    return f"{runs}" if runs <= MOST else f"more than {MOST:,}"


def _difference(ours: Array, theirs: Array) -> str:
    p = permutation_p(ours.mean(axis=1), theirs.mean(axis=1))
    return f"{ours.mean() - theirs.mean():+.3f}, p = {p:.3f}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Read the rows, write tables and figure."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.study statistics",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    return write_report(
        parser,
        arguments,
        lambda rows: [
            outcomes(rows, interval=False),
            interval_table(rows),
            comparison_table(rows),
            power_lines(rows),
        ],
        speed_table,
        rate_table,
    )
