"""A critic's values of the places of a room, and an actor's actions there."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import check_count, check_positive
from mpfa_envs.generators.generate import resolve_world
from mpfa_envs.render.grids import Heading, fill_cells, observe_room
from mpfa_envs.robots.model import RobotModel
from mpfa_envs.robots.resolve import resolve_robot
from mpfa_envs.scene.canvas import FINE, Canvas, Point
from mpfa_envs.scene.colors import ROBOT_FRONT, TEXT, shares_of
from mpfa_envs.scene.strip import HEIGHT, Entry, Facing, Scale, strip_width, titled, write_strip
from mpfa_envs.worlds.world import World

Observations = NDArray[np.float32]

_ARROW_TIME = 1.0
"""Time of the path that an arrow shows [s]."""
_CELL, _BETWEEN = 0.2, 0.6
"""Least side of a cell and least distance between two arrows [m]."""
_CELL_PIXELS = 9
"""Least side of a cell in larger rooms [px]: each cell takes time, the more the larger the room."""


def render_values(
    world: str | os.PathLike[str] | World,
    *,
    goal: Point,
    heading: Heading = 0.0,
    values: Callable[[Observations], Any] | None = None,
    actions: Callable[[Observations], Any] | None = None,
    spacing: float | None = None,
    arrow_spacing: float | None = None,
    name: str = "Q",
    title: str = "",
    size: int = 480,
    **env_arguments: Any,
) -> NDArray[np.uint8]:
    """Render a value and the actions of a policy all over a room, for one goal.

    In every cell stands a robot that has not moved; all face one direction. The cell has the color
    of its value, the scale leaves out the highest and lowest two per cent; an arrow is the path
    that the robot would take in the next second.

    Args:
        world: A name, the path of a YAML file or a world.
        goal: Where robots should go (x, y) [m].
        heading: Where they face [rad]; ``"goal"``: the goal, each from its place.
        values: From observations, ``[N, O]``, to numbers, ``[N]``, such as Q of the policy's own
            actions; None: no colors.
        actions: From observations to actions, ``[N, 2]``, as a :class:`~mpfa_envs.Policy`; None: no
            arrows.
        spacing: Side of a cell [m]. None: 0.2 m, or nine pixels if that is more.
        arrow_spacing: Distance between two arrows [m]. None: 0.6 m, or 27 pixels.
        name: Of the value.
        title: What to write in the strip.
        size: Longer side of the picture without the strip [px].
        **env_arguments: As in :func:`observe_room`.

    Returns:
        Picture of shape ``[height, width, 3]``.

    Raises:
        ValueError: If an argument is out of its range, or a function gives no number or action for
            each observation.

    Examples:
        >>> from mpfa_envs.render import render_values
        >>> nearness = lambda observations: 1.0 - observations[:, 21]
        >>> render_values("A", goal=(3.0, 3.0), values=nearness, spacing=1.0).shape
        (508, 480, 3)
    """
    world = resolve_world(world)
    pixel = max(world.size) / check_count("size", size, least=32)
    wider = max(1.0, _CELL_PIXELS * pixel / _CELL)
    spacing = _CELL * wider if spacing is None else spacing
    arrow_spacing = _BETWEEN * wider if arrow_spacing is None else arrow_spacing
    check_positive("arrow_spacing", arrow_spacing)
    where: dict[str, Any] = {"goal": goal, "heading": heading, **env_arguments}
    entries: list[Entry] = titled(title)
    cells: NDArray[np.float64] | None = None
    low = high = 0.0
    numbers = np.zeros(0)
    if values is not None:
        poses, observations = observe_room(world, spacing=spacing, **where)
        cells = poses[:, :2]
        numbers = np.asarray(values(observations), dtype=np.float64).reshape(-1)
        if numbers.shape != (len(cells),) or not np.isfinite(numbers).all():
            raise ValueError(
                f"values must give a finite number for each of {len(cells)} observations, got "
                f"shape {numbers.shape}"
            )
        low, high = np.quantile(numbers, (0.02, 0.98)).tolist()
        entries.append(Scale(name, low, high))
    if heading != "goal":
        entries.append(Facing(float(heading)))
    canvas = Canvas(world, size=size, footer=HEIGHT, least_width=strip_width(entries))
    if cells is not None:
        fill_cells(canvas, cells, spacing, shares_of(numbers, low, high))
    canvas.goal(*goal, env_arguments.get("goal_radius", 0.5))
    if actions is not None:
        poses, observations = observe_room(world, spacing=arrow_spacing, **where)
        chosen = np.asarray(actions(observations), dtype=np.float64)
        if chosen.shape != (len(poses), 2):
            raise ValueError(f"actions must have shape {(len(poses), 2)}, got {chosen.shape}")
        robot = resolve_robot(env_arguments.get("robot", "turtlebot2"))
        for pose, action in zip(poses.tolist(), chosen, strict=True):
            draw_arrow(canvas, arc_of(robot, pose, action, seconds=_ARROW_TIME))
    write_strip(canvas, entries)
    return canvas.pixels()


def arc_of(
    robot: RobotModel,
    pose: tuple[float, float, float],
    action: NDArray[np.float64],
    *,
    seconds: float,
    points: int = 9,
) -> list[Point]:
    """Positions (x, y) of the arc that a robot drives while it holds an action [m]."""
    left, right = robot.wheel_speeds(action.astype(np.float32))
    speed, turn = (left + right) / 2, (right - left) / robot.wheel_base
    x, y, heading = pose
    path = []
    for time in np.linspace(0.0, seconds, points).tolist():
        half = turn * time / 2
        chord = speed * time * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        path.append((x + chord * math.cos(heading + half), y + chord * math.sin(heading + half)))
    return path


def draw_arrow(canvas: Canvas, path: list[Point]) -> None:
    """Draw a path with a head at its end, white with a dark edge: it shows on every color."""
    (x, y), (before_x, before_y) = path[-1], path[-2]
    angle = math.atan2(y - before_y, x - before_x)
    tip, wings = canvas.at(x, y), []
    for side in (2.6, -2.6):
        reach = 6.5 * FINE
        # Pixels count from above.
        wings.append(
            (tip[0] + reach * math.cos(angle + side), tip[1] - reach * math.sin(angle + side))
        )
    for color, width in ((TEXT, 4.0), (ROBOT_FRONT, 1.6)):
        canvas.line(path, color, width)
        edge = round(2 * FINE) if color is TEXT else 0
        canvas.draw.polygon([tip, *wings], fill=color, outline=color, width=edge)
