"""One line of what a script has understood, as a number in another unit shows there."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.ndimage import label, maximum

from mpfa_envs import World
from mpfa_envs.generators.generate import resolve_world
from mpfa_envs.paths.distance import FreeGrid
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot

_FINEST = 0.025
"""Side of the cells in which a passage is looked for [m], unless there would be too many."""
_MOST_CELLS = 400_000
_COARSEST = 0.1
"""With longer cells the width of a door is not told [m]."""
_WIDEST = 2.5
"""A wider passage is no door [m]."""
_ROOM = 0.5
"""Least area for a robot's center on either side of a door [m²]."""


def understood(robot: RobotChoice, worlds: Iterable[str]) -> str:
    """Return the size of a robot and of the worlds that are read from files, in one line.

    Examples:
        >>> understood("kobuki", ["mixed", "A"])
        'kobuki: 0.36 m wide, 0.7 m/s; mixed; A'
    """
    model = resolve_robot(robot)
    parts = [f"{model.name}: {2 * model.radius:.3g} m wide, {model.max_wheel_speed:g} m/s"]
    for world in dict.fromkeys(worlds):
        parts.append(_described(resolve_world(world)) if Path(world).is_file() else world)
    return "; ".join(parts)


def _described(world: World) -> str:
    """Return the size of a world, and the width of its narrowest door if it has one."""
    width, depth = world.size
    door = narrowest_door(world)
    size = f"{world.name}: {width:.1f} x {depth:.1f} m"
    return size if door is None else f"{size}, doors from {door:.2f} m"


def narrowest_door(world: World) -> float | None:
    """Return the width of the narrowest passage between two rooms, to 0.05 m; None without one.

    A passage joins what a slightly wider robot finds in two parts, each with room to drive in.
    """
    side = max(_FINEST, math.sqrt(world.size[0] * world.size[1] / _MOST_CELLS))
    if side > _COARSEST:
        return None
    clearance = FreeGrid(world, distance=side, resolution=side).clearance
    parts, _ = label(clearance >= side)
    for half in np.arange(2 * side, _WIDEST / 2, side):
        inner, _ = label(clearance >= half)
        rooms = np.flatnonzero(np.bincount(inner.ravel()) * side**2 >= _ROOM)
        rooms = rooms[rooms > 0]
        joined = np.atleast_1d(maximum(parts, inner, rooms)) if len(rooms) else rooms
        if len(np.unique(joined)) < len(rooms):
            # The passage is narrower than this radius, and wider than the one before.
            return round(round((2 * half - side) / 0.05) * 0.05, 2)
        parts = inner
    return None
