"""A robot's map forgets what rays look through, and nothing that stands still."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("numba", reason="maps need Numba")

from mpfa_envs import ROBOTS, Box, Cylinder, Lidar, World, generate_world
from mpfa_envs.deploy import Pilot, Scan
from mpfa_envs.sensing.hits import Hits
from mpfa_envs.sensing.map_memory import RESOLUTION
from mpfa_envs.sensing.sectors import Points
from tests.envs.exported import card

WALLS = (Box(2.0, -4.0, 2.1, -0.5), Box(2.0, 0.5, 2.1, 4.0))
"""A wall with a door of 1 m."""
FREE = World(name="free", size=(10.0, 8.0), boxes=WALLS)
TAKEN = World(name="taken", size=(10.0, 8.0), boxes=WALLS, cylinders=(Cylinder(2.0, 0.0, 0.25),))
"""Somebody stands in the door."""
SHUT = World(name="shut", size=(10.0, 8.0), boxes=(*WALLS, Box(2.0, -0.5, 2.1, 0.5)))
CARD = card(
    robot=ROBOTS["kobuki"], memory="map", field_of_view=360.0, sectors=36, observation_size=45
)


def seen(
    world: World, pose: tuple[float, float, float] = (0.0, 0.0, 0.0), far: float = 10.0
) -> Scan:
    """A scan of 360 rays."""
    ranges = Lidar(world, sectors=36, rays_per_sector=10, field_of_view=360.0).cast(*pose)
    angles = Lidar(world, sectors=36, rays_per_sector=10, field_of_view=360.0).angles
    ranges = np.where(ranges < far, ranges, math.inf)
    return Scan(float(angles[0]), float(angles[1] - angles[0]), ranges, 0.0, far)


@pytest.fixture(scope="module")
def pilot() -> Pilot:
    return Pilot(CARD, lambda _: np.zeros((1, 2), np.float32), map_size=10.0)


def levels_after(pilot: Pilot, scans: list[Scan], *, plan: World | None = None) -> np.ndarray:
    """Levels of the map after scans at the origin."""
    pilot.begin((4.0, 0.0), plan=plan)
    for scan in scans:
        pilot.observe(scan, (0.0, 0.0, 0.0), (0.0, 0.0))
    known = pilot._ground.map
    assert known is not None
    return known._memory.arrays.levels[0].copy()


def test_who_has_left_a_door_leaves_no_trace_on_the_map(pilot: Pilot) -> None:
    never = levels_after(pilot, [seen(FREE)] * 30)
    there = levels_after(pilot, [seen(TAKEN)] * 10)
    assert (there > never).sum() > 20
    assert (levels_after(pilot, [seen(TAKEN)] * 10 + [seen(FREE)] * 4) >= there).all()
    np.testing.assert_array_equal(
        levels_after(pilot, [seen(TAKEN)] * 10 + [seen(FREE)] * 20), never
    )


def test_a_path_leads_through_a_door_again_that_somebody_stood_in(pilot: Pilot) -> None:
    levels_after(pilot, [seen(TAKEN)] * 10)
    assert pilot.closed_in((0.0, 0.0))
    levels_after(pilot, [seen(TAKEN)] * 10 + [seen(FREE)] * 20)
    assert not pilot.closed_in((0.0, 0.0))
    free = pilot.observe(seen(FREE), (0.0, 0.0, 0.0), (0.0, 0.0))
    levels_after(pilot, [seen(FREE)] * 30)
    again = pilot.observe(seen(FREE), (0.0, 0.0, 0.0), (0.0, 0.0))
    np.testing.assert_array_equal(free, again)


def test_walls_of_a_plan_stay_on_the_map_where_rays_look_through(pilot: Pilot) -> None:
    # The goal behind the wall is closed in, so that the map of another goal is looked at.
    pilot.begin((1.0, 1.0), plan=SHUT)
    known = pilot._ground.map
    assert known is not None
    pilot.observe(seen(FREE), (0.0, 0.0, 0.0), (0.0, 0.0))
    planned = known._planned.copy()
    for _ in range(30):
        pilot.observe(seen(FREE), (0.0, 0.0, 0.0), (0.0, 0.0))
    assert (known._memory.arrays.levels[0] >= planned).all() and planned.any()


def test_what_a_scan_does_not_reach_stays(pilot: Pilot) -> None:
    away = (-3.0, 0.0, 0.0)
    pilot.begin((4.0, 0.0), map_center=(0.0, 0.0))
    for _ in range(10):
        pilot.observe(seen(TAKEN), (0.0, 0.0, 0.0), (0.0, 0.0))
    for _ in range(30):  # A lidar that sees 3 m, and not the door.
        pilot.observe(seen(TAKEN, away, 3.0), away, (0.0, 0.0))
    assert pilot.closed_in(away[:2])


def enter(hits: Hits, lidar: Lidar, pose: np.ndarray, mount: tuple[float, float]) -> np.ndarray:
    """Enter a scan of a lidar; the cells that are empty now."""
    ranges = lidar.cast(*pose)
    x, y = mount[0] + ranges * np.cos(lidar.angles), mount[1] + ranges * np.sin(lidar.angles)
    met = ranges < lidar.max_range
    angles = np.where(met, np.arctan2(y, x), lidar.angles)
    ranges = np.where(met, np.minimum(np.hypot(x, y), lidar.max_range), lidar.max_range)
    return hits.see(pose, Points(angles, ranges, mount, lidar.max_range), lidar.max_range)


@pytest.mark.parametrize("kind", ["rooms", "fields", "mazes", "halls"])
@pytest.mark.parametrize("mount", [(0.0, 0.0), (0.1, 0.05)])
def test_where_nothing_moves_nothing_is_forgotten(kind: str, mount: tuple[float, float]) -> None:
    rng = np.random.default_rng(3)
    world = generate_world(kind, seed=int(rng.integers(1000)))
    lidar = Lidar(world, sectors=36, rays_per_sector=10, field_of_view=360.0, mount=mount)
    hits, shape = Hits(RESOLUTION), [math.ceil(side / RESOLUTION) + 10 for side in world.size]
    hits.begin((shape[0], shape[1]), -0.5 * RESOLUTION * (np.array(shape) - 1))
    scans = 0
    while scans < 200:
        pose = rng.uniform(-0.5, 0.5, 3) * [*world.size, math.tau]
        if world.clearance(*pose[:2]) < 0.15:
            continue
        for _ in range(5):  # It drives on, to where rays pass by what it has seen.
            assert len(enter(hits, lidar, pose, mount)) == 0
            pose = pose + rng.normal(size=3) * [0.02, 0.02, 0.1]
            scans += 1
    assert hits.walls.sum() > 100


@pytest.mark.parametrize("silent", [1, 3])
def test_rays_that_are_not_valid_look_through_nothing(silent: int) -> None:
    hits = Hits(RESOLUTION)
    hits.begin((60, 60), np.full(2, -2.95))
    angles, met = np.radians(np.arange(-90.0, 91.0)), np.full(181, 5.0)
    met[90] = 2.0
    for _ in range(5):
        hits.see(np.zeros(3), Points(angles, met), 5.0)
    assert hits.walls.sum() == 1
    # Somebody has gone, and what is left are rays with gaps that he might stand in.
    apart = np.delete(angles, np.arange(90 - silent // 2, 91 + silent // 2))
    for _ in range(20):
        hits.see(np.zeros(3), Points(apart, np.full(apart.size, 5.0)), 5.0)
    assert hits.walls.sum() == (silent == 3)


def test_a_cell_is_forgotten_after_as_many_looks_as_it_has_evidence() -> None:
    hits = Hits(RESOLUTION)
    hits.begin((60, 60), np.full(2, -2.95))
    angles = np.radians(np.arange(-90.0, 91.0, 1.0))
    met = np.full(angles.size, 5.0)
    met[90] = 2.0
    hits.see(np.zeros(3), Points(angles, met), 5.0)
    assert not hits.walls.any()  # One scan may be noise.
    hits.see(np.zeros(3), Points(angles, met), 5.0)
    assert hits.walls.sum() == 1
    met[90] = 5.0
    emptied = [len(hits.see(np.zeros(3), Points(angles, met), 5.0)) for _ in range(12)]
    assert emptied == [0] * 9 + [1, 0, 0] and not hits.walls.any()
