"""One robot in worlds that are new in each episode, and the id of it."""

from __future__ import annotations

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
    VectorNavigationEnv,
    navigation_reward,
)
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


@pytest.mark.filterwarnings("ignore")
def test_gymnasium_records_a_video_of_it(tmp_path: Path) -> None:
    pytest.importorskip("moviepy", reason="an extra")
    env = RecordVideo(gymnasium.make("mpfa/Rooms-v1", render_mode="rgb_array"), str(tmp_path))
    env.reset(seed=0)
    env.step(ACTIONS[0])
    env.close()
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 1000
