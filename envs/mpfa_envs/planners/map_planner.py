"""A driver that plans a path on the known map when an episode begins, and follows it."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import check_positive
from mpfa_envs.env.vector import VectorNavigationEnv
from mpfa_envs.paths.distance import MANY_CELLS, FreeGrid
from mpfa_envs.planners.pure_pursuit import PurePursuit
from mpfa_envs.planners.search import Search
from mpfa_envs.robots.model import TRAINING_CLEARANCE
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from mpfa_envs.worlds.shapes import Point
from mpfa_envs.worlds.world import World

_LEAST_CLEARANCE: Final = 0.02
"""Clearance tried where no path has the wanted one [m]."""
_FINE: Final = 0.05
"""Side of a cell of the grid for it [m]."""


class MapPlanner:
    """Plans on the known map and follows the path, a :class:`~mpfa_envs.evaluation.runs.Driver`.

    It knows all obstacles and the robot's pose, neither of which is in the observation: its results
    are a ceiling for policies that have the lidar alone.

    Where no path keeps the clearance it takes one that keeps less, on finer cells, and where there
    is none at all it drives at the goal.

    Args:
        search: Finds a path.
        robot: The robot.
        clearance: Least clearance of the robot's rim on a path [m].
        resolution: Side of a cell of the grid [m], longer in rooms of more than 200 m.
        look_ahead: Of the :class:`~mpfa_envs.planners.PurePursuit` [m].

    Raises:
        ValueError: If a length is not positive.

    Examples:
        >>> from mpfa_envs import evaluate
        >>> from mpfa_envs.planners import MapPlanner, shortest_path
        >>> planner = MapPlanner(shortest_path)
        >>> [each.success for each in evaluate(planner, "D", episodes=3, physics="kinematic")]
        [True, True, True]
    """

    def __init__(
        self,
        search: Search,
        *,
        robot: RobotChoice = "turtlebot2",
        clearance: float = TRAINING_CLEARANCE,
        resolution: float = 0.1,
        look_ahead: float = 0.6,
    ) -> None:
        self.search = search
        self.robot = resolve_robot(robot)
        self.clearance = check_positive("clearance", clearance)
        self.resolution = check_positive("resolution", resolution)
        self.look_ahead = check_positive("look_ahead", look_ahead)
        self.env_arguments: dict[str, Any] = {"robot": self.robot, "physics": "kinematic"}
        """Arguments of the environments that it drives in, unless others are given."""
        self._pursuits: dict[int, PurePursuit] = {}
        self._grids: dict[tuple[float, float], FreeGrid] = {}

    def begin(self, env: VectorNavigationEnv, robot: int) -> None:
        """Plan the path of a robot's episode, which has begun."""
        task = env.tasks[robot]
        if task is None:
            raise ValueError(f"robot {robot} must have begun an episode to plan for")
        path, grid = self.plan(env.worlds[robot], task.start[:2], task.goal)
        self._pursuits[robot] = PurePursuit(path, self.robot, grid, look_ahead=self.look_ahead)

    def drive(
        self,
        env: VectorNavigationEnv,
        robots: NDArray[np.int64],
        observations: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Actions that follow the paths of the N robots, ``[N, 2]``; observations are not read."""
        poses = env.poses
        actions = [self._pursuits[robot].act(*poses[robot].tolist()) for robot in robots.tolist()]
        return np.array(actions, dtype=np.float32)

    def plan(self, world: World, start: Point, goal: Point) -> tuple[list[Point], FreeGrid]:
        """Positions of a path from start to goal [m], and the grid that it was found on."""
        # In a room of more than 100 m the finest cells would be too many.
        least = 1.01 * math.sqrt(math.prod(world.size) / MANY_CELLS)
        coarse, fine = max(self.resolution, least), max(min(_FINE, self.resolution), least)
        for clearance, resolution in (
            (self.clearance, coarse),
            (self.clearance, fine),
            (_LEAST_CLEARANCE, fine),
        ):
            grid = self._grid_of(world, self.robot.radius + clearance, resolution)
            path = self.search(grid, start, goal)
            if path is not None:
                return path, grid
        return [start, goal], grid

    def _grid_of(self, world: World, distance: float, resolution: float) -> FreeGrid:
        """The grid of a world, kept as the next task is often in the same world."""
        kept = self._grids.get((distance, resolution))
        if kept is None or kept.world is not world:
            kept = FreeGrid(world, distance=distance, resolution=resolution)
            self._grids[distance, resolution] = kept
        return kept
