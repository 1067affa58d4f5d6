"""Rays and distances among the occupied cells of a map.

A ray steps from one square without an occupied cell to the next, as large as the cells around
allow (Amanatides and Woo 1987 with the jumps of Cohen and Sheffer 1994): in a hall it takes few
steps, and along a wall one for each cell. Where it enters an occupied cell is exact, as for a box.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.compiled import njit


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
