"""Worlds of a user's own, whose tasks lead through doors as narrow as the robot can pass."""

from __future__ import annotations

import warnings
from functools import lru_cache
from typing import Final

import numpy as np

from mpfa_envs.generators.generate import world_of_name
from mpfa_envs.paths.distance import NARROW, grid_for
from mpfa_envs.robots.model import PAPER_CLEARANCE, RobotModel
from mpfa_envs.safety.filter import CLEARANCE
from mpfa_envs.worlds.barn import barn_world
from mpfa_envs.worlds.builtin import WORLDS
from mpfa_envs.worlds.world import World

DOOR: Final = 0.05
"""Clearance on both sides of the narrowest door that tasks lead through [m]."""
_FINE: Final = 0.4
"""Share of a cell's usual side with which a row of cells leads through such a door."""
_PART: Final = 1.0
"""Least floor of a part of a world that is spoken of [m²]."""


@lru_cache(maxsize=512)
def is_built_in(world: World) -> bool:
    """Return True for worlds by name: of the paper, of a generator and of BARN."""
    name = world.name
    if name.startswith("barn300-"):  # Of the benchmark's archive.
        return True
    if name.startswith("barn-") and name[5:].isdigit() and int(name[5:]) < 20:
        return world == barn_world(int(name[5:]))
    return world in (WORLDS.get(name), world_of_name(name))


def cell_share(world: World) -> float:
    """Share of the usual side of a cell on which the tasks of a world are sampled."""
    return 1.0 if is_built_in(world) else _FINE


def kept_in(world: World) -> float:
    """Clearance of a robot's rim that the tasks of evaluations keep in a world [m]."""
    return PAPER_CLEARANCE if is_built_in(world) else CLEARANCE


@lru_cache(maxsize=64)
def warn_of_parts(world: World, robot: RobotModel, clearance: float) -> None:
    """Warn, once, of parts of a user's world that a robot with a clearance [m] cannot reach.

    Warns:
        UserWarning: If there are any.
    """
    if is_built_in(world):
        return
    grid = grid_for(world, round(robot.radius + clearance, 9), NARROW)
    floors = np.bincount(grid.parts.ravel())[1:] * grid.resolution**2
    floors = floors[floors >= _PART]
    if len(floors) > 1:
        cut_off = 1.0 - floors.max() / floors.sum()
        warnings.warn(
            f"{len(floors) - 1} of {len(floors)} parts of {world.name!r}, {cut_off:.0%} of the "
            f"floor, cannot be reached from its largest part by a robot {2 * robot.radius:.2f} m "
            f"wide: its tasks lead through doors of {2 * (robot.radius + max(clearance, DOOR)):.2f}"
            " m and more",
            stacklevel=2,
        )
