"""Whether what was seen closes a goal in: a grid of hits that rays can take back.

The map of the policy only gains obstacles, and its paths lead through blocked cells at a price, as
a robot may have to leave one. Here a cell is a wall only while hits on it outweigh the rays that
have passed it since, so that a person who walks on, or one noisy scan, closes nothing for good.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from mpfa_envs.compiled import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.worlds.world import World

RESOLUTION: Final = 0.1
"""Side of a cell [m]."""
_MARGIN: Final = 5
"""Cells around the area, which is open there unless a wall was seen."""
_HIT: Final = 2
"""What a hit adds to a cell's evidence; a ray that passes takes one away."""
_WALL: Final = 3
"""Evidence from which a cell is a wall: that of two scans."""
_MOST: Final = 10
"""Greatest evidence: what rays of so many scans pass has moved away."""
_SLIM: Final = 0.05
"""A passage may be this much narrower than the robot on either side, as hits are noisy [m]."""
_NEAR: Final = 0.3
"""A robot is where any open cell within this distance is [m]."""


class Reach:
    """The walls that a robot has seen, and whether they close a place in."""

    def __init__(self, radius: float) -> None:
        self._wide = max(math.floor((radius - _SLIM) / RESOLUTION), 0)
        self._evidence = np.zeros((0, 0), dtype=np.int8)
        self._marks = np.zeros((0, 0), dtype=np.uint8)
        self._origin = np.zeros(2)

    def begin(
        self,
        center: tuple[float, float],
        size: tuple[float, float],
        plan: World | None = None,
        pose: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Begin an area of a size around a place [m], empty or with the walls of a plan."""
        sides = [math.ceil(side / RESOLUTION) + 2 * _MARGIN for side in size]
        self._origin = np.array(center) - 0.5 * RESOLUTION * (np.array(sides) - 1)
        self._evidence = np.zeros(sides, dtype=np.int8)
        self._marks = np.zeros(sides, dtype=np.uint8)
        if plan is not None:
            cells = np.indices(sides).reshape(2, -1).T
            x, y = (self._origin + RESOLUTION * cells - pose[:2]).T
            cosine, sine = math.cos(pose[2]), math.sin(pose[2])
            points = np.stack((x * cosine + y * sine, y * cosine - x * sine), axis=1)
            walls = plan.clearances(points).reshape(sides) <= 0.5 * RESOLUTION
            self._evidence[walls] = _MOST

    def see(
        self,
        x: float,
        y: float,
        angles: NDArray[np.float64],
        ranges: NDArray[np.float64],
        far: float,
    ) -> None:
        """Enter rays from a place [m] in directions of the odometry [rad]; far is no hit [m]."""
        start = (np.array((x, y)) - self._origin) / RESOLUTION
        reach = np.ascontiguousarray(ranges) / RESOLUTION
        enter_rays(self._evidence, self._marks, start, angles, reach, far / RESOLUTION)

    def closes_in(
        self, goal: tuple[float, float], radius: float, place: tuple[float, float]
    ) -> bool:
        """Return True if no path leads from around a place to within a radius of a goal [m]."""
        to = (np.array(goal) - self._origin) / RESOLUTION
        at = (np.array(place) - self._origin) / RESOLUTION
        free = open_cells(self._evidence >= _WALL, self._wide)
        here = cells_around(free, at, _NEAR / RESOLUTION)
        # A robot in a wall is somewhere else than it thinks.
        if not len(here):
            return False
        reached = flood(free, cells_around(free, to, radius / RESOLUTION))
        return not reached[here[:, 0], here[:, 1]].any()


@njit
def enter_rays(
    evidence: NDArray[np.int8],
    marks: NDArray[np.uint8],  # changed in place; all 0 before and after
    start: NDArray[np.float64],  # in cells
    angles: NDArray[np.float64],  # [R]
    reach: NDArray[np.float64],  # in cells, [R]
    far: float,  # in cells
) -> None:
    """Add the hits of rays to cells, and take away where rays have passed and none has hit."""
    nx, ny = evidence.shape
    for ray in range(angles.size):
        across, up = math.cos(angles[ray]), math.sin(angles[ray])
        for step in range(int(max(reach[ray] - 1.5, 0.0)) + 1):
            i = math.floor(start[0] + step * across + 0.5)
            j = math.floor(start[1] + step * up + 0.5)
            if 0 <= i < nx and 0 <= j < ny:
                marks[i, j] = 1
    for ray in range(angles.size):
        if reach[ray] < far:
            i = math.floor(start[0] + reach[ray] * math.cos(angles[ray]) + 0.5)
            j = math.floor(start[1] + reach[ray] * math.sin(angles[ray]) + 0.5)
            if 0 <= i < nx and 0 <= j < ny:
                marks[i, j] = 2
    for i in range(nx):
        for j in range(ny):
            if marks[i, j] == 2:
                evidence[i, j] = min(evidence[i, j] + _HIT, _MOST)
            elif marks[i, j] == 1:
                evidence[i, j] = max(evidence[i, j] - 1, 0)
            marks[i, j] = 0


@njit
def open_cells(walls: NDArray[np.bool_], wide: int) -> NDArray[np.bool_]:
    """Cells with no wall within some cells of them, ``[columns, rows]``."""
    nx, ny = walls.shape
    free = np.ones((nx, ny), dtype=np.bool_)
    for i in range(nx):
        for j in range(ny):
            if not walls[i, j]:
                continue
            for a in range(max(i - wide, 0), min(i + wide, nx - 1) + 1):
                for b in range(max(j - wide, 0), min(j + wide, ny - 1) + 1):
                    if (a - i) ** 2 + (b - j) ** 2 <= wide * wide:
                        free[a, b] = False
    return free


@njit
def cells_around(
    free: NDArray[np.bool_], place: NDArray[np.float64], radius: float
) -> NDArray[np.int64]:
    """Columns and rows of the free cells within a radius of a place, ``[C, 2]``."""
    nx, ny = free.shape
    found = np.empty((nx * ny, 2), dtype=np.int64)
    count = 0
    for i in range(
        max(math.ceil(place[0] - radius), 0), min(math.floor(place[0] + radius), nx - 1) + 1
    ):
        for j in range(
            max(math.ceil(place[1] - radius), 0), min(math.floor(place[1] + radius), ny - 1) + 1
        ):
            if free[i, j] and (i - place[0]) ** 2 + (j - place[1]) ** 2 <= radius * radius:
                found[count, 0], found[count, 1] = i, j
                count += 1
    return found[:count]


@njit
def flood(free: NDArray[np.bool_], cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Free cells that straight steps reach from some cells; diagonal walls stop them."""
    nx, ny = free.shape
    reached = np.zeros((nx, ny), dtype=np.bool_)
    queue = np.empty((nx * ny, 2), dtype=np.int64)
    count, taken = len(cells), 0
    queue[:count] = cells
    for cell in cells:
        reached[cell[0], cell[1]] = True
    while taken < count:
        i, j = queue[taken, 0], queue[taken, 1]
        taken += 1
        for move in range(4):
            a = i + (move == 0) - (move == 1)
            b = j + (move == 2) - (move == 3)
            if 0 <= a < nx and 0 <= b < ny and free[a, b] and not reached[a, b]:
                reached[a, b] = True
                queue[count, 0], queue[count, 1] = a, b
                count += 1
    return reached
