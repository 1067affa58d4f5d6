"""Do actions of 0.4 s help where every step is rewarded? Make the runs, and keep their rows.

    python -m benchmarks.durations             train, evaluate, write docs/results/durations
    python -m benchmarks.durations --kept      print the tables of the kept rows

An arm has ``regime=rooms`` but for what :data:`ARMS` changes: half of the actions of twice the
duration, and as many updates, evaluations and seconds of exploration. All policies, and ``mpc``
once, drive the same tasks on wheels. Rows are added after each seed, and runs that have rows are
not made again: the same command continues. Tables are printed once all runs are there, or with
``--kept``; the last one has what the design planned. A difference of times is one of logarithms.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.paper.rows import arm_of, write_rows
from benchmarks.paper.runs import finished, without
from benchmarks.planned import Planned, planned_table
from training import files
from training.comparison.arms import Arm
from training.comparison.execution import make_runs
from training.comparison.jobs import SCRIPTS, Comparison, Evaluation
from training.comparison.report import difference_table, interval, table
from training.options import check_least
from training.records import read_table
from training.settings.train import register
from training.statistics import mean_interval
from training.worlds import family

KEPT = Path(__file__).parents[1] / "docs/results/durations"
METHOD = "mpfa_per"
"""The method of ``train.py`` unless another is named."""
LEARNERS = ("td3", "ddpg")
SEEDS = range(640, 650)
_LONGER = (
    *("environment.action_repeat=4", "actions=15000", "updates=8", "evaluation.every=2500"),
    *("exploration.random_steps=1000", "exploration.annealing_steps=10000"),
)
ARMS = (
    Arm("short"),
    Arm("long", _LONGER),
    # The square of 0.95: the horizon in seconds is that of the short actions.
    Arm("near", (*_LONGER, "learner.gamma=0.9025")),
)
SETTINGS = ("regime=rooms", "tracking=off", "learner.compile=false", "evaluation.every=5000")
NAMES = {"short": "0.2 s", "long": "0.4 s", "near": "0.4 s, γ of 0.9025"}
WORLDS = tuple(f"{kind}:test" for kind in ("rooms", "clutter", "bars", "fields", "halls", "mazes"))
EPISODES = 50
TESTS = ["arm", "seed", "world", "episode", "success", "collision", "time_s"]
CURVES = ["arm", "seed", "total_steps", "success"]
PLANNER = "mpc"
_MEASURES = ("success", "time over `mpc`")


def comparison(folder: Path, seeds: Sequence[int] = SEEDS) -> Comparison:
    """Return the comparison of all runs.

    Examples:
        >>> len(comparison(Path("runs/durations")).jobs)
        60
    """
    evaluation = Evaluation(WORLDS, EPISODES, physics="wheels")
    return Comparison(folder, (METHOD,), SETTINGS, seeds, LEARNERS, ARMS, evaluation)


def keep(planned: Comparison, kept: Path) -> None:
    """Add the rows of finished runs to those that are kept."""
    for name, columns in (("tests", TESTS), ("curves", CURVES)):
        path = kept / f"{name}.csv.gz"
        rows = read_table(path)
        there = set() if not len(rows) else set(zip(rows["arm"], rows["seed"], strict=True))
        tables = [rows] if len(rows) else []
        for of, job in finished([planned]):
            if (arm_of(job), job.seed) not in there:
                results = job.results(of.evaluation) / files.EPISODES
                source = results if name == "tests" else job.path / files.EVALUATIONS
                new = read_table(source).assign(arm=arm_of(job), seed=job.seed)
                tables.append(new[columns])
        if tables:
            write_rows(pd.concat(tables), path)


def keep_planner(folder: Path, kept: Path) -> None:
    """Drive the tasks with predictive control, unless it has rows."""
    path = kept / "tests.csv.gz"
    kept_rows = read_table(path)
    if not len(kept_rows) or PLANNER not in set(kept_rows["arm"]):
        script = [sys.executable, str(SCRIPTS / "evaluate.py"), "--policy", PLANNER]
        options = ["--robot", "kobuki", "--filter", "--physics", "wheels", "--no-pictures"]
        tasks = ["--episodes", str(EPISODES), "--worlds", *WORLDS]
        subprocess.run([*script, *options, *tasks, "--output", str(folder / PLANNER)], check=True)
        rows = read_table(folder / PLANNER / files.EPISODES)
        new = rows.assign(arm=PLANNER, seed=0)[TESTS]
        write_rows(pd.concat([kept_rows, new]) if len(kept_rows) else new, path)


def make(folder: Path, kept: Path, jobs: int) -> int:
    """Make the runs without rows, and keep their rows; return the exit status."""
    keep_planner(folder, kept)
    for seed in SEEDS:
        planned = comparison(folder, (seed,))
        tests = read_table(kept / "tests.csv.gz")
        names = [] if not len(tests) else [f"{arm}-{seed}" for arm, seed in _runs(tests)]
        for part in without(planned, set(names)):
            # The parts of a seed may have different arms.
            if status := make_runs(part, most=jobs):
                return status
            keep(part, kept)
    return 0


def _runs(tests: pd.DataFrame) -> list[tuple[str, int]]:
    """Return arm and seed of the runs in a table."""
    return list(tests[["arm", "seed"]].drop_duplicates().itertuples(index=False, name=None))


def measures(rows: pd.DataFrame) -> pd.DataFrame:
    """Return success, collisions and time over the planner of each run; each kind counts the same.

    The time is a geometric mean over the tasks that both reach. ``log_time`` is its logarithm.
    """
    tasks = ["world", "episode"]
    planner, tests = (found for _, found in rows.groupby(rows["arm"] != PLANNER))
    theirs = planner[planner["success"] == 1].set_index(tasks)["time_s"].rename("theirs")
    joined = tests.join(theirs, on=tasks).assign(kind=tests["world"].map(family))
    both = joined[joined["success"] == 1]
    joined["log_time"] = np.log(both["time_s"] / both["theirs"])
    of_kind = joined.groupby(["arm", "seed", "kind"])[["success", "collision", "log_time"]].mean()
    of_run = of_kind.groupby(["arm", "seed"]).mean().reset_index()
    mazes = of_kind["success"].xs("mazes:test", level="kind").reset_index(drop=True)
    return of_run.assign(mazes=mazes, time=np.exp(of_run["log_time"]))


def tables(kept: Path = KEPT) -> list[str]:
    """Return what each arm reached, and the differences between the arms of each learner."""
    found = measures(read_table(kept / "tests.csv.gz"))
    lines, differences = [], []
    for learner in LEARNERS:
        of_learner: dict[str, dict[str, dict[str, float]]] = {name: {} for name in _MEASURES}
        for arm, name in NAMES.items():
            runs = found[found["arm"] == f"{learner}-{METHOD}-{arm}"]
            if not len(runs):
                continue
            cells = [learner.upper(), name, str(len(runs))]
            for column, form in (("success", "{:.2%}"), ("time", "{:.3f}")):
                values = runs[column].to_numpy(dtype=float)
                reach = interval(mean_interval(values), [values], form.format)
                cells += [form.format(values.mean()), reach]
            ends = [f"{runs['mazes'].mean():.1%}", f"{runs['collision'].mean():.2%}"]
            lines.append([*cells, *ends])
            seeds = runs["seed"].astype(str)
            for measure, column in zip(_MEASURES, ("success", "log_time"), strict=True):
                of_learner[measure][name] = dict(zip(seeds, runs[column], strict=True))
        differences += [f"### {learner.upper()}", difference_table(of_learner)]
    head = ["learner", "actions", "runs", "success", "95 %", "time over `mpc`", "95 %"]
    return [table([*head, "mazes", "collisions"], lines), *differences]


def answer(kept: Path = KEPT) -> str:
    """Return the four differences that the design planned, corrected together."""
    found = measures(read_table(kept / "tests.csv.gz"))
    planned = []
    for learner in LEARNERS:
        short, long = (
            found[found["arm"] == f"{learner}-{METHOD}-{arm}"] for arm in ("short", "long")
        )
        for measure, column in zip(_MEASURES, ("success", "log_time"), strict=True):
            sides = (
                dict(zip(runs["seed"].astype(str), runs[column], strict=True))
                for runs in (long, short)
            )
            planned.append(Planned(f"{learner.upper()}: 0.4 s − 0.2 s", measure, *sides))
    return planned_table(planned)


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the missing runs, or print the tables; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.durations",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--jobs", type=int, default=2, help="runs at once (default: 2)")
    parser.add_argument("--folder", type=Path, default=Path("runs/durations"), help="of the runs")
    parser.add_argument("--output", type=Path, default=KEPT, help="folder of the rows")
    parser.add_argument("--kept", action="store_true", help="print tables of kept rows alone")
    options = parser.parse_args(arguments)
    check_least(parser, options, jobs=1)
    if not options.kept:
        register()
        if status := make(options.folder, options.output, options.jobs):
            return status
    print("\n\n".join([*tables(options.output), answer(options.output)]))
    return 0


if __name__ == "__main__":
    files.run_script(main)
