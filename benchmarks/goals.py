"""Make runs on goal tasks of gymnasium-robotics, and keep their rows.

    python -m benchmarks.goals search             choose the settings, by HER on seeds of its own
    python -m benchmarks.goals                    make the runs, write docs/results/goals.csv
    python -m benchmarks.goals --kept             print the tables of the kept rows
    python -m benchmarks.goals --tasks FetchReach-v4 --seeds 100 101

Runs are those of ``examples/gymnasium_td3.py``, and for *SB3's HER* of Stable-Baselines3's TD3 with
its own buffer. A run has its rows in the file as soon as it has ended, and is not made again: the
same command continues. It needs the extras ``robotics`` and ``peers``.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Final

import pandas as pd

import gymnasium_td3 as page
from benchmarks.planned import Planned, planned_table
from benchmarks.rivals import missing
from training.comparison.scores import COLUMNS, score_tables
from training.files import run_script
from training.records import area_under, read_table, write_table

KEPT = Path(__file__).parents[1] / "docs" / "results" / "goals.csv"
SEARCHED = KEPT.with_name("goals_search.csv")
SB3 = "SB3's HER"
HINDSIGHT = ["--hindsight", "4"]
ARMS: Final[Mapping[str, Sequence[str]]] = {
    "uniform": ["--replay", "uniform"],
    "HER": ["--replay", "her"],
    "PER with hindsight": ["--replay", "per", *HINDSIGHT],
    "MPFA-PER with hindsight": ["--replay", "mpfa_per", *HINDSIGHT],
    "half batches with hindsight": ["--replay", "uniform_halves", *HINDSIGHT],
}
"""What an arm says beside the settings of the task."""
STEPS: Final[Mapping[str, int]] = {
    "FetchReach-v4": 5_000,
    "PointMaze_UMaze-v3": 30_000,
    "PointMaze_Medium-v3": 60_000,
    "FetchPush-v4": 100_000,
}
"""Steps of a run, of which twenty have an evaluation after them."""
POSITIVE: Final[Mapping[str, float]] = {"FetchReach-v4": -0.5, "FetchPush-v4": -0.5}
"""Level above which a reward is positive for MPFA-PER: a step costs 1 there until the goal."""
COMMON: Final = {"width": 64, "batch-size": 256, "start": 1_000}
CHOSEN: Final[Mapping[str, Mapping[str, float]]] = {}
"""What the search chose for each task."""
CANDIDATES: Final = [
    {"gamma": gamma, "tau": tau, "noise": noise}
    for gamma, tau, noise in product((0.95, 0.98), (0.005, 0.05), (0.1, 0.3))
]
SEARCH_SEEDS: Final = (900, 901)
SEEDS: Final = range(100, 110)
SB3_SEEDS: Final = range(100, 105)


def words_of(task: str, seed: int, settings: Mapping[str, float]) -> list[str]:
    """Return the command line of a run but for its arm."""
    given = {**COMMON, "steps": STEPS[task], "every": STEPS[task] // 20, **settings}
    words = ["--task", task, "--seed", str(seed)]
    for name, value in given.items():
        words += [f"--{name}", str(value)]
    return words


def run(
    task: str, arm: str, seed: int, settings: Mapping[str, float], folder: Path
) -> pd.DataFrame:
    """Make a run; return its rows with the name of the arm."""
    words = words_of(task, seed, settings)
    if arm == SB3:
        from benchmarks.sb3_goals import train

        scores = train(page.parse(words)[0])
        rows = pd.DataFrame(scores, columns=["steps", "score"])
    else:
        own = [*ARMS[arm], "--folder", str(folder)]
        if arm.startswith("MPFA") and task in POSITIVE:
            own.append(f"--positive-above={POSITIVE[task]}")
        rows = read_table(page.main([*words, *own]) / page.SCORES)
    return rows.assign(task=task, method=arm, seed=seed)[list(COLUMNS)]


def make(tasks: Sequence[str], seeds: Sequence[int], folder: Path, kept: Path) -> None:
    """Make the runs without rows, seed by seed, and keep the rows of each."""
    for seed, task, arm in product(seeds, tasks, (*ARMS, SB3)):
        if arm == SB3 and seed not in SB3_SEEDS:
            continue
        rows = read_table(kept) if kept.exists() else pd.DataFrame(columns=list(COLUMNS))
        if missing(rows[rows["task"] == task], arm, [seed]):
            new = run(task, arm, seed, CHOSEN[task], folder)
            write_table(pd.concat([rows, new]) if len(rows) else new, kept)


def search(tasks: Sequence[str], folder: Path, kept: Path) -> str:
    """Make HER's runs with each candidate; return the mean area of each, the best first."""
    for task, candidate, seed in product(tasks, CANDIDATES, SEARCH_SEEDS):
        name = " ".join(f"{key}={value:g}" for key, value in candidate.items())
        rows = read_table(kept) if kept.exists() else pd.DataFrame(columns=list(COLUMNS))
        if missing(rows[rows["task"] == task], name, [seed]):
            new = run(task, "HER", seed, candidate, folder / name.replace(" ", "-"))
            new = new.assign(method=name)
            write_table(pd.concat([rows, new]) if len(rows) else new, kept)
    found = areas(read_table(kept)).groupby(["task", "method"])["area"].mean().reset_index()
    found = found.sort_values(["task", "area"], ascending=[True, False])
    return "\n".join(f"{r.task}: {r.method}: {r.area:.3f}" for r in found.itertuples())


def areas(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the area under the curve of each run."""
    found = [
        {"task": task, "method": arm, "seed": seed, "area": area_under(of["steps"], of["score"])}
        for (task, arm, seed), of in rows.groupby(["task", "method", "seed"])
    ]
    return pd.DataFrame(found)


def tables(kept: Path = KEPT) -> str:
    """Return what the design planned, and the tables of each task."""
    from training.comparison.scores import runs_by_task

    of_runs = areas(read_table(kept))
    mean = of_runs.groupby(["method", "seed"])["area"].mean()

    def planned(ours: str, theirs: str) -> Planned:
        sides = ({str(s): float(v) for s, v in mean[arm].items()} for arm in (ours, theirs))
        return Planned(f"{ours} − {theirs}", "area, mean of the tasks", *sides)

    uniform, her, per, mpfa, halves = ARMS
    primary = [planned(per, her)]
    secondary = [planned(mpfa, per), planned(halves, her), planned(her, uniform)]
    parts = [planned_table(primary, secondary)]
    for task, runs in runs_by_task([kept]).items():
        parts += [f"## {task}", *score_tables(runs)]
    return "\n\n".join(parts)


def main(arguments: Sequence[str] | None = None) -> int:
    """Search, make the missing runs, or print the tables; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.goals",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", nargs="?", choices=["runs", "search"], default="runs")
    parser.add_argument("--tasks", nargs="+", choices=list(STEPS), default=list(STEPS)[:3])
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    parser.add_argument("--folder", type=Path, default=Path("runs/goals"), help="of the runs")
    parser.add_argument("--output", type=Path, help="of the rows")
    parser.add_argument("--kept", action="store_true", help="print tables of kept rows alone")
    options = parser.parse_args(arguments)
    if options.what == "search":
        print(search(options.tasks, options.folder / "search", options.output or SEARCHED))
        return 0
    kept = options.output or KEPT
    if not options.kept:
        make(options.tasks, options.seeds, options.folder, kept)
    print(tables(kept))
    return 0


if __name__ == "__main__":
    run_script(main)
