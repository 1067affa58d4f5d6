"""Kept rows of the paper's runs: compressed files that outlive the folders of the runs.

A folder of rows holds ``tests.csv.gz``, the tests of every run in the unseen world,
``curves.csv.gz``, its evaluations during training, ``episodes.csv.gz``, its training episodes, and
``times.csv``, training times of runs that had the machine to themselves. Its folder ``question``
holds those of the runs that decide whether MPFA-PER fails less often than PER.
"""

from __future__ import annotations

import gzip
import os
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.paper.runs import finished
from training import files
from training.comparison.jobs import Comparison, Job
from training.records import read_table

FOLDER = Path("docs/results/paper")
"""Rows of the runs that the page reports."""
QUESTION = "question"
"""Folder, within one of rows, of those that were not looked at before all of them were there."""
RUN = ["arm", "seed"]
TESTS = [*RUN, "episode", "success", "collision", "spl", "time_s"]
CURVES = [*RUN, "total_steps", "success"]
TIMES = [*RUN, "minutes"]
EPISODES = [*RUN, "world", "steps", "total_steps", "reward", "success", "collision"]
_DIGITS = {"spl": 3, "time_s": 1, "reward": 4, "minutes": 2}


@dataclass(frozen=True)
class Rows:
    """Rows of runs; an arm is called LEARNER-METHOD, or LEARNER-METHOD-NAME if it has a name."""

    folder: Path
    tests: pd.DataFrame
    """A row for each run and each pair of start and goal in the unseen world."""
    curves: pd.DataFrame
    """Success in validation: a row for each evaluation during training."""
    times: pd.DataFrame
    """Training times of runs that had the machine to themselves [min]."""

    @property
    def runs(self) -> set[str]:
        """Names of the runs."""
        found = self.tests[RUN].drop_duplicates().itertuples(index=False, name=None)
        return {f"{arm}-{seed}" for arm, seed in found}

    def seeds(self, arm: str) -> list[int]:
        """Return the seeds of the runs of an arm."""
        return sorted(
            int(seed) for seed in self.tests.loc[self.tests["arm"] == arm, "seed"].unique()
        )

    def episodes(self, arm: str) -> dict[int, pd.DataFrame]:
        """Return the training episodes of each run of an arm, by its seed."""
        return {seed: self._trained[arm, seed] for seed in self.seeds(arm)}

    @cached_property
    def _trained(self) -> dict[Any, pd.DataFrame]:
        """Training episodes of each run, by its arm and seed."""
        found = _read(self.folder / "episodes.csv.gz", EPISODES)
        return {(arm, seed): run.reset_index(drop=True) for (arm, seed), run in found.groupby(RUN)}


def read_rows(folder: Path) -> Rows:
    """Read the rows in a folder; a missing file has none."""
    named = {"tests.csv.gz": TESTS, "curves.csv.gz": CURVES, "times.csv": TIMES}
    return Rows(folder, *(_read(folder / name, columns) for name, columns in named.items()))


def _read(path: Path, columns: list[str]) -> pd.DataFrame:
    """Read a table that has its columns also where there is no file."""
    found = read_table(path)
    return found if len(found) else pd.DataFrame(columns=columns)


def keep(planned: Iterable[Comparison], folder: Path) -> list[str]:
    """Add the rows of finished runs to those in a folder; return the names of these runs."""
    kept = read_rows(folder).runs
    new = [run for run in finished(planned) if run[1].name not in kept]
    if not new:
        return []
    made: dict[str, list[pd.DataFrame]] = {"episodes": [], "curves": [], "tests": []}
    columns = {"episodes": EPISODES, "curves": CURVES, "tests": TESTS}
    for comparison, job in new:
        paths = (
            job.path / files.EPISODES,
            job.path / files.EVALUATIONS,
            job.results(comparison.evaluation) / files.EPISODES,
        )
        for (name, tables), path in zip(made.items(), paths, strict=True):
            tables.append(read_table(path).assign(arm=arm_of(job), seed=job.seed)[columns[name]])
    # The tests say which runs there are: they are written last.
    for name, tables in made.items():
        path = folder / f"{name}.csv.gz"
        there = _read(path, columns[name])
        # A process that was killed here has left rows of runs whose tests are not there.
        whole = (there["arm"] + "-" + there["seed"].astype(str)).isin(kept)
        table = pd.concat([each for each in (there[whole], *tables) if len(each)])
        write_rows(table.sort_values(RUN, kind="stable"), path)
    return [job.name for _, job in new]


def keep_time(job: Job, folder: Path) -> None:
    """Add the training time of a run that had the machine to itself to the rows in a folder."""
    evaluated = read_table(job.path / files.EVALUATIONS)["seconds"].sum()
    seconds = read_table(job.path / files.EPISODES)["seconds"].iloc[-1] - evaluated
    row = pd.DataFrame([[arm_of(job), job.seed, seconds / 60]], columns=TIMES)
    there = read_rows(folder).times
    table = pd.concat([there, row]) if len(there) else row
    write_rows(table.drop_duplicates(RUN, keep="last").sort_values(RUN), folder / "times.csv")


def arm_of(job: Job) -> str:
    """Return the name of a run without its seed."""
    return job.name.removesuffix(f"-{job.seed}")


def write_rows(table: pd.DataFrame, path: Path) -> None:
    """Write a table in one step, the same bytes for the same rows."""
    flags = table.select_dtypes(bool).columns
    text = table.astype(dict.fromkeys(flags, int)).round(_DIGITS).to_csv(index=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    data = text.encode()
    part = path.with_suffix(".part")
    part.write_bytes(gzip.compress(data, mtime=0) if path.suffix == ".gz" else data)
    os.replace(part, path)
