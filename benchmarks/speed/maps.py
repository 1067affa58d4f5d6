"""Measure the cost of a large map: reading, a scan, a clearance, a task; and of boxes instead.

    python -m benchmarks.speed.maps

Times are CPU time of one thread.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.speed.timing import seconds_per_call
from mpfa_envs import Lidar, Task, World
from mpfa_envs.paths.distance import FreeGrid, shortest_length
from mpfa_envs.paths.tasks import sample_task_on_grid
from mpfa_envs.sensing.lidar_loops import cast_rays
from mpfa_envs.worlds.arrays import BatchArrays, clearance_at
from mpfa_envs.worlds.batch import WorldBatch
from mpfa_envs.worlds.shapes import OccupancyGrid

SIDE, ROOM, CELL = 2000, 160, 0.05
ROBOTS = 4


def building(seed: int = 0) -> NDArray[np.bool_]:
    """The occupied cells of rooms of 8 m with doors and furniture, with ragged walls."""
    rng = np.random.default_rng(seed)
    occupied = np.zeros((SIDE, SIDE), dtype=np.bool_)
    for first in (*range(0, SIDE, ROOM), SIDE - 3):
        occupied[first : first + 3] = occupied[:, first : first + 3] = True
    for x in range(0, SIDE, ROOM):
        for y in range(0, SIDE, ROOM):
            door, other = rng.integers(10, ROOM - 40, 2)
            if x:
                occupied[x : x + 3, y + door : y + door + 28] = False
            if y and rng.random() < 0.7:
                occupied[x + other : x + other + 28, y : y + 3] = False
            for _ in range(rng.integers(2, 7)):
                width, depth = rng.integers(4, 30, 2)
                left, low = np.array((x, y)) + rng.integers(10, ROOM - 40, 2)
                occupied[left : left + width, low : low + depth] = True
    beside = np.roll(occupied, 1, 0) | np.roll(occupied, 1, 1)
    return occupied | (beside & (rng.random(occupied.shape) < 0.4))


def boxes_of(occupied: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Rectangles that cover the cells, equal runs of neighboring columns in one, ``[boxes, 4]``."""
    going: dict[tuple[int, int], int] = {}
    boxes: list[tuple[int, int, int, int]] = []
    for column in range(len(occupied) + 1):
        cells = occupied[column] if column < len(occupied) else np.zeros(occupied.shape[1], bool)
        ends = np.flatnonzero(np.diff(np.concatenate(([0], cells.astype(np.int8), [0])))).tolist()
        runs = {(low, high): column for low, high in zip(ends[::2], ends[1::2], strict=True)}
        boxes += [
            (first, run[0], column, run[1]) for run, first in going.items() if run not in runs
        ]
        going = {run: going.get(run, first) for run, first in runs.items()}
    return CELL * (np.array(boxes) - np.tile(np.array(occupied.shape) / 2, 2))


def spent(function: Callable[[], object], times: int) -> float:
    """CPU time of a call [s], after one that compiles."""
    function()
    return seconds_per_call(function, times)


def main() -> None:
    """Measure and print."""
    grid = OccupancyGrid(building(), CELL)
    world = World(name="building", size=grid.size, occupancy=grid)
    with tempfile.TemporaryDirectory() as folder:
        world.to_map(Path(folder) / "map.yaml")
        reading = spent(lambda: World.from_map(Path(folder) / "map.yaml"), 3)
    start = time.process_time()
    grid.arrays  # noqa: B018
    print(f"reading {reading:.2f} s, arrays {time.process_time() - start:.2f} s")
    rng = np.random.default_rng(0)
    free = FreeGrid(world, distance=0.25)
    drawing = spent(lambda: sample_task_on_grid(free, rng, detour_chance=0.8), 20)
    # Lengths are kept: each is of another task.
    tasks = iter([sample_task_on_grid(free, rng, detour_chance=0.8)[0] for _ in range(21)])
    measuring = spent(lambda: _length(world, next(tasks)), 20)
    print(f"a task {1e3 * drawing:.1f} ms, its shortest path {1e3 * measuring:.1f} ms")
    motions = np.zeros((ROBOTS, 5))
    for row in motions:
        row[:3] = sample_task_on_grid(free, rng)[0].start
    cells = WorldBatch([world] * ROBOTS).arrays
    boxes = np.tile(boxes_of(grid.occupied), (ROBOTS, 1, 1))
    counts = np.tile([boxes.shape[1], 0, 0, 0], (ROBOTS, 1))
    instead = cells._replace(boxes=boxes, counts=counts, grid_of=np.full(ROBOTS, -1))
    angles = Lidar(world).angles
    rays = np.stack((np.cos(angles), np.sin(angles)))
    for name, arrays, times in (("cells", cells, 500), (f"{boxes.shape[1]} boxes", instead, 20)):
        scan, near = _measure(arrays, motions, rays, times)
        print(f"{name}: a scan {1e6 * scan:.1f} µs, a clearance {1e6 * near:.1f} µs")


def _length(world: World, task: Task) -> float:
    """The shortest path of a task [m]."""
    return shortest_length(world, 0.18, task.start[:2], task.goal)


def _measure(
    arrays: BatchArrays, motions: NDArray[np.float64], rays: NDArray[np.float64], times: int
) -> tuple[float, float]:
    """CPU time of a robot's scan and of a clearance [s]."""
    ranges, everyone = np.zeros((ROBOTS, rays.shape[1])), np.ones(ROBOTS, dtype=np.bool_)
    scan = spent(lambda: cast_rays(motions, everyone, arrays, rays, np.pi, 10.0, ranges), times)
    near = spent(lambda: clearance_at(arrays, 0, motions[0, 0], motions[0, 1]), times)
    return scan / ROBOTS, near


if __name__ == "__main__":
    main()
