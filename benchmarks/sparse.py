"""Make the runs of docs/results/sparse.md, and keep their rows.

    python -m benchmarks.sparse                       train, evaluate, write docs/results/sparse.csv
    python -m benchmarks.sparse --jobs 8 --arms "charged: HER"    some; made runs are left alone

Rows have the columns of ``report.py``: of *validation* one for each evaluation of a run, of *test*
one for its last policy in test worlds without mazes, of *mazes* one in mazes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

import compare
from training import files
from training.comparison.scores import COLUMNS
from training.records import read_table, write_table
from training.worlds import family

KEPT = Path(__file__).parents[1] / "docs/results/sparse.csv"
ACTIONS = 24_000
SETTINGS = (
    *("regime=rooms", f"actions={ACTIONS}", "updates=4", "environment.progress=none"),
    *("environment.max_steps=300", "environment.action_repeat=4"),
    *("learner.gamma=0.97", "learner.tau=0.01", "learner.lr_power=3"),
    *("evaluation.world=mixed:validation", "evaluation.every=2000", "evaluation.episodes=40"),
    *("evaluation.choose=false", "tracking=off"),
)
REGIMES = {
    "near goals": ("environment.filter_cost=0", "environment.max_goal_distance=6"),
    "charged": ("environment.filter_cost=0.5", "environment.max_goal_distance=12"),
}
"""Chosen for HER on the seeds 500 to 503, and for PER with hindsight."""
METHODS = {
    "PER with hindsight": ("per", 4),
    "HER": ("her", 4),
    "MPFA-PER with hindsight": ("mpfa_per", 4),
    "PER": ("per", 0),
    "MPFA-PER": ("mpfa_per", 0),
    "uniform": ("uniform", 0),
}
"""Method and goals in hindsight for each transition."""
ARMS = {
    f"{regime}: {name}": (regime, name)
    for regime in ("charged", "near goals")
    for name in METHODS
    if regime == "near goals" or METHODS[name][1]
}
"""Regime and method of each arm, in the order in which they are run."""
SEEDS = range(600, 620)
WORLDS = tuple(f"{kind}:test" for kind in ("rooms", "clutter", "bars", "fields", "halls", "mazes"))
_EPISODES = 20


def folder_of(arm: str, folder: Path) -> Path:
    """Folder of the runs of an arm."""
    return folder / arm.replace(": ", "-").replace(" ", "-")


def make(arm: str, folder: Path, seeds: Sequence[int], jobs: int) -> int:
    """Train and evaluate the runs of an arm; return the exit status."""
    regime, name = ARMS[arm]
    method, goals = METHODS[name]
    return compare.main(
        [
            *("--folder", str(folder_of(arm, folder)), "--methods", method),
            *("--seeds", *map(str, seeds), "--jobs", str(jobs), "--worlds", *WORLDS),
            *("--episodes", str(_EPISODES), "--physics", "kinematic"),
            *("--", *SETTINGS, *REGIMES[regime], f"method.hindsight={goals}"),
        ]
    )


def rows_of(arm: str, folder: Path) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of the runs of an arm."""
    regime, name = ARMS[arm]
    for run in sorted(folder_of(arm, folder).glob("*/evaluations.csv")):
        seed = run.parent.name.rsplit("-", 1)[1]
        found = read_table(run)
        for steps, success in zip(found["total_steps"], found["success"], strict=True):
            yield f"{regime}, validation", name, seed, steps, success
    tests = read_table(folder_of(arm, folder) / files.EPISODES)
    kinds = tests["world"].map(family)
    of_kind = tests["success"].groupby([tests["seed"], kinds]).mean().unstack()
    for number, success in of_kind.iterrows():
        mazes = success.pop("mazes:test")
        yield f"{regime}, test", name, number, ACTIONS, success.mean()
        yield f"{regime}, mazes", name, number, ACTIONS, mazes


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the runs that are missing and write the rows; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.sparse",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS), metavar="ARM")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--jobs", type=int, default=2, help="runs at once (default: 2)")
    parser.add_argument("--folder", type=Path, default=Path("runs/sparse"), help="of the runs")
    parser.add_argument("--output", type=Path, default=KEPT, help="of the rows")
    options = parser.parse_args(arguments)
    for arm in options.arms:
        if status := make(arm, options.folder, options.seeds, options.jobs):
            return status
    made = [arm for arm in ARMS if (folder_of(arm, options.folder) / files.EPISODES).exists()]
    rows = [row for arm in made for row in rows_of(arm, options.folder)]
    write_table(pd.DataFrame(rows, columns=list(COLUMNS)), options.output)
    print(f"written: {options.output}; now: report.py {options.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
