"""The rows of the study: curves and tests of each run, and the measures that are made of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.study.protocol import Table, label_of
from benchmarks.study.remaining import parts_left
from training import files
from training.comparison.jobs import Comparison, Evaluation, Job
from training.records import area_under, read_table
from training.worlds import family

GOAL = 0.9
"""Greedy success in validation that the speed of a run is told by."""
CURVES = ["arm", "seed", "total_steps", "success"]
TESTS = ["arm", "seed", "world", "episode", "success", "collision", "spl", "time_s"]
_DIGITS = {"success": 6, "spl": 3, "time_s": 1}


@dataclass(frozen=True)
class Rows:
    """What the tables and figures of a table of the study are made of."""

    curves: pd.DataFrame
    """A row for each evaluation during training: arm, seed, total_steps, success; of table F
    success is the score, and the return is beside it."""
    tests: pd.DataFrame = field(default_factory=lambda: pd.DataFrame(columns=TESTS))
    """A row for each episode of a last policy; what neither succeeded nor collided ran out of time.
    """


def read_runs(table: Table, root: Path) -> Rows:
    """The rows of the runs that are at their end."""
    curves: dict[tuple[str, int], pd.DataFrame] = {}
    tests: dict[tuple[str, int, Evaluation], pd.DataFrame] = {}
    for comparison in table.comparisons:
        for job in comparison.jobs:
            if not job.is_trained():
                continue
            run = label_of(job, root), job.seed
            curves[run] = _rows(run, job.path / files.EVALUATIONS, CURVES)
            if job.is_evaluated(comparison.evaluation):
                rows = job.results(comparison.evaluation) / files.EPISODES
                tests[(*run, comparison.evaluation)] = _rows(run, rows, TESTS)
    return Rows(together(curves.values(), CURVES), together(tests.values(), TESTS))


def scores_of(rows: Rows, table: Table) -> dict[str, pd.DataFrame]:
    """The measures of each run.

    Args:
        rows: The rows.
        table: The table.

    Returns:
        By arm a table with a row for each run, by its seed: ``area``, ``actions`` until
        :data:`GOAL` (infinite if it never had it), ``success`` of its last policy (NaN if it was
        not tested), each kind of worlds of ``table.kinds`` counting the same.
    """
    found: dict[str, dict[int, dict[str, float]]] = {}
    success = {arm: _success(worlds) for arm, worlds in worlds_of(rows, table).items()}
    for arm, seed, curve in by_run(rows.curves):
        reached = curve.loc[curve["success"] >= GOAL, "total_steps"]
        found.setdefault(arm, {})[seed] = {
            "area": area_under(curve["total_steps"], curve["success"]),
            "actions": float(reached.iloc[0]) if len(reached) else math.inf,
            "success": success.get(arm, {}).get(seed, math.nan),
        }
    return {arm: pd.DataFrame.from_dict(runs, "index") for arm, runs in found.items()}


def by_run(table: pd.DataFrame) -> Iterator[tuple[str, int, pd.DataFrame]]:
    """The rows of each run, with its arm and seed."""
    for arm, of_arm in table.groupby("arm", sort=False):
        for seed, of_run in of_arm.groupby("seed", sort=False):
            yield str(arm), int(str(seed)), of_run


def worlds_of(rows: Rows, table: Table) -> dict[str, pd.DataFrame]:
    """Success in each world of ``table.kinds``, by arm: rows by seed, columns by world.

    Of a kind with one world the columns are its pairs of start and goal. A run that was not tested
    in all worlds of its arm is left out, and an arm without one in each kind of worlds.
    """
    kinds = rows.tests["world"].map(family)
    number = rows.tests["world"].groupby(kinds).transform("nunique")
    tests = rows.tests.assign(pair=rows.tests["episode"].where(number == 1, 0))
    found = {}
    for arm, of_arm in tests[kinds.isin(table.kinds)].groupby("arm", sort=False):
        worlds = of_arm.pivot_table(
            index="seed", columns=["world", "pair"], values="success", sort=False
        )
        if set(kinds_of(worlds)) == set(table.kinds):
            found[str(arm)] = worlds.dropna()
    return found


def kinds_of(worlds: pd.DataFrame) -> list[str]:
    """The kind of each column of :func:`worlds_of`."""
    return [family(str(world)) for world in worlds.columns.get_level_values("world")]


def _success(worlds: pd.DataFrame) -> dict[int, float]:
    """Success of each run, each kind of worlds counting the same."""
    means = worlds.T.groupby(kinds_of(worlds)).mean().mean()
    return {int(str(seed)): float(value) for seed, value in means.items()}


def without_rows(comparison: Comparison, rows: Rows, root: Path) -> list[Job]:
    """The runs of a comparison that have no rows, or were not tested where they shall be."""
    trained = set(rows.curves[["arm", "seed"]].itertuples(index=False, name=None))
    kinds = rows.tests[["arm", "seed"]].assign(kind=rows.tests["world"].map(family))
    tested = set(kinds.drop_duplicates().itertuples(index=False, name=None))
    asked = {_kind(word) for word in comparison.evaluation.words}
    return [
        job
        for job in comparison.jobs
        for run in [(label_of(job, root), job.seed)]
        if run not in trained or any((*run, kind) not in tested for kind in asked)
    ]


def missing(table: Table, rows: Rows, root: Path) -> str:
    """Which runs have no rows, or were not tested, and the commands that make them."""
    lines = []
    for comparison in table.comparisons:
        absent: dict[str, list[int]] = {}
        jobs = without_rows(comparison, rows, root)
        for job in jobs:
            absent.setdefault(label_of(job, root), []).append(job.seed)
        if absent:
            names = "; ".join(f"{arm} {_span(seeds)}" for arm, seeds in absent.items())
            lines.append(f"Missing: {names}.\n")
            lines += [f"    {part.command}\n" for part in parts_left(comparison, jobs)]
    return "\n".join(lines).rstrip()


def _kind(word: str) -> str:
    """What :func:`family` says of the worlds that a word stands for."""
    name, colon, rest = word.partition(":")
    return name if colon and rest[:1].isdigit() else word


def _span(seeds: list[int]) -> str:
    whole = len(seeds) > 2 and seeds == list(range(seeds[0], seeds[-1] + 1))
    return f"{seeds[0]} to {seeds[-1]}" if whole else ", ".join(map(str, seeds))


def _rows(run: tuple[str, int], path: Path, columns: list[str]) -> pd.DataFrame:
    found = read_table(path)
    if not len(found):
        return together([], columns)
    return found.assign(arm=run[0], seed=run[1])[columns].round(_DIGITS)


def together(tables: Iterable[pd.DataFrame], columns: list[str]) -> pd.DataFrame:
    """Tables as one, with these columns if none of them has rows."""
    found: list[Any] = [each for each in tables if len(each)]
    return pd.concat(found, ignore_index=True) if found else pd.DataFrame(columns=columns)
