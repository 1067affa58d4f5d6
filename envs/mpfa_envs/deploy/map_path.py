"""The map that a robot makes and the path over it, for policies that sense one; needs Numba."""

from __future__ import annotations

from importlib import import_module
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from mpfa_envs.deploy.sectors import Points
from mpfa_envs.sensing.map_loops import UNKNOWN
from mpfa_envs.sensing.map_memory import MapMemory

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.deploy.card import Card


class MapPath:
    """A square map around a place, of a side [m], and the path over it to the goal."""

    def __init__(self, card: Card, *, size: float) -> None:
        # Without Numba the loops would run, but a thousand times more slowly.
        import_module("numba")
        # The rays come with each scan, and of the room only the size is known.
        rays = {"angles": np.zeros(1), "mount": (0.0, 0.0)}
        lidar: Any = SimpleNamespace(**rays, max_range=card.max_range)
        self._memory = MapMemory(1, card.robot, lidar)
        self._room: Any = SimpleNamespace(size=(size, size))
        self._center = np.zeros(2)
        # The loops are compiled by their first call, which takes seconds.
        self.begin((0.0, 0.0))
        self.sense((0.0, 0.0, 0.0), (1.0, 0.0), Points(np.zeros(1), np.ones(1)))

    def begin(self, center: tuple[float, float]) -> None:
        """Begin an empty map around a place [m]."""
        self._center[:] = center
        self._memory.begin(0, self._room)

    def look_again(self) -> None:
        """The goal has moved: no path to it is known."""
        self._memory.arrays.costs[0] = UNKNOWN

    def sense(
        self, pose: tuple[float, float, float], goal: tuple[float, float], points: Points
    ) -> NDArray[np.float64]:
        """Enter points; direction (x, y) for the robot and length of the path, ``[1, 3]``."""
        motion = np.zeros((1, 5))
        motion[0, :2], motion[0, 2] = np.subtract(pose[:2], self._center), pose[2]
        goals = np.subtract(goal, self._center)[None]
        directions = np.stack((np.cos(points.angles), np.sin(points.angles)))
        return self._memory.remember(motion, goals, points.ranges[None], directions=directions)
