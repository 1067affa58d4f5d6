"""Shortest paths on the grid of a known world, by graph searches of two libraries."""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np
from scipy.sparse.csgraph import dijkstra

from mpfa_envs.paths.distance import FreeGrid
from mpfa_envs.paths.grid_loops import STEP_SCALE
from mpfa_envs.worlds.shapes import Point

if TYPE_CHECKING:
    import networkx

_START: Final = -1
_GOAL: Final = -2
"""Nodes of NetworkX's graph besides the cells."""


class Search(Protocol):
    """Finds a path between two positions over the free cells of a grid."""

    def __call__(self, grid: FreeGrid, start: Point, goal: Point) -> list[Point] | None:
        """Positions from start to goal (x, y), with centers of cells between [m]; None if none."""


def dijkstra_path(grid: FreeGrid, start: Point, goal: Point) -> list[Point] | None:
    """Find a shortest path with SciPy's Dijkstra, as a :class:`Search`.

    Examples:
        >>> from mpfa_envs import WORLDS
        >>> from mpfa_envs.paths.distance import FreeGrid
        >>> from mpfa_envs.planners import dijkstra_path, path_length
        >>> grid = FreeGrid(WORLDS["B"], distance=0.25)
        >>> path = dijkstra_path(grid, (0.0, 0.0), (4.0, 0.0))
        >>> round(path_length(grid, path), 6) == round(grid.length((0.0, 0.0), (4.0, 0.0)), 6)
        True
    """
    if not grid.free.any():
        return None
    graph = grid.graph_to(goal)
    last = graph.shape[0] - 1
    # From the goal, as every move can be reversed; the predecessor of a cell is next on its path.
    lengths, following = dijkstra(graph, indices=[last], return_predecessors=True)
    length, cell = min((lengths[0, cell] + gap, cell) for cell, gap in grid.cells_around(start))
    if math.isinf(length):
        return None
    cells = []
    while cell != last:
        cells.append(cell)
        cell = int(following[0, cell])
    return [start, *centers(grid, cells), goal]


def astar_path(grid: FreeGrid, start: Point, goal: Point) -> list[Point] | None:
    """Find a shortest path with NetworkX's A*, as a :class:`Search`.

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
    if not grid.free.any():
        return None
    # Imported here because it takes long, and evaluating a policy does not need it.
    from networkx import NetworkXNoPath
    from networkx import astar_path as search

    graph = _networkx_graph(grid)
    gaps = STEP_SCALE * np.hypot(
        grid.xs[grid.cells[:, 0]] - goal[0], grid.ys[grid.cells[:, 1]] - goal[1]
    )
    # The last two are those of _GOAL and _START, which are -2 and -1.
    estimates = [*gaps.tolist(), 0.0, STEP_SCALE * math.dist(start, goal)]
    try:
        for node, place in ((_START, start), (_GOAL, goal)):
            edges = ((node, cell, gap) for cell, gap in grid.cells_around(place))
            graph.add_weighted_edges_from(edges)
        cells = search(graph, _START, _GOAL, heuristic=lambda cell, _: estimates[cell])[1:-1]
    except NetworkXNoPath:
        return None
    finally:
        graph.remove_nodes_from((_START, _GOAL))
    return [start, *centers(grid, cells), goal]


@lru_cache(maxsize=2)
def _networkx_graph(grid: FreeGrid) -> networkx.Graph:
    """The free cells and the moves between them; some tens of megabytes."""
    from networkx import Graph

    starts, neighbors, lengths = grid.moves
    cells = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    once = cells < neighbors
    graph = Graph()
    graph.add_nodes_from(range(len(starts) - 1))
    edges = (cells[once].tolist(), neighbors[once].tolist(), lengths[once].tolist())
    graph.add_weighted_edges_from(zip(*edges, strict=True))
    return graph


def centers(grid: FreeGrid, cells: list[int]) -> list[Point]:
    """Positions (x, y) of some free cells' centers [m]."""
    places = grid.cells[cells]
    return list(zip(grid.xs[places[:, 0]].tolist(), grid.ys[places[:, 1]].tolist(), strict=True))


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
