"""Rooms in which people walk about."""

from __future__ import annotations

import math
import random
from typing import Final

from mpfa_envs.generators.placing import between, cut_box, fit_cylinder, sample_size
from mpfa_envs.worlds.shapes import Point
from mpfa_envs.worlds.walker import Walker
from mpfa_envs.worlds.world import Box, Cylinder, World

_CORNERS: Final = 3
"""Waypoints of a round."""
_LEG: Final = 2.5
"""Least distance between two waypoints [m]."""
_ATTEMPTS: Final = 500


def crowd(rng: random.Random, difficulty: float) -> World:
    """Sample a room of 9 to 11 m a side with a few obstacles and some walkers.

    There are two to five boxes and cylinders. Half of the walkers go straight and bounce, the
    others have a round of three waypoints. They are 0.2 to 0.3 m in radius and walk at 0.1 to
    0.3 m/s, slower than a robot that cannot look back.

    Difficulty: 2 walkers at 0, 6 at 0.5, 10 at 1.
    """
    size = sample_size(rng, 9.0, 11.0)
    boxes: list[Box] = []
    cylinders: list[Cylinder] = []
    for _ in range(rng.randint(2, 5)):
        x, y = (rng.uniform(-side / 2, side / 2) for side in size)
        if rng.random() < 0.5:
            cylinders.append(fit_cylinder(x, y, round(rng.uniform(0.15, 0.4), 3), size))
        else:
            box = cut_box(x, y, rng.uniform(0.4, 1.5), rng.uniform(0.4, 1.5), size)
            if box is not None:
                boxes.append(box)
    room = World(name="crowd", size=size, boxes=tuple(boxes), cylinders=tuple(cylinders))
    walkers = []
    for number in range(round(between(2, 10, difficulty))):
        radius, speed = round(rng.uniform(0.2, 0.3), 3), round(rng.uniform(0.1, 0.3), 3)
        waypoints = _sample_round(rng, room, radius) if number % 2 else None
        if waypoints is None:
            walkers.append(Walker(radius=radius, speed=speed))
        else:
            walker = Walker(radius=radius, speed=speed, behavior="waypoints", waypoints=waypoints)
            walkers.append(walker)
    return World(
        name="crowd", size=size, boxes=room.boxes, cylinders=room.cylinders, walkers=tuple(walkers)
    )


def _sample_round(rng: random.Random, room: World, radius: float) -> tuple[Point, ...] | None:
    """Corners of a round on which nothing stands; None if none was found."""
    corners: list[Point] = []
    for _ in range(_ATTEMPTS):
        x, y = (round(rng.uniform(radius - side / 2, side / 2 - radius), 3) for side in room.size)
        legs = [(corner, (x, y)) for corner in corners[-1:]]
        if len(corners) == _CORNERS - 1:
            legs.append(((x, y), corners[0]))
        if room.clearance(x, y) >= radius and all(
            math.dist(*leg) >= _LEG and room.clearance_along(*leg) >= radius for leg in legs
        ):
            corners.append((x, y))
            if len(corners) == _CORNERS:
                return tuple(corners)
    return None
