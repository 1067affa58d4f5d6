"""What a robot's map forgets: what rays look past, and nothing that stands still."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mpfa_envs import Box, Cylinder, Lidar, World, world_tasks
from mpfa_envs.deploy.reach import closes_in
from mpfa_envs.paths.distance import FreeGrid
from mpfa_envs.planners import shortest_path
from mpfa_envs.robots.model import ROBOTS
from mpfa_envs.sensing.hits import Hits
from mpfa_envs.sensing.map_loops import BLOCKED
from mpfa_envs.sensing.map_memory import MapMemory

FREE = World(name="free", size=(8.0, 6.0), boxes=(Box(3.0, -3.0, 3.2, -0.6),))
PERSON = World(
    name="person", size=(8.0, 6.0), boxes=FREE.boxes, cylinders=(Cylinder(1.5, 0.4, 0.25),)
)


def look(hits: Hits, world: World, pose: tuple[float, float, float], scans: int = 1) -> int:
    """Enter scans of a world from a pose; how many cells were found free."""
    lidar = Lidar(world, sectors=36, rays_per_sector=10, field_of_view=360.0)
    ranges, angles = lidar.cast(*pose), lidar.angles + pose[2]
    return sum(len(hits.see(*pose[:2], angles, ranges, 10.0)) for _ in range(scans))


@pytest.mark.parametrize("kind", ["rooms:validation", "mazes:validation"])
def test_nothing_that_stands_still_is_forgotten(kind: str) -> None:
    rng = np.random.default_rng(0)
    for task in world_tasks(kind, episodes=1, robot="kobuki"):
        hits = Hits()
        hits.begin((0.0, 0.0), task.world.size)
        path = shortest_path(
            FreeGrid(task.world, distance=0.2), task.task.start[:2], task.task.goal
        )
        assert path is not None
        for x, y in path[::3]:
            assert look(hits, task.world, (x, y, rng.uniform(-math.pi, math.pi))) == 0


def test_who_has_left_is_forgotten_once_rays_have_looked_past_for_long() -> None:
    hits, pose = Hits(), (-1.0, 0.0, 0.0)
    hits.begin((0.0, 0.0), FREE.size)
    assert look(hits, PERSON, pose, 5) == 0
    person = np.hypot(*(hits.places - (1.5, 0.4)).T) < 0.3
    assert person.sum() >= 4
    assert look(hits, FREE, pose, 19) == 0
    assert look(hits, FREE, pose, 2) == person.sum()
    assert not (np.hypot(*(hits.places - (1.5, 0.4)).T) < 0.3).any()
    # The wall behind is as it was.
    assert (np.abs(hits.places[:, 0] - 3.0) < 0.1).any()


def test_a_plan_is_never_forgotten() -> None:
    hits, pose = Hits(), (-1.0, 0.0, 0.0)
    hits.begin((0.0, 0.0), PERSON.size, PERSON)
    walls = hits.walls.sum()
    assert look(hits, FREE, pose, 60) == 0 and hits.walls.sum() >= walls
    assert len(hits.places) < 200


def test_one_scan_is_no_wall_and_two_are() -> None:
    box = World(name="closed", size=(8.0, 6.0), boxes=(Box(0.0, -3.0, 0.2, 3.0),))
    hits = Hits()
    hits.begin((0.0, 0.0), box.size)
    look(hits, box, (-2.0, 0.0, 0.0))
    assert not closes_in(hits, 0.18, (2.0, 0.0), 0.3, (-2.0, 0.0))
    look(hits, box, (-2.0, 0.0, 0.01), 2)
    assert closes_in(hits, 0.18, (2.0, 0.0), 0.3, (-2.0, 0.0))


def test_cells_of_a_map_are_those_of_the_hits_that_are_still_there_and_of_the_plan() -> None:
    lidar = Lidar(PERSON, sectors=36, rays_per_sector=10, field_of_view=360.0)
    pose, goal = np.array([[-1.0, 0.0, 0.0, 0.0, 0.0]]), np.array([[2.8, 0.4]])
    never, after = (MapMemory(1, ROBOTS["kobuki"], lidar) for _ in range(2))
    free = Lidar(FREE, sectors=36, rays_per_sector=10, field_of_view=360.0).cast(-1.0, 0.0, 0.0)
    with_person = lidar.cast(-1.0, 0.0, 0.0)
    for memory in (never, after):
        memory.begin(0, FREE)
        memory.remember(pose, goal, free[None])
    path = after.remember(pose, goal, free[None]).copy()
    after.remember(pose, goal, with_person[None])
    assert (after.arrays.levels != never.arrays.levels).any()
    assert after.arrays.levels[0, 57, 38] == BLOCKED  # Where the person stands.
    angles = lidar.angles
    hits = np.stack((-1.0 + free * np.cos(angles), free * np.sin(angles)), axis=1)
    places = hits[free < 10.0]
    met = with_person < free - 0.05
    x = -1.0 + with_person * np.cos(angles)
    y = with_person * np.sin(angles)
    origin = after.arrays.origins[0]
    cells = np.floor((np.stack((x, y), axis=1)[met] - origin) / 0.1 + 0.5).astype(np.int64)
    after.forget(0, cells, places)
    np.testing.assert_array_equal(after.arrays.levels, never.arrays.levels)
    np.testing.assert_array_equal(after.remember(pose, goal, free[None]), path)
