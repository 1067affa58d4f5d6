"""Worlds of random shapes, however they lie, and distances in them by plain geometry."""

from __future__ import annotations

import math

import numpy as np

from mpfa_envs import Box, Cylinder, Polygon, World
from mpfa_envs.worlds.shapes import OccupancyGrid


def random_shapes(
    rng: np.random.Generator, *, boxes: int = 0, cylinders: int = 0, polygons: int = 0
) -> World:
    """A room of 10 x 8 m with shapes that may overlap."""
    return World(
        name="shapes",
        size=(10.0, 8.0),
        boxes=tuple(_box(rng) for _ in range(boxes)),
        cylinders=tuple(_cylinder(rng) for _ in range(cylinders)),
        polygons=tuple(_polygon(rng) for _ in range(polygons)),
    )


def _box(rng: np.random.Generator) -> Box:
    width, depth = rng.uniform(0.1, 1.5, 2)
    x, y = rng.uniform(-5.0, 5.0 - width), rng.uniform(-4.0, 4.0 - depth)
    return Box(x, y, x + width, y + depth)


def _cylinder(rng: np.random.Generator) -> Cylinder:
    radius = rng.uniform(0.05, 0.5)
    return Cylinder(
        rng.uniform(radius - 5, 5 - radius), rng.uniform(radius - 4, 4 - radius), radius
    )


def _polygon(rng: np.random.Generator) -> Polygon:
    """A star-shaped one, mostly not convex."""
    corners = int(rng.integers(3, 9))
    radii = rng.uniform(0.2, 1.0, corners)
    x, y = rng.uniform(-4.0, 4.0), rng.uniform(-3.0, 3.0)
    angles = [math.tau * (k + 0.4 * rng.random()) / corners for k in range(corners)]
    return Polygon(
        tuple(
            (x + r * math.cos(a), y + r * math.sin(a)) for r, a in zip(radii, angles, strict=True)
        )
    )


def cells(shape: tuple[int, int] = (40, 30), seed: int = 0) -> np.ndarray:
    """Some occupied cells with free ones at the sides."""
    occupied = np.random.default_rng(seed).random(shape) < 0.06
    occupied[[0, 1, -1], :] = False
    occupied[:, [0, 1, -1]] = False
    return occupied


GRID = OccupancyGrid(cells(), 0.2)
SCATTERED = World(name="map", size=GRID.size, occupancy=GRID)


def inside(x: float, y: float, polygon: Polygon) -> bool:
    """Tell by the sum of angles whether an outline winds around a point."""
    angles = [math.atan2(b - y, a - x) for a, b in polygon.vertices]
    turns = [
        math.remainder(b - a, math.tau)
        for a, b in zip(angles, angles[1:] + angles[:1], strict=True)
    ]
    return abs(sum(turns)) > 1.0


def to_segment(x: float, y: float, edge: tuple[float, float, float, float]) -> float:
    x0, y0, x1, y1 = edge
    length = math.dist((x0, y0), (x1, y1))
    along = ((x - x0) * (x1 - x0) + (y - y0) * (y1 - y0)) / length
    foot = min(max(along, 0.0), length) / length
    return math.dist((x, y), (x0 + foot * (x1 - x0), y0 + foot * (y1 - y0)))


def distance(x: float, y: float, world: World) -> float:
    """Signed distance to the nearest obstacle or wall, one edge after the other; 0 in a box."""
    found = [world.size[0] / 2 - abs(x), world.size[1] / 2 - abs(y)]
    for box in world.boxes:
        across, up = max(box.x_min - x, x - box.x_max), max(box.y_min - y, y - box.y_max)
        found.append(math.hypot(max(across, 0.0), max(up, 0.0)))
    for cylinder in world.cylinders:
        found.append(math.dist((x, y), (cylinder.x, cylinder.y)) - cylinder.radius)
    for polygon in world.polygons:
        gap = min(to_segment(x, y, edge) for edge in polygon.edges)
        found.append(-gap if inside(x, y, polygon) else gap)
    return min(found)
