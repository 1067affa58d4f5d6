"""Upright solids of a simulated world: from turned shapes, on a floor, in a room around them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.worlds.shapes import Box, Cylinder, Polygon, Shape
from mpfa_envs.worlds.world import World

Array = NDArray[np.float64]

STEP: Final = 0.01
"""A robot drives over steps up to this height [m]."""
_STRAIGHT: Final = 1e-5
"""A turn differs less from a quarter that is written with five digits [rad]."""
_TILT: Final = 0.025
"""A shape that is tilted by less counts as upright [rad]."""
_THIN: Final = 0.01
"""Thickness of the wall that an upright plane is [m]."""
_WIDE: Final = 0.75
"""Least share of the world under which a floor lies; a disc has 0.785 of the square around it."""


class Solid(NamedTuple):
    """A footprint between two heights [m]."""

    shape: Shape
    bottom: float
    top: float


def pose_matrix(
    x: float, y: float, z: float, roll: float, pitch: float, yaw: float
) -> NDArray[np.float64]:
    """Write a pose of SDF [m, rad] as a matrix, ``[4, 4]``."""
    matrix = np.eye(4)
    for axis, angle in enumerate((roll, pitch, yaw)):
        turn, (one, other) = np.eye(4), ((1, 2), (2, 0), (0, 1))[axis]
        turn[one, one] = turn[other, other] = math.cos(angle)
        turn[other, one] = math.sin(angle)
        turn[one, other] = -turn[other, one]
        matrix = turn @ matrix
    matrix[:3, 3] = x, y, z
    return matrix


def box_of(pose: Array, sides: Array) -> Solid | None:
    """A box, any side up; None if it is tilted."""
    for up, (along, across) in enumerate(((1, 2), (0, 2), (0, 1))):
        if abs(pose[2, up]) >= math.cos(_TILT):
            return _prism(pose, pose[:2, along], sides[along], sides[across], sides[up])
    return None


def cylinder_of(pose: Array, radius: float, length: float) -> Solid | None:
    """A cylinder that stands, or the box around one that lies; None if it is tilted."""
    x, y, z = pose[:3, 3].tolist()
    if abs(pose[2, 2]) >= math.cos(_TILT):
        return Solid(Cylinder(x, y, float(radius)), z - length / 2, z + length / 2)
    if abs(pose[2, 2]) <= math.sin(_TILT):
        return _prism(pose, pose[:2, 2], length, 2 * radius, 2 * radius)
    return None


def plane_of(pose: Array, normal: Array, size: Array) -> Solid | float | None:
    """A thin wall, or the height of a level plane [m]; None if it is tilted."""
    # The shortest turn from z to the normal, as in Gazebo, says how the plane's sides lie.
    a, b, c = normal / np.linalg.norm(normal)
    half = (1.0 - c) / (a * a + b * b) if a * a + b * b else 0.0
    sides = pose[:3, :3] @ [
        [1 - half * a * a, -half * a * b],
        [-half * a * b, 1 - half * b * b],
        [-a, -b],
    ]
    facing = pose[:3, :3] @ (a, b, c)
    if abs(facing[2]) >= math.cos(_TILT):
        return float(pose[2, 3])
    if abs(facing[2]) <= math.sin(_TILT):
        along = np.array([-facing[1], facing[0]])
        length = np.abs(along @ sides[:2]) @ size
        return _prism(pose, along, length, _THIN, np.abs(sides[2]) @ size)
    return None


def _prism(pose: Array, direction: Array, along: float, across: float, tall: float) -> Solid:
    """A rectangle between two heights, a polygon where its sides are not parallel to the axes."""
    x, y, z = pose[:3, 3].tolist()
    yaw = math.atan2(direction[1], direction[0])
    quarters = round(yaw / (math.pi / 2))
    u, v = along / 2, across / 2
    shape: Shape
    if abs(yaw - quarters * math.pi / 2) < _STRAIGHT:
        u, v = (u, v) if quarters % 2 == 0 else (v, u)
        shape = Box(float(x - u), float(y - v), float(x + u), float(y + v))
    else:
        c, s = math.cos(yaw), math.sin(yaw)
        corners = (-u, -v), (u, -v), (u, v), (-u, v)
        shape = Polygon(tuple((x + c * p - s * q, y + s * p + c * q) for p, q in corners))
    return Solid(shape, float(z - tall / 2), float(z + tall / 2))


def floor_of(solids: Sequence[Solid], grounds: Sequence[float], least: float = 0.0) -> float:
    """Find the height on which everything else stands [m], from solids and level planes."""
    # A floor has the least area [m²] or more: a pedestal in a hall is none.
    # The floor is the lowest of the ground, 0, and of what is as wide as the world, on which
    # something stands. From there it rises to whatever else is as wide, lies on it, and has most of
    # what is higher on it.
    if not solids:
        return 0.0
    bottoms, tops = np.array([(solid.bottom, solid.top) for solid in solids]).T
    bounds = np.array([solid.shape.bounds for solid in solids])
    outlines = [_outline(solid.shape) for solid in solids]
    order = np.argsort(tops)
    parts = np.split(order, np.flatnonzero(np.diff(tops[order]) > STEP) + 1)
    levels = [(float(tops[part].max()), float(bottoms[part].min()), part) for part in parts]
    levels += [(height, -math.inf, order[:0]) for height in grounds]

    def area_above(height: float) -> float:
        return _hull_area([outlines[k] for k in np.flatnonzero(tops > height)])

    def is_wide(part: NDArray[np.int64], area: float) -> bool:
        shapes = {solids[k].shape for k in part}  # The same one may be there twice.
        return not shapes or sum(shape.area for shape in shapes) >= max(_WIDE * area, least)

    area = area_above(-math.inf)
    floors = [0.0, *(top for top, _, part in levels if is_wide(part, area))]
    floor = min((at for at in floors if (abs(bottoms - at) <= STEP).any()), default=0.0)
    area = area_above(floor + STEP)
    for top, bottom, part in sorted(levels, key=lambda level: level[0]):
        higher = bounds[tops > top + STEP]
        rest = np.count_nonzero(tops > floor + STEP) - len(part)
        if top > floor >= bottom - STEP and 0 < rest <= 2 * len(higher) and is_wide(part, area):
            low = bounds[part, :2].min(axis=0, initial=math.inf) - STEP
            high = bounds[part, 2:].max(axis=0, initial=-math.inf) + STEP
            on = (higher[:, :2] <= high).all(axis=1) & (higher[:, 2:] >= low).all(axis=1)
            if not len(part) or on.mean() >= 0.5:
                floor, area = top, area_above(top + STEP)
    return floor


def _outline(shape: Shape) -> Array:
    """Corners of a shape, or of the square around a cylinder, ``[corners, 2]`` [m]."""
    if isinstance(shape, Polygon):
        return np.array(shape.vertices)
    left, low, right, high = shape.bounds
    return np.array([(left, low), (right, low), (right, high), (left, high)])


def _hull_area(outlines: Sequence[Array]) -> float:
    """Area of the convex hull of outlines [m²], infinite where it has none."""
    # Imported here because it takes long, and most worlds come from elsewhere.
    from scipy.spatial import ConvexHull, QhullError

    try:
        return float(ConvexHull(np.concatenate(outlines)).volume)
    except (QhullError, ValueError):  # No outline, or one without an area.
        return math.inf


def room_around(
    name: str,
    shapes: Sequence[Shape],
    size: tuple[float, float] | None,
    center: tuple[float, float] | None,
) -> World:
    """Put a room around obstacles, and move them into its frame."""
    bounds = [shape.bounds for shape in shapes]
    if center is None:
        center = (0.0, 0.0)
        if bounds:
            center = (
                (min(b.x_min for b in bounds) + max(b.x_max for b in bounds)) / 2,
                (min(b.y_min for b in bounds) + max(b.y_max for b in bounds)) / 2,
            )
    x, y = center
    if size is None:
        half_width = max(max(b.x_max - x, x - b.x_min) for b in bounds)
        half_depth = max(max(b.y_max - y, y - b.y_min) for b in bounds)
        # Up to a millimeter wider, so that rounding leaves none outside.
        size = (math.ceil(2e3 * half_width) / 1e3, math.ceil(2e3 * half_depth) / 1e3)
        size = (size[0] + 1e-3, size[1] + 1e-3)
    moved = [_moved(shape, -x, -y) for shape in shapes]
    return World(
        name=name,
        size=size,
        boxes=tuple(shape for shape in moved if isinstance(shape, Box)),
        cylinders=tuple(shape for shape in moved if isinstance(shape, Cylinder)),
        polygons=tuple(shape for shape in moved if isinstance(shape, Polygon)),
    )


def _moved(shape: Shape, x: float, y: float) -> Shape:
    """The same shape elsewhere."""
    if isinstance(shape, Cylinder):
        return Cylinder(shape.x + x, shape.y + y, shape.radius)
    if isinstance(shape, Box):
        return Box(shape.x_min + x, shape.y_min + y, shape.x_max + x, shape.y_max + y)
    return Polygon(tuple((u + x, v + y) for u, v in shape.vertices))
