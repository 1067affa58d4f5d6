"""Generators of worlds with narrow passages: fields of thin cylinders, and mazes."""

from __future__ import annotations

import random
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, label

from mpfa_envs.generators.rooms import between, cut_box
from mpfa_envs.worlds.world import Box, Cylinder, World

_OPEN: Final = 1.2
"""Depth of the strips without cylinders at both ends [m]."""
_MOST_CYLINDERS: Final = 600
_NEEDED: Final = 0.29
"""Distance that the path through a field keeps from the cylinders [m]."""
_ATTEMPTS: Final = 30


def fields(rng: random.Random, difficulty: float) -> World:
    """Sample a corridor with a field of cylinders across it and a path through the field.

    The corridor is 4 to 7 m wide. A field of 3 to 7 m depth lies between two open strips. Its cells
    are filled at random, and a few times those with few filled neighbors are emptied and those with
    many are filled: clumps and ragged walls are left, as in the BARN benchmark (Perille et al.
    2020, https://arxiv.org/abs/2008.13315). Half of the fields have BARN's cylinders, with
    a radius of 0.075 m, the others have thicker ones of up to 0.15 m.

    Difficulty: The share of the cells that is filled at first, 0.14 at 0 and 0.3 at 1; it
    is a twentieth less with each attempt that leaves no path through.
    """
    radius = 0.075 if rng.random() < 0.5 else round(rng.uniform(0.08, 0.15), 3)
    cell = 2 * radius
    columns = round(rng.uniform(4.0, 7.0) / cell)
    rows = round(rng.uniform(3.0, 7.0) / cell)
    rounds = rng.choice((2, 3, 4))
    fill = between(0.14, 0.3, difficulty)
    for _ in range(_ATTEMPTS):
        filled = _grow(rng, (columns, rows), fill, rounds)
        if filled.sum() <= _MOST_CYLINDERS and _is_passable(filled, cell):
            break
        fill *= 0.95
    else:
        filled = np.zeros((columns, rows), dtype=np.bool_)
    depth = round(rows * cell + 2 * _OPEN + rng.uniform(0.0, 3.0), 3)
    width = round(columns * cell, 3)
    if rng.random() < 0.5:
        filled, width, depth = filled.T, depth, width
    # Thinner than their cells: at a wall, sums of rounded numbers stay inside.
    thin = round(radius - 0.001, 3)
    shape = filled.shape
    cylinders = tuple(
        Cylinder(
            round((i + 0.5 - shape[0] / 2) * cell, 3),
            round((j + 0.5 - shape[1] / 2) * cell, 3),
            thin,
        )
        for i, j in np.argwhere(filled).tolist()
    )
    return World(name="fields", size=(width, depth), cylinders=cylinders)


def _grow(
    rng: random.Random, shape: tuple[int, int], fill: float, rounds: int
) -> NDArray[np.bool_]:
    """Fill cells at random and let the automaton smooth them; walls count as full."""
    count = shape[0] * shape[1]
    noise = np.frombuffer(rng.randbytes(count), dtype=np.uint8).reshape(shape)
    filled = noise < round(256 * fill)
    for _ in range(rounds):
        padded = np.zeros((shape[0] + 2, shape[1] + 2), dtype=np.int8)
        padded[1:-1, 1:-1] = filled
        padded[[0, -1], 1:-1] = 1
        threes = padded[:-2] + padded[1:-1] + padded[2:]
        # The nine cells of each square, less the one in the middle.
        neighbors = threes[:, :-2] + threes[:, 1:-1] + threes[:, 2:] - filled
        filled = np.where(filled, neighbors >= 2, neighbors >= 5)
    return filled


def _is_passable(filled: NDArray[np.bool_], cell: float) -> bool:
    """Return True if a disc gets from one end of the field to the other."""
    # From center to center: the needed distance and the cylinder's radius.
    reach = _NEEDED + cell / 2
    steps = np.arange(-int(reach / cell), int(reach / cell) + 1) * cell
    disc = np.hypot(steps[:, None], steps) < reach
    padded = np.pad(filled, ((1, 1), (0, 0)), constant_values=True)
    parts, _ = label(~binary_dilation(padded, disc))
    ends = set(parts[:, 0].tolist()) & set(parts[:, -1].tolist())
    return bool(ends - {0})


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
