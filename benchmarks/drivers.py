"""Learned policies and planners side by side, by their evaluations.

    python -m benchmarks.drivers runs/drivers --keep docs/results/rooms/drivers.csv
    python -m benchmarks.drivers docs/results/rooms/drivers.csv    the tables of kept rows

Takes what ``compare.py`` and ``evaluate.py`` wrote in the folder, however deep. A row is a driver,
a seed and a kind of worlds.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mpfa_envs import POLICIES, load_policy
from mpfa_envs.policies.files import policy_file
from mpfa_envs.robots.model import RobotModel
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from torchrl_mpfa.saving import write_text_atomically
from training import files
from training.comparison.report import table
from training.finished import read_json
from training.records import read_table
from training.worlds import family

_DRIVER = ["robot", "driver", "filter"]
_COUNTED = ["success", "collision", "timeout"]
_NAMES = {
    **{"dwa": "`dwa`", "dwa map": "`dwa --memory map`", "ddpg": "DDPG", "td3": "TD3"},
    "mpc known": "`mpc --plan known`",
}
_REFERENCE = "dwa map"
"""Driver whose times others are divided by, of the same robot."""
_TASK = ["world", "episode"]


def evaluations_of(folder: Path) -> Iterator[tuple[dict[str, Any], pd.DataFrame]]:
    """Read the driver and the episodes of each evaluation in a folder, on any level."""
    for path in sorted(folder.rglob(files.EPISODES)):
        asked = read_json(path.parent / files.SETTINGS)
        if "words" not in asked:  # Episodes of a training.
            continue
        run = read_json(path.parents[1] / files.SETTINGS)
        named = ("policy", "memory", "plan") if "policy" in asked else ()
        planner = " ".join(asked[name] for name in named if asked.get(name, "none") != "none")
        driver = {
            "robot": resolve_robot(asked.get("robot") or _trained_with(asked, run)),
            "driver": planner or asked["card"]["learner"],
            "seed": asked.get("card", asked)["seed"],
            "filter": "filter" in asked,
        }
        yield driver, read_table(path)


def _trained_with(asked: Mapping[str, Any], run: Mapping[str, Any]) -> RobotChoice:
    """The robot of an evaluation's policy: that of its run, or of a policy in the package."""
    if run:
        return run["environment"]["robot"]
    [name] = [name for name in POLICIES if files.digest(policy_file(name)) == asked["sha256"]]
    return load_policy(name).env_arguments["robot"]


def rows_of(folder: Path) -> list[dict[str, Any]]:
    """Make the rows of all evaluations in a folder."""
    found = list(evaluations_of(folder))
    # With the filter, where both ways were driven.
    references = {
        driver["robot"]: episodes[episodes["success"]].set_index(_TASK)["time_s"]
        for driver, episodes in sorted(found, key=lambda each: each[0]["filter"])
        if driver["driver"] == _REFERENCE
    }
    return [
        {
            **driver,
            "robot": driver["robot"].name,
            "worlds": kind,
            "episodes": len(each),
            **each[[*_COUNTED, "spl", "sct"]].astype(float).mean(),
            "time_s": each.loc[each["success"], "time_s"].mean(),
            **_beside(each, references.get(driver["robot"]), driver["robot"]),
        }
        for driver, episodes in found
        for kind, each in episodes.groupby(episodes["world"].map(family), sort=False)
    ]


def _beside(
    episodes: pd.DataFrame, reference: pd.Series | None, robot: RobotModel
) -> dict[str, float]:
    """Divide times, and those of the driven paths at full speed, by the reference's times.

    Over the tasks that both reach.
    """
    if reference is None:
        return {}
    reached = episodes[episodes["success"]].set_index(_TASK)
    both = reached.join(reference.rename("reference"), how="inner")
    time, bound = both["time_s"].sum(), both["path_length"].sum() / robot.max_wheel_speed
    least = both["reference"].sum()
    return {"time_ratio": time / least, "bound_ratio": bound / least} if len(both) else {}


def tables_of(rows: pd.DataFrame) -> str:
    """Write Markdown tables of success, of paths and times, and of times beside the reference."""
    kinds = rows["worlds"].unique()
    success, paths, beside = [], [], []
    for _, runs in rows.groupby(_DRIVER, sort=False):
        robot, driver, filtered = runs[_DRIVER].iloc[0]
        cells = [f"`{robot}`", _NAMES.get(driver, f"`{driver}`"), "yes" if filtered else "no"]
        of = {kind: runs[runs["worlds"] == kind] for kind in kinds}
        rate = (runs["collision"] * runs["episodes"]).sum() / runs["episodes"].sum()
        success.append([*cells, *(_lowest(of[kind]["success"]) for kind in kinds), f"{rate:.2%}"])
        path = (f"{of[kind]['spl'].mean():.3f}, {of[kind]['time_s'].mean():.1f}" for kind in kinds)
        paths.append([*cells, *path])
        if "time_ratio" in runs and runs["time_ratio"].notna().all():
            generated = runs[runs["worlds"].str.contains(":")]
            each = [*(of[kind] for kind in kinds), generated]
            beside.append([*cells, *map(_ratios, each)])
    heads = ["robot", "driver", "filter", *kinds]
    tables = [table([*heads, "collisions"], success), table(heads, paths)]
    if beside:
        tables.append(table([*heads, "generators"], beside))
    return "\n\n".join(tables)


def _ratios(runs: pd.DataFrame) -> str:
    """Write the times and their bounds beside the reference: geometric means over kinds."""
    means = runs.groupby("worlds")[["time_ratio", "bound_ratio"]].mean()
    time, bound = np.exp(np.log(means).mean())
    return f"{time:.3f} ({bound:.2f})"


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


def _lowest(values: pd.Series) -> str:
    mean = f"{values.mean():.1%}"
    return mean if len(values) == 1 else f"{mean} [{values.min():.0%}]"


if __name__ == "__main__":
    files.run_script(main)
