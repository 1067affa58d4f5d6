"""The shortest path on the grid of a known world."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Protocol

import numpy as np

from mpfa_envs.paths.distance import DistanceField, FreeGrid
from mpfa_envs.paths.grid_loops import STEP_SCALE
from mpfa_envs.worlds.shapes import Point


class Search(Protocol):
    """Finds a path between two positions over the free cells of a grid."""

    def __call__(self, grid: FreeGrid, start: Point, goal: Point) -> list[Point] | None:
        """Positions from start to goal (x, y), with centers of cells between [m]; None if none."""


def shortest_path(grid: FreeGrid, start: Point, goal: Point) -> list[Point] | None:
    """Find the shortest path, as a :class:`Search`.

    Examples:
        >>> from mpfa_envs import WORLDS
        >>> from mpfa_envs.paths.distance import FreeGrid
        >>> from mpfa_envs.planners import path_length, shortest_path
        >>> grid = FreeGrid(WORLDS["B"], distance=0.25)
        >>> path = shortest_path(grid, (0.0, 0.0), (4.0, 0.0))
        >>> round(path_length(grid, path), 6) == round(grid.length((0.0, 0.0), (4.0, 0.0)), 6)
        True
    """
    if not grid.joins(start, goal):
        return None
    # From the goal back to the start, down the lengths of the paths from there.
    lengths = DistanceField(grid, start, until=goal).lengths
    firsts, first_gaps = grid.around(start)
    gap_of = dict(zip(map(tuple, firsts.tolist()), first_gaps.tolist(), strict=True))
    cells, gaps = grid.around(goal)
    places = [goal]
    while True:
        best = (lengths[cells[:, 0], cells[:, 1]] + gaps).argmin()
        i, j = cells[best].tolist()
        places.append(grid.center(i, j))
        if lengths[i, j] == gap_of.get((i, j)):
            return [start, *places[::-1]]
        # The longest moves come first, so that of equally short paths always the same is found.
        cells = grid.neighbors(i, j)[::-1]
        gaps = np.hypot(*(cells - (i, j)).T) * (grid.resolution * STEP_SCALE)


def path_length(grid: FreeGrid, path: list[Point]) -> float:
    """Measure a path as :meth:`~mpfa_envs.paths.distance.FreeGrid.length` does.

    Args:
        grid: The grid.
        path: Positions, as a :class:`Search` finds them [m].

    Returns:
        Length [m], with moves between cells a little shorter than their lines.
    """
    steps = [math.dist(one, other) for one, other in pairwise(path)]
    return steps[0] + STEP_SCALE * sum(steps[1:-1]) + steps[-1]
