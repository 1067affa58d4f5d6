"""Length of the shortest path of one task, which SPL compares a robot's path with."""

from __future__ import annotations

import csv
import math
from functools import cache, lru_cache
from pathlib import Path
from typing import Final

from mpfa_envs.paths.distance import MANY_CELLS, RESOLUTION, FreeGrid
from mpfa_envs.worlds.builtin import WORLDS
from mpfa_envs.worlds.shapes import Point
from mpfa_envs.worlds.world import World

_FIXED: Final = Path(__file__).parents[1] / "assets" / "tasks" / "lengths.csv"
"""Lengths of 200 pairs of the worlds ``test`` (seed 0) and ``validation`` (seed 1) for a disc of
0.18 m, found among the lines of sight between corners. The SPL of published rows was computed with
them."""
_FIXED_RADIUS: Final = 0.18
_TOUCH: Final = 1e-9
"""A line that grazes a grown obstacle by less than this does not cross it [m]."""
NARROW: Final = 0.2
"""Cells are this much shorter where no path is found, as a passage may be narrow."""


# A reset measures a task twice, and an evaluation measures it before its first episode.
@lru_cache(maxsize=512)
def shortest_length(
    world: World, radius: float, start: Point, goal: Point, share: float = 1.0
) -> float:
    """Measure the shortest path of a disc [m]; infinite if there is none.

    A free straight line is measured exactly, and a path around obstacles over cells of 0.1 m, or of
    0.02 m where those have no path; in a room of more than 40,000 m² cells are longer. The share
    makes the cells of 0.1 m shorter.
    """
    fixed = _fixed_lengths(world.name) if radius == _FIXED_RADIUS else {}
    if fixed and world == WORLDS[world.name] and (start, goal) in fixed:
        return fixed[start, goal]
    if not _fits(world, radius, start, goal):
        return math.inf
    straight = math.dist(start, goal)
    if world.clearance_along(start, goal) >= radius - _TOUCH:
        return straight
    length = grid_for(world, radius, share).length(start, goal)
    if length == math.inf:
        length = grid_for(world, radius, NARROW).length(start, goal)
    # Moves are measured a little short, so that a path may seem shorter than the straight line.
    return max(length, straight)


def is_reachable(world: World, distance: float, start: Point, goal: Point) -> bool:
    """Return True if a path that keeps a distance [m] joins two positions."""
    return _fits(world, distance, start, goal) and (
        grid_for(world, distance).joins(start, goal)
        or grid_for(world, distance, NARROW).joins(start, goal)
    )


def _fits(world: World, radius: float, *points: Point) -> bool:
    """Return True if a disc keeps off obstacles and walls at all of these positions."""
    return all(world.clearance(*point) >= radius - _TOUCH for point in points)


@lru_cache(maxsize=16)
def grid_for(world: World, distance: float, share: float = 1.0) -> FreeGrid:
    """Share a grid, whose cells have a share of the usual side, among the users of a world."""
    side = max(share * RESOLUTION, math.sqrt(math.prod(world.size) / MANY_CELLS))
    return FreeGrid(world, distance=distance, resolution=min(side, distance))


@cache
def _fixed_lengths(name: str) -> dict[tuple[Point, Point], float]:
    """Read the lengths of a world's pairs [m]; there are none for most worlds."""
    with _FIXED.open(encoding="utf-8", newline="") as file:
        rows = [list(map(float, row[1:])) for row in csv.reader(file) if row[0] == name]
    return {((x, y), (to_x, to_y)): length for x, y, to_x, to_y, length in rows}
