"""Make runs on goal tasks of gymnasium-robotics, and keep their rows.

    python -m benchmarks.goals search             choose the settings, by HER on seeds of its own
    python -m benchmarks.goals                    make the runs, write docs/results/goals.csv, and
                                                  what was sampled into goals_replay.csv beside it
    python -m benchmarks.goals --kept             print the tables of the kept rows
    python -m benchmarks.goals exploratory        the same of arms that show why, with rows in
                                                  goals_exploratory.csv
    python -m benchmarks.goals --tasks FetchReach-v4 --arms HER uniform --seeds 100 101

Runs are those of ``examples/gymnasium_td3.py``, and for *SB3's HER* of Stable-Baselines3's TD3 with
its own buffer. A run has its rows in the file as soon as it has ended, and is not made again: the
same command continues. It needs the extras ``robotics`` and ``peers``.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import fields
from itertools import product
from pathlib import Path
from typing import Any, Final

import pandas as pd

import gymnasium_td3 as page
from benchmarks.planned import Planned, planned_table
from benchmarks.rivals import missing
from torchrl_mpfa import METHODS
from training.comparison.report import interval, number, table
from training.comparison.scores import COLUMNS
from training.files import run_script
from training.records import area_under, read_table, write_table
from training.statistics import mean_interval

KEPT = Path(__file__).parents[1] / "docs" / "results" / "goals.csv"
SEARCHED, EXPLORED = (KEPT.with_name(f"goals_{name}.csv") for name in ("search", "exploratory"))
SB3, PER, MPFA = "SB3's HER", "PER with hindsight", "MPFA-PER with hindsight"
HINDSIGHT = ["--hindsight", "4"]
ARMS: Final[Mapping[str, Sequence[str]]] = {
    "uniform": ["--replay", "uniform"],
    "HER": ["--replay", "her"],
    PER: ["--replay", "per", *HINDSIGHT],
    MPFA: ["--replay", "mpfa_per", *HINDSIGHT],
    "half batches with hindsight": ["--replay", "uniform_halves", *HINDSIGHT],
}
"""What an arm says beside the settings of the task."""
EXPLORATORY: Final[Mapping[str, Sequence[str]]] = {
    "MPFA-PER, neither raised nor decayed": ["--replay", "mpf_per", *HINDSIGHT],
    "reward and TD error": ["--replay", "td_reward", *HINDSIGHT],
    "TD error and action gradient": ["--replay", "td_loss", *HINDSIGHT],
    "PER, raised": ["--replay", "raise", *HINDSIGHT],
    "HER, two updates a step": ["--replay", "her", "--updates", "2"],
    "HER, two updates of half a batch": [
        "--replay",
        "her",
        "--updates",
        "2",
        "--batch-size",
        "128",
    ],
    "HER, eight goals an episode": ["--replay", "her", "--hindsight", "8"],
}
"""Parts of MPFA-PER with hindsight, more updates, and more goals."""
EVERY: Final = {**ARMS, SB3: (), **EXPLORATORY}
STEPS: Final[Mapping[str, int]] = {
    "FetchReach-v4": 5_000,
    "PointMaze_UMaze-v3": 30_000,
    "PointMaze_Medium-v3": 60_000,
    "FetchPush-v4": 100_000,
}
"""Steps of a run, of which twenty have an evaluation after them."""
PLANNED: Final = tuple(STEPS)[:3]
"""Tasks of the planned comparisons."""
POSITIVE: Final[Mapping[str, float]] = {"FetchReach-v4": -0.5, "FetchPush-v4": -0.5}
"""Level above which a reward is positive: a step costs 1 there until the goal."""
COMMON: Final = {"width": 64, "batch-size": 256, "start": 1_000}
_FAST: Final = {"gamma": 0.98, "tau": 0.05, "noise": 0.3}
CHOSEN: Final[Mapping[str, Mapping[str, float]]] = {
    "FetchReach-v4": _FAST,
    "PointMaze_UMaze-v3": _FAST,
    "PointMaze_Medium-v3": _FAST,
    "FetchPush-v4": _FAST,
}
"""What the search chose for each task; FetchPush had none, and has what all the others have."""
CANDIDATES: Final = [
    {"gamma": gamma, "tau": tau, "noise": noise}
    for gamma, tau, noise in product((0.95, 0.98), (0.005, 0.05), (0.1, 0.3))
]
SAMPLED: Final = {
    "share/reward": "share of the reward",
    "share/td_error": "of the TD error",
    "share/action_gradient": "of the action gradient",
    "positive_fraction_buffer": "positive in the buffer",
    "positive_fraction_batch": "positive in a batch",
    "effective_sample_size": "effective sample size",
}
"""What is kept of the statistics of a replay (``docs/metrics.md``), and how a table names it."""
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
) -> tuple[pd.DataFrame, pd.DataFrame | None]:
    """Make a run; return its scores and, where priorities decide, what was sampled."""
    words = words_of(task, seed, settings)
    name: dict[str, Any] = {"task": task, "method": arm, "seed": seed}
    if arm == SB3:
        from benchmarks.sb3_goals import train

        scores = pd.DataFrame(train(page.parse(words)[0]), columns=["steps", "score"])
        return scores.assign(**name)[list(COLUMNS)], None
    made = page.main([*words, *words_of_arm(arm, task), "--folder", str(folder)])
    scores, said = (
        read_table(made / file).assign(**name) for file in (page.SCORES, page.STATISTICS)
    )
    return scores[list(COLUMNS)], sampled(said, arm)


def words_of_arm(arm: str, task: str) -> list[str]:
    """Return what an arm says, and above which reward is positive to a method that asks for it."""
    words = [*EVERY[arm]]
    asks = {field.name for field in fields(METHODS[words[1]])}
    if task in POSITIVE and "positive_above" in asks:
        words.append(f"--positive-above={POSITIVE[task]}")
    return words


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


def sampled_of(kept: Path) -> Path:
    """Return the file of what was sampled, beside that of the scores."""
    return kept.with_name(f"{kept.stem}_replay.csv")


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


def areas(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the area under the curve of each run."""
    found = [
        {"task": task, "method": arm, "seed": seed, "area": area_under(of["steps"], of["score"])}
        for (task, arm, seed), of in rows.groupby(["task", "method", "seed"])
    ]
    return pd.DataFrame(found)


def tables(kept: Path = KEPT) -> str:
    """Return what the design planned, a table of each task, and what was sampled."""
    rows = read_table(kept)
    of_runs = areas(rows)
    parts = [planned_differences(of_runs)]
    for task in [name for name in STEPS if (rows["task"] == name).any()]:
        parts += [f"## {task}", task_table(rows[rows["task"] == task], of_runs)]
    if sampled_of(kept).exists():
        parts += ["## What was sampled", sampled_table(read_table(sampled_of(kept)))]
    return "\n\n".join(parts)


def planned_differences(of_runs: pd.DataFrame) -> str:
    """Return the planned table, or which runs it still needs."""
    # Stable-Baselines3 and a task that is apart are in no planned comparison.
    areas_of = of_runs[of_runs["task"].isin(PLANNED) & of_runs["method"].isin(list(ARMS))]
    runs = areas_of.pivot_table("area", "seed", ["method", "task"])
    runs = runs.reindex(columns=pd.MultiIndex.from_product([list(ARMS), PLANNED]))
    short = runs.isna().any() | (not len(runs))
    if short.any():
        names = [f"{arm} on {task}" for (arm, task), lacks in short.items() if lacks]
        return f"The planned comparisons need more runs: {', '.join(names)}."
    mean = runs.T.groupby(level=0).mean()

    def planned(ours: str, theirs: str) -> Planned:
        sides = ({str(s): float(v) for s, v in mean.loc[arm].items()} for arm in (ours, theirs))
        return Planned(f"{ours} − {theirs}", "area, mean of the tasks", *sides)

    uniform, her, per, mpfa, halves = ARMS
    primary = [planned(per, her)]
    secondary = [planned(mpfa, per), planned(halves, her), planned(her, uniform)]
    return planned_table(primary, secondary)


def task_table(rows: pd.DataFrame, of_runs: pd.DataFrame) -> str:
    """Return a task's areas and last scores: means, their intervals, and each run."""
    task, lines = rows["task"].iloc[0], []
    for arm in [name for name in EVERY if (rows["method"] == name).any()]:
        own = of_runs[(of_runs["task"] == task) & (of_runs["method"] == arm)]["area"].to_numpy()
        of_arm = rows[rows["method"] == arm].sort_values("steps")
        last = of_arm.groupby("seed")["score"].last().to_numpy()
        line = [arm]
        for found in (own, last):
            middle = mean_interval(found)
            line += [number(middle.value), interval(middle, [found], number)]
        lines.append([*line, ", ".join(f"{value:.2f}" for value in own)])
    return table(["arm", "area", "95 %", "at the end", "95 %", "area of each run"], lines)


def explored_table(explored: Path = EXPLORED, kept: Path = KEPT) -> str:
    """Return mean areas of exploratory arms in each task, beside those of the design.

    Seeds are those of which each exploratory arm has a run.
    """
    by_run, found = ["task", "seed"], [areas(read_table(file)) for file in (explored, kept)]
    ours, beside = (rows.pivot(index=by_run, columns="method", values="area") for rows in found)
    runs = ours.dropna().join(beside).dropna(axis=1, how="all")
    tasks = [task for task in STEPS if task in runs.index]
    lines = []
    for arm in [name for name in {**ARMS, **EXPLORATORY} if name in runs]:
        line = [arm]
        for task in tasks:
            own = runs.loc[task][arm].dropna().to_numpy()
            middle = mean_interval(own) if len(own) else None
            line += [number(middle.value), interval(middle, [own], number)] if middle else ["", ""]
        lines.append(line)
    heads = [head for task in tasks for head in (f"{task}, {len(runs.loc[task])} runs", "95 %")]
    return table(["arm", *heads], lines)


def sampled_table(rows: pd.DataFrame) -> str:
    """Return what was sampled in each task: means over evaluations after updates, and runs."""
    learned = rows.dropna(subset="effective_sample_size")
    lines = []
    for (task, arm), found in learned.groupby(["task", "method"], sort=False):
        means = found[list(SAMPLED)].mean().tolist()
        lines.append([str(task), str(arm), *("" if v != v else number(v) for v in means)])
    return table(["task", "arm", *SAMPLED.values()], lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Search, make the missing runs, or print the tables; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.goals",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "what", nargs="?", choices=["runs", "search", "exploratory"], default="runs"
    )
    parser.add_argument("--tasks", nargs="+", choices=list(STEPS), default=list(PLANNED))
    parser.add_argument("--arms", nargs="+", choices=list(EVERY), help="in place of all")
    parser.add_argument("--seeds", nargs="+", type=int, help="in place of those of the design")
    parser.add_argument("--folder", type=Path, default=Path("runs/goals"), help="of the runs")
    parser.add_argument("--output", type=Path, help="of the rows")
    parser.add_argument("--kept", action="store_true", help="print tables of kept rows alone")
    options = parser.parse_args(arguments)
    if options.what == "search":
        print(search(options.tasks, options.folder / "search", options.output or SEARCHED))
        return 0
    exploratory = options.what == "exploratory"
    kept = options.output or (EXPLORED if exploratory else KEPT)
    if not options.kept:
        usual = EXPLORATORY if exploratory else [*ARMS, SB3]
        seeds = {SB3: SB3_SEEDS} if options.seeds is None else {}
        arms = {arm: seeds.get(arm, options.seeds or SEEDS) for arm in options.arms or usual}
        make(options.tasks, arms, options.folder, kept)
    print(explored_table(kept) if exploratory else tables(kept))
    return 0


if __name__ == "__main__":
    run_script(main)
