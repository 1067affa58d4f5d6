"""The worlds of many robots as arrays that compiled loops read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from mpfa_envs.worlds.arrays import BatchArrays, GridArrays, with_row
from mpfa_envs.worlds.shapes import OccupancyGrid
from mpfa_envs.worlds.world import World


class WorldBatch:
    """A world for each of many robots; setting one copies its shapes and nothing else."""

    # Walkers have a row each behind the cylinders, and then the other robots of a team, for others
    # to write where they are.

    def __init__(self, worlds: Sequence[World], *, mates: int = 0, radius: float = 0.0) -> None:
        robots = len(worlds)
        self._mates = [(0.0, 0.0, radius)] * mates
        self._worlds = list(worlds)
        self._arrays = BatchArrays(
            np.empty((robots, 2)),
            np.empty((robots, 0, 4)),
            np.empty((robots, 0, 3)),
            np.empty((robots, 0, 4)),
            np.empty((robots, 0), dtype=np.int64),
            np.zeros((robots, 4), dtype=np.int64),
            _grid_arrays([]),
            np.full(robots, -1),
        )
        self._grids: list[OccupancyGrid] = []
        # The same without what moves.
        self._standing = self._arrays.counts.copy()
        for robot, world in enumerate(worlds):
            self[robot] = world

    @property
    def arrays(self) -> BatchArrays:
        """Arrays for compiled loops; setting a larger world may replace them."""
        return self._arrays

    @property
    def standing(self) -> BatchArrays:
        """The same arrays with counts that leave out walkers and the other robots."""
        return self._arrays._replace(counts=self._standing)

    def __len__(self) -> int:
        return len(self._worlds)

    def __iter__(self) -> Iterator[World]:
        return iter(self._worlds)

    def __getitem__(self, robot: int) -> World:
        return self._worlds[robot]

    def __setitem__(self, robot: int, world: World) -> None:
        rows = world.arrays
        moving = [(0.0, 0.0, walker.radius) for walker in world.walkers] + self._mates
        if moving:
            rows = rows._replace(circles=np.concatenate((rows.circles, moving)))
        shapes = rows._asdict()
        half_size = shapes.pop("half_size")
        counts = [len(shape) for shape in shapes.values()]
        self._arrays = with_row(self._arrays, robot, half_sizes=half_size, counts=counts, **shapes)
        self._standing[robot] = self._arrays.counts[robot]
        self._standing[robot, 1] -= len(moving)
        self._worlds[robot] = world
        self._arrays.grid_of[robot] = -1
        if world.occupancy is not None:
            self._set_grid(robot, world.occupancy)

    def _set_grid(self, robot: int, grid: OccupancyGrid) -> None:
        """Put a robot into a map, which it shares with other robots there."""
        grids = self._grids
        if grid not in grids:
            used = {int(number) for number in self._arrays.grid_of if number >= 0}
            kept = [number for number in range(len(grids)) if number in used]
            places = np.full(len(grids) + 1, -1)
            places[kept] = np.arange(len(kept))
            self._grids = grids = [*(grids[number] for number in kept), grid]
            # The last place stands for none: -1 stays -1.
            self._arrays.grid_of[:] = places[self._arrays.grid_of]
            self._arrays = self._arrays._replace(grids=_grid_arrays(grids))
        self._arrays.grid_of[robot] = grids.index(grid)


def _grid_arrays(grids: Sequence[OccupancyGrid]) -> GridArrays:
    """Copy maps into tables."""
    shapes = np.array([grid.occupied.shape for grid in grids], dtype=np.int64).reshape(-1, 2)
    most = shapes.max(axis=0, initial=0)
    left, right, gaps = (
        np.zeros((len(grids), *most), kind) for kind in (np.int16, np.int16, np.uint8)
    )
    for number, (grid, (columns, rows)) in enumerate(zip(grids, shapes, strict=True)):
        for table, values in zip((left, right, gaps), grid.arrays, strict=True):
            table[number, :columns, :rows] = values
    resolutions = np.array([grid.resolution for grid in grids], dtype=np.float64)
    return GridArrays(left, right, gaps, shapes, resolutions)
