"""One robot in worlds that are new in each episode, and the id of it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RecordVideo

from mpfa_envs import (
    ROBOTS,
    ROOMS_TASK,
    NavigationEnv,
    TaskConfig,
    VectorNavigationEnv,
    generate_world,
    navigation_reward,
)
from mpfa_envs.generators.generate import generator_tasks
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from mpfa_envs.sensing.observation import INFO_TYPES
from mpfa_envs.tasks.reward import payments_of

ACTIONS = np.random.default_rng(7).uniform(-1, 1, (60, 2)).astype(np.float32)


@pytest.fixture
def env():
    made = gymnasium.make("mpfa/Rooms-v1").unwrapped
    yield made
    made.close()


def test_the_id_makes_one_robot_or_many_of_one_task(env: NavigationEnv) -> None:
    many = gymnasium.make_vec("mpfa/Rooms-v1", num_envs=3)
    assert isinstance(env, NavigationEnv)
    assert isinstance(many, VectorNavigationEnv)
    for name, value in ROOMS_TASK.items():
        if name not in ("world", "max_goal_distance", "reward"):
            wanted = ROBOTS["kobuki"] if name == "robot" else value
            assert getattr(env.config, name) == getattr(many.config, name) == wanted
    # Gymnasium copies what it makes an environment with.
    paid = [payments_of(each.config.reward_function) for each in (env, many)]
    assert paid == [payments_of(partial(navigation_reward, step_cost=0.05))] * 2
    assert env.observation_space == many.single_observation_space
    # The same worlds, if each robot has the seed itself.
    many.reset(seed=[5, 6, 7])
    for robot, seed in enumerate((5, 6, 7)):
        env.reset(seed=seed)
        assert env.world == many.worlds[robot]
        assert env.task == many.tasks[robot]
    many.close()


@pytest.mark.parametrize("robot", [*ROBOTS, replace(ROBOTS["kobuki"], name="cart", radius=0.28)])
def test_the_task_keeps_its_clearance_of_the_rim_of_each_robot(robot: RobotChoice) -> None:
    task = TaskConfig(
        **{name: ROOMS_TASK[name] for name in ROOMS_TASK.keys() - {"world", "max_goal_distance"}}
        | {"robot": robot}
    )
    radius = resolve_robot(robot).radius
    assert task.collision_distance == pytest.approx(radius + 0.02, abs=1e-12)
    assert task.closeness_distance == pytest.approx(radius + 0.02, abs=1e-12)
    judged = replace(task, contact=True)
    assert (judged.collision_distance, judged.closeness_distance) == (
        radius,
        task.closeness_distance,
    )


def test_a_seed_repeats_worlds_that_change_with_each_episode(env: NavigationEnv) -> None:
    seen = []
    for seed in (3, None, None, None, np.int64(3), None):
        observation, info = env.reset(seed=seed)
        assert env.observation_space.contains(observation)
        assert tuple(info) == tuple(INFO_TYPES)
        seen.append(env.world.name)
    assert len(set(seen[:4])) == 4
    assert seen[4:] == seen[:2]


def test_an_episode_can_be_fixed(env: NavigationEnv) -> None:
    env.reset(seed=0, options={"world": "bars-7"})
    assert env.world == generate_world("bars", 7)
    ((world, task),) = generator_tasks("clutter", "validation", worlds=1, tasks=1)
    env.reset(options={"world": world, **task._asdict()})
    assert (env.world, env.task) == (world, task)
    env.reset()
    assert env.world != world
    assert env.task != task


@pytest.mark.filterwarnings("ignore")
def test_gymnasium_records_a_video_of_it(tmp_path: Path) -> None:
    pytest.importorskip("moviepy", reason="an extra")
    env = RecordVideo(gymnasium.make("mpfa/Rooms-v1", render_mode="rgb_array"), str(tmp_path))
    env.reset(seed=0)
    env.step(ACTIONS[0])
    env.close()
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 1000
