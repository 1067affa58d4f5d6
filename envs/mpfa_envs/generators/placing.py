"""Sizes of rooms, and shapes cut to them."""

from __future__ import annotations

import random

from mpfa_envs.worlds.world import Box, Cylinder, Polygon

_LEAST_SIDE = 0.05
"""Least side of a box that a wall cuts [m]."""


def between(low: float, high: float, difficulty: float) -> float:
    """Interpolate between the values at difficulty 0 and 1."""
    return low + (high - low) * difficulty


def sample_size(rng: random.Random, low: float, high: float) -> tuple[float, float]:
    """Width and depth of a room, each in the range, in whole decimeters [m]."""
    return round(rng.uniform(low, high), 1), round(rng.uniform(low, high), 1)


def cut_box(
    x: float, y: float, width: float, depth: float, size: tuple[float, float]
) -> Box | None:
    """A box around a center, cut off at the walls, in whole millimeters; None if little is left."""
    half_x, half_y = size[0] / 2, size[1] / 2
    x_min, x_max = max(round(x - width / 2, 3), -half_x), min(round(x + width / 2, 3), half_x)
    y_min, y_max = max(round(y - depth / 2, 3), -half_y), min(round(y + depth / 2, 3), half_y)
    if x_max - x_min < _LEAST_SIDE or y_max - y_min < _LEAST_SIDE:
        return None
    return Box(x_min, y_min, x_max, y_max)


def fit_cylinder(x: float, y: float, radius: float, size: tuple[float, float]) -> Cylinder:
    """A cylinder as near to a place as the walls allow, in whole millimeters."""
    # A millimeter less than the room has: the sum of center and radius is rounded too.
    half_x, half_y = (side / 2 - radius - 0.001 for side in size)
    return Cylinder(
        round(max(-half_x, min(half_x, x)), 3), round(max(-half_y, min(half_y, y)), 3), radius
    )


def fit_polygon(
    x: float, y: float, outline: list[tuple[float, float]], size: tuple[float, float]
) -> Polygon:
    """A polygon as near to a place as the walls allow, in whole millimeters."""
    # Sines and cosines differ in the last digit between machines; millimeters do not.
    corners = [(round(across, 3), round(up, 3)) for across, up in outline]
    place = []
    for at, side, values in zip((x, y), size, zip(*corners, strict=True), strict=True):
        low, high = -side / 2 - min(values) + 0.001, side / 2 - max(values) - 0.001
        place.append(round(max(low, min(high, at)), 3))
    return Polygon(tuple((round(place[0] + a, 3), round(place[1] + b, 3)) for a, b in corners))
