"""Worlds of random shapes, however they lie, and polygons cut into convex parts."""

from __future__ import annotations

import math

import numpy as np

from mpfa_envs import Box, Cylinder, Polygon, World
from mpfa_envs.worlds.shapes import Point


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


def convex_parts(polygon: Polygon) -> list[Polygon]:
    """Cut off ears, corners that bulge with no other vertex in their triangle, one by one."""
    left = list(polygon.vertices)
    parts: list[Polygon] = []
    while not Polygon(tuple(left)).is_convex:
        ear = next(i for i in range(len(left)) if _is_ear(left, i))
        parts.append(Polygon((left[ear - 1], left[ear], left[(ear + 1) % len(left)])))
        del left[ear]
    return [*parts, Polygon(tuple(left))]


def _is_ear(vertices: list[Point], at: int) -> bool:
    """Whether a vertex can be cut off, with the line between its neighbors all inside."""
    a, b, c = vertices[at - 1], vertices[at], vertices[(at + 1) % len(vertices)]
    if _turn(a, b, c) <= 0.0:
        return False
    return not any(
        vertex not in (a, b, c)
        and _turn(a, b, vertex) >= 0.0
        and _turn(b, c, vertex) >= 0.0
        and _turn(c, a, vertex) >= 0.0
        for vertex in vertices
    )


def _turn(a: Point, b: Point, c: Point) -> float:
    """Positive if c lies to the left of the line from a to b."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
