"""Worlds as arrays, and the compiled loops that find rays and clearances among what they hold.

Among the occupied cells of a map a ray steps from one square without such a cell to the next, as
large as the cells around allow (Amanatides and Woo 1987 with the jumps of Cohen and Sheffer 1994):
in a hall it takes few steps, and along a wall one for each cell. Where it enters an occupied cell
is exact, as for a box.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpfa_envs.compiled import njit

_Scalar = TypeVar("_Scalar", bound=np.generic)
_Arrays = TypeVar("_Arrays", bound=NamedTuple)


class GridArrays(NamedTuple):
    """Maps of the robots' worlds; each fills the first columns and rows of its table."""

    left: NDArray[np.int16]
    """The nearest occupied column to the left, ``[maps, most columns, most rows]``."""
    right: NDArray[np.int16]
    """The nearest to the right."""
    gaps: NDArray[np.uint8]
    """Columns or rows to the nearest occupied cell."""
    shapes: NDArray[np.int64]
    """Numbers of columns and rows, ``[maps, 2]``."""
    resolutions: NDArray[np.float64]
    """Side of a cell [m], ``[maps]``."""


class BatchArrays(NamedTuple):
    """Shapes by robot; only the first ``counts`` of each row are read."""

    half_sizes: NDArray[np.float64]
    """Half the width and the depth of the worlds [m], ``[N, 2]``."""
    boxes: NDArray[np.float64]
    """(x_min, y_min, x_max, y_max) [m], ``[N, most boxes, 4]``."""
    circles: NDArray[np.float64]
    """(x, y, radius) [m], ``[N, most circles, 3]``; after the cylinders come walkers, then the
    other robots of a team."""
    segments: NDArray[np.float64]
    """Edges of polygons (x0, y0, x1, y1) [m], ``[N, most edges, 4]``."""
    polygon_ends: NDArray[np.int64]
    """End of each polygon's edges in segments, ``[N, most polygons]``."""
    counts: NDArray[np.int64]
    """Numbers of boxes, circles, segments and polygons, ``[N, 4]``."""
    grids: GridArrays
    """Maps; robots in the same one share it."""
    grid_of: NDArray[np.int64]
    """Number of each robot's map, -1 without one, ``[N]``."""


def grown(table: NDArray[_Scalar], *sides: int) -> NDArray[_Scalar]:
    """The table, or a larger copy where its axes after the first are shorter than these sides."""
    shape = table.shape
    wanted = (shape[0], *map(max, shape[1:], sides), *shape[len(sides) + 1 :])
    if wanted == shape:
        return table
    wider: NDArray[Any] = np.zeros(wanted, dtype=table.dtype)
    wider[tuple(map(slice, shape))] = table
    return wider


def with_row(arrays: _Arrays, robot: int, **rows: ArrayLike) -> _Arrays:
    """The arrays with rows of a robot, each first in its row of a table that grows if it must."""
    for name, values in rows.items():
        row, before = np.asarray(values), getattr(arrays, name)
        table = grown(before, *row.shape)
        place: tuple[int | slice, ...] = (robot, *map(slice, row.shape))
        table[place] = row
        if table is not before:
            arrays = arrays._replace(**{name: table})
    return arrays


@njit
def cast_at_cells(
    x: float,  # [m]
    y: float,  # [m]
    beams: NDArray[np.float64],  # Cosine, sine, and one over each, none zero, [4, rays]
    gaps: NDArray[np.uint8],  # [columns, rows]
    resolution: float,  # [m]
    max_range: float,  # [m]
    row: NDArray[np.float64],  # [rays] [m]
) -> bool:
    """Shorten the rays that meet an occupied cell; return True if the sensor is in one."""
    columns, rows = gaps.shape
    # In cells from the lower left corner.
    u, v = x / resolution + 0.5 * columns, y / resolution + 0.5 * rows
    first = min(max(math.floor(u), 0), columns - 1)
    second = min(max(math.floor(v), 0), rows - 1)
    if gaps[first, second] == 0:
        return True
    for ray in range(row.shape[0]):
        across, up, per_across, per_up = (
            beams[0, ray],
            beams[1, ray],
            beams[2, ray],
            beams[3, ray],
        )
        end = min(row[ray], max_range) / resolution
        i, j, length = first, second, 0.0
        while length < end:
            free = int(gaps[i, j])
            if free == 0:
                row[ray] = length * resolution
                break
            side = i + free if across > 0.0 else i - free + 1
            edge = j + free if up > 0.0 else j - free + 1
            to_side, to_edge = (side - u) * per_across, (edge - v) * per_up
            if to_side < to_edge:
                length = max(to_side, 0.0)
                i = side if across > 0.0 else side - 1
                at = math.floor(v + length * up)
                j = min(max(at, j - free + 1, 0), j + free - 1, rows - 1)
            else:
                length = max(to_edge, 0.0)
                j = edge if up > 0.0 else edge - 1
                at = math.floor(u + length * across)
                i = min(max(at, i - free + 1, 0), i + free - 1, columns - 1)
            if i < 0 or j < 0 or i >= columns or j >= rows:
                break
    return False


@njit
def clearance_of_cells(
    left: NDArray[np.int16],  # [columns, rows]
    right: NDArray[np.int16],
    resolution: float,  # [m]
    x: float,  # [m]
    y: float,  # [m]
    nearest: float,  # [m]
) -> float:
    """Measure the distance from a point to the nearest occupied cell [m]."""
    # It looks at the cell's own row, then at the next above and below, and so on, of each of which
    # the nearest cells to the left and to the right are known.
    if nearest <= 0.0:
        return nearest
    columns, rows = left.shape
    u, v = x / resolution + 0.5 * columns, y / resolution + 0.5 * rows
    i = min(max(math.floor(u), 0), columns - 1)
    j = min(max(math.floor(v), 0), rows - 1)
    limit = (nearest / resolution) ** 2
    square = limit
    for away in range(rows):
        above, below = max(j + away - v, 0.0), max(v - (j - away + 1), 0.0)
        if min(above, below) ** 2 >= square:
            break
        if j + away < rows:
            beside = min(u - (left[i, j + away] + 1.0), right[i, j + away] - u)
            square = min(square, max(beside, 0.0) ** 2 + above * above)
        if j - away >= 0:
            beside = min(u - (left[i, j - away] + 1.0), right[i, j - away] - u)
            square = min(square, max(beside, 0.0) ** 2 + below * below)
    return math.sqrt(square) * resolution if square < limit else nearest


@njit
def lower_clearances(
    left: NDArray[np.int16],
    right: NDArray[np.int16],
    resolution: float,  # [m]
    xs: NDArray[np.float64],  # [nx] [m]
    ys: NDArray[np.float64],  # [m] [ny]
    found: NDArray[np.float32],  # [nx, ny] [m]
) -> None:
    """Lower the clearances of grid points to the distance from the nearest occupied cell."""
    for i in range(len(xs)):
        for j in range(len(ys)):
            found[i, j] = clearance_of_cells(left, right, resolution, xs[i], ys[j], found[i, j])


@njit
def clearances_of_cells(
    left: NDArray[np.int16],
    right: NDArray[np.int16],
    resolution: float,
    points: NDArray[np.float64],
    found: NDArray[np.float64],
) -> None:
    """The same for any points ``[N, 2]`` [m]."""
    for k in range(len(points)):
        x, y = points[k, 0], points[k, 1]
        found[k] = clearance_of_cells(left, right, resolution, x, y, found[k])


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
