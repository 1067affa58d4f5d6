"""Tables of studies in Markdown, out of the rows of their episodes and evaluations."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations

import numpy as np
import pandas as pd

from mpfa_envs.evaluation.results import Interval
from training.report.intervals import (
    Array,
    bootstrap_runs,
    bootstrap_runs_and_pairs,
    interquartile_mean,
    mean,
    probability_of_improvement,
    t_interval,
)
from training.report.permutation import least_p, permutation_p
from training.report.power import MOST, runs_needed

GOAL = 0.9
"""Greedy success in validation that the speed of each run is told by."""
RATES = (0.9, 0.95)
"""Those that the time to is told of."""
_DIFFERENCES = (0.02, 0.05)
_ARM = ("learner", "method", "arm")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def scores(rows: pd.DataFrame, column: str) -> Array:
    """Values of a column, shape ``[runs, pairs]``; flags are 0 and 1.

    Args:
        rows: Evaluation episodes of one arm, each of its runs on the same pairs.
        column: Its name.

    Returns:
        The values, runs in the order in which they come first.

    Raises:
        ValueError: If a run lacks pairs that another one has.
    """
    matrix = rows.pivot(index="run", columns=["world", "episode"], values=column)
    matrix = matrix.loc[rows["run"].unique()].astype(float)
    if matrix.isna().to_numpy().any():
        raise ValueError(f"the runs {', '.join(matrix.index)} were not tested on the same pairs")
    return matrix.to_numpy()


def outcome_table(rows: pd.DataFrame) -> str:
    """Success of each run, and means over the runs."""
    lines = []
    width = _width(rows["arm"])
    for arm, found in rows.groupby("arm", sort=False):
        success, time = scores(found, "success"), scores(found, "time_s")
        reached = time[success == 1.0]
        rates = [f"{scores(found, name).mean():.1%}" for name in ("collision", "timeout")]
        lines.append(
            [
                *_cells(str(arm), width),
                f"{success.mean():.1%}",
                ", ".join(f"{value:.1%}" for value in success.mean(axis=1)),
                *rates,
                f"{scores(found, 'spl').mean():.3f}",
                f"{reached.mean():.1f}" if reached.size else "",
            ]
        )
    head = [*_ARM[:width], "success", "of each run", "collision", "timeout", "SPL"]
    return table([*head, "time [s]"], lines)


def success_table(rows: pd.DataFrame) -> str:
    """Success of each arm in each world or generator, and in brackets that of its worst run."""
    arms = list(rows["arm"].unique())
    families = {str(name): found for name, found in rows.groupby("family", sort=False)}
    lines = []
    for name, found in (families | {"all": rows}).items():
        driven = {str(arm): each for arm, each in found.groupby("arm")}
        if name == "all":
            driven = {arm: each for arm, each in driven.items() if _is_whole(each, len(families))}
        lines.append([name, *(_worst(driven[arm]) if arm in driven else "" for arm in arms)])
    return table(["mean of the runs (the worst one)", *arms], lines)


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
    width = _width(curves)
    for arm, runs in curves.items():
        firsts, areas = [], []
        for found in runs.values():
            reached = found.loc[found["success"] >= GOAL, "total_steps"]
            firsts.append(f"{reached.iloc[0]:,.0f}" if len(reached) else "never")
            areas.append(area_under(found["total_steps"], found["success"]))
        each = ", ".join(f"{value:.3f}" for value in areas)
        lines.append([*_cells(arm, width), "; ".join(firsts), f"{np.mean(areas):.3f}", each])
    head = [*_ARM[:width], f"steps to {GOAL:.0%}, each run", "area under the curve"]
    return table([*head, "of each run"], lines)


def rate_table(curves: Mapping[str, Mapping[str, pd.DataFrame]]) -> str:
    """Actions and time of training after which validation first had a rate of success."""
    lines = []
    width = _width(curves)
    for arm, runs in curves.items():
        for rate in RATES:
            steps = [_first(found, rate, "total_steps") for found in runs.values()]
            seconds = [_first(found, rate, "trained_for") for found in runs.values()]
            never = sum(math.isinf(each) for each in steps)
            medians = [median_of(each) for each in (steps, seconds)]
            lines.append([*_cells(arm, width), f"{rate:.0%}", *medians, f"{never} of {len(runs)}"])
    head = [*_ARM[:width], "success", "actions, median of the runs", "seconds of training, median"]
    return table([*head, "never"], lines)


def area_under(steps: pd.Series, values: pd.Series) -> float:
    """Mean height of a curve that starts at zero, over its steps."""
    x, y = np.concatenate(([0.0], steps)), np.concatenate(([0.0], values))
    return float(np.trapezoid(y, x) / x[-1])


def median_of(values: Iterable[float]) -> str:
    """The median of what runs took, of an even number the lower of the two in the middle.

    Args:
        values: Of each run; infinite where it never came so far.

    Returns:
        The median: "never" if more than half of the runs never came so far, empty for NaN.

    Examples:
        >>> median_of([4000.0, 2000.0, math.inf, math.inf]), median_of([2000.0, math.inf, math.inf])
        ('4,000', 'never')
    """
    middle = float(np.quantile(np.array(list(values)), 0.5, method="inverted_cdf"))
    if math.isnan(middle):
        return ""
    return "never" if math.isinf(middle) else f"{middle:,.0f}"


def _first(found: pd.DataFrame, rate: float, column: str) -> float:
    """Value of a column where a rate of success is first reached; infinite if it never is."""
    reached = found[found["success"] >= rate]
    if not len(reached):
        return math.inf
    return float(reached[column].iloc[0]) if column in found else math.nan


def _worst(rows: pd.DataFrame) -> str:
    """Mean success of the runs of an arm, and in brackets the run with the lowest."""
    of_runs = scores(rows, "success").mean(axis=1)
    if len(of_runs) == 1:
        return f"{of_runs[0]:.1%}"
    name = rows["run"].unique()[of_runs.argmin()]
    return f"{of_runs.mean():.1%} ({name}: {of_runs.min():.1%})"


def _is_whole(rows: pd.DataFrame, families: int) -> bool:
    """Whether each run was driven in all of them."""
    return bool((rows.groupby("run")["family"].nunique() == families).all())


def _width(arms: Iterable[str]) -> int:
    """Columns that the names of arms take: two, or three where a study has arms of its own."""
    return max(arm.count("/") for arm in arms) + 1


def _cells(arm: str, width: int) -> list[str]:
    return [*arm.split("/"), *[""] * width][:width]


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
    return f"{ours.mean() - theirs.mean():+.3f}, p = {permutation_p(ours, theirs):.3f}"
