from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.speed.bullet_world import convex_parts
from mpfa_envs import Box, Cylinder, Polygon, World
from tests.envs.shapes import distance, inside

DENTED = Polygon(((-2.0, -1.0), (1.5, -1.5), (0.5, 0.0), (2.0, 1.0), (-1.0, 2.0), (-0.5, 0.5)))
TRIANGLE = Polygon(((2.0, 2.0), (4.0, 2.5), (3.0, 4.0)))
OVERLAPPING = Polygon(((0.0, -3.0), (1.0, -3.0), (1.0, 0.5), (0.0, 0.5)))


def polygon_world(*polygons: Polygon) -> World:
    return World(name="polygons", polygons=polygons)


def test_vertices_are_kept_counter_clockwise() -> None:
    square = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
    assert Polygon(square).vertices == square
    assert Polygon(square[::-1]).vertices == square
    assert Polygon(square).area == Polygon(square[::-1]).area == pytest.approx(1.0)
    assert Polygon(((0, 0), (0, 1), (2, 0))).area == pytest.approx(1.0)


def test_only_a_polygon_without_dents_is_convex() -> None:
    assert TRIANGLE.is_convex and not DENTED.is_convex
    assert Polygon(((0, 0), (1, 0), (2, 1), (1, 2), (0, 1))).is_convex


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


def test_the_area_under_obstacles_counts_polygons() -> None:
    square = Polygon(((0, 0), (1, 1), (0, 2), (-1, 1)))
    world = World(name="all", boxes=(Box(2, 2, 3, 4),), polygons=(square,))
    assert world.covered_area == pytest.approx(4.0)
    assert world.obstacle_count == 2


def test_arrays_hold_the_numbers_of_all_obstacles() -> None:
    world = World(
        name="all",
        size=(10.0, 8.0),
        boxes=(Box(2, 2, 3, 4),),
        cylinders=(Cylinder(-1, 2, 0.5),),
        polygons=(TRIANGLE, OVERLAPPING),
    )
    half_size, boxes, circles, segments, ends = world.arrays
    assert half_size.tolist() == [5.0, 4.0]
    assert boxes.tolist() == [[2, 2, 3, 4]] and circles.tolist() == [[-1, 2, 0.5]]
    assert ends.tolist() == [3, 7] and ends.dtype == np.int64
    assert segments.tolist() == [list(edge) for edge in TRIANGLE.edges + OVERLAPPING.edges]
    empty = World(name="empty").arrays
    assert [part.shape for part in empty] == [(2,), (0, 4), (0, 3), (0, 4), (0,)]
    for part in (*world.arrays[:4], *empty[:4]):
        assert part.dtype == np.float64 and part.flags.c_contiguous
