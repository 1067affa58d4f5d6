"""Make the runs that say whether PER is needed where rewards are rare, and keep their rows.

    python -m benchmarks.rivals              train, evaluate, write docs/results/rivals.csv
    python -m benchmarks.rivals --kept       print the tables of the kept rows

Every arm has the settings of ``examples/sparse.yaml`` but for its method. Rows are added to the
file after every five seeds of an arm, and runs that have rows are not made again: the same command
continues. Tables are printed once all runs are there, or with ``--kept``; the last one has what the
design planned. Rows are those of ``benchmarks.sparse``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from benchmarks import sparse
from benchmarks.planned import Planned, planned_table
from training.comparison.report import difference_table
from training.comparison.scores import COLUMNS, runs_by_task
from training.files import run_script
from training.records import area_under, read_table, write_table

KEPT = sparse.KEPT.with_name("rivals.csv")
REGIME = "simple"
METHODS = (
    "PER with hindsight",
    "HER",
    "MPFA-PER with hindsight",
    "half batches with hindsight",
    "uniform",
)
SEEDS = range(620, 640)
BLOCK = 5
"""Seeds of an arm that are made before the next arm."""


def missing(rows: pd.DataFrame, name: str, seeds: Sequence[int]) -> list[int]:
    """Return the seeds of a method that have no rows."""
    if not len(rows):
        return list(seeds)
    there = set(rows.loc[rows["method"] == name, "seed"])
    return [seed for seed in seeds if seed not in there]


def make(folder: Path, kept: Path, jobs: int) -> int:
    """Make the runs without rows and keep their rows; return the exit status."""
    for first in range(0, len(SEEDS), BLOCK):
        for name in METHODS:
            rows = read_table(kept)
            if seeds := missing(rows, name, SEEDS[first : first + BLOCK]):
                arm = f"{REGIME}: {name}"
                if status := sparse.make(arm, folder, seeds, jobs):
                    return status
                new = pd.DataFrame(sparse.rows_of(arm, folder), columns=list(COLUMNS))
                write_table(pd.concat([rows, new]) if len(rows) else new, kept)
    return 0


def mazes(kept: Path = KEPT) -> str:
    """Return the differences of all arms in mazes, which the design kept apart: exploratory."""
    runs = runs_by_task([kept])[f"{REGIME}, mazes"]
    last = {arm: {seed: float(run[1][-1]) for seed, run in of.items()} for arm, of in runs.items()}
    return difference_table({"success in mazes, exploratory": last})


def answer(kept: Path = KEPT) -> str:
    """Return the differences that the design planned, of kept rows."""
    tasks = runs_by_task([kept])
    curves, last = tasks[f"{REGIME}, validation"], tasks[f"{REGIME}, test"]
    area = {
        arm: {seed: area_under(*run) for seed, run in runs.items()} for arm, runs in curves.items()
    }
    ends = {
        arm: {seed: float(run[1][-1]) for seed, run in runs.items()} for arm, runs in last.items()
    }

    def planned(ours: str, theirs: str, measure: str = "area") -> Planned:
        of_arm = area if measure == "area" else ends
        return Planned(f"{ours} − {theirs}", measure, of_arm[ours], of_arm[theirs])

    per, her, mpfa, halves, uniform = METHODS
    secondary = [planned(mpfa, per), planned(halves, her), planned(her, uniform)]
    return planned_table(
        [planned(per, her)], [*secondary, planned(per, her, "success of the last policy")]
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the missing runs, or print the tables; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.rivals",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--jobs", type=int, default=2, help="runs at once (default: 2)")
    parser.add_argument("--folder", type=Path, default=Path("runs/rivals"), help="of the runs")
    parser.add_argument("--output", type=Path, default=KEPT, help="of the rows")
    parser.add_argument("--kept", action="store_true", help="print tables of kept rows alone")
    options = parser.parse_args(arguments)
    if not options.kept and (status := make(options.folder, options.output, options.jobs)):
        return status
    tables = *sparse.tables(options.output), mazes(options.output), answer(options.output)
    print("\n\n".join(tables))
    return 0


if __name__ == "__main__":
    run_script(main)
