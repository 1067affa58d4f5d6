"""Tasks of several robots in one world: who starts where, and who drives where."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from mpfa_envs.checks import check_count, check_seed, did_you_mean
from mpfa_envs.generators.generate import GENERATORS
from mpfa_envs.paths.distance import FreeGrid
from mpfa_envs.paths.tasks import sample_task_on_grid
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from mpfa_envs.tasks.sampling import TASKS_PER_WORLD, WorldTask, world_tasks
from mpfa_envs.worlds.shapes import Box
from mpfa_envs.worlds.world import Task, World

TEAM_STEPS: Final = 1200
"""Time limit of a team's task, in steps of 0.1 s."""
_RING: Final = 3.0
"""Distance of the starts of a crossing from its center [m]."""
_BETWEEN_STARTS: Final = 0.4
"""Least distance between the rims of two robots at the start [m]."""
_BETWEEN_GOALS: Final = 1.2
"""The same at their goals [m]: a robot has arrived within 0.5 m of its goal, and stays there."""
_TO_WALLS: Final = 0.1
"""Least clearance of the rim on a path [m]."""
_ATTEMPTS: Final = 1000
_STREAM: Final = 82
"""Apart from the random numbers of other tasks with the same seed."""

_STARTS = (Box(-6.5, -2.5, -4.0, 2.5), Box(4.0, -2.5, 6.5, 2.5))
"""Where robots start in worlds with two halls; they drive to the other one."""
_GOALS = (Box(-6.5, -2.5, -4.8, 2.5), Box(4.8, -2.5, 6.5, 2.5))
"""Where their goals lie: who has arrived leaves room at the end of a lane."""


def _halls(name: str, *boxes: Box) -> World:
    """A world whose halls, left and right, are joined by what the boxes leave."""
    return World(name=name, size=(14.0, 6.0), boxes=boxes)


TEAM_WORLDS: Final = {
    "crossing": World(name="crossing", size=(8.0, 8.0)),
    "door": _halls("door", Box(-0.1, 0.35, 0.1, 3.0), Box(-0.1, -3.0, 0.1, -0.35)),
    "lane": _halls("lane", Box(-3.0, 0.35, 3.0, 3.0), Box(-3.0, -3.0, 3.0, -0.35)),
    "bay": _halls(
        "bay",
        *(Box(-3.0, 0.35, -0.8, 3.0), Box(0.8, 0.35, 3.0, 3.0), Box(-0.8, 1.5, 0.8, 3.0)),
        Box(-3.0, -3.0, 3.0, -0.35),
    ),
}
"""Worlds for teams: a hall that all cross; two halls joined by a door, 0.7 m wide; by a lane of
that width, 6 m long, in which a Kobuki cannot pass another; by such a lane with a bay in its
middle."""


class TeamTask(NamedTuple):
    """A start and a goal for each robot of a team, and their world."""

    world: World
    tasks: tuple[Task, ...]
    seed: int
    """Seed of the noise; robot k has this times the size of the team, plus k."""

    def of_robots(self) -> list[WorldTask]:
        """The tasks of the robots one by one."""
        size = len(self.tasks)
        return [
            WorldTask(self.world, task, TEAM_STEPS, self.seed * size + number)
            for number, task in enumerate(self.tasks)
        ]


def team_tasks(
    name: str,
    team: int,
    *,
    episodes: int = 20,
    seed: int = 0,
    robot: RobotChoice = "turtlebot2",
) -> list[TeamTask]:
    """Make tasks for teams, the same for everyone.

    Args:
        name: One of :data:`TEAM_WORLDS`; or ``"rooms:validation"`` and so on, the worlds of a
            generator's split, a task in each.
        team: Number of robots. In a crossing they start on a circle of 3 m, and each drives to the
            other side; in two halls they start in the left and in the right one by turns, and each
            drives to the other hall.
        episodes: Number of tasks.
        seed: Seed of the tasks.
        robot: Whose radius counts.

    Returns:
        The tasks. Rims are 0.4 m apart at the start, and 1.2 m at the goals.

    Raises:
        ValueError: If there is no such world, a number is out of its range, or the world has no
            room for so many robots.

    Examples:
        >>> from mpfa_envs.tasks.teams import team_tasks
        >>> tasks = team_tasks("crossing", 4, episodes=2)
        >>> len(tasks), len(tasks[0].tasks), tasks[0].world.name
        (2, 4, 'crossing')
    """
    check_count("team", team)
    check_count("episodes", episodes)
    check_seed(seed)
    radius = resolve_robot(robot).radius
    worlds = [TEAM_WORLDS[name]] * episodes if name in TEAM_WORLDS else _generated(name, episodes)
    made = []
    for number, world in enumerate(worlds):
        rng = np.random.default_rng((_STREAM, seed, number))
        tasks = _sample(world, team, radius, rng)
        made.append(TeamTask(world, tasks, seed * episodes + number))
    return made


def _generated(name: str, episodes: int) -> list[World]:
    """The first worlds of a generator's split."""
    generator, _, split = name.partition(":")
    if generator not in GENERATORS or split not in ("validation", "test"):
        names = [*TEAM_WORLDS, *(f"{each}:validation" for each in GENERATORS)]
        question = did_you_mean(name, names)
        hint = f" ({question})" if question else ""
        raise ValueError(f"world of a team must be one of {names}, got {name!r}{hint}")
    tasks = world_tasks(name, episodes=TASKS_PER_WORLD * episodes)
    return [each.world for each in tasks[::TASKS_PER_WORLD]]


def _sample(world: World, team: int, radius: float, rng: np.random.Generator) -> tuple[Task, ...]:
    """Sample tasks whose starts, and whose goals, are apart."""
    if world is TEAM_WORLDS["crossing"]:
        return _cross(world, team, radius, rng)
    halls = world in TEAM_WORLDS.values()
    grid = None if halls else FreeGrid(world, distance=radius + _TO_WALLS)
    found: list[Task] = []
    for _ in range(_ATTEMPTS):
        if grid is None:
            side = len(found) % 2
            heading = float(rng.uniform(-math.pi, math.pi))
            task = Task((*_within(_STARTS[side], rng), heading), _within(_GOALS[1 - side], rng))
        else:
            task, _field = sample_task_on_grid(grid, rng)
        if all(_apart(task, other, radius) for other in found):
            found.append(task)
        if len(found) == team:
            return tuple(found)
    raise _crowded(world, team)


def _cross(world: World, team: int, radius: float, rng: np.random.Generator) -> tuple[Task, ...]:
    """Starts evenly on a circle with goals opposite, turned by chance."""
    turn = float(rng.uniform(0.0, math.tau))
    found: list[Task] = []
    for number in range(team):
        angle = turn + math.tau * number / team + float(rng.uniform(-0.1, 0.1))
        x, y = _RING * math.cos(angle), _RING * math.sin(angle)
        heading = math.remainder(angle + math.pi + float(rng.uniform(-0.5, 0.5)), math.tau)
        task = Task((x, y, heading), (-x, -y))
        if not all(_apart(task, other, radius) for other in found):
            raise _crowded(world, team)
        found.append(task)
    return tuple(found)


def _within(box: Box, rng: np.random.Generator) -> tuple[float, float]:
    """A point of a box."""
    x, y = rng.uniform((box.x_min, box.y_min), (box.x_max, box.y_max)).tolist()
    return x, y


def _apart(one: Task, other: Task, radius: float) -> bool:
    """Return True if two robots have room at their starts and at their goals."""
    starts, goals = math.dist(one.start[:2], other.start[:2]), math.dist(one.goal, other.goal)
    return starts >= 2 * radius + _BETWEEN_STARTS and goals >= 2 * radius + _BETWEEN_GOALS


def _crowded(world: World, team: int) -> ValueError:
    """The error of a world that is too small."""
    return ValueError(f"team must have room in world {world.name!r}, got {team} robots: take fewer")
