"""Table F as data, and its rows: scores of the tasks, and their mean."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from benchmarks.study.gym.runs import Run, wanted
from benchmarks.study.gym.tasks import TASKS
from benchmarks.study.gym.training import METHODS
from benchmarks.study.protocol import FIRST_SEED, Pair, Table
from benchmarks.study.rows import Rows

SEEDS = range(FIRST_SEED, FIRST_SEED + 10)
FOLDER = "gym"
"""Of the runs, in that of the study."""
ALL = "all tasks"
"""What the mean of the tasks goes by."""
_COLUMNS = ["arm", "seed", "total_steps", "success", "return"]


def label_of(task: str, method: str) -> str:
    """What an arm is called.

    Examples:
        >>> label_of("Pendulum-v1", "per")
        'gym/Pendulum-v1/per'
    """
    return f"gym/{task}/{method}"


def _pairs(task: str, *pairs: str) -> tuple[Pair, ...]:
    named = (pair.split("-") for pair in pairs)
    return tuple((label_of(task, a), label_of(task, b)) for a, b in named)


_UNIFORM = tuple(f"{method}-uniform" for method in METHODS if method != "uniform")
_OTHERS = ("mpfa_per-per", "mpfa_plus-per", "mpfa_plus-mpfa_per")
TABLE_F = Table(
    "F",
    "Off navigation: do priorities pay on tasks of Gymnasium?",
    (),
    _pairs(ALL, *_UNIFORM),
    (
        *_pairs(ALL, *_OTHERS),
        *(pair for task in TASKS for pair in _pairs(task, *_UNIFORM, *_OTHERS)),
    ),
    {name: tuple(label_of(name, method) for method in METHODS) for name in (ALL, *TASKS)},
    height="score",
    note="Score: total reward of a greedy episode, between two bounds of its task.",
)
"""Each method and uniform replay, in the mean of the tasks; the rest is exploratory."""


def read_runs(folder: Path) -> Rows:
    """The rows of the runs that are at their end."""
    found = []
    for run in runs_in(folder):
        if run.is_done():
            table = pd.read_csv(run.evaluations)
            table = table.rename(columns={"actions": "total_steps", "score": "success"})
            table["arm"] = label_of(run.settings.task, run.settings.method)
            table["seed"] = run.settings.seed
            found.append(table[_COLUMNS].round({"success": 6, "return": 3}))
    none = pd.DataFrame(columns=_COLUMNS)
    return Rows(pd.concat(found, ignore_index=True) if found else none)


def with_mean(rows: Rows) -> Rows:
    """Rows with arms for the mean of the tasks, of the seeds that a method has in all of them."""
    curves = rows.curves
    methods = curves["arm"].str.rsplit("/", n=1).str[-1]
    groups = curves.assign(arm="gym/" + ALL + "/" + methods).groupby(
        ["arm", "seed", "total_steps"], sort=False
    )
    means = groups.agg(success=("success", "mean"), tasks=("success", "size")).reset_index()
    whole = means[means["tasks"] == len(TASKS)].drop(columns="tasks")
    return Rows(pd.concat([whole, curves], ignore_index=True), rows.tests)


def runs_in(folder: Path) -> list[Run]:
    """All runs of the table, in the order in which they are made."""
    return wanted(list(TASKS), METHODS, SEEDS, folder)


def missing(rows: Rows, folder: Path) -> str:
    """Which runs have no rows, and the command that makes them."""
    there = set(rows.curves[["arm", "seed"]].itertuples(index=False, name=None))
    absent = [
        run.name
        for run in runs_in(folder)
        if (label_of(run.settings.task, run.settings.method), run.settings.seed) not in there
    ]
    if not absent:
        return ""
    command = f"python -m benchmarks.study gym --folder {folder}"
    return f"Missing: {', '.join(absent)}.\n\n    {command}"
