"""Mazes: corridors between thin walls, with dead ends and a few detours."""

from __future__ import annotations

import random
from typing import Final

from mpfa_envs.generators.placing import between, cut_box
from mpfa_envs.worlds.world import Box, World

_SIDES: Final = (8.0, 14.0)
"""Shortest and longest side [m]."""

Cell = tuple[int, int]
"""Column and row."""
Wall = tuple[Cell, Cell]
"""Between two cells, the left or lower one first."""


def mazes(rng: random.Random, difficulty: float) -> World:
    """Sample a maze of 8 to 14 m a side in which every place can be reached.

    Corridors of one width wind through square cells, by a random walk that steps back where it
    is stuck. Then some more walls fall, which makes detours.

    Difficulty: Corridors are 1.5 m wide at 0, 1.15 m at 0.5 and 0.8 m at 1. Of the walls
    that are left between cells, a third falls at 0, and one in twenty at 1.
    """
    passage, thick = round(between(1.5, 0.8, difficulty), 3), round(rng.uniform(0.1, 0.3), 3)
    pitch = passage + thick
    columns, rows = (max(3, round(rng.uniform(*_SIDES) / pitch)) for _ in range(2))
    walls = _carve(rng, columns, rows)
    opened = between(0.33, 0.05, difficulty)
    # Sorted: the order of a set of tuples is the same everywhere only by chance.
    standing = [wall for wall in sorted(walls) if rng.random() >= opened]
    size = (round(columns * pitch - thick, 3), round(rows * pitch - thick, 3))
    return World(name="mazes", size=size, boxes=tuple(_build(standing, size, pitch, thick)))


def _carve(rng: random.Random, columns: int, rows: int) -> set[Wall]:
    """Walls of a maze in which exactly one path leads from any cell to any other."""
    walls = {((i, j), (i + 1, j)) for i in range(columns - 1) for j in range(rows)}
    walls |= {((i, j), (i, j + 1)) for i in range(columns) for j in range(rows - 1)}
    first = rng.randrange(columns), rng.randrange(rows)
    visited, trail = {first}, [first]
    while trail:
        i, j = trail[-1]
        onward = [
            to
            for to in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1))
            if 0 <= to[0] < columns and 0 <= to[1] < rows and to not in visited
        ]
        if not onward:
            trail.pop()
            continue
        to = rng.choice(onward)
        walls.discard(((i, j), to) if (i, j) < to else (to, (i, j)))
        visited.add(to)
        trail.append(to)
    return walls


def _build(walls: list[Wall], size: tuple[float, float], pitch: float, thick: float) -> list[Box]:
    """Boxes along the walls; those that stand in one line are one box."""
    boxes: list[Box] = []
    for axis in (0, 1):
        # Walls that a step along the axis meets, by their line, and their places on it.
        lines: dict[int, list[int]] = {}
        for one, to in walls:
            if one[axis] != to[axis]:
                lines.setdefault(to[axis], []).append(one[1 - axis])
        for line, places in sorted(lines.items()):
            middle = line * pitch - thick / 2 - size[axis] / 2
            for first, last in _runs(sorted(places)):
                # A wall's thickness over both ends, so that walls meet in a post.
                length = (last - first + 1) * pitch + thick
                place = (first * pitch - thick - size[1 - axis] / 2) + length / 2
                box = (
                    cut_box(middle, place, thick, length, size)
                    if axis == 0
                    else cut_box(place, middle, length, thick, size)
                )
                if box is not None:
                    boxes.append(box)
    return boxes


def _runs(places: list[int]) -> list[tuple[int, int]]:
    """First and last of each run of places side by side.

    Examples:
        >>> _runs([0, 1, 2, 5, 7, 8])
        [(0, 2), (5, 5), (7, 8)]
    """
    runs: list[tuple[int, int]] = []
    for place in places:
        if runs and place == runs[-1][1] + 1:
            runs[-1] = runs[-1][0], place
        else:
            runs.append((place, place))
    return runs
