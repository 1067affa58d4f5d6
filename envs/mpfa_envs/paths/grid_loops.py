"""Loops over the cells of a grid: clearances, neighbors, interpolation, shortest paths."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.compiled import njit


def _moves() -> NDArray[np.int64]:
    """Steps to the 16 neighbors of a cell: straight, diagonal and a knight's, ``[16, 6]``."""
    # Each row has columns and rows of the step, and those of the two cells whose squares its line
    # crosses; for straight and diagonal steps, which cross none, the cell itself.
    rows = [(across, up, 0, 0, 0, 0) for across in (-1, 0, 1) for up in (-1, 0, 1) if across or up]
    for long in (-2, 2):
        for short in (-1, 1):
            half = long // 2
            rows.append((long, short, half, 0, half, short))
            rows.append((short, long, 0, half, short, half))
    return np.array(rows, dtype=np.int64)


MOVES: Final = _moves()
_STRETCH: Final = math.cos(math.atan(0.5) / 2)
"""The longest path with these moves is the straight line over this."""
STEP_SCALE: Final = 2.0 / (1.0 + 1.0 / _STRETCH)
"""Factor of the lengths of moves, so that paths are as much too long as too short.

With whole lengths they would be up to 2.8 % too long, and with these they are off by up to 1.4 %
in either direction (Borgefors 1986, https://doi.org/10.1016/S0734-189X(86)80047-0).
"""


@njit
def _measure_boxes(
    boxes: NDArray[np.float64],
    x: float,
    ys: NDArray[np.float64],
    square: NDArray[np.float64],
    depth: NDArray[np.float64],
) -> None:
    """Lower a column's squared distances [m²], and the negative depths in boxes [m]."""
    for k in range(len(boxes)):
        across = max(boxes[k, 0] - x, x - boxes[k, 2])
        out_x = max(across, 0.0) ** 2
        low, high = boxes[k, 1], boxes[k, 3]
        for j in range(len(ys)):
            up = max(low - ys[j], ys[j] - high)
            out_y = max(up, 0.0)
            square[j] = min(square[j], out_x + out_y * out_y)
            depth[j] = min(depth[j], max(across, up))


@njit
def _first_from(ys: NDArray[np.float64], y: float) -> int:
    """Index of the first of ascending numbers that is not below another."""
    low, high = 0, len(ys)
    while low < high:
        middle = (low + high) // 2
        if ys[middle] < y:
            low = middle + 1
        else:
            high = middle
    return low


@njit
def _measure_circles(
    circles: NDArray[np.float64],
    x: float,
    ys: NDArray[np.float64],
    reach: float,
    nearest: NDArray[np.float64],
) -> None:
    """Lower a column's distances [m] where circles are no farther away than the reach [m]."""
    for k in range(len(circles)):
        y, radius = circles[k, 1], circles[k, 2]
        off = (circles[k, 0] - x) ** 2
        if off <= (reach + radius) ** 2:
            low, high = _first_from(ys, y - radius - reach), _first_from(ys, y + radius + reach)
            for j in range(low, high):
                nearest[j] = min(nearest[j], math.sqrt(off + (y - ys[j]) ** 2) - radius)


@njit
def _measure_outline(
    edges: NDArray[np.float64],
    x: float,
    ys: NDArray[np.float64],
    outline: NDArray[np.float64],
    inside: NDArray[np.bool_],
) -> None:
    """Write a column's squared distances from a polygon's outline [m²] and the points inside."""
    for j in range(len(ys)):
        outline[j] = math.inf
        inside[j] = False
    for k in range(len(edges)):
        x0, y0, y1 = edges[k, 0], edges[k, 1], edges[k, 3]
        step_x, step_y = edges[k, 2] - x0, y1 - y0
        inverse = 1.0 / (step_x * step_x + step_y * step_y)
        off_x, upward = x - x0, step_y > 0.0
        for j in range(len(ys)):
            off_y = ys[j] - y0
            share = (off_x * step_x + off_y * step_y) * inverse
            share = min(max(share, 0.0), 1.0)
            gap_x, gap_y = share * step_x - off_x, share * step_y - off_y
            outline[j] = min(outline[j], gap_x * gap_x + gap_y * gap_y)
            left = step_x * off_y - step_y * off_x > 0.0
            inside[j] ^= ((y0 <= ys[j]) != (y1 <= ys[j])) & (left == upward)


@njit
def _measure_polygons(
    segments: NDArray[np.float64],
    polygon_ends: NDArray[np.int64],
    x: float,
    ys: NDArray[np.float64],
    reach: float,
    square: NDArray[np.float64],
    depth: NDArray[np.float64],
) -> None:
    """As :func:`_measure_boxes`, where polygons are no farther away than the reach [m]."""
    outline, inside = np.empty(len(ys)), np.empty(len(ys), np.bool_)
    first = 0
    for end in polygon_ends:
        edges = segments[first:end]
        first = end
        left, bottom, right, top = math.inf, math.inf, -math.inf, -math.inf
        for k in range(len(edges)):
            left, right = min(left, edges[k, 0]), max(right, edges[k, 0])
            bottom, top = min(bottom, edges[k, 1]), max(top, edges[k, 1])
        if max(left - x, x - right) > reach:
            continue
        low, high = _first_from(ys, bottom - reach), _first_from(ys, top + reach)
        _measure_outline(edges, x, ys[low:high], outline, inside)
        for j in range(low, high):
            square[j] = min(square[j], outline[j - low])
            if inside[j - low]:
                depth[j] = min(depth[j], -math.sqrt(outline[j - low]))


@njit
def clearance_grid(
    half_size: NDArray[np.float64],  # [m]
    boxes: NDArray[np.float64],  # (x_min, y_min, x_max, y_max) [boxes, 4] [m]
    circles: NDArray[np.float64],  # (x, y, radius) [cylinders, 3] [m]
    segments: NDArray[np.float64],  # (x0, y0, x1, y1) [edges, 4] [m]
    polygon_ends: NDArray[np.int64],  # [polygons]
    xs: NDArray[np.float64],  # [nx] [m]
    ys: NDArray[np.float64],  # [m] [ny]
) -> NDArray[np.float32]:
    """Distance of each point from the nearest obstacle or wall [m], ``[nx, ny]``."""
    nx, ny = len(xs), len(ys)
    found = np.empty((nx, ny), np.float32)
    # One column at a time: loops over its rows have no branches and no function calls.
    nearest, square, depth = np.empty(ny), np.empty(ny), np.empty(ny)
    reach, longest = math.inf, -math.inf
    for i in range(nx):
        if i > 0:
            # From one column to the next a distance grows by no more than the step between them,
            # so that shapes farther away than this are nearest to no point of the column.
            reach = max(longest, 0.0) + 1.001 * (xs[i] - xs[i - 1])
        longest = -math.inf
        for j in range(ny):
            nearest[j] = min(half_size[0] - abs(xs[i]), half_size[1] - abs(ys[j]))
            square[j] = math.inf
            depth[j] = 0.0
        _measure_boxes(boxes, xs[i], ys, square, depth)
        _measure_circles(circles, xs[i], ys, reach, nearest)
        _measure_polygons(segments, polygon_ends, xs[i], ys, reach, square, depth)
        for j in range(ny):
            from_edges = depth[j] if depth[j] < 0.0 else math.sqrt(square[j])
            found[i, j] = min(nearest[j], from_edges)
            longest = max(longest, found[i, j])
    return found


@njit
def fill_from_nearest(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Give each infinite value the nearest finite one, ``[nx, ny]``."""
    # Two sweeps hand on where the nearest is, as in Danielsson's distance transform, which may be
    # wrong by less than a cell.
    nx, ny = values.shape
    away_x = np.zeros((nx, ny), np.int32)
    away_y = np.zeros((nx, ny), np.int32)
    square = np.empty((nx, ny), np.int64)
    for i in range(nx):
        for j in range(ny):
            square[i, j] = 0 if math.isfinite(values[i, j]) else 2_000_000_000
    for sweep in range(2):
        turn = 1 - 2 * sweep
        for column in range(nx):
            i = column if sweep == 0 else nx - 1 - column
            # Along each column there and back, so that four neighbors of each side are asked.
            for back in range(2):
                for row in range(ny):
                    j = row if back == sweep else ny - 1 - row
                    beside = turn if back == sweep else -turn
                    for across, up in ((turn, -1), (turn, 0), (turn, 1), (0, beside)):
                        at_i, at_j = i - across, j - up
                        if 0 <= at_i < nx and 0 <= at_j < ny and square[at_i, at_j] < square[i, j]:
                            x, y = away_x[at_i, at_j] + across, away_y[at_i, at_j] + up
                            if x * x + y * y < square[i, j]:
                                square[i, j] = x * x + y * y
                                away_x[i, j], away_y[i, j] = x, y
    filled = values.copy()
    for i in range(nx):
        for j in range(ny):
            filled[i, j] = values[i - away_x[i, j], j - away_y[i, j]]
    return filled


@njit
def interpolate(
    values: NDArray[np.float32] | NDArray[np.float64],  # [N, most columns, most rows]
    number: int,  # of the grid
    nx: int,
    ny: int,
    x_first: float,  # [m]
    y_first: float,  # [m]
    resolution: float,  # [m]
    x: float,  # [m]
    y: float,  # [m]
) -> float:
    """Read a grid between its points, bilinearly; outside as at its edge."""
    column = min(max((x - x_first) / resolution, 0.0), nx - 1.0)
    row = min(max((y - y_first) / resolution, 0.0), ny - 1.0)
    i, j = int(column), int(row)
    right, above = min(i + 1, nx - 1), min(j + 1, ny - 1)
    a, b = column - i, row - j
    low = (1.0 - a) * values[number, i, j] + a * values[number, right, j]
    high = (1.0 - a) * values[number, i, above] + a * values[number, right, above]
    return (1.0 - b) * low + b * high


_BEYOND: Final = 3.0
"""Steps by which the last cell that is needed is exceeded: more than a move is long."""
_BUCKETS: Final = 8
"""Number of buckets; a move over free cells leads three ahead at most."""


@njit
def _twice(entries: NDArray[np.int64]) -> NDArray[np.int64]:
    """The entries in an array that has room for as many more."""
    longer = np.empty(2 * len(entries), np.int64)
    for k in range(len(entries)):
        longer[k] = entries[k]
    return longer


@njit
def path_lengths(
    # True, or by how much longer a move counts there; 0 where none leads, [nx, ny].
    free: NDArray[np.bool_] | NDArray[np.int64],
    seeds: NDArray[np.int64],  # [seeds, 2]
    gaps: NDArray[np.float64],  # [m] [seeds]
    moves: NDArray[np.int64],
    step: float,  # [m]
    limit: float,  # [m]
    last: tuple[int, int] = (-1, -1),  # Cells much farther than this one are left out.
    buckets: int = _BUCKETS,  # More than the longest move has steps.
    beyond: float = _BEYOND,  # Steps by which cells may be farther than the last one.
) -> NDArray[np.float64]:
    """Lengths of the shortest paths to all cells within the limit [m], ``[nx, ny]``."""
    # They are those of Dijkstra's algorithm to the bit. Cells wait in buckets as wide as the
    # shortest move: no cell of a bucket is reached by a shorter path through another one of it, so
    # that they need not be sorted (Dial 1969).
    nx, ny = free.shape
    lengths_to = np.empty((nx, ny))
    lengths_to[:, :] = math.inf
    settled = np.zeros((nx, ny), np.bool_)
    lengths = np.sqrt((moves[:, 0] ** 2 + moves[:, 1] ** 2).astype(np.float64)) * step
    # Lists of cells: the first of each bucket, and behind each entry the next.
    heads = np.empty(buckets, np.int64)
    heads[:] = -1
    cells, nexts = np.empty(1024, np.int64), np.empty(1024, np.int64)
    entries, waiting = 0, 0
    for k in range(len(seeds)):
        i, j = seeds[k]
        if gaps[k] <= limit and gaps[k] < lengths_to[i, j]:
            lengths_to[i, j] = gaps[k]
            bucket = int(gaps[k] / step) % buckets
            cells[entries], nexts[entries] = i * ny + j, heads[bucket]
            heads[bucket] = entries
            entries += 1
            waiting += 1
    bucket = 0
    while waiting > 0:
        at = heads[bucket % buckets]
        if at < 0:
            bucket += 1
            continue
        heads[bucket % buckets] = nexts[at]
        waiting -= 1
        i, j = cells[at] // ny, cells[at] % ny
        if settled[i, j] or lengths_to[i, j] > limit:
            continue
        settled[i, j] = True
        if i == last[0] and j == last[1]:
            limit = min(limit, lengths_to[i, j] + beyond * step)
        if entries + len(moves) > len(cells):
            cells, nexts = _twice(cells), _twice(nexts)
        for k in range(len(moves)):
            to_i, to_j = i + moves[k, 0], j + moves[k, 1]
            if to_i < 0 or to_j < 0 or to_i >= nx or to_j >= ny or not free[to_i, to_j]:
                continue
            length = lengths_to[i, j] + lengths[k]
            if length > limit or length >= lengths_to[to_i, to_j]:
                continue
            length = lengths_to[i, j] + _factor(free, i, j, moves[k]) * lengths[k]
            if length > limit or length >= lengths_to[to_i, to_j]:
                continue
            lengths_to[to_i, to_j] = length
            later = int(length / step) % buckets
            cells[entries], nexts[entries] = to_i * ny + to_j, heads[later]
            heads[later] = entries
            entries += 1
            waiting += 1
    return lengths_to


@njit
def _factor(
    free: NDArray[np.bool_] | NDArray[np.int64], i: int, j: int, move: NDArray[np.int64]
) -> float:
    """By how much longer a move from a cell counts; infinite if it cuts a corner."""
    over, under = free[i + move[2], j + move[3]], free[i + move[4], j + move[5]]
    if not (over and under):
        return math.inf
    return float(max(int(free[i, j]), int(free[i + move[0], j + move[1]]), int(over), int(under)))
