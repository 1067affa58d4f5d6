"""The paper's tables, with its numbers beside those of runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import pandas as pd

from benchmarks.study.paper import NAMES, TABLE_2, TABLE_3, TABLE_4, TESTS, Tested
from training.comparison.report import table
from training.figures import Runs


def unseen_table(tested: Runs, paper: Mapping[str, Tested]) -> str:
    """Collisions, success and time in the unseen world: Table 2 or 4."""
    lines = []
    for method, row in paper.items():
        runs = tested.get(method, {})
        time = [each.loc[each["success"], "time_s"].mean() for each in runs.values()]
        lines.append(
            [
                NAMES[method],
                str(row.collisions),
                _over(runs, lambda each: TESTS * each["collision"].mean(), "{:.1f}"),
                f"{row.success:.1%}",
                _over(runs, lambda each: each["success"].mean(), "{:.1%}"),
                f"{row.time:.1f}",
                _mean(time, "{:.1f}"),
                str(len(runs)),
            ]
        )
    head = ["", f"collisions of {TESTS}, paper", "ours", "success, paper", "ours"]
    return table([*head, "time [s], paper", "ours", "runs"], lines)


def trained_table(trained: Runs) -> str:
    """Time and steps of the training: Table 3."""
    lines = []
    for method, row in TABLE_3.items():
        runs = trained.get(method, {})
        lines.append(
            [
                NAMES[method],
                f"{row.minutes:,}",
                _over(runs, lambda each: each["seconds"].iloc[-1] / 60, "{:,.1f}"),
                f"{row.steps:,}",
                _over(runs, lambda each: each["total_steps"].iloc[-1], "{:,.0f}"),
                str(len(runs)),
            ]
        )
    return table(["", "time [min], paper", "ours", "steps, paper", "ours", "runs"], lines)


def paper_tables(trained: Runs, tested: Runs) -> str:
    """Tables 2 to 4."""
    return "\n\n".join(
        [
            "## Table 2: parts of the method in the unseen world",
            unseen_table(tested, TABLE_2),
            "## Table 3: time and steps of the training",
            trained_table(trained),
            "## Table 4: other methods in the unseen world",
            unseen_table(tested, TABLE_4),
        ]
    )


def _over(
    runs: Mapping[str, pd.DataFrame], value: Callable[[pd.DataFrame], float], form: str
) -> str:
    """Mean of a value over runs."""
    return _mean([value(each) for each in runs.values()], form)


def _mean(values: list[float], form: str) -> str:
    mean = pd.Series(values, dtype=float).mean()
    return "" if pd.isna(mean) else form.format(mean)
