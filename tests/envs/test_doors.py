"""Doors of a user's world: tasks lead through them, and what cannot be reached is said."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from mpfa_envs import ROBOTS, WORLDS, Box, VectorNavigationEnv, World, world_tasks
from mpfa_envs.tasks.sampling import evaluation_pairs
from mpfa_envs.worlds.shapes import OccupancyGrid
from mpfa_envs.worlds.world import Task

CART = replace(
    ROBOTS["kobuki"], name="cart", radius=0.31, wheel_base=0.46, min_wheel_speed=-0.9,
    max_wheel_speed=0.9,
)  # fmt: skip
SHAPES, MAP = "shapes", "map"


def two_rooms(door: float, kind: str) -> World:
    """Two rooms of 6 x 8 m with a door between them [m], off the middle of any cell."""
    low = 0.013 - door / 2
    wall = Box(-0.1, -4.0, 0.1, low), Box(-0.1, low + door, 0.1, 4.0)
    world = World(name=f"two {door}", size=(12.0, 8.0), boxes=wall)
    if kind == SHAPES:
        return world
    cells = np.zeros((1200, 800), np.bool_)
    cells[590:610] = True
    first = round((low + 4.0) / 0.01)
    cells[590:610, first : first + round(door / 0.01)] = False
    grid = OccupancyGrid(cells, 0.01)
    return World(name=f"map {door}", size=grid.size, occupancy=grid)


def crossing(tasks: list[Task]) -> int:
    """Number of tasks that lead through the door."""
    return sum(task.start[0] * task.goal[0] < 0.0 for task in tasks)


@pytest.mark.parametrize("kind", [SHAPES, MAP])
@pytest.mark.parametrize("door", [0.72, 0.8, 1.2])
def test_tasks_lead_through_doors_that_are_wider_by_a_tenth_of_a_meter(
    door: float, kind: str
) -> None:
    world = two_rooms(door, kind)
    assert crossing([each.task for each in world_tasks(world, episodes=40, robot=CART)]) > 10
    env = VectorNavigationEnv(
        20, world=world, robot=CART, physics="kinematic", clearance=0.02, max_goal_distance=20.0,
        progress="shortest_path",
    )  # fmt: skip
    env.reset(seed=0)
    assert crossing([task for task in env.tasks if task]) > 5


@pytest.mark.parametrize("kind", [SHAPES, MAP])
def test_parts_that_cannot_be_reached_are_said_once(kind: str) -> None:
    world = two_rooms(0.66, kind)
    message = r"1 of 2 parts of .*, 50% of the floor, .* by a robot 0.62 m wide: .* of 0.72 m and"
    with pytest.warns(UserWarning, match=message) as said:
        tasks = world_tasks(world, episodes=20, robot=CART)
        world_tasks(world, episodes=20, seed=1, robot=CART)
        VectorNavigationEnv(1, world=world, robot=CART, physics="kinematic", clearance=0.02)
    assert len(said) == 1
    assert crossing([each.task for each in tasks]) == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        world_tasks(two_rooms(0.72, kind), episodes=1, robot=CART)


def test_tasks_of_the_paper_keep_its_clearance() -> None:
    pairs = evaluation_pairs("test", 40, seed=3)
    assert min(WORLDS["test"].clearance(*pair.start[:2]) for pair in pairs) >= 0.35
    own = evaluation_pairs(replace(WORLDS["test"], name="own"), 40, seed=3)
    assert min(WORLDS["test"].clearance(*pair.start[:2]) for pair in own) < 0.4
    assert own != pairs
