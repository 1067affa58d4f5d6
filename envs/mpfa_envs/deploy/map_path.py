"""Places in the frame of the odometry, the map that a robot makes, and the path over it."""

from __future__ import annotations

import math
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from mpfa_envs.checks import MEANT, check_meant
from mpfa_envs.deploy.card import check_finite
from mpfa_envs.deploy.reach import closes_in
from mpfa_envs.sensing.hits import Hits
from mpfa_envs.sensing.map_loops import UNKNOWN
from mpfa_envs.sensing.map_memory import RESOLUTION, MapMemory, clearances_of
from mpfa_envs.sensing.sectors import Points
from mpfa_envs.worlds.world import World

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.deploy.card import Card
    from mpfa_envs.sensing.map_loops import MapArrays

_FARTHEST: Final = 1e7
"""Largest coordinate of a place [m]; those of UTM are smaller."""
_LARGEST_MAP: Final = 2.0 * MEANT["map_size"][1]
"""Side of the square around a robot in which its goal must be, without a map, too [m]."""


class GoalError(ValueError):
    """A goal that cannot be reached; the message says why."""


def pair_of(name: str, place: tuple[float, float]) -> tuple[float, float]:
    """Two finite numbers within the range of observations."""
    x, y = check_finite(name, place, 2)
    if max(abs(x), abs(y)) > _FARTHEST:
        raise ValueError(f"{name} must be within {_FARTHEST:g} m of the origin, got {place}")
    return x, y


def plan_at(world: World, pose: tuple[float, float, float]) -> Plan:
    """Return the plan of a world at a pose."""
    if not isinstance(world, World):
        # The text of any other object may have an address in memory.
        given = repr(world) if isinstance(world, str | Path) else type(world).__name__
        raise ValueError(f"plan must be a World, got {given}; load_world reads one from a file")
    x, y, heading = check_finite("plan_pose", pose, 3)
    check_meant("plan_pose", heading, "yaw")
    return Plan(world, (*pair_of("plan_pose", (x, y)), heading))


def sides_of(plan: Plan | None, map_size: float | None) -> tuple[float, float]:
    """Width and depth of the map [m]; without one, of what a goal may be away."""
    side = _LARGEST_MAP if map_size is None else map_size
    return (side, side) if plan is None else plan.size


def check_on_map(
    goal: tuple[float, float],
    center: tuple[float, float] | None,
    plan: Plan | None,
    map_size: float | None,  # [m]; None: there is no map
) -> None:
    """Reject a goal beyond the map, once its center is known, or one in another unit."""
    if center is None:
        return
    width, depth = sides_of(plan, map_size)
    if abs(goal[0] - center[0]) > 0.5 * width or abs(goal[1] - center[1]) > 0.5 * depth:
        size = f"{width:g} m" + " (map_size)" * (map_size is not None)
        if plan is not None:
            size = f"{width:g} m x {depth:g} m (plan)"
        raise GoalError(
            f"goal must be on the map, {size} around "
            f"({center[0]:.2f}, {center[1]:.2f}), got ({goal[0]:.2f}, {goal[1]:.2f})"
        )


class Plan(NamedTuple):
    """A plan that a robot knows, and where it lies."""

    world: World
    pose: tuple[float, float, float]
    """Of the plan's frame in that of the odometry (x, y, heading) [m, m, rad]."""

    def check(self, *, has_map: bool, center: tuple[float, float] | None) -> None:
        """Reject a plan for a policy without a map, or beside a center of the map."""
        if not has_map or center is not None:
            raise ValueError(
                "plan must be None for a policy without a map (memory='map'), and with a "
                f"map_center, got {self.world.name!r}"
            )

    @property
    def middle(self) -> tuple[float, float]:
        """Middle of the world in the frame of the odometry (x, y) [m]."""
        x, y, heading = self.pose
        # A map of ROS has an origin of its own.
        cells = self.world.occupancy
        across, up = (0.0, 0.0) if cells is None else cells.center
        cosine, sine = math.cos(heading), math.sin(heading)
        return x + across * cosine - up * sine, y + across * sine + up * cosine

    @property
    def size(self) -> tuple[float, float]:
        """Sides of the smallest rectangle along the axes of the odometry that holds it [m]."""
        width, depth = self.world.size
        cosine, sine = abs(math.cos(self.pose[2])), abs(math.sin(self.pose[2]))
        return width * cosine + depth * sine, width * sine + depth * cosine

    def is_off(self, pose: tuple[float, float, float]) -> bool:
        """Return True if from another pose a wall of the plan would be in another cell."""
        reach = 0.5 * math.hypot(*self.world.size)
        turn = abs(math.remainder(pose[2] - self.pose[2], math.tau))
        return math.dist(self._replace(pose=pose).middle, self.middle) + reach * turn > RESOLUTION


class MapPath:
    """A map around a place, the path over it to the goal, and whether there is one.

    The map forgets what rays look through, but for what the plan has.
    """

    def __init__(self, card: Card) -> None:
        # Without Numba the loops would run, but a thousand times more slowly.
        import_module("numba")
        # The rays come with each scan, and of the world only the size is known.
        rays = {"angles": np.zeros(1), "mount": (0.0, 0.0)}
        lidar: Any = SimpleNamespace(**rays, max_range=card.max_range)
        self._memory = MapMemory(1, card.robot, lidar)
        self._center = np.zeros(2)
        self._hits, self._planned = Hits(RESOLUTION), self._memory.arrays.levels[0]
        self._rim, self._far = card.robot.radius, card.max_range
        # The loops are compiled by their first call, which takes seconds.
        self.begin((0.0, 0.0), (10.0, 10.0))
        here = np.zeros(3)
        self.sense(here, here, (1.0, 0.0), Points(np.zeros(1), np.ones(1)))
        self._forget(np.zeros((1, 2), dtype=np.int64))
        self.closes_in((1.0, 0.0), 0.5, (0.0, 0.0))

    def begin(
        self, center: tuple[float, float], size: tuple[float, float], plan: Plan | None = None
    ) -> None:
        """Begin a map of a size around a place [m], empty or with what a plan knows."""
        self._center[:] = center
        extent: Any = SimpleNamespace(size=size)
        memory, walls = self._memory, None
        if plan is None:
            memory.begin(0, extent)
        else:
            x, y = np.subtract(plan.middle, center).tolist()
            memory.begin(0, extent, plan=plan.world, pose=(x, y, plan.pose[2]))
        columns, rows = memory.arrays.shapes[0].tolist()
        origin = memory.arrays.origins[0] + self._center
        if plan is not None:
            pose = *plan.middle, plan.pose[2]
            away = clearances_of(plan.world, pose, origin, (columns, rows))
            walls = away <= 0.5 * RESOLUTION
        self._hits.begin((columns, rows), origin, walls)
        self._planned = memory.arrays.levels[0].copy()

    def _forget(self, cells: NDArray[np.int64]) -> None:
        """Make the map around cells again, from which what was there has gone."""
        self._hits.lower(self._memory.arrays.levels[0], self._planned, cells, self._memory.bounds)
        # Paths may be cheaper now.
        self.look_again()

    @property
    def arrays(self) -> MapArrays:
        """The map, which changes with each scan, in the frame of the odometry."""
        arrays = self._memory.arrays
        return arrays._replace(origins=arrays.origins + self._center)

    @property
    def shape(self) -> tuple[int, int]:
        """Its columns and rows."""
        columns, rows = self._memory.arrays.shapes[0].tolist()
        return columns, rows

    def look_again(self) -> None:
        """The goal or the map is another one: no path is known."""
        self._memory.arrays.costs[0] = UNKNOWN

    def closes_in(
        self, goal: tuple[float, float], radius: float, place: tuple[float, float]
    ) -> bool:
        """Return True if what is known keeps a place from within a radius of a goal [m]."""
        return closes_in(self._hits.walls, self._hits.origin, self._rim, goal, radius, place)

    def reject_closed(
        self, goal: tuple[float, float], radius: float, place: tuple[float, float]
    ) -> None:
        """Reject a goal that the plan closes in."""
        if self.closes_in(goal, radius, place):
            x, y = goal
            raise GoalError(
                f"goal must be reachable, got ({x:.2f}, {y:.2f}): the plan closes it in"
            )

    def sense(
        self,
        pose: NDArray[np.float64],
        taken: NDArray[np.float64],
        goal: tuple[float, float],
        points: Points,
    ) -> NDArray[np.float64]:
        """Enter points taken at a pose; direction (x, y) and length of the path, ``[1, 3]``."""
        if len(emptied := self._hits.see(taken, points, self._far)):
            self._forget(emptied)
        poses = np.zeros((2, 1, 5))
        poses[:, 0, :3] = pose[:3], taken[:3]
        poses[:, 0, :2] -= self._center
        goals = np.subtract(goal, self._center)[None]
        directions = np.stack((np.cos(points.angles), np.sin(points.angles)))
        ranges = points.ranges[None]
        return self._memory.remember(poses[0], goals, ranges, directions=directions, taken=poses[1])
