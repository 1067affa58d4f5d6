"""Cells of a world as colors: where samples of a buffer come from, what a critic expects."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import check_count, check_number, check_positive
from mpfa_envs.env.config import TaskConfig
from mpfa_envs.env.episodes import Episode
from mpfa_envs.env.robots import RobotBatch
from mpfa_envs.generators.generate import resolve_world
from mpfa_envs.robots.model import RobotModel
from mpfa_envs.robots.resolve import resolve_robot
from mpfa_envs.scene.canvas import (
    FINE,
    HEIGHT,
    Canvas,
    Entry,
    Facing,
    Point,
    Scale,
    strip_width,
    tiled,
    titled,
    write_strip,
)
from mpfa_envs.scene.colors import ROBOT_FRONT, TEXT, shares_of, viridis
from mpfa_envs.walkers.batch import start_walkers
from mpfa_envs.worlds.world import Task, World

Array = NDArray[np.float64]

_ROBOTS: Final = 64
"""Number of places observed together; each may need a map."""
Heading = float | Literal["goal"]
"""Heading of all robots [rad], or that each of them faces the goal."""


def cell_centers(world: World, spacing: float) -> Array:
    """Centers (x, y) of square cells that fill a world, row by row from below [m], ``[N, 2]``."""
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
    """Observations of a robot at places all over a world.

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


_FEW = 3
"""Least number of transitions of a cell whose mean is shown."""


def render_samples(
    world: str | os.PathLike[str] | World,
    positions: Any,
    priorities: Any,
    sampled: Any,
    *,
    spacing: float = 0.4,
    title: str = "",
    size: int = 360,
) -> NDArray[np.uint8]:
    """Render three pictures of a buffer: its transitions, their priorities, their samples.

    Each cell has the color of how many transitions lie in it, of the mean of their priorities, and
    of how often they are sampled, in units of uniform sampling: 1 is as often as any other. All
    scales are logarithmic; cells with fewer than three transitions stay empty.

    Args:
        world: A name, the path of a YAML file or a world.
        positions: Where the robot was in each transition (x, y) [m], ``[N, 2]``.
        priorities: Of each transition, ``[N]``.
        sampled: How often each was sampled, ``[N]``, or the numbers of those that were, ``[M]``, of
            an integer type, where M is not N.
        spacing: Side of a cell [m].
        title: What to write in the first strip.
        size: Longer side of a picture [px].

    Returns:
        The three pictures side by side, shape ``[height, width, 3]``.

    Raises:
        ValueError: If the arrays do not fit together, or a number is negative or not finite.

    Examples:
        >>> import numpy as np
        >>> from mpfa_envs.render import render_samples
        >>> rng = np.random.default_rng(0)
        >>> places = rng.uniform(-2, 2, (500, 2))
        >>> render_samples("A", places, rng.random(500), rng.integers(500, size=900)).shape
        (388, 1096, 3)
    """
    world = resolve_world(world)
    check_positive("spacing", spacing)
    places, weights, counts = _checked(positions, priorities, sampled)
    room = world.room
    shape = tuple(max(math.ceil(side / spacing), 1) for side in world.size)
    corner = room.x_min, room.y_min
    cells = np.floor((places - corner) / spacing).astype(int).clip(0, np.array(shape) - 1)
    number = cells[:, 0] * shape[1] + cells[:, 1]

    def per_cell(values: Array) -> Array:
        found = np.bincount(number, weights=values, minlength=shape[0] * shape[1])
        return np.asarray(found, dtype=np.float64)

    there = per_cell(np.ones(len(places)))
    shown = np.flatnonzero(there >= _FEW)
    places_of = np.stack(np.unravel_index(shown, shape), axis=1)
    centers: Array = np.asarray(places_of * spacing + corner + spacing / 2, dtype=np.float64)
    rate = counts / max(float(counts.mean()), 1e-300)
    pictures = {
        (title, "transitions"): there[shown],
        ("", "priority"): per_cell(weights)[shown] / there[shown],
        ("", "sampled"): per_cell(rate)[shown] / there[shown],
    }
    return tiled(
        [
            _heat(world, centers, values, spacing=spacing, title=head, name=name, size=size)
            for (head, name), values in pictures.items()
        ],
        columns=3,
    )


def _checked(positions: Any, priorities: Any, sampled: Any) -> tuple[Array, Array, Array]:
    """Positions, priorities and counts, rejected if they do not fit together."""
    places = np.asarray(positions, dtype=np.float64)
    if places.ndim != 2 or places.shape[1] != 2 or not len(places):
        raise ValueError(f"positions must have shape [N, 2] and N > 0, got {places.shape}")
    count = len(places)
    numbers = np.asarray(sampled)
    if numbers.shape != (count,):
        if numbers.ndim != 1 or not np.issubdtype(numbers.dtype, np.integer):
            raise ValueError(
                f"sampled must be {count} counts or the numbers of transitions, got shape "
                f"{numbers.shape} of {numbers.dtype}"
            )
        if numbers.size and not 0 <= numbers.min() <= numbers.max() < count:
            raise ValueError(f"sampled must be numbers below {count}, got {numbers.max()}")
        numbers = np.bincount(numbers, minlength=count)
    weights = np.asarray(priorities, dtype=np.float64)
    if weights.shape != (count,):
        raise ValueError(f"priorities must have shape ({count},), got {weights.shape}")
    for name, values in (("positions", abs(places)), ("priorities", weights), ("sampled", numbers)):
        if not np.isfinite(values).all() or values.min(initial=0.0) < 0:
            raise ValueError(f"{name} must be finite, and none negative but positions")
    return places, weights, numbers.astype(np.float64)


def _heat(
    world: World,
    centers: Array,
    values: Array,
    *,
    spacing: float,
    title: str,
    name: str,
    size: int,
) -> NDArray[np.uint8]:
    """One picture, its colors from the lowest to the highest value on a logarithmic scale."""
    positive = values[values > 0]
    low, high = np.quantile(positive, (0.02, 0.98)).tolist() if len(positive) else (1.0, 1.0)
    entries = titled(title, Scale(name, low, high))
    canvas = Canvas(world, size=size, footer=HEIGHT, least_width=strip_width(entries))
    logs = np.log(np.maximum(values, low))
    fill_cells(canvas, centers, spacing, shares_of(logs, math.log(low), math.log(high)))
    canvas.obstacles(world)
    write_strip(canvas, entries)
    return canvas.pixels()


Observations = NDArray[np.float32]

_ARROW_TIME = 1.0
"""Time of the path that an arrow shows [s]."""
_CELL, _BETWEEN = 0.2, 0.6
"""Least side of a cell and least distance between two arrows [m]."""
_CELL_PIXELS = 9
"""Least side of a cell in larger worlds [px]: each cell takes time."""


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
    """Render a value and the actions of a policy all over a world, for one goal.

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
