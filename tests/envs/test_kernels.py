"""The compiled loops against plain geometry."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import numpy as np
import pytest

import mpfa_envs
from mpfa_envs import ROBOTS, WORLDS, Lidar, TaskConfig, World
from mpfa_envs.compiled import njit
from mpfa_envs.robots.drives import KinematicDrives
from mpfa_envs.worlds.arrays import clearance_at
from mpfa_envs.worlds.batch import WorldBatch
from tests.envs.plain_robot import drive_arc, scan
from tests.envs.process import run
from tests.envs.shapes import distance, random_shapes

MIXES = [
    {},
    {"boxes": 12},
    {"cylinders": 40},
    {"polygons": 10},
    {"boxes": 6, "cylinders": 10, "polygons": 5},
]


def somewhere(rng: np.random.Generator, count: int) -> np.ndarray:
    """Motions at random poses in the room of ``random_shapes``, some of them in shapes."""
    motions = np.zeros((count, 5))
    motions[:, 0], motions[:, 1] = rng.uniform(-4.9, 4.9, count), rng.uniform(-3.9, 3.9, count)
    motions[:, 2] = rng.uniform(-math.pi, math.pi, count)
    return motions


def cast_all(worlds: list[World], motions: np.ndarray, lidar: Lidar) -> np.ndarray:
    ranges = np.full((len(worlds), lidar.angles.size), np.nan)
    chosen = np.ones(len(worlds), dtype=np.bool_)
    lidar.cast_all(motions, chosen, WorldBatch(worlds).arrays, ranges)
    return ranges


@pytest.mark.parametrize("mix", MIXES, ids=str)
@pytest.mark.parametrize(
    ("view", "max_range"), [(180.0, 10.0), (180.0, 1.5), (90.0, 1.5), (270.0, 10.0), (360.0, 1.5)]
)
def test_rays_meet_what_plain_geometry_says(
    mix: dict[str, int], max_range: float, view: float
) -> None:
    rng = np.random.default_rng(1)
    worlds = [random_shapes(rng, **mix) for _ in range(24)]
    motions = somewhere(rng, 24)
    lidar = Lidar(worlds[0], max_range=max_range, field_of_view=view)
    expected = [
        scan(lidar, world, *pose) for world, pose in zip(worlds, motions[:, :3], strict=True)
    ]
    np.testing.assert_allclose(cast_all(worlds, motions, lidar), expected, atol=1e-9)
    np.testing.assert_array_equal(
        lidar.cast(*motions[0, :3]), cast_all(worlds[:1], motions[:1], lidar)[0]
    )


@pytest.mark.parametrize("mix", MIXES, ids=str)
def test_clearances_are_those_of_plain_geometry(mix: dict[str, int]) -> None:
    rng = np.random.default_rng(2)
    worlds = [random_shapes(rng, **mix) for _ in range(200)]
    points = somewhere(rng, 200)[:, :2]
    arrays = WorldBatch(worlds).arrays
    measured = [clearance_at(arrays, i, *points[i]) for i in range(200)]
    expected = [distance(*point, world) for world, point in zip(worlds, points, strict=True)]
    np.testing.assert_allclose(measured, expected, atol=1e-12)
    one = [world.clearance(*point) for world, point in zip(worlds, points, strict=True)]
    assert one == measured


def test_arcs_are_those_of_plain_geometry() -> None:
    robot, rng = ROBOTS["turtlebot2"], np.random.default_rng(3)
    motions = somewhere(rng, 8)
    config = TaskConfig(robot=robot)
    drives = KinematicDrives(robot, 8, time_step=0.1)
    for step in range(200):
        speeds = rng.uniform(0.05, 0.5, (8, 2))
        speeds[step % 8, 1] = speeds[step % 8, 0]  # One of them goes straight.
        expected = [
            drive_arc(tuple(m), *pair, config) for m, pair in zip(motions, speeds, strict=True)
        ]
        drives.move(motions, np.ones(8, dtype=np.bool_), speeds)
        np.testing.assert_allclose(motions, expected, atol=1e-12)


def test_a_world_replaces_another_whatever_their_sizes() -> None:
    rng = np.random.default_rng(4)
    batch = WorldBatch([WORLDS["A"], WORLDS["D"]])
    lidar = Lidar(WORLDS["A"])
    for mix in (MIXES[4], MIXES[0], MIXES[2], MIXES[3]):
        world = random_shapes(rng, **mix)
        batch[0] = world
        motions = somewhere(rng, 2)
        ranges = np.empty((2, lidar.angles.size))
        lidar.cast_all(motions, np.ones(2, dtype=np.bool_), batch.arrays, ranges)
        for row, each, motion in zip(ranges, (world, WORLDS["D"]), motions, strict=True):
            np.testing.assert_allclose(row, Lidar(each).cast(*motion[:3]), atol=1e-9)
    assert batch[0] is world and len(batch) == 2


@pytest.mark.parametrize("folder", ["/dev/null/none", ""])
def test_a_function_is_compiled_where_it_cannot_be_cached(folder: str) -> None:
    code = "from mpfa_envs.compiled import njit\nprint(njit(lambda x: 2.0 * x)(3.0))\n"
    assert run(code, NUMBA_CACHE_DIR=folder) == "6.0\n"


def test_a_loop_is_compiled_again_when_another_file_of_the_package_changed(tmp_path: Path) -> None:
    package = Path(mpfa_envs.__file__).parent
    shutil.copytree(package, tmp_path / "mpfa_envs", ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "mpfa_envs/inner.py").write_text(
        "from mpfa_envs.compiled import njit\n@njit\ndef _inner(x):\n    return 2.0 * x\n"
    )
    (tmp_path / "mpfa_envs/outer.py").write_text(
        "from typing import NamedTuple\nfrom mpfa_envs.compiled import njit\n"
        "from mpfa_envs.inner import _inner\n"
        "class Pair(NamedTuple):\n    x: float\n    y: float\n"
        "@njit\ndef outer(pair):\n    return _inner(pair.x)\n"
    )
    code = "from mpfa_envs.outer import Pair, outer\nprint(outer(Pair(3.0, 4.0)))\n"
    assert run(code, PYTHONPATH=str(tmp_path)) == "6.0\n"
    (tmp_path / "mpfa_envs/inner.py").write_text(
        "from mpfa_envs.compiled import njit\n@njit\ndef _inner(x):\n    return 5.0 * x\n"
    )
    assert run(code, PYTHONPATH=str(tmp_path)) == "15.0\n"
    moved = (tmp_path / "mpfa_envs/outer.py").read_text().replace("Pair", "Point")
    (tmp_path / "mpfa_envs/outer.py").write_text(moved)
    assert run(code.replace("Pair", "Point"), PYTHONPATH=str(tmp_path)) == "15.0\n"


def test_a_division_by_zero_is_infinite_as_in_numpy() -> None:
    assert njit(lambda x: 1.0 / x)(0.0) == math.inf
