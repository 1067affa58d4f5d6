"""The walkers of many robots: where they start, where they are, and how they avoid each other.

Those that avoid each other and the robot do so by the ORCA of the RVO2 library.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, TypeAlias

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
from mpfa_envs.worlds.arrays import with_row

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.sensing.lidar import Lidar
    from mpfa_envs.worlds.batch import WorldBatch
    from mpfa_envs.worlds.shapes import Point
    from mpfa_envs.worlds.walker import Walker
    from mpfa_envs.worlds.world import World

WalkerStarts: TypeAlias = "tuple[NDArray[np.float64], NDArray[np.int64]]"
"""(x, y) and both speeds [m, m/s], ``[K, 4]``; the index of the next waypoint, ``[K]``."""
_START: Final = 1.0
"""Distance of a walker's rim from the robot's center at the start, where that is possible [m]."""
_SLACK: Final = 0.02
"""Distance of a walker's rim from obstacles at the start [m]."""
_SAMPLES: Final = 256
"""Places that are sampled at once."""
_FEW: Final = 16
"""Those of them that are checked first."""
_ROUNDS: Final = 20


def start_walkers(world: World, start: Point, rng: np.random.Generator) -> WalkerStarts:
    """Sample the starts of a world's walkers."""
    states = np.zeros((len(world.walkers), 4))
    targets = np.zeros(len(world.walkers), dtype=np.int64)
    taken = [(*start, _START)]
    for number, walker in enumerate(world.walkers):
        sample = _sample_room if walker.behavior == "straight" else _sample_round
        for _ in range(_ROUNDS):
            places, nexts, headings = sample(world, walker, rng)
            chosen = _choose(world, walker, places, taken)
            if chosen is not None:
                break
        else:
            raise ValueError(f"world {world.name!r} has no place for {walker}")
        x, y = places[chosen].tolist()
        heading = float(headings[chosen])
        states[number] = x, y, walker.speed * math.cos(heading), walker.speed * math.sin(heading)
        targets[number] = nexts[chosen]
        taken.append((x, y, walker.radius))
    return states, targets


def _choose(
    world: World,
    walker: Walker,
    places: NDArray[np.float64],
    taken: list[tuple[float, float, float]],
) -> int | None:
    """Number of the first free place that is far enough from what is taken, or of the farthest."""
    # One of the first nearly always does; checking all takes ten times as long.
    for few in (places[:_FEW], places):
        gaps = np.min([np.hypot(few[:, 0] - x, few[:, 1] - y) - reach for x, y, reach in taken], 0)
        free = np.ones(len(few), dtype=np.bool_)
        if walker.behavior == "straight":  # A round is free, which the world has checked.
            free = world.clearances(few) >= walker.radius + _SLACK
        enough = free & (gaps >= walker.radius)
        if enough.any():
            return int(np.argmax(enough))
    return int(np.argmax(np.where(free, gaps, -np.inf))) if free.any() else None


def _sample_room(
    world: World, walker: Walker, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Places anywhere in the world with a direction each: (x, y), 0 and heading."""
    half = np.array(world.size) / 2 - walker.radius
    places = rng.uniform(-half, half, (_SAMPLES, 2))
    headings = rng.uniform(-math.pi, math.pi, _SAMPLES)
    return places, np.zeros(_SAMPLES, dtype=np.int64), headings


def _sample_round(
    world: World, walker: Walker, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Places anywhere on a walker's round: (x, y), the next waypoint and the heading to it."""
    points = np.array(walker.waypoints)
    steps = np.roll(points, -1, axis=0) - points
    ends = np.cumsum(np.hypot(*steps.T))
    along = rng.uniform(0.0, ends[-1], _SAMPLES)
    legs = np.minimum(np.searchsorted(ends, along, side="right"), len(points) - 1)
    shares = 1.0 - (ends[legs] - along) / np.hypot(*steps[legs].T)
    places = points[legs] + shares[:, None] * steps[legs]
    return places, (legs + 1) % len(points), np.arctan2(steps[legs, 1], steps[legs, 0])


_REACH: Final = 5.0
"""Walkers farther away are ignored [m]."""
_HORIZON: Final = 3.0
"""Time ahead for which collisions with others are avoided [s]."""
_WALL_HORIZON: Final = 1.0
"""Time ahead for which collisions with obstacles are avoided [s]."""
_CORNERS: Final = 12
"""Corners of the polygon that a cylinder is to the library."""


class OrcaRoom:
    """One robot's world for the library: all walkers, the robot, and the obstacles."""

    # ORCA (van den Berg et al. 2011, https://doi.org/10.1007/978-3-642-19457-3_1) gives each walker
    # the velocity nearest to the one that it wants with which none collide if both do their
    # half. Nothing but the obstacles is kept from one time step to the next.

    def __init__(self, world: World, *, radius: float, time_step: float) -> None:
        try:
            from pyrvo import RVOSimulator
        except ImportError as error:
            raise ImportError(
                "behavior='orca' needs pyrvo: install the extra 'orca', see Install in the README"
            ) from error
        self._walkers = world.walkers
        self._simulator: Any = RVOSimulator()
        self._simulator.set_time_step(time_step)
        bodies = [(radius, 10.0), *((walker.radius, walker.speed) for walker in world.walkers)]
        for size, speed in bodies:
            self._simulator.add_agent(
                (0.0, 0.0), _REACH, len(bodies), _HORIZON, _WALL_HORIZON, size, speed, (0.0, 0.0)
            )
        for outline in _outlines(world):
            self._simulator.add_obstacle(outline)
        self._simulator.process_obstacles()

    def choose(
        self,
        motion: NDArray[np.float64],
        states: NDArray[np.float64],  # (x, y) [K, 4] [m, m/s]
        targets: NDArray[np.int64],  # [K]
    ) -> None:
        """Choose the next velocities of the walkers with ``"orca"``."""
        x, y, heading, speed, _ = motion.tolist()
        self._set(0, x, y, speed * math.cos(heading), speed * math.sin(heading), None)
        for number, (walker, state) in enumerate(zip(self._walkers, states.tolist(), strict=True)):
            wanted = None
            if walker.behavior == "orca":
                to_x, to_y = walker.waypoints[int(targets[number])]
                across, up = to_x - state[0], to_y - state[1]
                scale = walker.speed / max(math.hypot(across, up), 1e-9)
                wanted = (scale * across, scale * up)
            at_x, at_y, speed_x, speed_y = state
            self._set(number + 1, at_x, at_y, speed_x, speed_y, wanted)
        self._simulator.do_step()
        for number, walker in enumerate(self._walkers):
            if walker.behavior == "orca":
                found = self._simulator.get_agent_velocity(number + 1)
                states[number, 2:] = found.x, found.y

    def _set(
        self,
        agent: int,
        x: float,
        y: float,
        speed_x: float,
        speed_y: float,
        wanted: tuple[float, float] | None,
    ) -> None:
        """Give the library an agent's position, velocity and wanted velocity."""
        simulator = self._simulator
        simulator.set_agent_position(agent, (x, y))
        simulator.set_agent_velocity(agent, (speed_x, speed_y))
        simulator.set_agent_pref_velocity(agent, wanted or (speed_x, speed_y))


def _outlines(world: World) -> list[list[Point]]:
    """Outlines of obstacles, counter-clockwise, and of the world around them, clockwise."""
    room = world.room
    walls = [
        (room.x_min, room.y_min), (room.x_min, room.y_max),
        (room.x_max, room.y_max), (room.x_max, room.y_min),
    ]  # fmt: skip
    boxes = [
        [(b.x_min, b.y_min), (b.x_max, b.y_min), (b.x_max, b.y_max), (b.x_min, b.y_max)]
        for b in world.boxes
    ]
    turns = [math.tau * corner / _CORNERS for corner in range(_CORNERS)]
    # Around the cylinder, so that none comes too near to it.
    wider = 1.0 / math.cos(math.pi / _CORNERS)
    cylinders = [
        [
            (c.x + wider * c.radius * math.cos(a), c.y + wider * c.radius * math.sin(a))
            for a in turns
        ]
        for c in world.cylinders
    ]
    return [walls, *boxes, *cylinders, *(list(polygon.vertices) for polygon in world.polygons)]


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
        self._simulations: dict[int, OrcaRoom] = {}
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
        self._simulations.pop(index, None)
        if any(walker.behavior == "orca" for walker in world.walkers):
            self._simulations[index] = OrcaRoom(
                world, radius=self._radius, time_step=self._time_step
            )
        first = self._worlds.standing.counts[index, 1]
        self._worlds.arrays.circles[index, first : first + count, :2] = states[:, :2]

    def move(self, running: NDArray[np.bool_], motions: NDArray[np.float64]) -> None:
        """Move the walkers for one time step."""
        for index, room in self._simulations.items():
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
        hide_walkers(
            self._arrays, lidar.sensor_motions(motions), directions, margin, lidar.max_range, seen
        )
        return seen
