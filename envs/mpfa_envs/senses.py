"""What one robot senses, and what it keeps of it: its map and its last scans."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mpfa_envs.observation import add_history, observe

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.arguments import TaskArguments
    from mpfa_envs.drives import Motion
    from mpfa_envs.lidar import Lidar
    from mpfa_envs.map_memory import MapMemory, Sketch
    from mpfa_envs.walker_batch import WalkerBatch
    from mpfa_envs.worlds import World


class Senses:
    """Builds the observations of :class:`~mpfa_envs.NavigationEnv`.

    Args:
        rules: The arguments of the task.
        lidar: What the robot sees by.
    """

    def __init__(self, rules: TaskArguments, lidar: Lidar) -> None:
        self._rules = rules
        self._lidar = lidar
        self._map = _make_map(rules, lidar) if rules.memory == "map" else None
        self._last: NDArray[np.float32] | None = None

    def begin(self, world: World) -> None:
        """Forget what the robot has seen; its next episode is in a world."""
        self._last = None
        if self._map is not None:
            self._map.begin(0, world)

    def observe(
        self,
        motion: Motion,
        odometry: Motion,
        goal: tuple[float, float],
        *,
        walkers: WalkerBatch | None,
        rng: np.random.Generator | None,
    ) -> NDArray[np.float32]:
        """Sense the world and build the observation.

        Args:
            motion: Where the robot is and how it moves.
            odometry: The same as it holds it to be.
            goal: Where it should go (x, y) [m].
            walkers: What moves around it, if anything does.
            rng: Source of the lidar's noise; needed only if there is noise.

        Returns:
            The observation, ``[O]``.
        """
        rules, lidar = self._rules, self._lidar
        moving = None if walkers is None else walkers.circles(0)
        rays = lidar.measure(*motion[:3], rng=rng, moving=moving)
        way = None
        if self._map is not None:
            met = rays[None]
            if walkers is not None:
                met = walkers.without(np.array([motion]), lidar, met)
            way = self._map.remember(np.array([odometry]), np.array([goal]), met)[0]
        seen = observe(
            lidar.reduce(rays),
            odometry,
            goal,
            math.dist(goal, odometry[:2]),
            rules.robot,
            rules.closeness_distance,
            way,
        )
        if rules.history:
            seen = add_history(seen, self._last, lidar.sectors, rules.history)
            self._last = seen.copy()
        return seen

    def sketch(self, x: float, y: float) -> Sketch | None:
        """The map that the robot has made, around where it is [m]; None if it makes none."""
        return None if self._map is None else self._map.sketch(0, x, y)


def _make_map(rules: TaskArguments, lidar: Lidar) -> MapMemory:
    """The map that the robot makes."""
    # Imported here because it needs Numba, which takes half a second.
    from mpfa_envs.map_memory import MapMemory

    return MapMemory(1, rules.robot, lidar)
