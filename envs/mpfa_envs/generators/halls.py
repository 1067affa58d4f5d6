"""Halls of up to 20 x 20 m with obstacles that stand at any angle."""

from __future__ import annotations

import math
import random

from mpfa_envs.generators.placing import between, fit_cylinder, fit_polygon, sample_size
from mpfa_envs.worlds.world import Cylinder, Polygon, World

Outline = list[tuple[float, float]]
"""Corners around the origin (x, y) [m]."""


def halls(rng: random.Random, difficulty: float) -> World:
    """Sample a hall of 10 to 20 m a side with rotated boxes, polygons and columns.

    Four obstacles in ten are boxes with sides of 0.3 to 3 m, three are polygons of three to seven
    corners and up to 2.4 m across, two have the shape of an L, and one is a column with a radius of
    0.15 to 0.5 m. They may overlap.

    Difficulty: 5 obstacles in 100 m² at 0, 16 at 1.
    """
    size = sample_size(rng, 10.0, 20.0)
    polygons: list[Polygon] = []
    cylinders: list[Cylinder] = []
    for _ in range(round(size[0] * size[1] * between(0.05, 0.16, difficulty))):
        x, y = (rng.uniform(-side / 2, side / 2) for side in size)
        kind = rng.random()
        if kind < 0.1:
            cylinders.append(fit_cylinder(x, y, round(rng.uniform(0.15, 0.5), 3), size))
            continue
        sample = _sample_box if kind < 0.5 else _sample_corners if kind < 0.8 else _sample_l
        polygons.append(fit_polygon(x, y, _turn(sample(rng), rng.uniform(0, math.tau)), size))
    return World(name="halls", size=size, polygons=tuple(polygons), cylinders=tuple(cylinders))


def _sample_box(rng: random.Random) -> Outline:
    """A box."""
    across, up = rng.uniform(0.15, 1.5), rng.uniform(0.15, 0.7)
    return [(-across, -up), (across, -up), (across, up), (-across, up)]


def _sample_corners(rng: random.Random) -> Outline:
    """Corners on an ellipse, one somewhere in each of its equal parts."""
    count = rng.randrange(3, 8)
    across, up = rng.uniform(0.3, 1.2), rng.uniform(0.3, 1.2)
    angles = [math.tau * (i + rng.uniform(0.0, 0.8)) / count for i in range(count)]
    return [(across * math.cos(angle), up * math.sin(angle)) for angle in angles]


def _sample_l(rng: random.Random) -> Outline:
    """Two arms that meet at a right angle."""
    along, up, thick = rng.uniform(0.8, 2.4), rng.uniform(0.8, 2.4), rng.uniform(0.2, 0.6)
    corners = [(0.0, 0.0), (along, 0.0), (along, thick), (thick, thick), (thick, up), (0.0, up)]
    return [(x - along / 2, y - up / 2) for x, y in corners]


def _turn(outline: Outline, angle: float) -> Outline:
    """An outline turned around the origin by an angle [rad]."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return [(cosine * x - sine * y, sine * x + cosine * y) for x, y in outline]
