"""Whether walls close a goal in."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from mpfa_envs.compiled import njit
from mpfa_envs.sensing.map_memory import RESOLUTION

if TYPE_CHECKING:
    from numpy.typing import NDArray

_SLIM: Final = 0.05
"""A passage may be this much narrower than the robot on either side, as hits are noisy [m]."""
_NEAR: Final = 0.3
"""A robot is where any open cell within this distance is [m]."""


def closes_in(
    walls: NDArray[np.bool_],  # [columns, rows]
    origin: NDArray[np.float64],  # center of the first cell (x, y) [m]
    rim: float,  # radius of the robot [m]
    goal: tuple[float, float],  # [m]
    radius: float,  # of the goal [m]
    place: tuple[float, float],  # of the robot [m]
) -> bool:
    """Return True if no path leads from around a place to within a radius of a goal."""
    to, at = (np.array(goal) - origin) / RESOLUTION, (np.array(place) - origin) / RESOLUTION
    free = open_cells(walls, max(math.floor((rim - _SLIM) / RESOLUTION), 0))
    here = cells_around(free, at, _NEAR / RESOLUTION)
    # A robot in a wall is somewhere else than it thinks.
    if not len(here):
        return False
    reached = flood(free, cells_around(free, to, radius / RESOLUTION))
    return not reached[here[:, 0], here[:, 1]].any()


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
