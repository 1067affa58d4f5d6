"""Starts and goals: sampled, read from a reset, and the sets on which policies are compared."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import islice
from typing import Any, Final, NamedTuple, cast, get_args

import numpy as np

from mpfa_envs.checks import check_count, check_seed, did_you_mean
from mpfa_envs.generators.generate import (
    GENERATORS,
    Split,
    generator_tasks,
    resolve_world,
    world_of_name,
)
from mpfa_envs.paths.distance import NARROW, FreeGrid, grid_for, is_reachable
from mpfa_envs.paths.tasks import is_wide, sample_task_on_grid
from mpfa_envs.robots.model import PAPER_CLEARANCE, RobotModel
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from mpfa_envs.safety.filter import CLEARANCE
from mpfa_envs.worlds.barn import barn_task, barn_world, barn_worlds, load_barn
from mpfa_envs.worlds.builtin import WORLDS
from mpfa_envs.worlds.world import START_SLACK, Box, Task, World

DOOR: Final = 0.05
"""Clearance on both sides of the narrowest door that tasks lead through [m]."""
_FINE: Final = 0.4
"""Share of a cell's usual side with which a row of cells leads through such a door."""
_PART: Final = 1.0
"""Least floor of a part of a world that is spoken of [m²]."""


@lru_cache(maxsize=512)
def is_built_in(world: World) -> bool:
    """Return True for worlds by name: of the paper, of a generator and of BARN."""
    name = world.name
    if name.startswith("barn300-"):  # Of the benchmark's archive.
        return True
    if name.startswith("barn-") and name[5:].isdigit() and int(name[5:]) < 20:
        return world == barn_world(int(name[5:]))
    return world in (WORLDS.get(name), world_of_name(name))


def cell_share(world: World) -> float:
    """Share of the usual side of a cell on which the tasks of a world are sampled."""
    return 1.0 if is_built_in(world) else _FINE


def kept_in(world: World) -> float:
    """Clearance of a robot's rim that the tasks of evaluations keep in a world [m]."""
    return PAPER_CLEARANCE if is_built_in(world) else CLEARANCE


@lru_cache(maxsize=64)
def warn_of_parts(world: World, robot: RobotModel, clearance: float) -> None:
    """Warn, once, of parts of a user's world that a robot with a clearance [m] cannot reach.

    Warns:
        UserWarning: If there are any.
    """
    if is_built_in(world):
        return
    grid = grid_for(world, round(robot.radius + clearance, 9), NARROW)
    floors = np.bincount(grid.parts.ravel())[1:] * grid.resolution**2
    floors = floors[floors >= _PART]
    if len(floors) > 1:
        cut_off = 1.0 - floors.max() / floors.sum()
        warnings.warn(
            f"{len(floors) - 1} of {len(floors)} parts of {world.name!r}, {cut_off:.0%} of the "
            f"floor, cannot be reached from its largest part by a robot {2 * robot.radius:.2f} m "
            f"wide: its tasks lead through doors of {2 * (robot.radius + max(clearance, DOOR)):.2f}"
            " m and more",
            stacklevel=2,
        )


GOAL_CLEARANCE = 0.5
"""No goal lies nearer to an obstacle or a wall than this [m]."""
_GRID_SLACK = 0.04
"""A grid path may fall short of its clearance by at most this [m]."""
_AROUND = [(math.cos(turn), math.sin(turn)) for turn in np.arange(16) * math.tau / 16]
"""Directions in which points near a goal are tested for reachability."""
_STARTS = 60
_GOALS_PER_START = 50
_ATTEMPTS = 1000
_EVALUATION_STREAM = 1281166


def sample_task(
    world: World,
    rng: np.random.Generator,
    *,
    collision_distance: float,
    min_goal_distance: float = 2.0,
    detour_chance: float = 0.0,
) -> Task:
    """Sample a start and a goal uniformly over the free space of their regions.

    The two are joined by a path that keeps the collision distance, so every task can be solved.
    Tasks in maps, in wide worlds (:func:`~mpfa_envs.paths.tasks.is_wide`) and in those too narrow
    for the usual distance of goals are those of :func:`~mpfa_envs.paths.tasks.sample_task_on_grid`.

    Args:
        world: Its walls, obstacles and its regions.
        rng: Source of randomness.
        collision_distance: Distance of the center from an obstacle that is a collision [m].
        min_goal_distance: Least distance between start and goal [m].
        detour_chance: Chance that the straight line between them must come too near to an obstacle,
            in a world that has any; 0: no condition.

    Returns:
        The task; its heading is uniform.

    Raises:
        ValueError: If a region has no free space, or no start and goal fit together.

    Examples:
        >>> import numpy as np
        >>> from mpfa_envs import WORLDS
        >>> from mpfa_envs.tasks.sampling import sample_task
        >>> task = sample_task(WORLDS["A"], np.random.default_rng(0), collision_distance=0.35)
        >>> len(task.start), len(task.goal)
        (3, 2)
    """
    asked = {"min_goal_distance": min_goal_distance, "detour_chance": detour_chance}
    grid = grid_for(world, collision_distance, cell_share(world))
    if is_wide(world):
        return sample_task_on_grid(grid, rng, **asked)[0]
    try:
        return _sample_points(grid, rng, **asked)
    except ValueError:
        with suppress(ValueError):
            return sample_task_on_grid(grid, rng, **asked)[0]
        raise


def _sample_points(
    grid: FreeGrid, rng: np.random.Generator, min_goal_distance: float, detour_chance: float
) -> Task:
    """Sample points until two of them make a task."""
    world, distance = grid.world, grid.distance
    detour = detour_chance > 0.0 and world.obstacle_count > 0 and rng.random() < detour_chance
    straight: Task | None = None
    for _ in range(_STARTS):
        start = _sample_point(grid, rng, world.start_regions, distance + START_SLACK, "start")
        for _ in range(_GOALS_PER_START):
            clearance = max(GOAL_CLEARANCE, distance)
            goal = _sample_point(grid, rng, world.goal_regions, clearance, "goal")
            far = math.dist(start, goal) >= min_goal_distance
            if not (
                far and (grid.joins(start, goal) or is_reachable(world, distance, start, goal))
            ):
                continue
            task = Task((*start, float(rng.uniform(-math.pi, math.pi))), goal)
            if not (detour and world.clearance_along(start, goal) >= distance):
                return task
            straight = straight or task
    if straight is not None:  # No task in this world needs a detour.
        return straight
    raise ValueError(
        f"world {world.name!r} has no start and goal at least min_goal_distance = "
        f"{min_goal_distance} m apart with a path between them, in {grid}"
    )


def check_task(
    world: World,
    start: Any,  # x, y, heading [m, m, rad]
    goal: Any,  # x, y [m]
    *,
    collision_distance: float,  # [m]
    goal_radius: float,  # [m]
    radius: float,  # [m]
) -> Task:
    """Read a task, and reject one that cannot be driven."""
    x, y, heading = _numbers("start", start, 3)
    goal_x, goal_y = _numbers("goal", goal, 2)
    goal = (goal_x, goal_y)
    clearance = world.clearance(x, y)
    if clearance <= collision_distance:
        raise ValueError(
            f"start must be farther than collision_distance = {collision_distance:g} m from "
            f"obstacles and walls, got {(x, y)} with {clearance:.3f} m"
        )
    if math.dist((x, y), goal) <= goal_radius:
        raise ValueError(
            f"goal must be farther than goal_radius = {goal_radius} m from the start {(x, y)}, "
            f"got {goal}"
        )
    if not is_reachable(world, radius, (x, y), goal):
        raise ValueError(f"goal must be within reach of the start {(x, y)}, got {goal}")
    kept = max(radius, collision_distance - _GRID_SLACK)
    if kept > radius and not _can_be_won(world, kept, (x, y), goal, goal_radius):
        raise ValueError(
            f"goal must be within reach of the start {(x, y)} by a path that keeps "
            f"collision_distance = {collision_distance:g} m from obstacles and walls, got {goal}"
        )
    return Task((x, y, heading), goal)


def _numbers(name: str, given: Any, count: int) -> list[float]:
    """Read some finite numbers."""
    try:
        values = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(f"{name} must be {count} finite numbers, got {given!r}")
    return values.tolist()


def _can_be_won(
    world: World,
    distance: float,
    start: tuple[float, float],
    goal: tuple[float, float],
    goal_radius: float,
) -> bool:
    """Return True if a path that keeps the distance leads to the goal, or within its radius."""
    # A goal may lie nearer to a wall than a robot comes, and is reached from its side then.
    around = [
        (goal[0] + share * goal_radius * across, goal[1] + share * goal_radius * up)
        for share in (0.5, 0.99)
        for across, up in _AROUND
    ]
    return any(is_reachable(world, distance, start, place) for place in (goal, *around))


def _sample_point(
    grid: FreeGrid,
    rng: np.random.Generator,
    regions: tuple[Box, ...],
    clearance: float,
    what: str,
) -> tuple[float, float]:
    """Sample a point with the clearance [m] from the union of the regions."""
    world = grid.world
    regions = regions or (world.room,)
    shares = np.cumsum([region.area for region in regions])
    for _ in range(_ATTEMPTS):
        pick, across, up = rng.random(3).tolist()
        index = int(np.searchsorted(shares, pick * shares[-1], side="right"))
        region = regions[min(index, len(regions) - 1)]
        x = region.x_min + across * (region.x_max - region.x_min)
        y = region.y_min + up * (region.y_max - region.y_min)
        if world.clearance(x, y) >= clearance:
            return x, y
    raise ValueError(
        f"world {world.name!r} has no free {what}: {_ATTEMPTS} samples found no point "
        f"{clearance:.2f} m from every obstacle and wall, in {grid}"
    )


def evaluation_pairs(
    world: str | os.PathLike[str] | World,
    n: int,
    seed: int,
    *,
    robot: RobotChoice = "turtlebot2",
    min_goal_distance: float = 2.0,
) -> list[Task]:
    """Sample a fixed list of tasks, the same for everyone with the same arguments.

    Args:
        world: A name, the path of a YAML file or a world.
        n: Number of tasks.
        seed: Seed of the sampling; the first tasks of a longer list are those of a shorter one.
        robot: The robot, whose rim keeps a clearance at the start, at the goal and on a path
            between them, for any clearance of its training: the paper's 0.17 m in worlds that have
            a name, 0.03 m in others, where doors may be 0.1 m wider than the robot.
        min_goal_distance: Least distance between start and goal [m].

    Returns:
        The tasks.

    Raises:
        ValueError: If n or the seed is out of its range, or the world has no room for a task.

    Warns:
        UserWarning: If parts of a world without a name cannot be reached from its largest one.

    Examples:
        >>> from mpfa_envs import NavigationEnv
        >>> from mpfa_envs.tasks.sampling import evaluation_pairs
        >>> env = NavigationEnv(world="test", physics="kinematic")
        >>> task = evaluation_pairs("test", 2, seed=0)[1]
        >>> observation, info = env.reset(options=task._asdict())
        >>> (info["x"], info["y"]) == task.start[:2]
        True
    """
    check_count("n", n)
    check_seed(seed)
    world = resolve_world(world)
    robot = resolve_robot(robot)
    # Not the distance of training: settings may change it, and the tasks must stay the same.
    distance = round(robot.radius + kept_in(world), 9)
    warn_of_parts(world, robot, kept_in(world))
    # An environment with the same seed must not train on these tasks.
    rng = np.random.default_rng((_EVALUATION_STREAM, seed))
    return [
        sample_task(world, rng, collision_distance=distance, min_goal_distance=min_goal_distance)
        for _ in range(n)
    ]


TASKS_PER_WORLD: Final = 4
"""Number of tasks in each world of a generator."""
_STANDARD_TIME_STEP: Final = 0.1
"""Unit of time limits [s]."""
BARN_MAX_STEPS: Final = 1000
"""The benchmark's 100 s."""
_IN_A_WORLD: Final = 200
_OF_A_GENERATOR: Final = 400


class WorldTask(NamedTuple):
    """One episode to drive and its world."""

    world: World
    task: Task
    max_steps: int | None = None
    """Time limit in steps of 0.1 s, in place of the environment's; None: the environment's."""
    seed: int | None = None
    """Seed of walkers and noise; None: the number of the task among those that are driven."""
    reference_path: float | None = None
    """Length of BARN's reference path, by which its score is computed [m]; None without one."""

    def limit(self, env_arguments: Mapping[str, Any]) -> dict[str, int]:
        """The time limit as an argument of an environment; nothing where that has its own.

        Args:
            env_arguments: The environment's other arguments, ``time_step`` [s] perhaps among them.

        Examples:
            >>> from mpfa_envs import world_tasks
            >>> world_tasks("barn", episodes=1)[0].limit({"time_step": 0.05})  # 100 s
            {'max_steps': 2000}
        """
        if self.max_steps is None:
            return {}
        time_step = env_arguments.get("time_step", _STANDARD_TIME_STEP)
        return {"max_steps": round(self.max_steps * _STANDARD_TIME_STEP / time_step)}


def world_tasks(
    name: str | os.PathLike[str] | World,
    *,
    episodes: int | None = None,
    seed: int = 0,
    robot: RobotChoice = "turtlebot2",
) -> list[WorldTask]:
    """Make the tasks of a name, the same for everyone.

    Args:
        name: A world, as in :class:`~mpfa_envs.NavigationEnv`, with tasks of
            ``evaluation_pairs``; ``"bars:test"`` or ``"bars:validation"``, the
            worlds of that split of a generator, four tasks in each, of
            ``generator_tasks``; or the benchmark's own task: ``"barn"`` in the
            twenty worlds that come with the package, ``"barn:PATH"`` in those of its
            archive, which :func:`~mpfa_envs.worlds.barn.load_barn` reads.
        episodes: Number of tasks; None: 200 in a world, 400 in the worlds of a generator, one in
            each world of the benchmark. The first tasks of a longer list are those of a shorter
            one.
        seed: Seed of the tasks in a world; those of a generator are fixed.
        robot: Whose radius counts in a world. Those of a generator are for a TurtleBot2.

    Returns:
        The tasks with their worlds.

    Raises:
        ValueError: If nothing has that name, or a number is out of its range.
        WorldFileError: If a file is no world, or there is no archive of the benchmark.

    Examples:
        >>> from mpfa_envs import world_tasks
        >>> [each.world.name for each in world_tasks("bars:test", episodes=5)[3:]]
        ['bars-test-0', 'bars-test-1']
    """
    if episodes is not None:
        check_count("episodes", episodes)
    if isinstance(name, str) and (name == "barn" or name.startswith("barn:")):
        # The robot starts at one pose in all of them: more episodes would be the same ones again.
        worlds = barn_worlds() if name == "barn" else load_barn(name.partition(":")[2])
        return _numbered(
            [
                WorldTask(world, barn_task(), BARN_MAX_STEPS, reference_path=length)
                for world, length in islice(worlds, episodes)
            ]
        )
    generator, _, split = str(name).partition(":")
    if split in get_args(Split)[1:] and generator not in GENERATORS:
        hint = f" ({question})" if (question := did_you_mean(generator, GENERATORS)) else ""
        raise ValueError(
            f"world must be NAME:{split} with a NAME of {list(GENERATORS)}, got {name!r}{hint}"
        )
    if isinstance(name, str) and generator in GENERATORS:
        if split not in get_args(Split)[1:]:
            raise ValueError(
                f"world must be {generator}:validation or {generator}:test to stand for tasks in "
                f"the worlds of a generator, got {name!r}"
            )
        count = _OF_A_GENERATOR if episodes is None else episodes
        made = generator_tasks(
            generator,
            cast("Split", split),
            worlds=-(-count // TASKS_PER_WORLD),
            tasks=TASKS_PER_WORLD,
        )
        return _numbered([WorldTask(*each) for each in made[:count]])
    world = resolve_world(name)
    count = _IN_A_WORLD if episodes is None else episodes
    pairs = evaluation_pairs(world, count, seed, robot=robot)
    return _numbered([WorldTask(world, task) for task in pairs])


def _numbered(tasks: Sequence[WorldTask]) -> list[WorldTask]:
    """Seed each task by its number in its set, whichever tasks are driven along with it."""
    return [each._replace(seed=number) for number, each in enumerate(tasks)]
