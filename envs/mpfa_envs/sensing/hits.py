"""Where a robot's rays have hit, and whether later ones have looked through there: what has left.

A map of hits alone never forgets: whoever stood in a door for a moment would close it for good.
Each cell keeps its last hit and the evidence for it. A scan that hits there again adds to it, one
that looks past it takes away, and a cell without evidence is free again.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from mpfa_envs.compiled import njit
from mpfa_envs.sensing.map_memory import RESOLUTION

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.worlds.world import World

MARGIN: Final = 5
"""Cells around the area, which is open there unless a wall was seen."""
_HIT: Final = 10
"""What a hit adds to a cell's evidence; a scan that looks past it takes one away."""
_WALL: Final = 11
"""Evidence from which a cell is a wall: that of two scans."""
_MOST: Final = 20
"""Greatest evidence: what so many scans have looked past has moved away."""
_PLAN: Final = 100
"""Evidence of a wall of a plan, which no scan takes away."""
_PAST: Final = 0.01
"""A ray looks past a hit that is no farther from it than this [m],"""
_BEYOND: Final = 0.3
"""and reaches farther by this at least [m],"""
_GRAZES: Final = 0.2
"""and by this share of its length: one that grazes a wall comes as near just before its end."""


class Hits:
    """The hits of a robot's rays in a grid over an area, and the evidence for each."""

    def __init__(self) -> None:
        self._evidence = np.zeros((0, 0), dtype=np.int8)
        self._seen = np.zeros((0, 0), dtype=np.int8)
        self._places = np.zeros((0, 0, 2))
        self.origin = np.zeros(2)
        """Center of the first cell (x, y) [m]."""

    @property
    def walls(self) -> NDArray[np.bool_]:
        """Where walls were seen, or are in the plan, ``[columns, rows]``."""
        return self._evidence >= _WALL

    @property
    def places(self) -> NDArray[np.float64]:
        """The last hits in all cells that they have not left, without the plan [m], ``[P, 2]``."""
        there = (self._evidence > 0) & (self._evidence < _PLAN)
        return self._places[there] + self.origin

    def begin(
        self,
        center: tuple[float, float],
        size: tuple[float, float],
        plan: World | None = None,
        pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Begin an area of a size around a place [m], empty or with the walls of a plan."""
        sides = [math.ceil(side / RESOLUTION) + 2 * MARGIN for side in size]
        self.origin = np.array(center) - 0.5 * RESOLUTION * (np.array(sides) - 1)
        self._evidence = np.zeros(sides, dtype=np.int8)
        self._seen = np.zeros(sides, dtype=np.int8)
        self._places = np.zeros((*sides, 2))
        if plan is not None:
            cells = np.indices(sides).reshape(2, -1).T
            x, y = (self.origin + RESOLUTION * cells - pose[:2]).T
            cosine, sine = math.cos(pose[2]), math.sin(pose[2])
            points = np.stack((x * cosine + y * sine, y * cosine - x * sine), axis=1)
            walls = plan.clearances(points).reshape(sides) <= 0.5 * RESOLUTION
            self._evidence[walls] = _PLAN

    def see(
        self,
        x: float,
        y: float,
        angles: NDArray[np.float64],
        ranges: NDArray[np.float64],
        far: float,
    ) -> NDArray[np.int64]:
        """Enter rays from a place [m] in directions of the odometry [rad]; far is no hit [m].

        Returns:
            Columns and rows of the cells whose hits have left, ``[C, 2]``.
        """
        start = np.array((x, y)) - self.origin
        most = angles.size * (2 + 9 * int(far / RESOLUTION))
        found = np.empty((most, 2), dtype=np.int64)
        grid = self._evidence, self._seen, self._places
        rays = start, angles, np.ascontiguousarray(ranges), far
        return found[: enter_rays(grid, rays, found)].copy()


@njit
def enter_rays(
    # Evidence [columns, rows], marks of this scan, all 0 before, and last hits from the first
    # cell's center [m], [columns, rows, 2]
    grid: tuple[NDArray[np.int8], NDArray[np.int8], NDArray[np.float64]],
    # Place of the lidar from there [m], [2], angles [R] and ranges [m], [R], and that of no hit [m]
    rays: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float],
    found: NDArray[np.int64],  # columns and rows of cells, [F, 2]
) -> int:
    """Weigh the hits of rays against those that they look past; the number of cells found free."""
    count = _mark_hits(grid, rays, found)
    count = _mark_past(grid, rays, found, count)
    return _weigh(grid, found, count)


@njit
def _mark_hits(
    grid: tuple[NDArray[np.int8], NDArray[np.int8], NDArray[np.float64]],
    rays: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float],
    found: NDArray[np.int64],
) -> int:
    """Mark the cells that rays hit with 2; their number."""
    evidence, seen, places = grid
    start, angles, ranges, far = rays
    nx, ny = evidence.shape
    count = 0
    for ray in range(angles.size):
        if ranges[ray] >= far:
            continue
        x = start[0] + ranges[ray] * math.cos(angles[ray])
        y = start[1] + ranges[ray] * math.sin(angles[ray])
        i, j = math.floor(x / RESOLUTION + 0.5), math.floor(y / RESOLUTION + 0.5)
        if 0 <= i < nx and 0 <= j < ny:
            places[i, j, 0], places[i, j, 1] = x, y
            if seen[i, j] == 0:
                found[count, 0], found[count, 1] = i, j
                count += 1
            seen[i, j] = 2
    return count


@njit
def _mark_past(
    grid: tuple[NDArray[np.int8], NDArray[np.int8], NDArray[np.float64]],
    rays: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float],
    found: NDArray[np.int64],
    count: int,
) -> int:
    """Mark the cells whose hits rays look past with 1; the number of all marked cells."""
    evidence, seen, places = grid
    start, angles, ranges, far = rays
    nx, ny = evidence.shape
    for ray in range(angles.size):
        reach = min(ranges[ray], far)
        last = reach - max(_BEYOND, _GRAZES * reach)
        across, up = math.cos(angles[ray]), math.sin(angles[ray])
        for step in range(int(max(last, 0.0) / RESOLUTION) + 1):
            u = math.floor(start[0] / RESOLUTION + step * across + 0.5)
            v = math.floor(start[1] / RESOLUTION + step * up + 0.5)
            for i in range(max(u - 1, 0), min(u + 1, nx - 1) + 1):
                for j in range(max(v - 1, 0), min(v + 1, ny - 1) + 1):
                    if not 0 < evidence[i, j] < _PLAN or seen[i, j] != 0:
                        continue
                    x, y = places[i, j, 0] - start[0], places[i, j, 1] - start[1]
                    along = x * across + y * up
                    if 0.0 < along < last and abs(y * across - x * up) <= _PAST:
                        seen[i, j] = 1
                        found[count, 0], found[count, 1] = i, j
                        count += 1
    return count


@njit
def _weigh(
    grid: tuple[NDArray[np.int8], NDArray[np.int8], NDArray[np.float64]],
    found: NDArray[np.int64],  # the cells that have left come first
    count: int,
) -> int:
    """Change the evidence of marked cells, and clear the marks; the number of those that left."""
    evidence, seen, _ = grid
    left = 0
    for k in range(count):
        i, j = found[k, 0], found[k, 1]
        if seen[i, j] == 2 and evidence[i, j] < _PLAN:
            evidence[i, j] = min(evidence[i, j] + _HIT, _MOST)
        elif seen[i, j] == 1:
            evidence[i, j] -= 1
            if evidence[i, j] == 0:
                found[left, 0], found[left, 1] = i, j
                left += 1
        seen[i, j] = 0
    return left
