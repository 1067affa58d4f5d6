"""Distance from points to the nearest obstacle or wall."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.compiled import njit
from mpfa_envs.worlds.cell_loops import clearance_of_cells

if TYPE_CHECKING:
    from mpfa_envs.worlds.arrays import BatchArrays


@njit
def clearance_at(worlds: BatchArrays, robot: int, x: float, y: float) -> float:
    """Measure the distance from a point in a robot's world to the nearest obstacle or wall [m]."""
    boxes, circles, _, polygons = worlds.counts[robot]
    nearest = clearance_of_shapes(
        worlds.half_sizes[robot],
        worlds.boxes[robot, :boxes],
        worlds.circles[robot, :circles],
        worlds.segments[robot],
        worlds.polygon_ends[robot, :polygons],
        x,
        y,
    )
    number = worlds.grid_of[robot]
    if number >= 0:
        columns, rows = worlds.grids.shapes[number]
        left = worlds.grids.left[number, :columns, :rows]
        right = worlds.grids.right[number, :columns, :rows]
        resolution = worlds.grids.resolutions[number]
        nearest = clearance_of_cells(left, right, resolution, x, y, nearest)
    return nearest


@njit
def clearance_of_shapes(
    half_size: NDArray[np.float64],
    boxes: NDArray[np.float64],
    circles: NDArray[np.float64],
    segments: NDArray[np.float64],
    polygon_ends: NDArray[np.int64],
    x: float,
    y: float,
) -> float:
    """Measure the distance from a point to the nearest shape or wall [m]; zero in a box."""
    nearest = min(half_size[0] - abs(x), half_size[1] - abs(y))
    square = math.inf
    for index in range(boxes.shape[0]):
        across = max(boxes[index, 0] - x, x - boxes[index, 2], 0.0)
        up = max(boxes[index, 1] - y, y - boxes[index, 3], 0.0)
        square = min(square, across * across + up * up)
    first = 0
    for last in polygon_ends:
        near, inside = _to_polygon(segments[first:last], x, y)
        if inside:
            nearest = min(nearest, -math.sqrt(near))
        else:
            square = min(square, near)
        first = last
    nearest = min(nearest, math.sqrt(square))
    for index in range(circles.shape[0]):
        dx, radius = circles[index, 0] - x, circles[index, 2]
        near = nearest + radius
        if abs(dx) < near:  # Few are nearer than the nearest so far.
            dy = circles[index, 1] - y
            square = dx * dx + dy * dy
            if square < near * near:
                nearest = math.sqrt(square) - radius
    return nearest


@njit
def clearances_of_shapes(
    half_size: NDArray[np.float64],
    boxes: NDArray[np.float64],
    circles: NDArray[np.float64],
    segments: NDArray[np.float64],
    polygon_ends: NDArray[np.int64],
    points: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Measure the same for points ``[N, 2]``, negative in a box [m], ``[N]``."""
    found = np.empty(len(points))
    for k in range(len(points)):
        x, y = points[k, 0], points[k, 1]
        found[k] = clearance_of_shapes(half_size, boxes, circles, segments, polygon_ends, x, y)
        for box in range(boxes.shape[0]):
            across = max(boxes[box, 0] - x, x - boxes[box, 2])
            up = max(boxes[box, 1] - y, y - boxes[box, 3])
            if max(across, up) < 0.0:
                found[k] = min(found[k], max(across, up))
    return found


@njit
def _to_polygon(edges: NDArray[np.float64], x: float, y: float) -> tuple[float, bool]:
    """Squared distance from a point to a polygon's outline [m²], and whether it lies inside."""
    inside = False
    nearest = math.inf
    for edge in range(edges.shape[0]):
        x0, y0 = edges[edge, 0] - x, edges[edge, 1] - y
        x1, y1 = edges[edge, 2] - x, edges[edge, 3] - y
        if (y0 > 0.0) != (y1 > 0.0) and (x0 * y1 - x1 * y0 > 0.0) == (y1 > y0):
            inside = not inside  # A ray to the right crosses this edge.
        across, up = x1 - x0, y1 - y0
        share = -(x0 * across + y0 * up) / (across * across + up * up)
        share = min(max(share, 0.0), 1.0)
        gap_x, gap_y = x0 + share * across, y0 + share * up
        nearest = min(nearest, gap_x * gap_x + gap_y * gap_y)
    return nearest, inside
