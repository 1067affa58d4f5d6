"""Cells of a room: their centers, observations in them, and their colors."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import check_number, check_positive
from mpfa_envs.env.config import TaskConfig
from mpfa_envs.env.episodes import Episode
from mpfa_envs.env.robots import RobotBatch
from mpfa_envs.generators.generate import resolve_world
from mpfa_envs.scene.canvas import Canvas
from mpfa_envs.scene.colors import viridis
from mpfa_envs.walkers.batch import start_walkers
from mpfa_envs.worlds.world import Task, World

Array = NDArray[np.float64]

_ROBOTS: Final = 64
"""Number of places observed together; each may need a map."""
Heading = float | Literal["goal"]
"""Heading of all robots [rad], or that each of them faces the goal."""


def cell_centers(world: World, spacing: float) -> Array:
    """Centers (x, y) of square cells that fill a room, row by row from below [m], ``[N, 2]``."""
    check_positive("spacing", spacing)
    room = world.room
    sides = []
    for low, high in ((room.x_min, room.x_max), (room.y_min, room.y_max)):
        count = max(math.floor((high - low) / spacing + 1e-9), 1)
        sides.append((low + high - (count - 1) * spacing) / 2 + spacing * np.arange(count))
    x, y = np.meshgrid(*sides)
    return np.stack((x.reshape(-1), y.reshape(-1)), axis=1)


def observe_room(
    world: str | os.PathLike[str] | World,
    *,
    goal: tuple[float, float],
    heading: Heading = 0.0,
    spacing: float = 0.2,
    **env_arguments: Any,
) -> tuple[Array, NDArray[np.float32]]:
    """Observations of a robot at places all over a room.

    Args:
        world: A name, the path of a YAML file or a world.
        goal: Position (x, y) [m].
        heading: Direction of its front [rad]; ``"goal"``: towards the goal, from everywhere.
        spacing: Distance between two places [m].
        **env_arguments: Fields of :class:`~mpfa_envs.TaskConfig`, those that the policy was trained
            with: ``policy.env_arguments``.

    Returns:
        Poses (x, y, heading), ``[N, 3]``, where the robot fits and has not reached the goal, and
        observations, ``[N, O]``. It has seen nothing before, and there are no walkers.

    Raises:
        ValueError: If an argument is out of its range.

    Examples:
        >>> from mpfa_envs.render import observe_room
        >>> poses, observations = observe_room("A", goal=(3.0, 3.0), spacing=1.0)
        >>> poses.shape, observations.shape
        ((100, 3), (100, 24))
    """
    if heading != "goal":
        check_number("heading", heading)
    world = replace(resolve_world(world), walkers=())
    config = TaskConfig(**{**env_arguments, "physics": "kinematic", "progress": "straight_line"})
    places = cell_centers(world, spacing)
    offset = np.asarray(goal, dtype=np.float64) - places
    free = world.clearances(places) > config.robot.radius
    chosen = free & (np.hypot(*offset.T) > config.goal_radius)
    places, offset = places[chosen], offset[chosen]
    facing = np.arctan2(offset[:, 1], offset[:, 0])
    if heading != "goal":
        facing = np.full(len(places), float(heading))
    poses = np.column_stack((places, facing))
    robots = RobotBatch(config, config.make_lidar(), [world] * _ROBOTS)
    rng = np.random.default_rng(0)
    walkers = start_walkers(world, (0.0, 0.0), rng)
    found = []
    for part in np.array_split(poses, range(_ROBOTS, len(poses), _ROBOTS)):
        for index, (x, y, turn) in enumerate(part.tolist()):
            task = Task((x, y, turn), goal)
            robots.begin(index, Episode(world, task, 0.0, None, walkers), rng)
        robots.sense(np.arange(_ROBOTS) < len(part), [rng] * _ROBOTS)
        found.append(robots.observations[: len(part)].copy())
    return poses, np.concatenate(found)


def fill_cells(canvas: Canvas, centers: Array, spacing: float, shares: Array) -> None:
    """Color cells with centers ``[N, 2]`` [m] by shares from 0 to 1, ``[N]``."""
    half = spacing / 2
    for (x, y), color in zip(centers.tolist(), viridis(shares).tolist(), strict=True):
        canvas.rectangle(x - half, y - half, x + half, y + half, fill=(*color, 255))
