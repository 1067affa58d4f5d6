"""Tasks sampled over the cells of a grid, in milliseconds in any world."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects, label

from mpfa_envs.checks import check_positive, check_share
from mpfa_envs.paths.distance import DistanceField, FreeGrid
from mpfa_envs.worlds.world import START_SLACK, Box, Task, World

LONGEST_PATH: Final = 20.0
"""Longest path of a sampled task in a wide world [m]: longer ones take longer than an episode."""
_ROOMY: Final = 0.1
"""Least share of free cells with the usual clearance at which starts and goals keep it."""
_GOALS: Final = 30
"""Number of goals tried before a world counts as without a task."""
_GOALS_IN_WINDOWS: Final = 100
"""The same in a wide world, where each is tried in a window."""
_DETOURS: Final = 5
"""Number of goals tried for a detour before a straight path is taken."""


def sample_task_on_grid(
    place: FreeGrid | World,
    rng: np.random.Generator,
    *,
    distance: float | None = None,
    min_goal_distance: float = 2.0,
    max_goal_distance: float = math.inf,
    detour_chance: float = 0.0,
) -> tuple[Task, DistanceField]:
    """Sample a goal, and a start from which there is a path to it, over the cells of a grid.

    It takes milliseconds however many obstacles there are and however rare tasks are, where
    :func:`~mpfa_envs.tasks.sampling.sample_task` tries points one by one.

    In a wide world (:func:`is_wide`) no path is longer than 20 m, and the field is that of a window
    around the goal. Start and goal keep 0.15 m more than the path, or the same as the path where
    fewer than a tenth of the free cells have that.

    Args:
        place: A grid, or a world, of which one is made.
        rng: Source of randomness.
        distance: Least clearance of the path [m]; for a world only.
        min_goal_distance: Least distance between start and goal [m].
        max_goal_distance: Longest path between them [m].
        detour_chance: Chance that the task must be a detour, if the world has any: its path is more
            than 1.08 times the straight line and 0.3 m.

    Returns:
        The task, its heading uniform; and the field of its goal.

    Raises:
        ValueError: If an argument is out of its range, or the world has no such task.

    Examples:
        >>> import numpy as np
        >>> from mpfa_envs import WORLDS
        >>> from mpfa_envs.paths.tasks import sample_task_on_grid
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
    world, wide, clearance = grid.world, is_wide(grid.world), _clearance(grid)
    may_start, goals = _places(grid, clearance)
    longest = min(max_goal_distance, LONGEST_PATH) if wide else max_goal_distance
    slack = grid.resolution  # Start and goal leave the middle of their cells: by this much.
    detour = detour_chance > 0.0 and rng.random() < detour_chance
    straight: tuple[Task, DistanceField] | None = None
    attempts = _GOALS_IN_WINDOWS if wide else _GOALS
    for attempt in range(attempts if len(goals) and may_start.any() else 0):
        if straight is not None and attempt >= _DETOURS:
            break
        i, j = np.unravel_index(goals[rng.integers(len(goals))], grid.free.shape)
        goal = _within_cell(grid, rng, int(i), int(j), clearance)
        far = np.hypot(grid.xs[:, None] - goal[0], grid.ys - goal[1]) >= min_goal_distance + slack
        if not (may_start & far).any():  # The paths to this goal, which take time, are not needed.
            continue
        field = DistanceField(grid, goal, LONGEST_PATH if wide else math.inf)
        xs, ys = grid.xs[field.window[0], None], grid.ys[None, field.window[1]]
        direct = np.hypot(xs - goal[0], ys - goal[1])
        fits = may_start[field.window] & far[field.window]
        fits &= np.isfinite(field.lengths) & (field.lengths <= longest - slack)
        around = fits & (field.lengths > 1.08 * direct + 0.3)
        wanted = detour and bool(around.any())
        starts = np.flatnonzero(around if wanted else fits)
        if not len(starts) or (detour and not wanted and straight is not None):
            continue
        column, row = np.unravel_index(starts[rng.integers(len(starts))], fits.shape)
        cell = int(column) + field.first[0], int(row) + field.first[1]
        start = _within_cell(grid, rng, *cell, clearance)
        task = Task((*start, float(rng.uniform(-math.pi, math.pi))), goal)
        if wanted or not detour:
            return task, field
        straight = task, field
    if straight is not None:  # Nothing in this world is in a robot's path.
        return straight
    raise ValueError(
        f"world {world.name!r} has no start and goal at least min_goal_distance = "
        f"{min_goal_distance} m apart with a path of at most {longest} m between them, in {grid}"
    )


def is_wide(world: World) -> bool:
    """Return True if sampled paths are limited: in maps, and in worlds with a side over 20 m."""
    return world.occupancy is not None or max(world.size) > LONGEST_PATH


def has_task(grid: FreeGrid) -> bool:
    """Return True if there is a start and a goal 2 m apart with a path between them."""
    # That is a connected part of the free cells that is wide enough in x or in y.
    parts, _ = label(grid.free)
    parts = np.where(grid.clearance >= np.float32(_clearance(grid)), parts, 0)
    steps = 2.0 / grid.resolution + 1.0
    return any(
        place is not None and max(span.stop - span.start - 1 for span in place) > steps
        for place in find_objects(parts)
    )


def _as_grid(place: FreeGrid | World, distance: float | None) -> FreeGrid:
    """The grid itself, or one over the world."""
    if isinstance(place, FreeGrid):
        if distance is not None:
            raise ValueError(f"distance must be None for a grid, which has one, got {distance}")
        return place
    if distance is None:
        raise ValueError("distance must be given for a world, got None")
    return FreeGrid(place, distance=distance)


def _clearance(grid: FreeGrid) -> float:
    """The clearance that starts and goals keep [m]."""
    usual = grid.distance + START_SLACK
    roomy = np.count_nonzero(grid.clearance >= np.float32(usual))
    return usual if roomy >= _ROOMY * np.count_nonzero(grid.free) else grid.distance


@lru_cache(maxsize=8)
def _places(grid: FreeGrid, clearance: float) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Cells where episodes may start, ``[nx, ny]``, and numbers of those where goals may lie."""
    roomy = grid.free & (grid.clearance >= np.float32(clearance))
    starts, goals = (
        roomy & _inside(grid, regions)
        for regions in (grid.world.start_regions, grid.world.goal_regions)
    )
    return starts, np.flatnonzero(goals)


def _inside(grid: FreeGrid, regions: tuple[Box, ...]) -> NDArray[np.bool_]:
    """Return the mask of cells in one of the regions, ``[nx, ny]``; all of them without any."""
    inside = np.full(grid.free.shape, not regions)
    for region in regions:
        columns = (region.x_min <= grid.xs) & (grid.xs <= region.x_max)
        rows = (region.y_min <= grid.ys) & (grid.ys <= region.y_max)
        inside |= columns[:, None] & rows
    return inside


def _within_cell(
    grid: FreeGrid, rng: np.random.Generator, i: int, j: int, clearance: float
) -> tuple[float, float]:
    """A point of a cell that keeps the clearance, its center (x, y) if no other is found [m]."""
    x, y = grid.center(i, j)
    for across, up in (grid.resolution * (rng.random((4, 2)) - 0.5)).tolist():
        if grid.world.clearance(x + across, y + up) >= clearance:
            return x + across, y + up
    return x, y
