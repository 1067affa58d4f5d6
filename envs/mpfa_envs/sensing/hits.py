"""What of the things that a lidar has hit is still there: evidence that rays can take back."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from mpfa_envs.compiled import njit
from mpfa_envs.sensing.map_loops import enter_hit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.sensing.sectors import Points

_HIT: Final = 5
"""What a scan that hits a cell adds to its evidence; one that looks through it takes one away."""
_WALL: Final = 6
"""Evidence from which a cell is a wall: that of two scans."""
_MOST: Final = 10
"""Greatest evidence: what so many scans look through has moved away."""
_WIDEST: Final = 1.0
"""Distance of two rays beside a place at most, for them to look through it, in cells: nothing that
is wider fits between them."""
_BEHIND: Final = 1.0
"""How much farther than a place these rays must reach, in cells."""
_CORNER: Final = math.sqrt(0.5)
"""Distance of a cell's corners from its middle, in cells."""
_KEPT: Final = 4
"""Hits of a cell that are kept: the outermost to the left, the right, below and above."""


class Hits:
    """Hits of a lidar on a grid of square cells, until scans have looked through them.

    A scan looks through a place if the rays on both sides of it, no farther from each other than a
    cell is wide, reach a cell farther than it. What stands still and is at least as wide as a cell
    stops one of them. Its hits are never taken back, so that where nothing moves no map changes.

    A cell holds evidence from 0 to 10: 5 more after each scan that hits it, 1 less after each that
    looks through all its hits. Where none is left the hits are forgotten.
    """

    def __init__(self, resolution: float) -> None:
        self._resolution = resolution  # [m]
        self._evidence = np.zeros((0, 0), dtype=np.int8)
        self._marks = np.zeros((0, 0), dtype=np.uint8)
        self._places = np.zeros((0, 0, _KEPT, 2), dtype=np.float32)
        self.origin = np.zeros(2)
        """Center of the first cell (x, y) [m]."""

    def begin(
        self,
        shape: tuple[int, int],
        origin: NDArray[np.float64],
        walls: NDArray[np.bool_] | None = None,
    ) -> None:
        """Begin a grid of a shape with an origin [m], empty or with walls that are known."""
        self.origin = np.array(origin)
        self._evidence = np.zeros(shape, dtype=np.int8)
        self._marks = np.zeros(shape, dtype=np.uint8)
        self._places = np.zeros((*shape, _KEPT, 2), dtype=np.float32)
        if walls is not None:
            self._evidence[walls] = _MOST

    @property
    def walls(self) -> NDArray[np.bool_]:
        """Which cells are walls, ``[columns, rows]``: hit twice, and not looked through since."""
        return self._evidence >= _WALL

    def see(self, taken: NDArray[np.float64], points: Points, far: float) -> NDArray[np.int64]:
        """Enter a scan taken at a pose, whose ranges of far [m] or more have hit nothing.

        Returns columns and rows of the cells that are empty now, ``[C, 2]``.
        """
        x, y, heading = taken[:3].tolist()
        across, up = points.sensor
        cosine, sine = math.cos(heading), math.sin(heading)
        start = np.array((x + across * cosine - up * sine, y + across * sine + up * cosine))
        ends = np.stack((np.cos(points.angles), np.sin(points.angles))) * points.ranges
        met = points.ranges < far
        to_x, to_y = ends[0] - across, ends[1] - up
        angles = np.where(met, np.arctan2(to_y, to_x), points.angles) + heading
        ranges = np.where(
            met, np.hypot(to_x, to_y), min(points.reach, far - math.hypot(across, up))
        )
        angles = angles % math.tau
        order = np.argsort(angles, kind="stable")
        return enter_rays(
            self._evidence,
            self._marks,
            self._places,
            (start - self.origin) / self._resolution,
            angles[order],
            ranges[order] / self._resolution,
            met[order],
        )

    def lower(
        self,
        levels: NDArray[np.uint8],  # of the map, changed in place, [columns, rows] at least
        least: NDArray[np.uint8],  # what the plan gives them, of the same shape
        cells: NDArray[np.int64],  # [C, 2]
        bounds: tuple[float, float, float],  # where they are blocked, tight, near to a hit [m]
    ) -> None:
        """Make the levels around cells again by the hits that are left."""
        blocked, tight, near = (bound / self._resolution for bound in bounds)
        lower_levels(levels, least, self._evidence, self._places, cells, (blocked, tight, near))


@njit
def enter_rays(
    evidence: NDArray[np.int8],
    marks: NDArray[np.uint8],  # changed in place; all 0 before and after
    # Hits from a cell's lower left corner, plus 1 in both directions; 0: none. [nx, ny, K, 2]
    places: NDArray[np.float32],
    start: NDArray[np.float64],  # in cells
    angles: NDArray[np.float64],  # in ascending order, [R]
    reach: NDArray[np.float64],  # in cells, [R]
    met: NDArray[np.bool_],  # [R]
) -> NDArray[np.int64]:
    """Enter the hits of rays, and take away where they looked through; cells that are empty now."""
    nx, ny = evidence.shape
    hits = np.empty((angles.size, 2), dtype=np.int64)
    count, most = 0, 0.0
    for ray in range(angles.size):
        most = max(most, reach[ray])
        if not met[ray]:
            continue
        u = start[0] + reach[ray] * math.cos(angles[ray])
        v = start[1] + reach[ray] * math.sin(angles[ray])
        i, j = math.floor(u + 0.5), math.floor(v + 0.5)
        if not (0 <= i < nx and 0 <= j < ny):
            continue
        if marks[i, j] == 0:
            marks[i, j] = 1
            evidence[i, j] = min(evidence[i, j] + _HIT, _MOST)
            hits[count, 0], hits[count, 1] = i, j
            count += 1
        _keep(places[i, j], u - i + 1.5, v - j + 1.5)
    emptied = np.empty((nx * ny, 2), dtype=np.int64)
    number = 0
    for i in range(
        max(math.ceil(start[0] - most), 0), min(math.floor(start[0] + most), nx - 1) + 1
    ):
        for j in range(
            max(math.ceil(start[1] - most), 0), min(math.floor(start[1] + most), ny - 1) + 1
        ):
            if evidence[i, j] == 0 or marks[i, j] == 1:
                continue
            if _is_looked_through(i - start[0], j - start[1], places[i, j], angles, reach):
                evidence[i, j] -= 1
                if evidence[i, j] == 0 and places[i, j, 0, 0] > 0.0:
                    places[i, j] = 0.0
                    emptied[number, 0], emptied[number, 1] = i, j
                    number += 1
    for hit in range(count):
        marks[hits[hit, 0], hits[hit, 1]] = 0
    return emptied[:number].copy()


@njit
def _keep(places: NDArray[np.float32], u: float, v: float) -> None:
    """Keep a hit of a cell if it is the outermost on one side."""
    if places[0, 0] == 0.0:
        places[:, 0], places[:, 1] = u, v
        return
    for side in range(_KEPT):
        along, at = (u, places[side, 0]) if side < 2 else (v, places[side, 1])
        if (side % 2 == 0 and along < at) or (side % 2 == 1 and along > at):
            places[side, 0], places[side, 1] = u, v


@njit
def _is_looked_through(
    across: float,  # of the cell's middle from the lidar, in cells
    up: float,
    places: NDArray[np.float32],  # of its hits, [K, 2]
    angles: NDArray[np.float64],
    reach: NDArray[np.float64],
) -> bool:
    """Return True if rays look through all hits of a cell, or through a whole one of a plan."""
    if places[0, 0] == 0.0:
        return _looks_through(across, up, _CORNER, angles, reach)
    for side in range(_KEPT):
        u, v = across + places[side, 0] - 1.5, up + places[side, 1] - 1.5
        if not _looks_through(u, v, 0.0, angles, reach):
            return False
    return True


@njit
def _looks_through(
    across: float, up: float, wide: float, angles: NDArray[np.float64], reach: NDArray[np.float64]
) -> bool:
    """Return True if the rays beside and within a circle around a place reach farther."""
    away = math.hypot(across, up)
    # The robot itself is within a cell of the lidar.
    if angles.size < 2 or away <= 1.0 + wide:
        return False
    half = math.asin(wide / away)
    first = (math.atan2(up, across) - half) % math.tau
    ray = np.searchsorted(angles, first, side="right") - 1
    least = away + wide + _BEHIND
    turned = -((first - angles[ray]) % math.tau)  # from the place's right to the ray
    while reach[ray] >= least:
        if turned >= 2.0 * half and turned > 0.0:
            return True
        gap = (angles[(ray + 1) % angles.size] - angles[ray]) % math.tau
        if gap * least > _WIDEST:
            return False
        ray = (ray + 1) % angles.size
        turned += gap
    return False


@njit
def lower_levels(
    levels: NDArray[np.uint8],  # changed in place
    least: NDArray[np.uint8],
    evidence: NDArray[np.int8],
    places: NDArray[np.float32],
    cells: NDArray[np.int64],  # [C, 2]
    bounds: tuple[float, float, float],  # in cells
) -> None:
    """Make the levels around cells again by the hits that are left."""
    nx, ny = evidence.shape
    inside = levels[:nx, :ny]
    wide = math.ceil(bounds[2] + 1.0)
    for cell in cells:
        for i in range(max(cell[0] - wide, 0), min(cell[0] + wide, nx - 1) + 1):
            for j in range(max(cell[1] - wide, 0), min(cell[1] + wide, ny - 1) + 1):
                inside[i, j] = least[i, j]
    for cell in cells:
        for i in range(max(cell[0] - 2 * wide, 0), min(cell[0] + 2 * wide, nx - 1) + 1):
            for j in range(max(cell[1] - 2 * wide, 0), min(cell[1] + 2 * wide, ny - 1) + 1):
                if evidence[i, j] == 0 or places[i, j, 0, 0] == 0.0:
                    continue
                for side in range(_KEPT):
                    u, v = i + places[i, j, side, 0] - 1.5, j + places[i, j, side, 1] - 1.5
                    enter_hit(inside, u, v, bounds)
