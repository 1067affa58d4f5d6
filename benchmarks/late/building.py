"""Buildings as occupied cells: rays, clearances, shortest paths, tasks through narrow doors."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

CELL = 0.05
"""Side of a cell [m]."""
EDGE = 0.2
"""Thickness of the outer walls, which lie around the origin [m]."""
_WIDTH, _DEPTH = 18.0, 12.0
_DOOR = 1.2
_TRIES = 6000
_APART = 4.0
"""Least distance of a start from its goal [m]."""
Point = tuple[float, float]
Grid = NDArray[np.bool_]


def building(seed: int, narrow: float) -> Grid:
    """Return the occupied cells [row, column] of two rows of three rooms along a corridor.

    One door of each row has the width ``narrow`` [m], the others 1.2 m.
    """
    rng = np.random.default_rng(seed)
    grid = np.ones((_cells(_DEPTH + 2 * EDGE), _cells(_WIDTH + 2 * EDGE)), bool)

    def fill(x0: float, y0: float, x1: float, y1: float, *, occupied: bool) -> None:
        rows = slice(_cells(y0 + EDGE), _cells(y1 + EDGE))
        grid[rows, _cells(x0 + EDGE) : _cells(x1 + EDGE)] = occupied

    fill(0, 0, _WIDTH, _DEPTH, occupied=False)
    low, high = 4.6 + 0.4 * rng.random(), 6.6 + 0.4 * rng.random()
    fill(0, low - 0.15, _WIDTH, low, occupied=True)
    fill(0, high, _WIDTH, high + 0.15, occupied=True)
    for upper in (False, True):
        walls = [0.0, 5.5 + rng.random(), 11.5 + rng.random(), _WIDTH]
        for x in walls[1:3]:
            fill(x, high if upper else 0, x + 0.15, _DEPTH if upper else low, occupied=True)
        tight = int(rng.integers(3))
        for room in range(3):
            left, right = walls[room], walls[room + 1]
            width = narrow if room == tight else _DOOR
            x = left + 0.4 + (right - left - 0.6 - width) * rng.random()
            bottom, top = (high, high + 0.15) if upper else (low - 0.15, low)
            fill(x, bottom, x + width, top, occupied=False)
            for _ in range(2):  # Furniture, 1 m away from the wall of the corridor.
                w, h = 0.6 + rng.random(), 0.4 + 0.5 * rng.random()
                x = left + 0.9 + max(right - left - 1.8 - w, 0.1) * rng.random()
                if upper:
                    y = high + 1.4 + (_DEPTH - high - 2.6 - h) * rng.random()
                else:
                    y = 0.9 + (low - 2.5 - h) * rng.random()
                fill(x, y, x + w, y + h, occupied=True)
    rows, columns = np.mgrid[: grid.shape[0], : grid.shape[1]]
    for _ in range(3):  # Pillars.
        x = 1 + 16 * rng.random()
        y = 1 + 2.5 * rng.random() if rng.random() < 0.5 else 9 + 2 * rng.random()
        radius = 0.15 + 0.1 * rng.random()
        away = np.hypot((columns + 0.5) * CELL - EDGE - x, (rows + 0.5) * CELL - EDGE - y)
        grid |= away < radius
    return grid


def _cells(length: float) -> int:
    """Return a length in cells."""
    return round(length / CELL)


@njit(cache=False)
def _cast(grid: Grid, x: float, y: float, angle: float, far: float) -> float:
    """Return the distance to the first occupied cell along a ray."""
    px, py = (x + EDGE) / CELL, (y + EDGE) / CELL
    column, row = math.floor(px), math.floor(py)
    dx, dy = math.cos(angle), math.sin(angle)
    right, up = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    to_column = ((column + (dx > 0)) - px) / dx if dx != 0.0 else 1e18
    to_row = ((row + (dy > 0)) - py) / dy if dy != 0.0 else 1e18
    way = 0.0
    while way * CELL < far:
        outside = row < 0 or column < 0 or row >= grid.shape[0] or column >= grid.shape[1]
        if outside or grid[row, column]:
            return way * CELL
        if to_column < to_row:
            way = to_column
            to_column += abs(1.0 / dx)
            column += right
        else:
            way = to_row
            to_row += abs(1.0 / dy)
            row += up
    return far


@njit(cache=False)
def ranges(
    grid: Grid, x: float, y: float, first: float, step: float, count: int, far: float
) -> NDArray[np.float64]:
    """Return the ranges of a scan from a place [m]."""
    found = np.empty(count)
    for ray in range(count):
        found[ray] = _cast(grid, x, y, first + ray * step, far)
    return found


@njit(cache=False)
def clearance(grid: Grid, x: float, y: float, reach: float) -> float:
    """Return the distance to the nearest occupied cell, or ``reach`` [m]."""
    around = int(reach / CELL) + 2
    column, row = int((x + EDGE) / CELL), int((y + EDGE) / CELL)
    best = reach
    for j in range(max(0, row - around), min(grid.shape[0], row + around + 1)):
        for i in range(max(0, column - around), min(grid.shape[1], column + around + 1)):
            if grid[j, i]:
                dx = max(i * CELL - EDGE - x, x + EDGE - (i + 1) * CELL, 0.0)
                dy = max(j * CELL - EDGE - y, y + EDGE - (j + 1) * CELL, 0.0)
                best = min(best, math.hypot(dx, dy))
    return best


class Planner:
    """A* on the cells that a robot's center may be in; cells near walls cost more."""

    def __init__(self, grid: Grid, radius: float) -> None:
        self.clear = distance_transform_edt(~grid) * CELL - CELL / 2
        self.free = self.clear > radius + 0.02
        near = np.where(self.clear < radius + 0.4, np.exp(-3 * (self.clear - radius)), 0)
        self.cost = 1 + 5 * near

    def path(self, start: Point, goal: Point) -> NDArray[np.float64] | None:
        """Return the places of a shortest path; None if there is none."""
        first, last = cell_of(start), cell_of(goal)
        best, came = {first: 0.0}, {first: first}
        heap, done = [(math.dist(first, last), first)], set()
        while heap:
            _, cell = heapq.heappop(heap)
            if cell == last:
                break
            if cell in done:
                continue
            done.add(cell)
            for down in (-1, 0, 1):
                for aside in (-1, 0, 1):
                    beside = cell[0] + down, cell[1] + aside
                    if beside != cell and self.free[beside]:
                        cost = best[cell] + math.hypot(down, aside) * self.cost[beside]
                        if cost < best.get(beside, math.inf):
                            best[beside], came[beside] = cost, cell
                            heapq.heappush(heap, (cost + math.dist(beside, last), beside))
        if last not in came:
            return None
        way = [last]
        while way[-1] != first:
            way.append(came[way[-1]])
        return np.array([place_of(cell) for cell in way[::-1]])


def cell_of(place: Point) -> tuple[int, int]:
    """Return row and column of a place."""
    return int((place[1] + EDGE) / CELL), int((place[0] + EDGE) / CELL)


def place_of(cell: tuple[int, int]) -> Point:
    """Return the middle of a cell."""
    return (cell[1] + 0.5) * CELL - EDGE, (cell[0] + 0.5) * CELL - EDGE


@dataclass(frozen=True)
class Task:
    """A start, a goal, and the length of the shortest path between them."""

    start: Point
    heading: float
    goal: Point
    length: float
    narrow: bool
    """True if the path leads through a narrow door."""


def sample_tasks(grid: Grid, radius: float, count: int, *, seed: int, narrow: float) -> list[Task]:
    """Sample tasks, every second of which leads through a narrow door, the first one included."""
    planner, rng = Planner(grid, radius), np.random.default_rng(seed + 1000)
    cells = np.argwhere(planner.clear > radius + 0.12)
    tasks: list[Task] = []
    for _ in range(_TRIES):
        if len(tasks) == count:
            break
        start, goal = (place_of(cell) for cell in cells[rng.integers(len(cells), size=2)])
        if math.dist(start, goal) < _APART or (path := planner.path(start, goal)) is None:
            continue
        least = min(planner.clear[cell_of(place)] for place in path)
        tight = bool(least < narrow / 2 + CELL / 2)
        if tight != (len(tasks) % 2 == 0):
            continue
        length = float(np.hypot(*np.diff(path, axis=0).T).sum())
        tasks.append(Task(start, rng.uniform(-3.1, 3.1), goal, length, tight))
    return tasks
