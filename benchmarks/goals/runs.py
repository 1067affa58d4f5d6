"""Make runs on goal tasks, and keep the rows of each as soon as it has ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd

import gymnasium_td3 as page
from benchmarks.goals.arms import (
    CANDIDATES,
    CHOSEN,
    MPFA,
    PER,
    SB3,
    SEARCH_SEEDS,
    words_of,
    words_of_arm,
)
from benchmarks.goals.tables import SAMPLED, areas, sampled_of
from benchmarks.rivals import missing
from training.comparison.scores import COLUMNS
from training.records import read_table, write_table


def run(
    task: str, arm: str, seed: int, settings: Mapping[str, float], folder: Path
) -> tuple[pd.DataFrame, pd.DataFrame | None]:
    """Make a run; return its scores and, where priorities decide, what was sampled."""
    words = words_of(task, seed, settings)
    name: dict[str, Any] = {"task": task, "method": arm, "seed": seed}
    if arm == SB3:
        from benchmarks.goals.sb3 import train

        scores = pd.DataFrame(train(page.parse(words)[0]), columns=["steps", "score"])
        return scores.assign(**name)[list(COLUMNS)], None
    made = page.main([*words, *words_of_arm(arm, task), "--folder", str(folder / arm)])
    scores, said = (
        read_table(made / file).assign(**name) for file in (page.SCORES, page.STATISTICS)
    )
    return scores[list(COLUMNS)], sampled(said, arm)


def sampled(said: pd.DataFrame, arm: str) -> pd.DataFrame | None:
    """Return what is kept of the statistics of a run; None where all are sampled alike."""
    if arm not in (PER, MPFA):
        return None
    # To PER nothing is positive, and its only signal has all of the share.
    of_arm = list(SAMPLED) if arm == MPFA else ["effective_sample_size"]
    return said.reindex(columns=[*COLUMNS[:-1], *of_arm]).reindex(columns=[*COLUMNS[:-1], *SAMPLED])


def make(tasks: Sequence[str], arms: Mapping[str, Sequence[int]], folder: Path, kept: Path) -> None:
    """Make the runs without rows, seed by seed, and keep the rows of each."""
    every = sorted({seed for seeds in arms.values() for seed in seeds})
    for seed, task, arm in product(every, tasks, arms):
        if seed in arms[arm] and missing(rows_of(kept, task), arm, [seed]):
            scores, said = run(task, arm, seed, CHOSEN[task], folder)
            if said is not None:
                add(said, sampled_of(kept))
            add(scores, kept)


def rows_of(kept: Path, task: str) -> pd.DataFrame:
    """Return the rows of a task that are kept."""
    rows = read_table(kept) if kept.exists() else pd.DataFrame(columns=list(COLUMNS))
    return rows[rows["task"] == task]


def add(rows: pd.DataFrame, kept: Path) -> None:
    """Add the rows of a run to those that are kept, in place of rows of the same run."""
    if kept.exists():
        run_of = list(COLUMNS[:3])
        before = read_table(kept)
        same = before[run_of].apply(tuple, axis=1).isin(rows[run_of].apply(tuple, axis=1))
        rows = pd.concat([before[~same], rows])
    write_table(rows, kept)


def search(tasks: Sequence[str], folder: Path, kept: Path) -> str:
    """Make HER's runs with each candidate; return the mean area of each, the best first."""
    for task, candidate, seed in product(tasks, CANDIDATES, SEARCH_SEEDS):
        name = " ".join(f"{key}={value:g}" for key, value in candidate.items())
        if missing(rows_of(kept, task), name, [seed]):
            scores, _ = run(task, "HER", seed, candidate, folder / name.replace(" ", "-"))
            add(scores.assign(method=name), kept)
    found = areas(read_table(kept)).groupby(["task", "method"])["area"].mean().reset_index()
    found = found.sort_values(["task", "area"], ascending=[True, False])
    return "\n".join(f"{r.task}: {r.method}: {r.area:.3f}" for r in found.itertuples())
