"""The walkers of many robots: where they start, and where they are."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpfa_envs.saved import read_array
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

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from mpfa_envs.sensing.lidar import Lidar
    from mpfa_envs.walkers.starts import WalkerStarts
    from mpfa_envs.worlds.batch import WorldBatch
    from mpfa_envs.worlds.world import World

_MARGIN: Final = 0.05
"""A ray that ends this near to a walker, and three deviations of its noise, met it [m]."""
_CHANGING: Final = ("states", "targets")
_BEHAVIORS: Final = {"straight": STRAIGHT, "waypoints": WAYPOINTS, "orca": ORCA}


class WalkerBatch:
    """The walkers in the worlds of many robots.

    Args:
        worlds: The worlds; their circles are kept where the walkers are.
        radius: Radius of the robots [m].
        time_step: Duration of a time step [s].

    Examples:
        >>> import numpy as np
        >>> from mpfa_envs import Walker, World
        >>> from mpfa_envs.walkers.batch import WalkerBatch
        >>> from mpfa_envs.walkers.starts import start_walkers
        >>> from mpfa_envs.worlds.batch import WorldBatch
        >>> worlds = WorldBatch([World(name="one", walkers=(Walker(),))])
        >>> batch = WalkerBatch(worlds, radius=0.18, time_step=0.1)
        >>> batch.begin(0, start_walkers(worlds[0], (0.0, 0.0), np.random.default_rng(0)))
        >>> before = batch.of(0)
        >>> batch.move(np.array([True]), np.zeros((1, 5)))
        >>> float(np.hypot(*(batch.of(0) - before)[0, :2]).round(6))  # 0.3 m/s for 0.1 s
        0.03
    """

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
        self._rooms: dict[int, OrcaRoom] = {}
        """The worlds of the robots around whom somebody avoids others."""

    def begin(self, index: int, starts: WalkerStarts) -> None:
        """Put the walkers of a robot's world where they start.

        Args:
            index: Number of the robot.
            starts: What :func:`~mpfa_envs.walkers.starts.start_walkers` gave for that world.
        """
        self._set(index, self._worlds[index])
        states, targets = starts
        count = len(states)
        if not count:
            return
        self._arrays.states[index, :count], self._arrays.targets[index, :count] = states, targets
        self._place(index)

    def move(self, running: NDArray[np.bool_], motions: NDArray[np.float64]) -> None:
        """Let walkers walk for one time step.

        Args:
            running: The walkers of which robots, ``[N]``.
            motions: Poses and speeds of the robots, ``[N, 5]``, for those who avoid them.
        """
        for index, room in self._rooms.items():
            if running[index]:
                count = self._arrays.counts[index]
                states, targets = self._arrays.states[index], self._arrays.targets[index]
                room.choose(motions[index], states[:count], targets[:count])
        if self.present:
            walk(self._arrays, self._worlds.standing, running, self._time_step)

    @property
    def present(self) -> bool:
        """Whether there are any walkers."""
        return bool(self._arrays.counts.any())

    def of(self, index: int) -> NDArray[np.float64]:
        """The walkers of a robot: (x, y), speeds in both directions, radius [m, m/s], ``[K, 5]``.

        Args:
            index: Number of the robot.
        """
        count = self._arrays.counts[index]
        return np.concatenate(
            (self._arrays.states[index, :count], self._arrays.bodies[index, :count, :1]), axis=1
        )

    def circles(self, index: int) -> NDArray[np.float64]:
        """The same as circles (x, y, radius) [m], ``[K, 3]``."""
        return self.of(index)[:, [0, 1, 4]]

    def clearance(self, index: int, x: float, y: float) -> float:
        """Distance from a point to the nearest walker of a robot [m]; infinite without one."""
        return float(nearest_walker(self._arrays, index, x, y))

    def count_encounters(
        self,
        motions: NDArray[np.float64],
        running: NDArray[np.bool_],
        counts: NDArray[np.float64],
    ) -> None:
        """Take in how near the walkers are to robots that have moved.

        Args:
            motions: Poses and speeds of the robots, ``[N, 5]``.
            running: Which have moved, ``[N]``.
            counts: Least distance between the rims [m], time in personal space [s] and least time
                to collision [s] so far, ``[3, N]``; changed in place.
        """
        if self.present:
            count_encounters(self._arrays, motions, running, self._radius, self._time_step, counts)

    def without(
        self, motions: NDArray[np.float64], lidar: Lidar, ranges: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Ranges in which the rays that met a walker have met nothing.

        Args:
            motions: Poses (x, y, heading) in the first three columns [m, m, rad], ``[N, 5]``.
            lidar: What the robots see by.
            ranges: Range of each ray [m], ``[N, rays]``.

        Returns:
            The same array if there are no walkers, else another one.
        """
        if not self.present:
            return ranges
        seen = ranges.copy()
        directions = np.stack((np.cos(lidar.angles), np.sin(lidar.angles)))
        margin = _MARGIN + 3 * lidar.noise
        hide_walkers(self._arrays, motions, directions, margin, lidar.max_range, seen)
        return seen

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """Where the walkers are and go, as arrays; the worlds have the rest."""
        return {name: getattr(self._arrays, name).copy() for name in _CHANGING}

    def read(self, state: Mapping[str, Any], worlds: list[World]) -> dict[str, NDArray[Any]]:
        """Check what :meth:`state_dict` gave, before :meth:`load` takes it.

        Args:
            state: What it gave.
            worlds: The worlds that go with it.

        Returns:
            Its arrays.

        Raises:
            ValueError: If something is missing, of another shape or not finite, or leads to a
                waypoint that there is not.
        """
        most = np.shape(state.get("states", ()))[1:2]
        need = max((len(world.walkers) for world in worlds), default=0)
        if len(most) != 1 or most[0] < need:
            raise ValueError(f"states of the state must have rows for {need} walkers")
        likes = {
            "states": np.zeros((len(worlds), *most, 4)),
            "targets": np.zeros((len(worlds), *most), dtype=np.int64),
        }
        found = {name: read_array(state, name, like) for name, like in likes.items()}
        for world, targets in zip(worlds, found["targets"], strict=True):
            for walker, target in zip(world.walkers, targets.tolist(), strict=False):
                # The compiled loops do not look where an array ends.
                if not 0 <= target < max(len(walker.waypoints), 1):
                    raise ValueError(
                        f"targets of the state must be numbers of waypoints, got {target} for "
                        f"{walker}"
                    )
        return found

    def load(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Put the walkers of all worlds where :meth:`read` says that they are."""
        for index, world in enumerate(self._worlds):
            self._set(index, world)
            count = len(world.walkers)
            for name in _CHANGING:
                getattr(self._arrays, name)[index, :count] = arrays[name][index, :count]
            self._place(index)

    def _set(self, index: int, world: World) -> None:
        """Take in who walks in a world."""
        count = len(world.walkers)
        self._make_room(count, max((len(each.waypoints) for each in world.walkers), default=0))
        arrays = self._arrays
        arrays.counts[index] = count
        self._rooms.pop(index, None)
        if any(walker.behavior == "orca" for walker in world.walkers):
            self._rooms[index] = OrcaRoom(world, radius=self._radius, time_step=self._time_step)
        for number, walker in enumerate(world.walkers):
            arrays.bodies[index, number] = walker.radius, walker.speed
            arrays.behaviors[index, number] = _BEHAVIORS[walker.behavior]
            points = len(walker.waypoints)
            arrays.waypoint_counts[index, number] = points
            if points:
                arrays.waypoints[index, number, :points] = walker.waypoints

    def _place(self, index: int) -> None:
        """Write where the walkers of a robot are into the circles of its world."""
        count = self._arrays.counts[index]
        first = self._worlds.standing.counts[index, 1]
        places = self._arrays.states[index, :count, :2]
        self._worlds.arrays.circles[index, first : first + count, :2] = places
        self._arrays.slacks[index] = 0.0

    def _make_room(self, walkers: int, waypoints: int) -> None:
        """Have rows for so many walkers and waypoints at least."""
        _, most, most_points, _ = self._arrays.waypoints.shape
        if walkers <= most and waypoints <= most_points:
            return
        sides = max(walkers, most), max(waypoints, most_points)
        wider = {}
        for name, old in self._arrays._asdict().items():
            new = old.shape[:1] + sides[: old.ndim - 1] + old.shape[3:]
            if name in ("states", "bodies"):
                new = (len(old), sides[0], old.shape[2])
            wider[name] = np.zeros(new, dtype=old.dtype)
            wider[name][tuple(map(slice, old.shape))] = old
        self._arrays = WalkerArrays(**wider)
