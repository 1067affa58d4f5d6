"""Several robots in one world: what each sees of the others, and how their episodes end."""

import math

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from mpfa_envs import Task, VectorNavigationEnv, Walker, World

HALL = World(name="hall", size=(8.0, 8.0))
AHEAD = np.ones((2, 2), dtype=np.float32)


def pair(robots=2, team=2, **task):
    task = {"physics": "kinematic", "robot": "kobuki", "contact": True} | task
    return VectorNavigationEnv(
        robots, world=HALL, team=team, autoreset_mode=AutoresetMode.DISABLED, **task
    )


def facing(gap=2.0, far=3.0):
    return [
        Task((-gap / 2, 0.0, 0.0), (far, 0.0)),
        Task((gap / 2, 0.0, math.pi), (-far, 0.0)),
    ]


def begin(env, tasks):
    return env.reset(seed=0, options={"tasks": tasks})


def test_the_lidar_of_each_robot_sees_the_others_as_circles_of_their_radius():
    env = pair(goal_radius=0.1)
    begin(env, facing())
    ahead = np.argmin(np.abs(env.lidar.angles))
    assert env._batch.ranges[:, ahead] == pytest.approx(2.0 - env.config.robot.radius, abs=0.01)
    assert env.walkers(0)[0] == pytest.approx([1.0, 0.0, 0.0, 0.0, env.config.robot.radius])


def test_robots_that_meet_have_both_collided_at_the_sum_of_their_radii():
    env = pair()
    begin(env, facing())
    for _ in range(40):
        _, _, ended, _, info = env.step(AHEAD)
        if ended.any():
            break
    assert ended.all()
    assert info["collision"].all()
    gap = math.dist(*env.poses[:, :2]) - 2 * env.config.robot.radius
    assert -0.15 < gap <= 0.0


def test_a_robot_that_has_arrived_stays_as_an_obstacle_of_the_other():
    env = pair()
    begin(env, [Task((-1.0, 0.0, 0.0), (0.0, 0.0)), Task((2.0, 0.0, math.pi), (-3.0, 0.0))])
    running = np.ones(2, dtype=np.bool_)
    while running.any():
        _, _, terminated, truncated, info = env.step(AHEAD, only=running)
        running &= ~(terminated | truncated)
    assert info["success"].tolist() == [True, False]
    assert info["collision"].tolist() == [False, True]
    assert env.poses[1, 0] > env.poses[0, 0]


def test_two_teams_do_not_see_each_other_and_each_drives_as_alone():
    tasks = [Task((-3.0, y, 0.0), (3.0, y)) for y in (-2.0, 2.0)]
    both = pair(4)
    begin(both, tasks + tasks)
    alone = pair()
    begin(alone, tasks)
    for _ in range(10):
        seen = both.step(np.ones((4, 2), dtype=np.float32))[0]
        expected = alone.step(AHEAD)[0]
    np.testing.assert_array_equal(seen[:2], expected)
    np.testing.assert_array_equal(seen[2:], expected)


def test_robots_in_worlds_of_their_own_drive_as_before_beside_a_team_of_one():
    tasks = [Task((-3.0, 0.0, 0.0), (3.0, 0.0))]
    observations = []
    for team in ({}, {"team": 1}):
        env = VectorNavigationEnv(1, world=HALL, physics="kinematic", memory="map", **team)
        env.reset(seed=3, options={"tasks": tasks})
        observations.append([env.step(AHEAD[:1])[0] for _ in range(20)])
    np.testing.assert_array_equal(*observations)


def test_the_map_of_a_robot_has_the_others_where_its_rays_met_them():
    env = pair(memory="map")
    begin(env, facing())
    maps = env.senses(np.arange(env.num_envs)).maps
    resolution, levels = 0.1, maps.levels[0]
    column, row = (
        int((place - origin) / resolution + 0.5)
        for place, origin in zip((1.0 - env.config.robot.radius, 0.0), maps.origins[0], strict=True)
    )
    assert levels[column - 1 : column + 2, row - 1 : row + 2].max() == levels.max()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"team": 3}, "team must divide num_envs = 2"),
        ({"team": 0}, "team must be"),
    ],
)
def test_a_team_that_does_not_divide_the_robots_is_rejected(change, message):
    with pytest.raises(ValueError, match=message):
        pair(**change)


def test_a_team_with_autoreset_is_rejected():
    with pytest.raises(ValueError, match="autoreset_mode must be DISABLED with team=2"):
        VectorNavigationEnv(2, world=HALL, team=2, physics="kinematic")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "tasks must have one for each robot of a team"),
        ({"tasks": [facing()[0]] * 2}, "must start 0.36 m apart"),
        ({"tasks": facing(), "reset_mask": np.array([True, False])}, "all robots of a team"),
        ({"tasks": facing(), "worlds": [HALL, World(name="other", size=(8.0, 8.0))]}, "one world"),
        (
            {
                "tasks": facing(),
                "worlds": [World(name="w", size=(8.0, 8.0), walkers=(Walker(),))] * 2,
            },
            "must have no walkers",
        ),
    ],
)
def test_a_start_that_a_team_cannot_make_together_is_rejected_and_nothing_begins(options, message):
    env = pair()
    with pytest.raises(ValueError, match=message):
        env.reset(seed=0, options=options)
    assert env.tasks == [None, None]
