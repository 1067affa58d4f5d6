from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.speed.bullet_world import BulletWorld
from mpfa_envs import (
    EXAMPLE_WORLD,
    WORLDS,
    Box,
    Lidar,
    Polygon,
    World,
    generate_world,
    load_world,
)


def test_the_rays_go_from_left_to_right_over_the_front() -> None:
    lidar = Lidar(WORLDS["A"])
    assert lidar.angles.size == 54
    assert np.degrees(lidar.angles[[0, -1]]) == pytest.approx([90 - 5 / 3, -90 + 5 / 3])
    single = Lidar(WORLDS["A"], reduction="single")
    assert np.degrees(single.angles[[0, 1, -1]]) == pytest.approx([85, 75, -85])


@pytest.mark.parametrize(
    "shapes",
    [
        {"boxes": (Box(1.0, 0.0, 2.0, 1.0),)},
        {"polygons": (Polygon(((1.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 1.0))),)},
    ],
    ids=lambda shapes: next(iter(shapes)),
)
def test_a_ray_along_an_edge_meets_its_corner(shapes: dict[str, tuple[object, ...]]) -> None:
    world = World(name="edge", **shapes)
    with np.errstate(all="raise", under="ignore"):
        ranges = Lidar(world, sectors=1, reduction="single").scan(0.0, 0.0, 0.0)
    assert ranges == pytest.approx(1.0)


def test_no_ray_slips_between_two_edges() -> None:
    wedge = World(name="wedge", polygons=(Polygon(((1.0, 0.0), (3.0, -1.0), (3.0, 1.0))),))
    lidar, rng = Lidar(wedge, sectors=1, reduction="single"), np.random.default_rng(0)
    for x, y in rng.uniform((-4.0, -0.2), (0.5, 0.2), (2000, 2)).tolist():
        (found,) = lidar.cast(x, y, math.atan2(-y, 1.0 - x))
        assert found == pytest.approx(math.hypot(1.0 - x, y), abs=1e-6)


def test_the_reductions_differ_at_the_edge_of_a_box() -> None:
    world = World(name="leg", boxes=(Box(2.0, -0.02, 2.04, 0.02),))
    near = Lidar(world, sectors=1, rays_per_sector=5, reduction="min").scan(0.0, 0.0, 0.0)
    median = Lidar(world, sectors=1, rays_per_sector=5, reduction="median").scan(0.0, 0.0, 0.0)
    # Turned, as the middle two of four rays are equal in a symmetric room.
    even = Lidar(world, sectors=1, rays_per_sector=4, reduction="median").scan(0.0, 0.0, 0.3)
    rays = Lidar(world, sectors=1, rays_per_sector=5).cast(0.0, 0.0, 0.0)
    assert near == pytest.approx(2.0)
    assert median == pytest.approx(np.median(rays))
    assert even == pytest.approx(
        np.median(Lidar(world, sectors=1, rays_per_sector=4).cast(0.0, 0.0, 0.3))
    )


def test_the_lidar_agrees_with_the_ray_test_of_the_engine() -> None:
    rng = np.random.default_rng(0)
    hall = generate_world("halls", 5, difficulty=0.6)
    assert {polygon.is_convex for polygon in hall.polygons} == {True, False}
    for world in (WORLDS["test"], load_world(EXAMPLE_WORLD), hall):
        lidar = Lidar(world, max_range=9.0)
        engine = BulletWorld(world)
        for _ in range(20):
            x, y = (rng.uniform(-0.5, 0.5, 2) * world.size).tolist()
            if world.clearance(x, y) < 0.1:
                continue
            heading = rng.uniform(-math.pi, math.pi)
            expected = engine.cast_rays(x, y, lidar.angles + heading, reach=9.0)
            ours = lidar.cast(x, y, heading)
            # The engine rounds edges by millimeters, so single rays there may differ.
            assert np.mean(np.abs(expected - ours) < 0.01) > 0.96
        engine.close()


def test_a_ray_that_meets_nothing_has_no_noise() -> None:
    lidar = Lidar(World(name="wide", size=(30.0, 30.0)), noise=0.05)
    rng = np.random.default_rng(0)
    assert (lidar.scan(0.0, 0.0, 0.3, rng=rng) == lidar.max_range).all()
    exact = lidar.cast(14.0, 0.0, 0.3)
    noisy, met = exact.copy(), exact < lidar.max_range
    lidar.disturb(noisy, rng)
    assert 0 < met.sum() < met.size
    assert (noisy[~met] == lidar.max_range).all()
    assert (noisy[met] != exact[met]).all()


def test_noise_needs_a_generator_and_is_its_only_randomness() -> None:
    lidar = Lidar(WORLDS["A"], noise=0.1)
    with pytest.raises(ValueError, match=r"rng must be a Generator when noise is 0.1, got None"):
        lidar.scan(0.0, 0.0, 0.0)
    first, second = (lidar.scan(0, 0, 0, rng=np.random.default_rng(1)) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_a_mounted_lidar_at_whole_numbers_scans_as_at_the_same_fractions() -> None:
    lidar = Lidar(WORLDS["A"], mount=(0.1, 0.0))
    assert lidar.scan(0, 0, 0).tolist() == lidar.scan(0.0, 0.0, 0.0).tolist()
