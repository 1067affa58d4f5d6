"""Learned policies and planners side by side, by their evaluations.

    python -m benchmarks.drivers runs/drivers --keep docs/results/rooms/drivers.csv
    python -m benchmarks.drivers docs/results/rooms/drivers.csv    the tables of kept rows

Takes what ``compare.py`` and ``evaluate.py`` wrote in the folder, however deep. A row is a driver,
a seed, a condition and a kind of worlds. Time is that over the *bound*: the task's shortest path at
the robot's full speed.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mpfa_envs import POLICIES, load_policy
from mpfa_envs.policies.policy import policy_file
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from torchrl_mpfa.saving import write_text_atomically
from training import files
from training.comparison.report import table
from training.finished import read_json
from training.records import read_table
from training.worlds import family

_DRIVER = ["robot", "driver", "filter"]
_ENDS = ["collision", "standstill", "timeout"]
_NAMES = {
    **{"dwa": "`dwa`", "dwa map": "`dwa --memory map`", "ddpg": "DDPG", "td3": "TD3"},
    "mpc known": "`mpc --plan known`",
}
_ERRORS = ("range_noise", "dropout", "slip", "drift")
_MAZES = "mazes:test"
_EASIER = "five kinds"
"""The worlds of all generators but mazes."""


def evaluations_of(folder: Path) -> Iterator[tuple[dict[str, Any], pd.DataFrame]]:
    """Read the driver and the episodes of each evaluation in a folder, on any level."""
    for path in sorted(folder.rglob(files.EPISODES)):
        asked = read_json(path.parent / files.SETTINGS)
        if "words" not in asked:  # Episodes of a training.
            continue
        run = read_json(path.parents[1] / files.SETTINGS)
        driver = {
            "robot": resolve_robot(asked.get("robot") or _trained_with(asked, run)).name,
            "driver": _driver_of(asked, run),
            "seed": asked.get("card", asked)["seed"],
            "filter": "filter" in asked,
            "condition": _condition(asked),
        }
        yield driver, read_table(path)


def _driver_of(asked: Mapping[str, Any], run: Mapping[str, Any]) -> str:
    """Name a planner with its options, a policy of the package, or the learner of a run."""
    if "policy" in asked:
        options = (asked[name] for name in ("policy", "memory", "plan") if name in asked)
        return " ".join(option for option in options if option not in ("none", "unknown"))
    return str(asked["card"]["learner"]) if run else _packaged(asked)


def _packaged(asked: Mapping[str, Any]) -> str:
    """Return the name of the package's policy that an evaluation drove."""
    [name] = [name for name in POLICIES if files.digest(policy_file(name)) == asked["sha256"]]
    return name


def _trained_with(asked: Mapping[str, Any], run: Mapping[str, Any]) -> RobotChoice:
    """The robot of an evaluation's policy: that of its run, or of a policy in the package."""
    if run:
        return run["environment"]["robot"]
    return load_policy(_packaged(asked)).env_arguments["robot"]


def _condition(asked: Mapping[str, Any]) -> str:
    """Name errors and delay of an evaluation; ``clean`` for none."""
    errors = asked.get("noise", {})
    named = [f"{name} {errors[name]:g}" for name in _ERRORS if errors.get(name)]
    if asked.get("latency"):
        named.append(f"{asked['latency']:g} s late")
    return ", ".join(named) or "clean"


def rows_of(folder: Path) -> list[dict[str, Any]]:
    """Make the rows of all evaluations in a folder."""
    return [
        {**driver, "worlds": kind, **_row(group)}
        for driver, episodes in evaluations_of(folder)
        for kind, group in episodes.groupby(episodes["world"].map(family), sort=False)
    ]


def _row(episodes: pd.DataFrame) -> dict[str, float]:
    """Rates and means of episodes in a kind of worlds; a standstill is no other timeout."""
    reached = episodes[episodes["success"]]
    return {
        "episodes": len(episodes),
        "success": episodes["success"].mean(),
        "collision": episodes["collision"].mean(),
        "standstill": episodes["standstill"].mean(),
        "timeout": (episodes["timeout"] & ~episodes["standstill"]).mean(),
        "spl": episodes["spl"].mean(),
        "time_s": reached["time_s"].mean(),
        # SCT of a success is the least time over the time.
        "time_over_bound": float(np.exp(-np.log(reached["sct"]).mean())),
        # The first decisions of a process load what is compiled.
        "decision_ms": 1000.0 * episodes["decision_s"].median(),
    }


def tables_of(rows: pd.DataFrame) -> str:
    """Write Markdown tables of success, of paths and times, and of errors and delays."""
    clean = rows[rows["condition"] == "clean"]
    parts = list(dict.fromkeys(map(_part, clean["worlds"])))
    generated = [part for part in parts if part in (_EASIER, _MAZES)]
    success, times = [], []
    for _, runs in clean.groupby(_DRIVER, sort=False):
        cells = [*_cells(runs), "yes" if runs["filter"].iloc[0] else "no"]
        of = {part: runs[runs["worlds"].map(_part) == part] for part in parts}
        ends = (f"{_rate(runs, end):.2%}" for end in _ENDS)
        success.append([*cells, *(_lowest(of[part]) for part in parts), *ends])
        every = pd.concat([of[part] for part in generated])
        times.append(
            [
                *cells,
                *(f"{of[part]['spl'].mean():.3f}" for part in generated),
                f"{runs['decision_ms'].median():.2f}",
                *(
                    f"{_over_bound(each):.3f}"
                    for each in [*(of[part] for part in generated), every]
                ),
            ]
        )
    heads = ["robot", "driver", "filter"]
    spl, over = ([f"{measure}: {part}" for part in generated] for measure in ("SPL", "time"))
    tables = [
        table([*heads, *parts, "collisions", "stand-stills", "other timeouts"], success),
        table([*heads, *spl, "CPU time of a decision [ms]", *over, "time: six kinds"], times),
    ]
    if len(clean) < len(rows):
        tables.append(_table_of_conditions(rows))
    return "\n\n".join(tables)


def _table_of_conditions(rows: pd.DataFrame) -> str:
    """Write success, collisions and time over the bound with errors and delays."""
    lines = []
    for (_, _, condition), runs in rows.groupby(["robot", "driver", "condition"], sort=False):
        if condition == "clean":
            continue
        mazes = runs["worlds"] == _MAZES
        cells = [*_cells(runs), str(condition)]
        for part in (runs[~mazes], runs[mazes]):
            rates = f"{_rate(part, 'success'):.1%}, {_rate(part, 'collision'):.1%}"
            cells.append(f"{rates}, {_over_bound(part):.2f}")
        lines.append(cells)
    return table(["robot", "driver", "condition", _EASIER, _MAZES], lines)


def _part(kind: str) -> str:
    """Return the column of a kind of worlds."""
    return kind if kind == _MAZES or ":" not in kind else _EASIER


def _cells(runs: pd.DataFrame) -> list[str]:
    """Name the robot and the driver of rows."""
    robot, driver = runs[["robot", "driver"]].iloc[0]
    return [f"`{robot}`", _NAMES.get(driver, f"`{driver}`")]


def _rate(runs: pd.DataFrame, end: str) -> float:
    """Share of all episodes that end so."""
    return float((runs[end] * runs["episodes"]).sum() / runs["episodes"].sum())


def _over_bound(runs: pd.DataFrame) -> float:
    """Geometric mean over kinds of the time over the bound."""
    means = np.log(runs["time_over_bound"]).groupby(runs["worlds"]).mean()
    return float(np.exp(means.mean()))


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables, and keep the rows if asked to."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.drivers",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("path", type=Path, help="folder of evaluations, or a file of kept rows")
    parser.add_argument("--keep", type=Path, metavar="FILE", help="write the rows to a CSV file")
    options = parser.parse_args(arguments)
    if not options.path.exists():
        parser.error(f"there is no {options.path}")
    rows = read_table(options.path) if options.path.is_file() else _sorted(options.path)
    if not len(rows):
        parser.error(f"{options.path} has no evaluations")
    if options.keep is not None:
        text = rows.to_csv(index=False, float_format="%.4f", lineterminator="\n")
        write_text_atomically(text, options.keep)
    print(tables_of(rows))
    return 0


def _sorted(folder: Path) -> pd.DataFrame:
    rows = pd.DataFrame(rows_of(folder))
    return rows if not len(rows) else rows.sort_values([*_DRIVER, "seed"], kind="stable")


def _lowest(rows: pd.DataFrame) -> str:
    """Write the mean of runs, and the worst of several."""
    runs = rows.groupby("seed")["success"].mean()
    mean = f"{runs.mean():.1%}"
    return mean if len(runs) == 1 else f"{mean} [{runs.min():.0%}]"


if __name__ == "__main__":
    files.run_script(main)
