"""Walkers that avoid each other and the robot, by the ORCA of the RVO2 library."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.worlds.shapes import Point
    from mpfa_envs.worlds.world import World

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
    """Outlines of obstacles, counter-clockwise, and of the room around them, clockwise."""
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
