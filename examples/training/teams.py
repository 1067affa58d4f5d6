"""Evaluations of teams: several robots in one world, all driven by the same policy."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mpfa_envs.driver import Action, Driver, as_driver
from mpfa_envs.evaluation.results import EpisodeResult, wilson
from mpfa_envs.evaluation.right_of_way import RightOfWay
from mpfa_envs.evaluation.teams import TeamResult, Trail, run_teams
from mpfa_envs.tasks.teams import TEAM_WORLDS, TeamTask, team_tasks
from training.evaluating import Conditions, Drivable

if TYPE_CHECKING:
    import pandas as pd

EPISODES = 20
"""Tasks in each world by default."""
_PANELS = 6
"""Drives in the picture at most."""


def add_team(parser: argparse.ArgumentParser) -> None:
    """Add the options of teams."""
    parser.add_argument(
        "--team",
        type=int,
        default=1,
        help="robots that share a world; --worlds are then some of "
        f"{', '.join(TEAM_WORLDS)}, rooms:validation and so on (default: the first four)",
    )
    parser.add_argument(
        "--right-of-way",
        action="store_true",
        help="robots of a team wait for those of a lower number whose paths theirs meet",
    )


def team_worlds(options: argparse.Namespace) -> list[str]:
    """Return the worlds of a command line with a team, each of which has been tried."""
    if options.live:
        raise ValueError("--live must be left out with --team: one robot is shown")
    worlds = list(options.worlds)
    for name in worlds:
        team_tasks(name, options.team, episodes=1)
    return worlds


def drive_teams(
    driver: Drivable, asked: Conditions, names: Sequence[str], folder: Path, *, pictures: bool
) -> pd.DataFrame:
    """Drive teams through the tasks of some worlds; write tables, and a picture of some drives.

    Returns:
        A row for each world.
    """
    import pandas as pd

    from training.pictures import TRAJECTORIES
    from training.records import as_table, write_table

    robot = driver.env_arguments.get("robot", "turtlebot2")
    arguments = {**driver.env_arguments, **asked.arguments}
    chosen: Action | Driver = driver
    if asked.right_of_way:
        chosen = RightOfWay(as_driver(driver), robot, asked.team)
    shown: list[tuple[TeamTask, list[Trail], list[EpisodeResult]]] = []
    results: list[TeamResult] = []
    rows: list[dict[str, Any]] = []
    for name in names:
        tasks = team_tasks(
            name, asked.team, episodes=asked.episodes or EPISODES, seed=asked.seed, robot=robot
        )

        def keep(
            number: int,
            trails: list[Trail],
            ends: list[EpisodeResult],
            tasks: list[TeamTask] = tasks,
        ) -> None:
            if number == 0:
                shown.append((tasks[number], trails, ends))

        driven = run_teams(chosen, tasks, on_end=keep, **arguments)
        results += driven
        rows.append({"world": name, "physics": asked.physics, **team_row(driven)})
    summary = pd.DataFrame(rows)
    write_table(summary, folder / "summary.csv")
    write_table(as_table(results, TeamResult), folder / "teams.csv")
    if pictures:
        draw(shown[:_PANELS], folder / TRAJECTORIES, goal_radius=arguments.get("goal_radius", 0.5))
    return summary


def team_row(results: Sequence[TeamResult]) -> dict[str, float]:
    """Rates and counts of drives of teams, as one row."""
    success = wilson([result.success for result in results])
    times = [result.time_s for result in results if result.success]
    return {
        "team": results[0].robots,
        "episodes": len(results),
        "success": success.value,
        "success_low": success.low,
        "success_high": success.high,
        "arrived": sum(each.arrived for each in results) / sum(each.robots for each in results),
        "touched": sum(each.touched for each in results),
        "touch_speed": max(each.touch_speed for each in results),
        "hit": sum(each.hit for each in results),
        "deadlock": float(np.mean([each.deadlock for each in results])),
        "time_s": float(np.mean(times)) if times else float("nan"),
        "min_gap": min(each.min_gap for each in results),
    }


def draw(
    shown: Sequence[tuple[TeamTask, list[Trail], list[EpisodeResult]]],
    path: Path,
    *,
    goal_radius: float,
) -> None:
    """Write the paths of some drives side by side."""
    from PIL import Image

    from mpfa_envs.render import render_trajectories

    panels = [
        render_trajectories(
            task.world,
            trails,
            [each.goal for each in task.tasks],
            [end.outcome for end in ends],
            title=task.world.name,
            goal_radius=goal_radius,
        )
        for task, trails, ends in shown
    ]
    height = max(len(panel) for panel in panels)
    padded = [
        np.pad(panel, ((0, height - len(panel)), (0, 8), (0, 0)), constant_values=255)
        for panel in panels
    ]
    Image.fromarray(np.concatenate(padded, axis=1)).save(path, optimize=True)


def printed(summary: pd.DataFrame) -> str:
    """The table on the screen."""
    table = summary.drop(columns=["physics", "success_low", "success_high"])
    forms = {"success": "{:.0%}", "arrived": "{:.0%}", "deadlock": "{:.0%}", "time_s": "{:.1f}"}
    for name, form in {**forms, "touch_speed": "{:.2f}", "min_gap": "{:.3f}"}.items():
        table[name] = table[name].map(form.format)
    return str(table.to_string(index=False))
