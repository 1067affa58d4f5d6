"""Who waits: robots of a team tell each other their paths, and one lets those before it pass."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.driver import Driver, Errand, Senses
from mpfa_envs.paths.distance import DistanceField, FreeGrid
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from mpfa_envs.worlds.world import World

_STEP: Final = 0.1
"""Distance between the points of a path [m]."""
_AHEAD: Final = 2.0
"""Length of its own path that a robot compares with the paths of others [m]."""
_GAP: Final = 0.3
"""Paths on which rims come nearer to each other than this meet [m]."""
_PATIENCE: Final = 5.0
"""A robot that has stood for so long has lost its right of way until it moves [s]."""
_MOVED: Final = 0.05
"""Distance by which a robot has moved [m]."""


class RightOfWay:
    """A driver whose robots wait for those of a lower number in their team.

    Each robot tells the others the shortest path that it has left in the world, which must be
    known. A robot waits where the next 2 m of its own path come so near to the path of a robot of a
    lower number that rims would be within 0.3 m. Who is on another's path already, where that one
    cannot pass, as in a lane or a door, goes first whatever its number. Nobody waits for a robot
    that has arrived, or has stood for 5 s.

    Args:
        driver: Of each robot.
        robot: What they are.
        team: Robots of a team; their numbers follow each other.
    """

    def __init__(self, driver: Driver, robot: RobotChoice, team: int) -> None:
        self._driver, self._robot, self._team = driver, resolve_robot(robot), team
        self._worlds: dict[int, World] = {}
        self._period = 0.0
        self._paths: dict[int, NDArray[np.float64]] = {}
        self._places: dict[int, tuple[float, float]] = {}
        self._stood: dict[int, float] = {}
        self._grids: dict[int, FreeGrid] = {}

    def begin(self, robot: int, errand: Errand) -> None:
        """Plan the path of a robot, and prepare its driver."""
        self._driver.begin(robot, errand)
        world, start = errand.world, errand.start[:2]
        if world is None:
            raise ValueError(f"world must be known for the path of robot {robot}, got None")
        self._worlds[robot], self._period = world, errand.time_step * errand.action_repeat
        grid = self._grids.get(id(world))
        if grid is None or grid.world is not world:
            grid = self._grids[id(world)] = FreeGrid(world, distance=self._robot.radius)
        self._paths[robot] = descend(DistanceField(grid, errand.goal), start)
        self._places[robot], self._stood[robot] = start, 0.0

    def drive(self, senses: Senses) -> NDArray[np.float32]:
        """The driver's actions; those who wait stop."""
        actions, robots = np.array(self._driver.drive(senses)), senses.robots
        for robot, (x, y) in zip(robots.tolist(), senses.poses[:, :2].tolist(), strict=True):
            self._stood[robot] += self._period
            if math.dist(self._places[robot], (x, y)) > _MOVED:
                self._places[robot], self._stood[robot] = (x, y), 0.0
            self._paths[robot] = rest_of(self._paths[robot], (x, y))
        slow, fast = self._robot.min_wheel_speed, self._robot.max_wheel_speed
        standing = -(fast + slow) / (fast - slow)
        under_way = set(robots.tolist())
        for row, robot in enumerate(robots.tolist()):
            first = robot // self._team * self._team
            others = [each for each in range(first, first + self._team) if each in under_way]
            if any(self._waits(robot, other) for other in others if other != robot):
                actions[row] = standing
        return actions

    def _waits(self, robot: int, other: int) -> bool:
        """Return True if a robot lets another one pass."""
        if self._stood[other] >= _PATIENCE:
            return False
        own, others = self._paths[robot][: round(_AHEAD / _STEP)], self._paths[other]
        gaps = np.hypot(*(own[:, None] - others[None]).transpose(2, 0, 1))
        if not (gaps < 2.0 * self._robot.radius + _GAP).any():
            return False
        if self._blocks(robot, other):
            return False
        return other < robot or self._blocks(other, robot)

    def _blocks(self, robot: int, other: int) -> bool:
        """Return True if a robot is where another one has to go, and cannot be passed."""
        place, radius = self._places[robot], self._robot.radius
        away = np.hypot(*(self._paths[other] - place).T).min()
        near = bool(away < 2.0 * radius + _GAP)
        return near and self._worlds[robot].clearance(*place) < 3.0 * radius + _GAP


def descend(field: DistanceField, start: tuple[float, float]) -> NDArray[np.float64]:
    """Follow a field to its goal: points ``[P, 2]`` of the path from a start [m]."""
    place, points = np.array(start), [np.array(start)]
    turns = np.linspace(0.0, math.tau, 32, endpoint=False)
    steps = _STEP * np.stack((np.cos(turns), np.sin(turns)), axis=1)
    for _ in range(math.ceil(2.0 * field.at(*start) / _STEP)):
        if math.dist(place, field.goal) <= _STEP:
            break
        lengths = [field.at(*(place + step).tolist()) for step in steps]
        place = place + steps[int(np.argmin(lengths))]
        points.append(place)
    return np.array([*points, field.goal])


def rest_of(path: NDArray[np.float64], place: tuple[float, float]) -> NDArray[np.float64]:
    """What is left of a path from the point that is nearest to a place, among the next 3 m."""
    among = path[: round(3.0 / _STEP)]
    return path[int(np.argmin(np.hypot(*(among - place).T))) :]
