"""A robot's memory: a map of its lidar's hits, and the path to the goal on it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from mpfa_envs.sensing.map_loops import (
    BLOCKED,
    UNKNOWN,
    MapArrays,
    cell_of,
    enter_scans,
    follow_path,
)
from mpfa_envs.worlds.arrays import grown

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.robots.model import RobotModel
    from mpfa_envs.sensing.lidar import Lidar
    from mpfa_envs.worlds.world import World

RESOLUTION: Final = 0.1
"""Side of a cell [m]."""
_MARGIN: Final = 5
"""Cells around the world: where it ends is not known before a wall was seen."""
_BLOCKED: Final = -0.02
"""Clearance of the robot's rim at or below which a cell is blocked [m]. A cell holds places up to
half its side farther from a wall than its middle: with 0 a door 0.1 m wider than the robot would be
blocked or not by where the map begins."""
_TIGHT: Final = 0.06
"""Clearance below which a cell is tight [m]."""
_NEAR: Final = 0.22
"""Clearance below which a cell is near an obstacle [m]."""


class KnownMap(NamedTuple):
    """A robot's map as a picture needs it."""

    blocked: NDArray[np.bool_]
    """Where the robot's center cannot be, ``[columns, rows]`` of cells around the world's middle,
    the first column at the left and the first row at the bottom."""
    path: list[tuple[float, float]]
    """Centers of the cells of its path to the goal, in order (x, y) [m]."""
    resolution: float
    """Side of a cell [m]."""


def clearances_of(
    plan: World,
    pose: tuple[float, float, float],
    origin: NDArray[np.float64],
    shape: tuple[int, int],
) -> NDArray[np.float64]:
    """Distances of a grid's cells from what a plan at a pose has [m], ``[columns, rows]``."""
    cells = np.indices(shape).reshape(2, -1).T
    x, y = (origin + RESOLUTION * cells - pose[:2]).T
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    points = np.stack((x * cosine + y * sine, y * cosine - x * sine), axis=1)
    return plan.clearances(points).reshape(shape)


class MapMemory:
    """A map for each of many robots, empty when an episode begins, or as a plan says.

    The map has square cells. Where the robot's center cannot be, as a point that the lidar hit
    would be 2 cm inside its rim, a cell is blocked; unseen cells count as free. The path is the
    cheapest one to the goal over the map, where cells near an obstacle cost three times as much as
    free ones, tight ones thirty and blocked ones two hundred times, found again whenever a scan
    makes it costlier. Its direction is that of the farthest of its next cells, two meters away at
    most, to which a straight line is no narrower than its ends.

    It knows of the world only the scans, entered at the poses that odometry gives, and its plan if
    it is given. Scans add what the plan does not have; what it has too much stays, at the cost of
    blocked cells.

    Args:
        count: Number of robots N.
        robot: Robot whose radius decides where its center fits.
        lidar: The robots' lidar; its ``angles``, ``max_range`` and ``mount`` count.

    Examples:
        >>> from mpfa_envs import Box, Lidar, World
        >>> from mpfa_envs.sensing.map_memory import MapMemory
        >>> from mpfa_envs.robots.model import ROBOTS
        >>> wall = World(name="wall", boxes=(Box(0.9, -1.5, 1.1, 1.5),))
        >>> memory = MapMemory(1, ROBOTS["turtlebot2"], lidar := Lidar(wall))
        >>> memory.begin(0, wall)
        >>> ranges = lidar.cast(0.0, 0.0, 0.0)[None]
        >>> path = memory.remember(np.zeros((1, 5)), np.array([[3.0, 0.0]]), ranges)[0]
        >>> bool(abs(path[1]) > 0.5), bool(path[2] > 3.0)  # Around the wall, which is longer.
        (True, True)
    """

    def __init__(self, count: int, robot: RobotModel, lidar: Lidar) -> None:
        self.arrays = MapArrays(
            np.zeros((count, 0, 0), dtype=np.uint8),
            np.zeros((count, 0, 0), dtype=np.int32),
            np.zeros((count, 2), dtype=np.int64),
            np.zeros((count, 2)),
        )
        """The maps, as compiled loops read them."""
        self._paths = np.zeros((count, 3))
        self._directions = np.stack((np.cos(lidar.angles), np.sin(lidar.angles)))
        radius = robot.radius
        bounds = radius + _BLOCKED, radius + _TIGHT, radius + _NEAR
        self._lengths = RESOLUTION, *bounds, lidar.max_range
        self._mount = lidar.mount

    @property
    def bounds(self) -> tuple[float, float, float]:
        """Distances from a hit up to which cells are blocked, tight and near [m]."""
        return self._lengths[1:4]

    def begin(
        self,
        index: int,
        world: World,
        *,
        plan: World | None = None,
        pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Clear a robot's map.

        Args:
            index: Number of the robot.
            world: Room of its next episode, for whose ``size`` the map is made.
            plan: What is known: cells have the levels that hits on all of its obstacles and walls
                would give them; None: nothing.
            pose: Of the plan's origin in the world (x, y, heading) [m, m, rad].
        """
        sides = [math.ceil(side / RESOLUTION) + 2 * _MARGIN for side in world.size]
        arrays = self.arrays
        levels, costs = grown(arrays.levels, *sides), grown(arrays.costs, *sides)
        self.arrays = arrays = arrays._replace(levels=levels, costs=costs)
        arrays.shapes[index] = sides
        arrays.origins[index] = [-(side - 1) / 2 * RESOLUTION for side in sides]
        arrays.levels[index] = 0
        arrays.costs[index] = UNKNOWN
        if plan is not None:
            clearance = clearances_of(plan, pose, arrays.origins[index], (sides[0], sides[1]))
            levels[index, : sides[0], : sides[1]] = sum(
                (clearance <= bound).astype(np.uint8) for bound in self._lengths[1:4]
            )
        self._paths[index] = 0.0

    def remember(
        self,
        motions: NDArray[np.float64],
        goals: NDArray[np.float64],
        ranges: NDArray[np.float64],
        chosen: NDArray[np.bool_] | None = None,
        *,
        directions: NDArray[np.float64] | None = None,
        taken: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Enter a scan in the maps and find the paths.

        Args:
            motions: Poses (x, y, heading) in the first three columns [m, m, rad], ``[N, 5]``.
            goals: Positions (x, y) [m], ``[N, 2]``.
            ranges: Range of each ray [m], ``[N, rays]``.
            chosen: Which robots have looked around, ``[N]``; None: all. The others' paths stay.
            directions: Cosine and sine of each ray's angle in the robot's frame, ``[2, rays]``;
                None: those of the lidar.
            taken: Poses where the scans were taken, as motions; None: the same.

        Returns:
            Direction (x, y) in the robot's frame and length [m] of the path, ``[N, 3]``; the length
            counts a meter near obstacles as three.
        """
        if chosen is None:
            chosen = np.ones(len(motions), dtype=np.bool_)
        directions = self._directions if directions is None else directions
        taken = motions if taken is None else taken
        how = self.arrays, self._lengths, self._mount
        enter_scans(motions, taken, goals, ranges, chosen, directions, *how, self._paths)
        return self._paths

    def known_map(self, index: int, x: float, y: float) -> KnownMap:
        """Give a robot's map and its path from a position, for a picture.

        Args:
            index: Number of the robot.
            x: Position [m].
            y: Position [m].
        """
        columns, rows = self.arrays.shapes[index]
        levels = self.arrays.levels[index, :columns, :rows]
        costs = self.arrays.costs[index, :columns, :rows]
        origin = self.arrays.origins[index]
        u, v = (np.array((x, y)) - origin) / RESOLUTION
        path = follow_path(levels, costs, cell_of(u, columns), cell_of(v, rows))
        along = [(across, up) for across, up in (origin + RESOLUTION * path).tolist()]
        return KnownMap(levels == BLOCKED, along, RESOLUTION)
