"""Tables and curves of scores that any script wrote: rows of task, method, seed, steps, score."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from mpfa_envs.render.charts import Curve
from training import files
from training.comparison.report import difference_table, interval, number, table, write_tables
from training.figures import plot_scores
from training.records import checked_numbers, checked_words, read_words
from training.statistics import mean_interval

COLUMNS = ("task", "method", "seed", "steps", "score")
CURVES = "curves.png"
Runs = dict[str, dict[str, Curve]]
"""Curves of the runs of a task, by method and seed."""


def write_scores(paths: Sequence[Path], output: Path) -> str:
    """Write ``tables.md`` and ``curves.png``.

    Args:
        paths: Tables of scores, or folders of such tables.
        output: Folder of the two files.

    Returns:
        The tables.

    Raises:
        ValueError: If there are no scores, a table is damaged, or the output is no folder.
    """
    files.check_folder(output)
    tasks = runs_by_task(paths)
    parts = [part for task, runs in tasks.items() for part in (f"## {task}", *score_tables(runs))]
    text = write_tables([*parts, f"![Scores over steps: mean of the runs]({CURVES})"], output)
    plot_scores(tasks, output / CURVES)
    return text


def runs_by_task(paths: Sequence[Path]) -> dict[str, Runs]:
    """Read tables of scores as curves by task, method and seed."""
    return {str(task): runs_of(found) for task, found in read_scores(paths).groupby("task")}


def read_scores(paths: Sequence[Path]) -> pd.DataFrame:
    """Read tables of scores: files, or all in folders that have their columns."""
    tables = []
    for path in paths:
        found = [path] if path.is_file() else sorted(path.rglob("*.csv"))
        for file in found:
            rows = read_words(file)
            missing = [name for name in COLUMNS if name not in rows]
            if not missing and len(rows):
                tables.append(_checked(rows[list(COLUMNS)].copy(), file))
            elif missing and path.is_file():
                raise ValueError(f"{file} must have the columns {', '.join(COLUMNS)}: no {missing}")
    if not tables:
        names = ", ".join(map(str, paths))
        raise ValueError(
            f"{names}: neither {files.EPISODES} of compare.py nor rows of {', '.join(COLUMNS)}"
        )
    rows = pd.concat(tables, ignore_index=True)
    twice = rows[rows.duplicated(["task", "method", "seed", "steps"])]
    if len(twice):
        one = ", ".join(f"{name} {twice.iloc[0][name]}" for name in COLUMNS[:-1])
        raise ValueError(
            f"{twice.iloc[0]['line']}: a run must have one score at each step, got two of {one}"
        )
    return rows


def _checked(rows: pd.DataFrame, file: Path) -> pd.DataFrame:
    """Return the rows with steps and scores as numbers; raise where they are none."""
    names = ["task", "method", "seed"]
    checked_words(rows, names, file)
    for name in ("steps", "score"):
        rows[name] = checked_numbers(rows, name, file)
    for name in names:
        rows[name] = rows[name].str.strip()
    rows["seed"] = rows["seed"].map(_seed)
    rows["line"] = [f"{file}:{index + 2}" for index in rows.index]
    return rows


def _seed(text: str) -> str:
    """Return a seed as an integer is written: a column that once had a gap has 1.0 for 1."""
    return re.sub(r"^(-?\d+)\.0*$", r"\1", text)


def runs_of(rows: pd.DataFrame) -> Runs:
    """Return the curves of one task, in the order of the rows."""
    runs: Runs = {}
    for (method, seed), found in rows.groupby(["method", "seed"], sort=False):
        found = found.sort_values("steps")
        curve = found["steps"].to_numpy(), found["score"].to_numpy()
        runs.setdefault(str(method), {})[str(seed)] = curve
    return runs


def score_tables(runs: Runs) -> list[str]:
    """Return what the columns are, a table of the methods, and one of their differences."""
    curves = [curve for of_method in runs.values() for curve in of_method.values()]
    begin = max(steps[0] for steps, _ in curves)
    end = min(steps[-1] for steps, _ in curves)
    if end < begin:
        raise ValueError(f"runs must have steps in common, got one to {end:g}, one from {begin:g}")
    last, mean = f"score at {end:,.0f} steps", "mean of the curve"
    values = {
        name: {
            method: {seed: height(curve, first, end) for seed, curve in of_method.items()}
            for method, of_method in runs.items()
        }
        for name, first in ((last, end), (mean, begin))
    }
    lines = []
    for method in runs:
        line = [method]
        for name in (last, mean):
            found = np.array(list(values[name][method].values()))
            middle = mean_interval(found)
            line += [number(middle.value), interval(middle, [found], number)]
        lines.append([*line, ", ".join(map(number, values[last][method].values()))])
    head = ["method", last, "95 %", mean, "95 %", "score of each run"]
    why = "Runs are compared up to the last step that all of them have."
    return [why, table(head, lines), difference_table(values)]


def height(curve: Curve, begin: float, end: float) -> float:
    """Return the mean height of a curve between two steps; its height where they are one."""
    steps, scores = curve
    inside = steps[(steps > begin) & (steps < end)]
    x = np.array([begin, *inside, end])
    y = np.interp(x, steps, scores)
    return float(y[-1] if begin == end else np.trapezoid(y, x) / (end - begin))
