"""What the policies of the package reach and touch in test worlds, from kept rows.

    python -m benchmarks.shipped             print the table of docs/policies.md
    python -m benchmarks.shipped --drive     drive ``td3-paper`` first, and keep its rows

Rows of the other policies are those of ``benchmarks.drivers``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from mpfa_envs import POLICIES, evaluate, load_policy
from training.comparison.report import table
from training.files import run_script
from training.records import read_table, write_table

ROWS = Path(__file__).parents[1] / "docs/results/rooms"
DRIVERS, PAPER = ROWS / "drivers.csv", ROWS / "td3-paper.csv"
TASKS = 200
_MAZES = "mazes:test"


def drive_paper() -> None:
    """Drive the policy of the paper's task in the paper's test world, and keep its rows."""
    drives = evaluate(load_policy("td3-paper"), "test", episodes=TASKS, physics="wheels")
    rows = [(number, drive.success, drive.collision) for number, drive in enumerate(drives)]
    write_table(pd.DataFrame(rows, columns=["episode", "success", "collision"]), PAPER)


def shipped_table() -> str:
    """Return a table of all policies, those that touch the most first."""
    rows = read_table(DRIVERS)
    rows = rows[rows["condition"] == "clean"]
    found = []
    for name in POLICIES:
        of_policy = rows[rows["driver"] == name]
        if not len(of_policy):
            continue
        mazes = of_policy["worlds"] == _MAZES
        shares = [_shares(of_policy, mazes, end) for end in ("success", "collision")]
        cells = [f"{share:.1%}" for pair in shares for share in pair]
        hit = float((of_policy["collision"] * of_policy["episodes"]).sum())
        tasks = int(of_policy["episodes"].sum())
        found.append((hit / tasks, [f"`{name}`", f"{tasks} generated and of BARN", *cells]))
    paper = read_table(PAPER)
    ends = [f"{paper[end].mean():.1%}" for end in ("success", "collision")]
    line = ["`td3-paper`", f"{len(paper)} in the world `test`", ends[0], "", ends[1], ""]
    found.append((float(paper["collision"].mean()), line))
    found.sort(key=lambda entry: -entry[0])
    head = ["policy", "tasks", "reached", "reached in mazes", "touched", "touched in mazes"]
    return table(head, [line for _, line in found])


def _shares(rows: pd.DataFrame, mazes: pd.Series, end: str) -> tuple[float, float]:
    """Return the share of an end in all tasks, and in mazes."""
    share = (rows[end] * rows["episodes"]).sum() / rows["episodes"].sum()
    return float(share), float(rows.loc[mazes, end].iloc[0])


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table; drive first if asked to."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.shipped",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--drive", action="store_true", help="drive td3-paper, and keep its rows")
    if parser.parse_args(arguments).drive:
        drive_paper()
    print(shipped_table())


if __name__ == "__main__":
    run_script(main)
