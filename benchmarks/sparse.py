"""Make the runs of docs/results/sparse.md, and keep their rows.

    python -m benchmarks.sparse                       train, evaluate, write docs/results/sparse.csv
    python -m benchmarks.sparse --jobs 8 --arms "charged: HER"    some; made runs are left alone
    python -m benchmarks.sparse --kept                print the tables of the kept rows

Rows have the columns of ``report.py``: of *validation* one for each evaluation of a run, of *test*
one for its last policy in test worlds without mazes, of *near* and *far* one for its tasks up to
6 m and beyond, of *mazes* one in mazes, and of *changed* the share of the last policy's actions
that the filter changes.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from mpfa_envs import Policy, TaskConfig, VectorNavigationEnv, load_policy
from training import files
from training.comparison.execution import make_runs
from training.comparison.jobs import Comparison, Evaluation
from training.comparison.report import difference_table, interval, table
from training.comparison.scores import COLUMNS, runs_by_task
from training.records import area_under, read_table, write_table
from training.settings.train import register
from training.statistics import mean_interval
from training.worlds import family

KEPT = Path(__file__).parents[1] / "docs/results/sparse.csv"
SEARCH = KEPT.with_name("sparse_search.csv.gz")
"""Evaluations of the search, by the settings that are not those of ``before``."""
ACTIONS = 24_000
SETTINGS = (
    *("regime=rooms", f"actions={ACTIONS}", "environment.progress=none"),
    *("learner.gamma=0.97", "learner.tau=0.01"),
    *("evaluation.world=mixed:validation", "evaluation.every=2000", "evaluation.episodes=40"),
    *("evaluation.choose=false", "tracking=off"),
)
_LONGER = ("updates=4", "environment.max_steps=300", "environment.action_repeat=4")
_MENDED = (*_LONGER, "learner.lr_power=3")
_NEAR, _FAR = 6, 12
"""Longest paths of the tasks of a training [m]."""
_GOALS = "environment.max_goal_distance"
REGIMES = {
    "charged": (*_MENDED, "environment.filter_cost=0.5", f"{_GOALS}={_FAR}"),
    "near goals": (*_MENDED, "environment.filter_cost=0", f"{_GOALS}={_NEAR}"),
    "carried out": (*_MENDED, f"{_GOALS}={_NEAR}"),
    "simple": (*_LONGER, f"{_GOALS}={_NEAR}"),
    "before": ("updates=2", f"{_GOALS}={_NEAR}"),
}
"""The best of the search for PER with hindsight; the best for HER; the same with the actions that
were carried out in the buffer; this with the usual fall of the rates; that of earlier tables."""
METHODS = {
    "PER with hindsight": ("per", 4),
    "HER": ("her", 4),
    "MPFA-PER with hindsight": ("mpfa_per", 4),
    "PER": ("per", 0),
    "MPFA-PER": ("mpfa_per", 0),
    "uniform": ("uniform", 0),
    "half batches with hindsight": ("uniform_halves", 4),
}
"""Method and goals in hindsight for each transition."""
_OF_REGIME = {"charged": 3, "near goals": 6, "carried out": 1, "simple": 1, "before": 1}
ARMS = {
    f"{regime}: {name}": (regime, name)
    for regime, count in _OF_REGIME.items()
    for name in list(METHODS)[:count]
}
"""Regime and method of each arm, in the order in which they are run."""
SEEDS = range(600, 620)
WORLDS = tuple(f"{kind}:test" for kind in ("rooms", "clutter", "bars", "fields", "halls", "mazes"))
_EPISODES = 20
_GROUP = re.compile(r"^(environment|learner|method)\.")
_PARTS = {
    **{"near": f"within {_NEAR} m", "far": "farther", "mazes": "mazes"},
    "changed": "changed by the filter",
}
"""Further rows of the last policy, by the names of their columns."""
_MEASURES = ("area", "success of the last policy")
_IN_ALL = "PER with hindsight"
"""The arm of every regime."""
_HIGH = 0.9
"""Success in validation worlds that a run reaches, and may lose."""
_SEARCHED = 4
"""Seeds of an arm of the search whose mean says something."""
_JUDGED = 100
"""Actions of each of the robots that show what the filter changes."""


def folder_of(arm: str, folder: Path) -> Path:
    """Folder of the runs of an arm."""
    return folder / arm.replace(": ", "-").replace(" ", "-")


def make(arm: str, folder: Path, seeds: Sequence[int], jobs: int) -> int:
    """Train and evaluate the runs of an arm, REGIME: METHOD; return the exit status."""
    regime, name = arm.split(": ")
    method, goals = METHODS[name]
    words = (*SETTINGS, *REGIMES[regime], f"method.hindsight={goals}")
    judged = Evaluation(WORLDS, episodes=_EPISODES, physics="kinematic")
    register()
    runs = Comparison(folder_of(arm, folder), (method,), words, seeds, evaluation=judged)
    return make_runs(runs, most=jobs)


def rows_of(arm: str, folder: Path) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of the evaluated runs of an arm."""
    regime, name = arm.split(": ")
    tests = read_table(folder_of(arm, folder) / files.EPISODES)
    runs = {str(seed): [*folder_of(arm, folder).glob(f"*-{seed}")] for seed in tests["seed"]}
    for seed, [run] in runs.items():
        curve = read_table(run / files.EVALUATIONS)
        for steps, success in zip(curve["total_steps"], curve["success"], strict=True):
            yield f"{regime}, validation", name, seed, steps, success
    kinds = tests["world"].map(family)
    of_kind = tests["success"].groupby([tests["seed"], kinds]).mean().unstack()
    for seed, [run] in runs.items():
        changed = changed_share(load_policy(run / files.POLICY))
        yield f"{regime}, changed", name, seed, ACTIONS, changed
    for number, success in of_kind.iterrows():
        mazes = success.pop("mazes:test")
        yield f"{regime}, test", name, number, ACTIONS, success.mean()
        yield f"{regime}, mazes", name, number, ACTIONS, mazes
    near = (tests["shortest_path"] <= _NEAR).map({True: "near", False: "far"})
    open_worlds = tests["success"][kinds != "mazes:test"]
    for (number, place), success in open_worlds.groupby([tests["seed"], near]):
        yield f"{regime}, {place}", name, number, ACTIONS, success.mean()


def changed_share(policy: Policy) -> float:
    """Share of the actions of a policy that the filter changes, in validation worlds."""
    keep = TaskConfig(**policy.env_arguments).make_filter()
    task = {**policy.env_arguments, "split": "validation", "contact": True}
    env = VectorNavigationEnv(num_envs=64, world="mixed", **task)
    seen, _ = env.reset(seed=0)
    changed = []
    for _ in range(_JUDGED):
        wanted = policy(seen)
        kept = keep(seen, wanted)
        changed.append((kept != wanted).any(axis=1))
        seen, *_ = env.step(kept)
    env.close()
    return float(np.mean(changed))


def tables(path: Path = KEPT) -> list[str]:
    """Return what each arm reached, and the differences within each regime, of kept rows."""
    tasks = runs_by_task([path])
    lines, differences = [], []
    everywhere: dict[str, dict[str, dict[str, float]]] = {name: {} for name in _MEASURES}
    for regime in (regime for regime in REGIMES if f"{regime}, validation" in tasks):
        curves = tasks[f"{regime}, validation"]
        area = {
            arm: {seed: area_under(*run) for seed, run in runs.items()}
            for arm, runs in curves.items()
        }
        last = {
            kind: {
                arm: {seed: float(run[1][-1]) for seed, run in runs.items()}
                for arm, runs in tasks[f"{regime}, {kind}"].items()
            }
            for kind in ("test", *_PARTS)
        }
        for arm, of_arm in area.items():
            areas, tested = (np.array(list(of[arm].values())) for of in (area, last["test"]))
            shares = [np.mean(list(last[kind][arm].values())) for kind in _PARTS]
            curve = [run[1] for run in curves[arm].values()]
            reached = sum(max(success) >= _HIGH for success in curve)
            kept = sum(success[-1] >= _HIGH for success in curve)
            lines.append(
                [
                    *(regime, arm, f"{len(of_arm)}, {reached}, {kept}", *_mean(areas, ".2f")),
                    *(*_mean(tested, ".1%"), f"{tested.min():.0%}"),
                    *(f"{share:.0%}" for share in shares),
                ]
            )
        measures = dict(zip(_MEASURES, (area, last["test"]), strict=True))
        for name, of_arms in measures.items():
            everywhere[name][regime] = of_arms[_IN_ALL]
        if len(area) > 1:
            differences += [f"### {regime.capitalize()}", difference_table(measures)]
    if len(everywhere[_MEASURES[0]]) > 1:
        differences += [f"### {_IN_ALL}, by regime", difference_table(everywhere)]
    head = [
        "regime",
        "arm",
        "runs, reach 90 %, end so",
        "area",
        "95 %",
        "last policy",
        "95 %",
        "worst run",
    ]
    return [table([*head, *_PARTS.values()], lines), *differences]


def search_table(path: Path = SEARCH) -> str:
    """Return what the arms of the search with four seeds reached, by their areas."""
    found = read_table(path).fillna({"note": ""})
    lines = []
    for (settings, note), rows in found.groupby(["settings", "note"]):
        runs = [run for _, run in rows.groupby("seed")]
        if len(runs) == _SEARCHED:
            areas = [area_under(run["steps"], run["success"]) for run in runs]
            last = [run["success"].iloc[-1] for run in runs]
            shown = [f"{np.mean(areas):.2f}", f"{np.mean(last):.0%}", f"{min(last):.0%}"]
            words = [f"`{_GROUP.sub('', word)}`" for word in str(settings).split()]
            lines.append([", ".join(words) + f"; {note}" * bool(note), *shown])
    lines.sort(key=lambda line: line[1], reverse=True)
    return table(["settings", "area", "last policy", "worst run"], lines)


def _mean(runs: NDArray[np.float64], form: str) -> tuple[str, str]:
    """Write the mean of runs and its interval."""
    found = mean_interval(runs)
    return f"{found.value:{form}}", interval(found, [runs], lambda end: f"{end:{form}}")


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
    parser.add_argument("--kept", action="store_true", help="print tables of kept rows alone")
    options = parser.parse_args(arguments)
    if options.kept:
        print("\n\n".join([*tables(options.output), search_table()]))
        return 0
    for arm in options.arms:
        if status := make(arm, options.folder, options.seeds, options.jobs):
            return status
    made = [arm for arm in ARMS if (folder_of(arm, options.folder) / files.EPISODES).exists()]
    rows = [row for arm in made for row in rows_of(arm, options.folder)]
    write_table(pd.DataFrame(rows, columns=list(COLUMNS)), options.output)
    print("\n\n".join(tables(options.output)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
