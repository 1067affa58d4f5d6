"""Lidar of many robots: each shape is intersected only with the rays that point at it.

A world has tens or hundreds of shapes, and most are seen by a few rays or by none. The directions
of a shape's two outermost points give the rays between them; only these are intersected with it, by
the formulas of :class:`mpfa_envs.Lidar`, to which a test holds them.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from mpfa_envs.compiled import njit
from mpfa_envs.worlds.arrays import cast_at_cells

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.worlds.arrays import BatchArrays

_GUARD = 0.001
"""Error of a direction, at most: rays this near to a shape's outermost are tried as well [rad]."""
_END = 1e-12
"""Share of an edge by which a ray may pass its ends, as it must not slip between two edges."""


@njit
def cast_rays(
    motions: NDArray[np.float64],  # x, y, heading first [m, m, rad], [N, 5]
    chosen: NDArray[np.bool_],  # [N]; the others' ranges stay
    worlds: BatchArrays,
    directions: NDArray[np.float64],  # cosine and sine in the robot's frame, [2, rays]
    view: float,  # each ray is in the middle of an equal part of it [rad]
    max_range: float,
    ranges: NDArray[np.float64],  # [m], [N, rays]
) -> None:
    """Write the noise-free range of every ray of the chosen robots; zero in an obstacle."""
    rays = directions.shape[1]
    # Directions (cosine, sine) of the rays in the world, and one over them.
    beams = np.empty((4, rays))
    for robot in range(motions.shape[0]):
        if not chosen[robot]:
            continue
        x, y, heading = motions[robot, 0], motions[robot, 1], motions[robot, 2]
        ahead = math.cos(heading), math.sin(heading)
        row = ranges[robot]
        _turn(ahead, directions, beams)
        reach = min(_cast_at_walls(x, y, worlds.half_sizes[robot], beams, row), max_range)
        inside = False
        boxes, circles = worlds.boxes[robot], worlds.circles[robot]
        for index in range(worlds.counts[robot, 0]):
            # Plain numbers: making a view of a row would cost more than the work on it.
            x0, y0, x1, y1 = boxes[index, 0], boxes[index, 1], boxes[index, 2], boxes[index, 3]
            inside |= _cast_at_box(x0 - x, y0 - y, x1 - x, y1 - y, ahead, view, reach, beams, row)
        for index in range(worlds.counts[robot, 1]):
            dx, dy, radius = circles[index, 0] - x, circles[index, 1] - y, circles[index, 2]
            inside |= _cast_at_circle(dx, dy, radius, ahead, view, reach, beams, row)
        first = 0
        for polygon in range(worlds.counts[robot, 3]):
            last = worlds.polygon_ends[robot, polygon]
            edges = worlds.segments[robot, first:last]
            inside |= _cast_at_polygon(x, y, ahead, edges, view, reach, beams, row)
            first = last
        number = worlds.grid_of[robot]
        if number >= 0:
            columns, lines = worlds.grids.shapes[number]
            gaps = worlds.grids.gaps[number, :columns, :lines]
            resolution = worlds.grids.resolutions[number]
            inside |= cast_at_cells(x, y, beams, gaps, resolution, max_range, row)
        for ray in range(rays):
            row[ray] = 0.0 if inside else min(max(row[ray], 0.0), max_range)


@njit
def _turn(
    ahead: tuple[float, float], directions: NDArray[np.float64], beams: NDArray[np.float64]
) -> None:
    """Turn the rays with the robot: their directions in the world, and one over these."""
    cosine, sine = ahead
    for ray in range(directions.shape[1]):
        # A ray parallel to a wall: the tiny number turns 0 / 0 into 0 and changes no other value.
        across = directions[0, ray] * cosine - directions[1, ray] * sine + 1e-300
        up = directions[0, ray] * sine + directions[1, ray] * cosine + 1e-300
        beams[0, ray], beams[1, ray] = across, up
        beams[2, ray], beams[3, ray] = 1.0 / across, 1.0 / up


@njit
def _cast_at_walls(
    x: float,
    y: float,
    half_size: NDArray[np.float64],
    beams: NDArray[np.float64],
    row: NDArray[np.float64],
) -> float:
    """Set the ranges to the walls; return the longest [m]."""
    longest = 0.0
    for ray in range(row.shape[0]):
        to_side = (math.copysign(half_size[0], beams[0, ray]) - x) * beams[2, ray]
        to_end = (math.copysign(half_size[1], beams[1, ray]) - y) * beams[3, ray]
        row[ray] = min(to_side, to_end)
        longest = max(longest, row[ray])
    return longest


@njit
def _span(
    ahead: tuple[float, float],
    x0: float,
    y0: float,
    x1: float,
    y1: float,
    view: float,
    rays: int,
) -> tuple[int, int]:
    """First and last ray on the shorter arc between two points; without rays, last before first."""
    cosine, sine = ahead
    front0, left0 = cosine * x0 + sine * y0, cosine * y0 - sine * x0
    front1, left1 = cosine * x1 + sine * y1, cosine * y1 - sine * x1
    if view <= math.pi and front0 <= 0.0 and front1 <= 0.0:
        return 0, -1
    low, high = _direction(front0, left0), _direction(front1, left1)
    if low > high:
        low, high = high, low
    if high - low > math.pi:
        # The arc between them leads around the back, where a wide view has both its ends.
        if view > math.pi:
            return 0, rays - 1
        low, high = (high, math.pi) if abs(high) < abs(low) else (-math.pi, low)
    return _rays_between(low, high, view, rays)


@njit
def _rays_between(low: float, high: float, view: float, rays: int) -> tuple[int, int]:
    """First and last ray between two directions in the robot's frame [rad]."""
    if view > math.pi and (low < -math.pi or high > math.pi):
        return 0, rays - 1
    # Ray k points at (1/2 - (k + 1/2) / rays) view; int() rounds up what is negative.
    per_angle, middle = rays / view, 0.5 * (rays - 1)
    first = int(max(middle - (high + _GUARD) * per_angle, -1.0) + 1.0)
    last = int(min(middle - (low - _GUARD) * per_angle, rays - 1.0) + 1.0) - 1
    return first, last


@njit
def _direction(front: float, left: float) -> float:
    """``math.atan2(left, front)`` with an error below 0.001 rad, in a fraction of its time."""
    # A polynomial for the arc tangent of at most one.
    ahead, aside = abs(front), abs(left)
    slope = min(ahead, aside) / max(ahead, aside, 1e-300)
    square = slope * slope
    angle = slope * (0.995354 + square * (0.079331 * square - 0.288679))
    if aside > ahead:
        angle = 0.5 * math.pi - angle
    if front < 0.0:
        angle = math.pi - angle
    return math.copysign(angle, left)


@njit
def _cast_at_box(
    x0: float,
    y0: float,
    x1: float,
    y1: float,
    ahead: tuple[float, float],
    view: float,
    reach: float,
    beams: NDArray[np.float64],
    row: NDArray[np.float64],
) -> bool:
    """Shorten the rays that meet a box, relative to the robot; return True if it is in the box."""
    aside = 1 if x0 > 0.0 else -1 if x1 < 0.0 else 0
    above = 1 if y0 > 0.0 else -1 if y1 < 0.0 else 0
    if aside == 0 and above == 0:
        return True
    near_x = x0 if aside > 0 else x1 if aside < 0 else 0.0
    near_y = y0 if above > 0 else y1 if above < 0 else 0.0
    if near_x * near_x + near_y * near_y > reach * reach:
        return False
    # The two outermost corners: of the near side, or of the diagonal that is seen.
    if above == 0:
        left, low, right, high = near_x, y0, near_x, y1
    elif aside == 0:
        left, low, right, high = x0, near_y, x1, near_y
    elif aside == above:
        left, low, right, high = x0, y1, x1, y0
    else:
        left, low, right, high = x0, y0, x1, y1
    first, last = _span(ahead, left, low, right, high, view, row.shape[0])
    for ray in range(first, last + 1):
        across, up = beams[2, ray], beams[3, ray]
        a, b, c, d = x0 * across, x1 * across, y0 * up, y1 * up
        enter = max(min(a, b), min(c, d), 0.0)
        if enter <= min(max(a, b), max(c, d)) and enter < row[ray]:
            row[ray] = enter
    return False


@njit
def _cast_at_circle(
    dx: float,
    dy: float,
    radius: float,
    ahead: tuple[float, float],
    view: float,
    reach: float,
    beams: NDArray[np.float64],
    row: NDArray[np.float64],
) -> bool:
    """Shorten the rays that meet a circle, relative to the robot; return True if it is in it."""
    front = ahead[0] * dx + ahead[1] * dy
    square = dx * dx + dy * dy
    far = reach + radius
    if square <= radius * radius:
        return True
    if (view <= math.pi and front < -radius) or square > far * far:
        return False
    # asin(s) <= s + 0.571 s³: a little wider than the circle looks.
    sine = radius / math.sqrt(square)
    half = sine + 0.571 * sine * sine * sine
    middle = _direction(front, ahead[0] * dy - ahead[1] * dx)
    first, last = _rays_between(middle - half, middle + half, view, row.shape[0])
    for ray in range(first, last + 1):
        along = dx * beams[0, ray] + dy * beams[1, ray]
        inner = along * along + radius * radius - square
        if inner >= 0.0:
            root = math.sqrt(inner)
            if along + root >= 0.0:
                row[ray] = min(row[ray], max(along - root, 0.0))
    return False


@njit
def _cast_at_polygon(
    x: float,
    y: float,
    ahead: tuple[float, float],
    edges: NDArray[np.float64],
    view: float,
    reach: float,
    beams: NDArray[np.float64],
    row: NDArray[np.float64],
) -> bool:
    """Shorten the rays that meet the edges of a polygon; return True if the robot is in it."""
    inside = False
    for edge in range(edges.shape[0]):
        x0, y0 = edges[edge, 0] - x, edges[edge, 1] - y
        x1, y1 = edges[edge, 2] - x, edges[edge, 3] - y
        if (y0 > 0.0) != (y1 > 0.0) and (x0 * y1 - x1 * y0 > 0.0) == (y1 > y0):
            inside = not inside  # A ray to the right crosses this edge.
        if max(min(x0, x1), -max(x0, x1), min(y0, y1), -max(y0, y1)) > reach:
            continue
        along_x, along_y = x1 - x0, y1 - y0
        first, last = _span(ahead, x0, y0, x1, y1, view, row.shape[0])
        for ray in range(first, last + 1):
            across, up = beams[0, ray], beams[1, ray]
            slant = across * along_y - up * along_x
            if slant == 0.0:
                continue
            share = (x0 * up - y0 * across) / slant
            length = (x0 * along_y - y0 * along_x) / slant
            if -_END <= share <= 1.0 + _END and 0.0 <= length < row[ray]:
                row[ray] = length
    return inside
