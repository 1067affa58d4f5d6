"""Shortest paths on the grid of a known world, by two searches."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.paths.distance import FreeGrid
from mpfa_envs.paths.field_loops import astar_tree
from mpfa_envs.paths.grid_loops import MOVES, STEP_SCALE
from mpfa_envs.worlds.shapes import Point

_ORDERED: Final = np.array(sorted(MOVES.tolist(), key=lambda move: min((*move[:2],), (0, 1))))
"""Moves of A*: to cells of lower numbers first; of paths that are equally short one is found."""


class Search(Protocol):
    """Finds a path between two positions over the free cells of a grid."""

    def __call__(self, grid: FreeGrid, start: Point, goal: Point) -> list[Point] | None:
        """Positions from start to goal (x, y), with centers of cells between [m]; None if none."""


def dijkstra_path(grid: FreeGrid, start: Point, goal: Point) -> list[Point] | None:
    """Find a shortest path with Dijkstra's algorithm, as a :class:`Search`.

    Examples:
        >>> from mpfa_envs import WORLDS
        >>> from mpfa_envs.paths.distance import FreeGrid
        >>> from mpfa_envs.planners import dijkstra_path, path_length
        >>> grid = FreeGrid(WORLDS["B"], distance=0.25)
        >>> path = dijkstra_path(grid, (0.0, 0.0), (4.0, 0.0))
        >>> round(path_length(grid, path), 6) == round(grid.length((0.0, 0.0), (4.0, 0.0)), 6)
        True
    """
    # A* that knows nothing of where the goal is.
    return _search(grid, start, goal, np.zeros(grid.free.shape))


def astar_path(grid: FreeGrid, start: Point, goal: Point) -> list[Point] | None:
    """Find a shortest path with A*, as a :class:`Search`.

    The rest of a path is estimated by the straight line, measured as short as moves are: it is
    never overestimated, so that the path is a shortest one.

    Examples:
        >>> from mpfa_envs import WORLDS
        >>> from mpfa_envs.paths.distance import FreeGrid
        >>> from mpfa_envs.planners import astar_path, path_length
        >>> grid = FreeGrid(WORLDS["B"], distance=0.25)
        >>> path = astar_path(grid, (0.0, 0.0), (4.0, 0.0))
        >>> round(path_length(grid, path), 6) == round(grid.length((0.0, 0.0), (4.0, 0.0)), 6)
        True
    """
    straight = np.hypot(grid.xs[:, None] - goal[0], grid.ys - goal[1])
    return _search(grid, start, goal, STEP_SCALE * straight)


def _search(
    grid: FreeGrid, start: Point, goal: Point, estimates: NDArray[np.float64]
) -> list[Point] | None:
    """Find a shortest path, with an estimate of the rest of it from each cell [m]."""
    if not grid.free.any():
        return None
    ends = (*grid.around(start), *grid.around(goal))
    step = grid.resolution * STEP_SCALE
    before = astar_tree(grid.free, *ends, estimates, _ORDERED, step)
    places, cell = [goal], before[-1]
    while cell >= 0:
        places.append(grid.center(*divmod(int(cell), len(grid.ys))))
        cell = before[cell]
    return [start, *places[::-1]] if len(places) > 1 else None


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
