from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.speed.bullet_world import convex_parts
from mpfa_envs import Polygon, World
from tests.envs.shapes import distance, inside

DENTED = Polygon(((-2.0, -1.0), (1.5, -1.5), (0.5, 0.0), (2.0, 1.0), (-1.0, 2.0), (-0.5, 0.5)))
TRIANGLE = Polygon(((2.0, 2.0), (4.0, 2.5), (3.0, 4.0)))


def polygon_world(*polygons: Polygon) -> World:
    return World(name="polygons", polygons=polygons)


def test_vertices_are_kept_counter_clockwise() -> None:
    square = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
    assert Polygon(square).vertices == square
    assert Polygon(square[::-1]).vertices == square
    assert Polygon(square).area == Polygon(square[::-1]).area == pytest.approx(1.0)
    assert Polygon(((0, 0), (0, 1), (2, 0))).area == pytest.approx(1.0)


def test_convex_parts_make_up_the_polygon() -> None:
    assert convex_parts(TRIANGLE) == [TRIANGLE]
    rng = np.random.default_rng(0)
    outlines = [DENTED]
    for count in (5, 8, 13, 20):
        # A star: corners near to and far from the middle, one after the other.
        angles = math.tau * np.arange(count) / count
        reach = np.where(np.arange(count) % 2, 1.0, 0.3) * rng.uniform(0.8, 1.2, count)
        corners = zip(reach * np.cos(angles), reach * np.sin(angles), strict=True)
        outlines.append(Polygon(tuple((float(x), float(y)) for x, y in corners)))
    for polygon in outlines:
        parts = convex_parts(polygon)
        assert all(part.is_convex for part in parts)
        assert sum(part.area for part in parts) == pytest.approx(polygon.area)
        for x, y in rng.uniform(-2.0, 2.0, (200, 2)).tolist():
            if abs(distance(x, y, polygon_world(*parts))) < 1e-6:
                continue
            assert sum(inside(x, y, part) for part in parts) == inside(x, y, polygon)
