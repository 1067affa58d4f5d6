"""Worlds of random shapes, however they lie."""

from __future__ import annotations

import math

import numpy as np

from mpfa_envs import Box, Cylinder, Polygon, World


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
