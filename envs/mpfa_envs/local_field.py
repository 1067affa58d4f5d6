"""Ways and tasks in the world of a map, where a field over the whole room would be too large.

A map has a million cells and more, and a robot drives 25 m in the time limit of an episode. What
is measured is a window around the goal, in some ten milliseconds.
"""

from __future__ import annotations

import math
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

from mpfa_envs.kernels.grid import MOVES, STEP_SCALE, fill_from_nearest, interpolate
from mpfa_envs.kernels.ways import ways_from
from mpfa_envs.tasks import START_SLACK, Task

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.distance import FreeGrid
    from mpfa_envs.worlds import Box

LONGEST_WAY: Final = 20.0
"""No sampled task in a map has a longer way [m]."""
_MARGIN: Final = 3
"""Cells by which the window is wider than the longest way."""
_ROOMY: Final = 0.1
"""Share of the free cells with the usual clearance that a world must have to be asked for it."""
_GOALS: Final = 100
"""Goals that are tried before a world is said to have no task."""
_DETOURS: Final = 5
"""Goals that are tried for a detour before a straight way will do."""


class LocalField:
    """The shortest way to one goal from the cells of a grid around it.

    Args:
        grid: The grid.
        goal: Position (x, y) [m]. If its cell is not free, the way ends at the nearest free one of
            the window.
        longest: Longest way that is measured [m].

    Examples:
        >>> from mpfa_envs import WORLDS, FreeGrid
        >>> from mpfa_envs.local_field import LocalField
        >>> field = LocalField(FreeGrid(WORLDS["B"], distance=0.18), (4.0, 0.0), longest=3.0)
        >>> round(field.at(3.9, 0.0), 1), field.filled.shape  # [m]
        (0.1, (45, 69))
    """

    def __init__(
        self, grid: FreeGrid, goal: tuple[float, float], longest: float = LONGEST_WAY
    ) -> None:
        self.grid = grid
        self.goal = goal
        i, j = grid.index(*goal)
        # Moves are measured a little short.
        reach = min(longest / STEP_SCALE / grid.resolution, max(grid.free.shape))
        wide = math.ceil(reach) + _MARGIN
        self.first = max(i - wide, 0), max(j - wide, 0)
        """Column and row of the grid that the window begins with."""
        self.window = tuple(
            slice(first, at + wide + 1) for first, at in zip(self.first, (i, j), strict=True)
        )
        free = grid.free[self.window]
        seeds, gaps = self._around(free, i - self.first[0], j - self.first[1])
        step = grid.resolution * STEP_SCALE
        self.ways = ways_from(free, seeds, gaps, MOVES, step, float(longest))
        """Lengths of the shortest ways [m], infinite where there is none, ``[columns, rows]``."""

    @property
    def origin(self) -> tuple[float, float]:
        """Center of the window's first cell (x, y) [m]."""
        return self.grid.center(*self.first)

    @property
    def resolution(self) -> float:
        """Side of a cell [m]."""
        return self.grid.resolution

    @cached_property
    def filled(self) -> NDArray[np.float32]:
        """The same; cells without a way have what the nearest cell with one has."""
        return fill_from_nearest(self.ways.astype(np.float32))

    def at(self, x: float, y: float) -> float:
        """Read the length of the way from a position, at the window's edge from outside of it.

        Args:
            x: Position [m].
            y: Position [m].

        Returns:
            Length [m], interpolated between the centers of the cells.
        """
        return interpolate(self.filled, *self.origin, self.resolution, x, y)

    def length_from(self, start: tuple[float, float]) -> float:
        """Measure the way from a position as :meth:`~mpfa_envs.FreeGrid.length` does.

        Args:
            start: Position (x, y) [m].

        Returns:
            Length [m]; infinite if there is no way in the window.
        """
        i, j = (at - first for at, first in zip(self.grid.index(*start), self.first, strict=True))
        columns, rows = self.ways.shape
        if not (0 <= i < columns and 0 <= j < rows):
            return math.inf
        cells, gaps = self._around(self.grid.free[self.window], i, j, start)
        return float((self.ways[cells[:, 0], cells[:, 1]] + gaps).min(initial=math.inf))

    def _around(
        self,
        free: NDArray[np.bool_],
        i: int,
        j: int,
        place: tuple[float, float] | None = None,
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Cells of the window around a place in cell (i, j), ``[cells, 2]``, and how far they are.

        They are those of :meth:`~mpfa_envs.FreeGrid.cells_around`.
        """
        x, y = self.goal if place is None else place
        if free[i, j]:
            cells = np.concatenate(([[i, j]], _neighbors(free, i, j)))
        else:
            cells = np.argwhere(free)
        gaps = np.hypot(
            self.grid.xs[cells[:, 0] + self.first[0]] - x,
            self.grid.ys[cells[:, 1] + self.first[1]] - y,
        )
        if not free[i, j] and len(cells):
            nearest = int(gaps.argmin())
            cells, gaps = cells[nearest : nearest + 1], gaps[nearest : nearest + 1]
        # A gap of zero would be no edge of a graph.
        return cells.astype(np.int64), np.maximum(gaps, 1e-12)


def _neighbors(free: NDArray[np.bool_], i: int, j: int) -> NDArray[np.int64]:
    """Cells to which a move leads from a cell, ``[cells, 2]``."""
    columns, rows = free.shape
    to = MOVES[:, :2] + (i, j)
    inside = ((to >= 0) & (to < (columns, rows))).all(axis=1)
    to, moves = to[inside], MOVES[inside]
    over, under = moves[:, 2:4] + (i, j), moves[:, 4:6] + (i, j)
    is_open = (
        free[to[:, 0], to[:, 1]] & free[over[:, 0], over[:, 1]] & free[under[:, 0], under[:, 1]]
    )
    return to[is_open]


def length_in_map(grid: FreeGrid, start: tuple[float, float], goal: tuple[float, float]) -> float:
    """Measure the way between two positions: near them first, then in the whole room.

    Args:
        grid: The grid.
        start: Position (x, y) [m].
        goal: Position (x, y) [m].

    Returns:
        Length [m]; infinite if there is no way.
    """
    direct = math.dist(start, goal)
    for near in (1.2 * direct + 1.0, 2.0 * direct + 4.0):
        found = LocalField(grid, goal, near).length_from(start)
        # A cell whose way is longer than this was not found, but might have been the best one.
        if found <= near:
            return found
    return LocalField(grid, goal, math.inf).length_from(start)


def sample_task_in_map(
    grid: FreeGrid,
    rng: np.random.Generator,
    *,
    min_goal_distance: float,
    max_goal_distance: float,
    detour_chance: float,
) -> tuple[Task, LocalField]:
    """Sample a task as :func:`~mpfa_envs.sample_task_on_grid` does, of 20 m at most.

    Args:
        grid: The grid of a map's world.
        rng: Source of randomness.
        min_goal_distance: Least distance between start and goal [m].
        max_goal_distance: Longest way between them [m]; 20 m if it is more.
        detour_chance: Chance that the way must be a detour.

    Returns:
        The task, its heading uniform; and the field of its goal.

    Raises:
        ValueError: If the world has no such task.
    """
    world = grid.world
    longest = min(max_goal_distance, LONGEST_WAY)
    starts, goals, room = _places(grid)
    detour = detour_chance > 0.0 and rng.random() < detour_chance
    straight: tuple[Task, LocalField] | None = None
    for attempt in range(_GOALS if len(goals) and starts.any() else 0):
        if straight is not None and attempt >= _DETOURS:
            break
        i, j = np.unravel_index(goals[rng.integers(len(goals))], grid.free.shape)
        goal = within_cell(grid, rng, *grid.center(int(i), int(j)), room)
        field = LocalField(grid, goal)
        direct = np.hypot(
            grid.xs[field.window[0], None] - goal[0], grid.ys[None, field.window[1]] - goal[1]
        )
        # Start and goal leave the middle of their cells: by this much they may come nearer.
        fits = starts[field.window] & (direct >= min_goal_distance + grid.resolution)
        fits &= field.ways <= longest - grid.resolution
        around = fits & (field.ways > 1.08 * direct + 0.3)
        wanted = detour and bool(around.any())
        found = np.flatnonzero(around if wanted else fits)
        if not len(found) or (detour and not wanted and straight is not None):
            continue
        column, row = np.unravel_index(found[rng.integers(len(found))], fits.shape)
        cell = int(column) + field.first[0], int(row) + field.first[1]
        start = within_cell(grid, rng, *grid.center(*cell), room)
        task = Task((*start, float(rng.uniform(-math.pi, math.pi))), goal)
        if wanted or not detour:
            return task, field
        straight = task, field
    if straight is not None:  # Nothing in this world stands in anyone's way.
        return straight
    raise ValueError(
        f"world {world.name!r} has no start and goal at least min_goal_distance = "
        f"{min_goal_distance} m apart with a path of at most {longest} m between them that keeps "
        f"{grid.distance} m"
    )


@lru_cache(maxsize=8)
def _places(grid: FreeGrid) -> tuple[NDArray[np.bool_], NDArray[np.int64], float]:
    """Where episodes may start ``[nx, ny]``, numbers of goals' cells, and their clearance [m]."""
    world, room = grid.world, usual_clearance(grid)
    roomy = grid.clearance >= np.float32(room)
    starts, goals = (
        roomy & _inside(grid, regions) for regions in (world.start_regions, world.goal_regions)
    )
    return starts, np.flatnonzero(goals), room


def _inside(grid: FreeGrid, regions: tuple[Box, ...]) -> NDArray[np.bool_]:
    """Tell which cells lie in one of the regions, ``[nx, ny]``; all do if there are none."""
    inside = np.full(grid.free.shape, not regions)
    for region in regions:
        columns = (region.x_min <= grid.xs) & (grid.xs <= region.x_max)
        rows = (region.y_min <= grid.ys) & (grid.ys <= region.y_max)
        inside |= columns[:, None] & rows
    return inside


def usual_clearance(grid: FreeGrid) -> float:
    """What starts and goals keep from obstacles [m]: more than the way, where there is room."""
    usual = grid.distance + START_SLACK
    roomy = np.count_nonzero(grid.clearance >= np.float32(usual))
    return usual if roomy >= _ROOMY * np.count_nonzero(grid.free) else grid.distance


def within_cell(
    grid: FreeGrid, rng: np.random.Generator, x: float, y: float, clearance: float
) -> tuple[float, float]:
    """A point of a cell that keeps the clearance, its center (x, y) if no other is found [m]."""
    for across, up in (grid.resolution * (rng.random((4, 2)) - 0.5)).tolist():
        if grid.world.clearance(x + across, y + up) >= clearance:
            return float(x + across), float(y + up)
    return float(x), float(y)
