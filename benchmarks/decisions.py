"""Measure the computing time of a decision, with one robot and with sixteen at once.

    python -m benchmarks.decisions           drive, and write docs/results/rooms/decisions.csv
    python -m benchmarks.decisions --kept    print the table of the kept rows

A row is a drive in world D on exact arcs: the mean CPU time of its decisions, behind the filter. A
network decides for all robots in one call, whose time is divided by their number. The drivers take
turns, as the speed of a machine changes with what else it does.
"""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import pandas as pd

from mpfa_envs import TaskConfig, evaluate, load_policy
from mpfa_envs.driver import Filtered
from mpfa_envs.planners import PredictiveControl
from training.comparison.report import table
from training.files import run_script
from training.records import read_table, write_table

KEPT = Path(__file__).parents[1] / "docs/results/rooms/decisions.csv"
POLICIES = ("td3-rooms", "ddpg-rooms")
PLANNER = "mpc"
ROBOTS = (1, 16)
"""Robots at once."""
DRIVES = 16
ROUNDS = 5
_FIELDS = set(inspect.signature(TaskConfig).parameters)


def make_driver(name: str) -> PredictiveControl | Filtered:
    """Make predictive control, which has the filter, or a policy of the package behind it."""
    if name == PLANNER:
        return PredictiveControl(robot="kobuki")
    policy = load_policy(name)
    arguments = {key: value for key, value in policy.env_arguments.items() if key in _FIELDS}
    return Filtered(policy, TaskConfig(**arguments).make_filter())


def measure() -> pd.DataFrame:
    """Drive with all drivers; return a row for each drive."""
    rows = []
    names = (*POLICIES, PLANNER)
    for name in names:  # What is compiled is loaded before the first drive that counts.
        evaluate(make_driver(name), "D", episodes=1, physics="kinematic")
    for turn, robots, name in product(range(ROUNDS), ROBOTS, names):
        driver = make_driver(name)
        drives = evaluate(driver, "D", episodes=DRIVES, envs_at_once=robots, physics="kinematic")
        for number, drive in enumerate(drives):
            rows.append((name, robots, turn, number, round(1000.0 * drive.decision_s, 4)))
    return pd.DataFrame(rows, columns=["driver", "robots", "round", "drive", "decision_ms"])


def decision_table(path: Path = KEPT) -> str:
    """Return the medians of the drives, and those of predictive control over them."""
    medians = read_table(path).groupby(["driver", "robots"])["decision_ms"].median()
    lines = []
    for name in (*POLICIES, PLANNER):
        of_driver = [medians[name, robots] for robots in ROBOTS]
        ratios = [
            medians[PLANNER, robots] / own for robots, own in zip(ROBOTS, of_driver, strict=True)
        ]
        texts = [f"{value:.2f}" for value in of_driver], [f"{ratio:.0f}" for ratio in ratios]
        lines.append([f"`{name}`", *(cell for pair in zip(*texts, strict=True) for cell in pair)])
    head = [
        cell
        for robots in ("one robot", "sixteen robots")
        for cell in (f"{robots} [ms]", f"`{PLANNER}` over it")
    ]
    return table(["driver", *head], lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and keep the rows, or print the table of the kept ones."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.decisions",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--output", type=Path, default=KEPT, help="of the rows")
    parser.add_argument("--kept", action="store_true", help="print the table of kept rows alone")
    options = parser.parse_args(arguments)
    if not options.kept:
        write_table(measure(), options.output)
    print(decision_table(options.output))


if __name__ == "__main__":
    run_script(main)
