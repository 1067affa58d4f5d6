"""The map that a robot makes and the way over it, for policies that sense one; needs Numba."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from mpfa_envs.deploy.sectors import Points
from mpfa_envs.sensing.map_loops import UNKNOWN
from mpfa_envs.sensing.map_memory import MapMemory

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.deploy.card import Card


class _Rays:
    """What :class:`~mpfa_envs.MapMemory` needs of a lidar whose rays change from scan to scan."""

    def __init__(self, max_range: float) -> None:
        self.angles = np.zeros(1)
        self.max_range = max_range


class _Square:
    """What it needs of a world."""

    def __init__(self, side: float) -> None:
        self.size = side, side


class Way:
    """A map around a place, empty at first.

    Args:
        card: Of the policy.
        size: Side of the map, a square [m].

    Raises:
        ImportError: If there is no Numba.
    """

    def __init__(self, card: Card, *, size: float) -> None:
        # Without it the loops over the map would run, a thousand times too slowly.
        import_module("numba")
        lidar = _Rays(card.max_range)
        self._memory = MapMemory(1, card.robot, lidar)
        self._square = _Square(size)
        self._center = np.zeros(2)

    def begin(self, center: tuple[float, float]) -> None:
        """Forget all, and map around another place [m]."""
        self._center[:] = center
        self._memory.begin(0, self._square)

    def warm_up(self) -> None:
        """Have the loops compiled, which takes seconds the first time."""
        self.begin((0.0, 0.0))
        self.sense((0.0, 0.0, 0.0), (1.0, 0.0), Points(np.zeros(1), np.ones(1)))

    def look_anew(self) -> None:
        """The goal has moved: no way to it is known."""
        self._memory.arrays.costs[0] = UNKNOWN

    def sense(
        self, pose: tuple[float, float, float], goal: tuple[float, float], points: Points
    ) -> NDArray[np.float64]:
        """Enter what was met, and find the way.

        Args:
            pose: Of the robot (x, y, heading) [m, m, rad].
            goal: Where it should go (x, y) [m].
            points: What the lidar has met.

        Returns:
            Direction (x, y) in the robot's frame and length of the way [m], ``[3]``.
        """
        motion = np.zeros((1, 5))
        motion[0, :2], motion[0, 2] = np.subtract(pose[:2], self._center), pose[2]
        goals = np.subtract(goal, self._center)[None]
        directions = np.stack((np.cos(points.angles), np.sin(points.angles)))
        ways = self._memory.remember(motion, goals, points.ranges[None], directions=directions)
        found: NDArray[np.float64] = ways[0]
        return found
