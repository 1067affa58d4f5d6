"""Numbers of NumPy in robots, noise, worlds and environments: what is kept is Python's own."""

import numpy as np
import pytest

from mpfa_envs import Box, Cylinder, RobotModel, RobotNoise, VectorNavigationEnv, World
from mpfa_envs.worlds.walker import Walker

ONE, HALF = np.int64(1), np.float32(0.5)
CART = {
    **{"radius": np.float32(0.25), "height": HALF, "mass": np.int64(3), "wheel_base": HALF},
    **{"wheel_radius": np.float64(0.04), "min_wheel_speed": np.int64(0), "max_wheel_speed": HALF},
    **{"lidar_rays": np.int64(36), "turn_limit": ONE},
}
KEPT = {
    "robot": lambda: RobotModel(name="cart", **CART),
    "noise": lambda: RobotNoise(range_noise=HALF, dropout=HALF, slip=np.float32(0)),
    "box": lambda: Box(-ONE, -HALF, ONE, HALF),
    "cylinder": lambda: Cylinder(ONE, HALF, HALF),
    "walker": lambda: Walker(radius=HALF, speed=HALF),
}


def numbers_of_numpy(value):
    """NumPy's numbers in a value of mappings and lists."""
    if isinstance(value, dict | list | tuple):
        entries = value.values() if isinstance(value, dict) else value
        return [found for each in entries for found in numbers_of_numpy(each)]
    return [value] if isinstance(value, np.generic) else []


@pytest.mark.parametrize("name", KEPT)
def test_number_of_numpy_is_kept_as_one_of_python(name):
    assert numbers_of_numpy(vars(KEPT[name]())) == []


def test_state_of_an_environment_with_numbers_of_numpy_has_none():
    part = {"boxes": (Box(-HALF, -HALF, HALF, HALF),), "size": (np.int64(8), np.float64(8))}
    world = World(
        name="own", **part, start_regions=(Box(-3, -3, -2, -2),), goal_regions=(Box(2, 2, 3, 3),)
    )
    env = VectorNavigationEnv(
        np.int64(2),
        world=world,
        physics="kinematic",
        robot=KEPT["robot"](),
        noise={"slip": np.float32(0.125)},
        max_steps=np.int64(20),
        goal_radius=np.float32(0.5),
        max_goal_distance=np.float32(9),
    )
    env.reset(seed=int(ONE))
    assert numbers_of_numpy(env.state_dict()) == []
    env.close()


def test_state_of_generated_worlds_of_a_difficulty_of_numpy_has_none():
    env = VectorNavigationEnv(1, world="bars", physics="kinematic", difficulty=HALF)
    env.reset(seed=0)
    assert numbers_of_numpy(env.state_dict()) == []
    env.close()
