"""The positions of a buffer's transitions in a room, and how often each is replayed."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import check_positive
from mpfa_envs.generators.generate import resolve_world
from mpfa_envs.render.grids import fill_cells
from mpfa_envs.scene.canvas import Canvas
from mpfa_envs.scene.colors import shares_of
from mpfa_envs.scene.strip import HEIGHT, Scale, strip_width, titled, write_strip
from mpfa_envs.scene.tiles import tiled
from mpfa_envs.worlds.world import World

Array = NDArray[np.float64]

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
