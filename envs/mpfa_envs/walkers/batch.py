"""The walkers of many robots: where they start, and where they are."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from mpfa_envs.walkers.loops import (
    ORCA,
    STRAIGHT,
    WAYPOINTS,
    WalkerArrays,
    count_encounters,
    hide_walkers,
    nearest_walker,
    walk,
)
from mpfa_envs.walkers.orca import OrcaRoom
from mpfa_envs.worlds.arrays import with_row

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.sensing.lidar import Lidar
    from mpfa_envs.walkers.starts import WalkerStarts
    from mpfa_envs.worlds.batch import WorldBatch

_MARGIN: Final = 0.05
"""A ray that ends this near to a walker, and three deviations of its noise, met it [m]."""
_BEHAVIORS: Final = {"straight": STRAIGHT, "waypoints": WAYPOINTS, "orca": ORCA}


class WalkerBatch:
    """The walkers in the worlds of many robots."""

    def __init__(self, worlds: WorldBatch, *, radius: float, time_step: float) -> None:
        count = len(worlds)
        self._worlds, self._radius, self._time_step = worlds, radius, time_step
        self._arrays = WalkerArrays(
            states=np.zeros((count, 0, 4)),
            targets=np.zeros((count, 0), dtype=np.int64),
            slacks=np.zeros((count, 0)),
            bodies=np.zeros((count, 0, 2)),
            behaviors=np.zeros((count, 0), dtype=np.int64),
            waypoints=np.zeros((count, 0, 0, 2)),
            waypoint_counts=np.zeros((count, 0), dtype=np.int64),
            counts=np.zeros(count, dtype=np.int64),
        )
        self.present = False
        """True if there are any walkers."""
        self._rooms: dict[int, OrcaRoom] = {}
        """Worlds of the robots around which walkers avoid others, by robot."""

    def begin(self, index: int, starts: WalkerStarts) -> None:
        """Put the walkers of a robot's world, and their circles in it, at their starts."""
        world = self._worlds[index]
        count = len(world.walkers)
        lengths = [len(walker.waypoints) for walker in world.walkers]
        waypoints = np.zeros((count, max(lengths, default=0), 2))
        for walker, length, points in zip(world.walkers, lengths, waypoints, strict=True):
            points[:length] = np.reshape(walker.waypoints, (length, 2))
        states, targets = starts
        self._arrays = with_row(
            self._arrays,
            index,
            states=states,
            targets=targets,
            slacks=np.zeros(count),
            bodies=np.reshape([(each.radius, each.speed) for each in world.walkers], (count, 2)),
            behaviors=[_BEHAVIORS[walker.behavior] for walker in world.walkers],
            waypoints=waypoints,
            waypoint_counts=lengths,
            counts=count,
        )
        self.present = bool(self._arrays.counts.any())
        self._rooms.pop(index, None)
        if any(walker.behavior == "orca" for walker in world.walkers):
            self._rooms[index] = OrcaRoom(world, radius=self._radius, time_step=self._time_step)
        first = self._worlds.standing.counts[index, 1]
        self._worlds.arrays.circles[index, first : first + count, :2] = states[:, :2]

    def move(self, running: NDArray[np.bool_], motions: NDArray[np.float64]) -> None:
        """Move the walkers for one time step."""
        for index, room in self._rooms.items():
            if running[index]:
                count = self._arrays.counts[index]
                states, targets = self._arrays.states[index], self._arrays.targets[index]
                room.choose(motions[index], states[:count], targets[:count])
        if self.present:
            walk(self._arrays, self._worlds.standing, running, self._time_step)

    def of(self, index: int) -> NDArray[np.float64]:
        """Walkers of a robot: (x, y), speeds in both directions, radius [m, m/s], ``[K, 5]``."""
        count = self._arrays.counts[index]
        return np.concatenate(
            (self._arrays.states[index, :count], self._arrays.bodies[index, :count, :1]), axis=1
        )

    def clearance(self, index: int, x: float, y: float) -> float:
        """Distance from a point to the nearest walker of a robot [m]; infinite without one."""
        if not self._arrays.counts[index]:
            return math.inf
        return float(nearest_walker(self._arrays, index, x, y))

    def count_encounters(
        self,
        motions: NDArray[np.float64],  # [N, 5]
        running: NDArray[np.bool_],  # [N]
        counts: NDArray[np.float64],  # Gap [m], time near, to collision [s], [3, N]
    ) -> None:
        """Update the encounters with walkers of the robots that have moved."""
        if self.present:
            count_encounters(self._arrays, motions, running, self._radius, self._time_step, counts)

    def without(
        self, motions: NDArray[np.float64], lidar: Lidar, ranges: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Ranges [m], ``[N, rays]``, where rays that met a walker report the maximum."""
        if not self.present:
            return ranges
        seen = ranges.copy()
        directions = np.stack((np.cos(lidar.angles), np.sin(lidar.angles)))
        margin = _MARGIN + 3 * lidar.noise
        hide_walkers(self._arrays, lidar.placed(motions), directions, margin, lidar.max_range, seen)
        return seen
