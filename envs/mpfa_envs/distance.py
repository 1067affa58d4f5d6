"""The shortest way from everywhere in a world to a goal, on a grid.

Where :mod:`~mpfa_envs.path` answers one question exactly, a field answers it for all cells at once,
and in milliseconds however many obstacles there are: the moves between free cells and their 16
neighbors make a graph, and SciPy's Dijkstra starts from the goal. Moves have 16 directions, hence
a way in the open is up to 1.4 % too long or too short. Around corners and in narrow passages the
size of the cells adds to it: ``docs/worlds.md`` has what was measured.

Centers of free cells keep the distance d. Between two that are a step L apart a way keeps
√(d² - L²/4) at least: whatever is nearest to its middle is d away from both ends.
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.ndimage import find_objects, label
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from mpfa_envs.checks import check_number, check_positive, check_share
from mpfa_envs.kernels.cells import lower_clearances
from mpfa_envs.kernels.grid import (
    MOVES,
    STEP_SCALE,
    clearance_grid,
    fill_from_nearest,
    interpolate,
    neighbor_lists,
    number_cells,
    shortest_way,
)
from mpfa_envs.local_field import (
    LocalField,
    length_in_map,
    sample_task_in_map,
    usual_clearance,
    within_cell,
)
from mpfa_envs.tasks import Task

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.worlds import Box, World

__all__ = ["DistanceField", "FreeGrid", "sample_task_on_grid", "shortest_way"]

RESOLUTION: Final = 0.1
"""Side of a cell unless another is asked for [m]."""
_MOST_CELLS: Final = 4_000_000
_GOALS: Final = 30
"""Goals that are tried before a world is said to have no task."""
_DETOURS: Final = 5
"""Goals that are tried for a detour before a straight way will do."""


class FreeGrid:
    """Square cells over a room, and which of them a disc's center may be in.

    Args:
        world: The room and its obstacles.
        distance: What a free cell's center keeps from every obstacle and wall [m].
        resolution: Side of a cell [m], no longer than the distance, so that no move steps over a
            wall. None: 0.1 m, or the distance if that is less.

    Raises:
        ValueError: If a number is out of its range, or there would be more than four million cells.

    Examples:
        >>> from mpfa_envs import WORLDS, FreeGrid
        >>> grid = FreeGrid(WORLDS["B"], distance=0.25)
        >>> grid.clearance.shape, grid.origin
        ((100, 100), (-4.95, -4.95))
        >>> grid.index(0.0, 3.75), bool(grid.free[50, 87])  # In a box.
        ((50, 87), False)
    """

    def __init__(self, world: World, *, distance: float, resolution: float | None = None) -> None:
        self.world = world
        self.distance = check_positive("distance", distance)
        if resolution is None:
            resolution = min(RESOLUTION, self.distance)
        self.resolution = check_positive("resolution", resolution)
        if self.resolution > self.distance:
            raise ValueError(
                f"resolution must be at most the distance, {distance} m, got {resolution}"
            )
        # The grid is as wide as the room or a little wider; what is behind a wall is not free.
        sides = [max(1, math.ceil(round(side / resolution, 6))) for side in world.size]
        if math.prod(sides) > _MOST_CELLS:
            raise ValueError(
                f"resolution must leave at most {_MOST_CELLS} cells in a room of {world.size} m, "
                f"got {resolution}"
            )
        self.xs, self.ys = (_centers(count, self.resolution) for count in sides)
        """Centers of the columns ``[nx]`` and the rows ``[ny]`` [m]."""
        self.origin = (float(self.xs[0]), float(self.ys[0]))
        """Center of the first cell (x, y) [m]."""
        self.clearance: NDArray[np.float32] = clearance_grid(*world.arrays, self.xs, self.ys)
        """Distance of each center from the nearest obstacle or wall [m], ``[nx, ny]``."""
        if (cells := world.occupancy) is not None:
            left, right, _ = cells.arrays
            lower_clearances(left, right, cells.resolution, self.xs, self.ys, self.clearance)
        self.free: NDArray[np.bool_] = self.clearance >= np.float32(self.distance)
        """Where the center keeps the distance, ``[nx, ny]``."""

    @cached_property
    def cells(self) -> NDArray[np.int64]:
        """Column and row of each free cell, shape ``[cells, 2]``."""
        return np.argwhere(self.free)

    @cached_property
    def _numbers(self) -> NDArray[np.int32]:
        """Place of each free cell in :attr:`cells`, -1 for the others, ``[nx, ny]``."""
        return number_cells(self.free)

    @cached_property
    def moves(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float64]]:
        """The moves between free cells, in compressed rows.

        Where the moves of each of :attr:`cells` begin, ``[cells + 1]``; the numbers of the cells
        that they lead to, and their lengths [m], ``[moves]``.
        """
        return neighbor_lists(self.free, self._numbers, MOVES, self.resolution * STEP_SCALE)

    def index(self, x: float, y: float) -> tuple[int, int]:
        """Find the cell of a position, the nearest one for a position outside.

        Args:
            x: Position [m].
            y: Position [m].

        Returns:
            Column and row.
        """
        places = zip((x, y), self.origin, self.free.shape, strict=True)
        i, j = (
            min(max(round((at - first) / self.resolution), 0), count - 1)
            for at, first, count in places
        )
        return i, j

    def center(self, i: int, j: int) -> tuple[float, float]:
        """Position (x, y) of a cell's center [m]."""
        return float(self.xs[i]), float(self.ys[j])

    def cells_around(self, place: tuple[float, float]) -> list[tuple[int, float]]:
        """Find where ways to or from a position pass.

        Args:
            place: Position (x, y) [m].

        Returns:
            Numbers of the cells around it, or of the nearest one if its own is not free, and how
            far they are from it [m].

        Raises:
            ValueError: If no cell is free.
        """
        if not self.free.any():
            raise ValueError(f"grid must have a free cell, and {self.world.name!r} has none")
        i, j = self.index(*place)
        if not self.free[i, j]:
            gaps = np.hypot(
                self.xs[self.cells[:, 0]] - place[0], self.ys[self.cells[:, 1]] - place[1]
            )
            nearest = int(gaps.argmin())
            return [(nearest, float(gaps[nearest]))]
        starts, neighbors, _ = self.moves
        number = self._numbers[i, j]
        around = [number, *neighbors[starts[number] : starts[number + 1]]]
        return [(int(at), math.dist(self.center(*self.cells[at]), place)) for at in around]

    def length(self, start: tuple[float, float], goal: tuple[float, float]) -> float:
        """Measure the way between two positions.

        Args:
            start: Position (x, y) [m].
            goal: Position (x, y) [m].

        Returns:
            Length [m]; infinite if there is no way.
        """
        if not self.free.any():
            return math.inf
        if self.world.occupancy is not None:
            return length_in_map(self, start, goal)
        ways = self.distances(goal)
        return min(float(ways[cell]) + gap for cell, gap in self.cells_around(start))

    def distances(self, goal: tuple[float, float]) -> NDArray[np.float64]:
        """Measure the way from every free cell to a goal.

        Args:
            goal: Position (x, y) [m]. If its cell is not free, the nearest free one counts.

        Returns:
            Lengths [m], infinite where there is no way, one for each of :attr:`cells`.

        Raises:
            ValueError: If no cell is free.
        """
        graph = self.graph_to(goal)
        count = graph.shape[0] - 1
        return np.asarray(dijkstra(graph, indices=[count]))[0, :count]

    def graph_to(self, goal: tuple[float, float]) -> csr_array:
        """Write the moves, and those from a goal to the cells around it, as a sparse matrix.

        Args:
            goal: Position (x, y) [m].

        Returns:
            Lengths [m], ``[cells + 1, cells + 1]``; the last row is the goal's.

        Raises:
            ValueError: If no cell is free.
        """
        first = self.cells_around(goal)
        starts, neighbors, lengths = self.moves
        count = len(starts) - 1
        # The goal is a node of its own, the last one, from which the cells around it are reached.
        numbers, gaps = zip(*first, strict=True)
        return csr_array(
            (
                # A gap of zero would be no edge.
                np.concatenate((lengths, np.maximum(gaps, 1e-12))),
                np.concatenate((neighbors, np.array(numbers, dtype=np.int32))),
                np.append(starts, np.int32(len(neighbors) + len(first))),
            ),
            shape=(count + 1, count + 1),
        )


def _centers(count: int, resolution: float) -> NDArray[np.float64]:
    """Middles of cells side by side around zero [m]."""
    return resolution * (np.arange(count, dtype=np.float64) - (count - 1) / 2)


class DistanceField:
    """The shortest way from every cell of a grid to one goal.

    Args:
        grid: The grid.
        goal: Position (x, y) [m]. If its cell is not free, the way ends at the nearest free one.

    Raises:
        ValueError: If the goal is not two finite numbers, or no cell is free.

    Examples:
        >>> from mpfa_envs import WORLDS, DistanceField, FreeGrid
        >>> field = DistanceField(FreeGrid(WORLDS["B"], distance=0.18), (4.0, 0.0))
        >>> round(field.at(3.9, 0.0), 1), round(field.at(0.0, 0.0), 1)  # [m]; a box is between
        (0.1, 6.4)
    """

    def __init__(self, grid: FreeGrid, goal: tuple[float, float]) -> None:
        self.grid = grid
        self.goal = (check_number("goal", goal[0]), check_number("goal", goal[1]))
        self.values: NDArray[np.float32] = np.full(grid.free.shape, math.inf, dtype=np.float32)
        """Length of the shortest way [m], infinite where there is none, ``[nx, ny]``."""
        self.values[grid.free] = grid.distances(self.goal)

    @property
    def origin(self) -> tuple[float, float]:
        """Center of the first cell (x, y) [m]."""
        return self.grid.origin

    @property
    def resolution(self) -> float:
        """Side of a cell [m]."""
        return self.grid.resolution

    @cached_property
    def filled(self) -> NDArray[np.float32]:
        """As :attr:`values`; cells without a way have what the nearest cell with one has."""
        return fill_from_nearest(self.values)

    def at(self, x: float, y: float) -> float:
        """Read the length of the way from a position.

        Args:
            x: Position [m].
            y: Position [m].

        Returns:
            Length [m], interpolated between the centers of the cells.
        """
        return interpolate(self.filled, *self.grid.origin, self.grid.resolution, x, y)


def sample_task_on_grid(
    place: FreeGrid | World,
    rng: np.random.Generator,
    *,
    distance: float | None = None,
    min_goal_distance: float = 2.0,
    max_goal_distance: float = math.inf,
    detour_chance: float = 0.0,
    start_clearance: float | None = None,
    goal_clearance: float | None = None,
) -> tuple[Task, DistanceField | LocalField]:
    """Sample a goal, and a start from which there is a way to it, over the cells of a grid.

    It takes milliseconds however many obstacles there are and however rare tasks are, where
    :func:`~mpfa_envs.sample_task` tries points one by one.

    In the world of a map no way is longer than 20 m, start and goal have the usual clearance, and
    the field is that of a window around the goal.

    Args:
        place: A grid, or a world, of which one is made.
        rng: Source of randomness.
        distance: What the way keeps from obstacles [m]; for a world only.
        min_goal_distance: Least distance between start and goal [m].
        max_goal_distance: Longest way between them [m].
        detour_chance: Chance that the task must be a detour, if the world has any: its way is more
            than 1.08 times the straight line and 0.3 m.
        start_clearance: What the start keeps from obstacles [m]. None: 0.15 m more than the way,
            or no more than it where fewer than a tenth of the free cells have that.
        goal_clearance: The same of the goal.

    Returns:
        The task, its heading uniform; and the field of its goal.

    Raises:
        ValueError: If an argument is out of its range, or the world has no such task.

    Examples:
        >>> import numpy as np
        >>> from mpfa_envs import WORLDS, sample_task_on_grid
        >>> rng = np.random.default_rng(0)
        >>> task, field = sample_task_on_grid(WORLDS["D"], rng, distance=0.25)
        >>> WORLDS["D"].clearance(*task.goal) >= 0.4, field.at(*task.start[:2]) < 20.0
        (True, True)
    """
    check_positive("min_goal_distance", min_goal_distance)
    if not max_goal_distance > min_goal_distance:
        raise ValueError(
            f"max_goal_distance must be above min_goal_distance = {min_goal_distance}, got "
            f"{max_goal_distance}"
        )
    check_share("detour_chance", detour_chance)
    grid = _as_grid(place, distance)
    world = grid.world
    if world.occupancy is not None:
        return sample_task_in_map(
            grid,
            rng,
            min_goal_distance=min_goal_distance,
            max_goal_distance=max_goal_distance,
            detour_chance=detour_chance,
        )
    goal_room = _clearance(grid, goal_clearance)
    start_room = _clearance(grid, start_clearance)
    columns, rows = grid.cells.T
    x, y = grid.xs[columns], grid.ys[rows]
    room = grid.clearance[columns, rows]
    may_start = (room >= np.float32(start_room)) & _in_regions(world.start_regions, x, y)
    goals = np.flatnonzero((room >= np.float32(goal_room)) & _in_regions(world.goal_regions, x, y))
    detour = detour_chance > 0.0 and rng.random() < detour_chance
    straight: tuple[Task, DistanceField] | None = None
    for attempt in range(_GOALS if len(goals) and may_start.any() else 0):
        if straight is not None and attempt >= _DETOURS:
            break
        goal_cell = goals[rng.integers(len(goals))]
        goal = within_cell(grid, rng, x[goal_cell], y[goal_cell], goal_room)
        direct = np.hypot(x - goal[0], y - goal[1])
        # Start and goal leave the middle of their cells: by this much they may come nearer.
        fits = may_start & (direct >= min_goal_distance + grid.resolution)
        if not fits.any():  # The ways to this goal, which take the time, need not be known.
            continue
        field = DistanceField(grid, goal)
        way = field.values[columns, rows]
        fits &= np.isfinite(way) & (way <= max_goal_distance - grid.resolution)
        around = fits & (way > 1.08 * direct + 0.3)
        wanted = detour and bool(around.any())
        starts = np.flatnonzero(around if wanted else fits)
        if not len(starts) or (detour and not wanted and straight is not None):
            continue
        cell = starts[rng.integers(len(starts))]
        start = within_cell(grid, rng, x[cell], y[cell], start_room)
        task = Task((*start, float(rng.uniform(-math.pi, math.pi))), goal)
        if wanted or not detour:
            return task, field
        straight = task, field
    if straight is not None:  # Nothing in this world stands in anyone's way.
        return straight
    raise ValueError(
        f"world {world.name!r} has no start and goal at least min_goal_distance = "
        f"{min_goal_distance} m apart with a path of at most {max_goal_distance} m between them "
        f"that keeps {grid.distance} m"
    )


def has_task(grid: FreeGrid, *, min_goal_distance: float = 2.0) -> bool:
    """Tell whether there is a start and a goal with a path between them.

    It looks for a part of the free cells that hangs together and is wide enough in x or in y.

    Args:
        grid: The grid.
        min_goal_distance: Least distance between start and goal [m].

    Returns:
        Whether :func:`sample_task_on_grid` finds one.
    """
    parts, _ = label(grid.free)
    parts = np.where(grid.clearance >= np.float32(_clearance(grid, None)), parts, 0)
    steps = min_goal_distance / grid.resolution + 1.0
    return any(
        place is not None and max(span.stop - span.start - 1 for span in place) > steps
        for place in find_objects(parts)
    )


def _as_grid(place: FreeGrid | World, distance: float | None) -> FreeGrid:
    """The grid that is meant."""
    if isinstance(place, FreeGrid):
        if distance is not None:
            raise ValueError(f"distance must be None for a grid, which has one, got {distance}")
        return place
    if distance is None:
        raise ValueError("distance must be given for a world, got None")
    return FreeGrid(place, distance=distance)


def _clearance(grid: FreeGrid, wanted: float | None) -> float:
    """The clearance that starts or goals keep [m]."""
    if wanted is not None:
        return max(check_positive("clearance", wanted), grid.distance)
    return usual_clearance(grid)


def _in_regions(
    regions: tuple[Box, ...], x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Tell which points lie in one of the regions; all do if there are none."""
    inside = np.full(len(x), not regions)
    for region in regions:
        x_min, y_min, x_max, y_max = region.bounds
        inside |= (x_min <= x) & (x <= x_max) & (y_min <= y) & (y <= y_max)
    return inside
