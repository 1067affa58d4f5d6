from __future__ import annotations

import math

import numpy as np
import pytest

from mpfa_envs import NavigationEnv
from mpfa_envs.generators.resolve import resolve_world
from mpfa_envs.paths.distance import DistanceField, FreeGrid
from mpfa_envs.worlds.barn import BARN_WORLDS, barn_task, barn_world


def test_there_are_twenty_worlds_from_open_to_narrow() -> None:
    worlds = [barn_world(index) for index in range(20)]
    counts = [len(world.cylinders) for world in worlds]
    assert len(BARN_WORLDS) == 20 and min(counts) >= 181 and max(counts) <= 365
    assert sum(counts[10:]) > sum(counts[:10])
    for world in worlds:
        edges = np.array([cylinder.bounds for cylinder in world.cylinders])
        # The bounding box of every world of the benchmark, moved to the middle of the room.
        assert edges[:, :2].min(axis=0) == pytest.approx((-2.25, -7.0))
        assert edges[:, 2:].max(axis=0) == pytest.approx((2.25, 2.6))
        assert {cylinder.radius for cylinder in world.cylinders} == {0.075}


@pytest.mark.parametrize("index", range(20))
def test_the_task_can_be_solved_with_something_to_spare(index: int) -> None:
    task = barn_task()
    field = DistanceField(FreeGrid(barn_world(index), distance=0.25), task.goal)
    assert math.dist(task.start[:2], task.goal) == 10.0
    assert 9.8 < field.at(*task.start[:2]) < 15.0
    i, j = field.grid.index(*task.start[:2])
    assert math.isfinite(field.lengths[i, j])


def test_a_world_is_found_by_its_name() -> None:
    world = resolve_world("barn-12")
    assert world == barn_world(12) and world.name == "barn-12"
    env = NavigationEnv(world="barn-0", physics="kinematic")
    _, info = env.reset(options=barn_task()._asdict())
    assert info["distance"] == 10.0 and info["heading"] == pytest.approx(math.pi / 2)
    _, info = env.reset(seed=0)
    assert info["y"] < -2.5 and env.task is not None and env.task.goal[1] > 3.5
