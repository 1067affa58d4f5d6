"""Where a run learns and where its policy is judged."""

from __future__ import annotations

import pytest

from mpfa_envs import NavigationEnv
from navigation.environments import env_arguments, make_training_env
from navigation.settings import EnvironmentSettings


@pytest.mark.parametrize(("robot", "radius"), [("turtlebot2", 0.18), ("burger", 0.105)])
def test_a_robot_learns_with_a_clearance(robot: str, radius: float) -> None:
    settings = EnvironmentSettings(
        robot=robot, physics="kinematic", clearance=0.1, progress_scale=3.0
    )
    training = make_training_env("C", settings)
    assert training.envs[0].collision_distance == pytest.approx(radius + 0.1)
    assert env_arguments(settings)["closeness_distance"] == pytest.approx(radius + 0.1)
    training.close()


def test_it_senses_alike_where_it_learns_and_where_it_is_judged() -> None:
    settings = EnvironmentSettings(
        physics="kinematic", clearance=0.1, max_steps=40, action_repeat=3
    )
    training = make_training_env("D", settings)
    judging = NavigationEnv(world="D", collision_distance="contact", **env_arguments(settings))
    training.set_seed(1)
    seen = training.reset()["observation"].numpy()
    task = training.envs[0].task
    assert judging.reset(options=task._asdict())[0] == pytest.approx(seen)
    for name in ("max_steps", "action_repeat", "closeness_distance", "physics"):
        assert getattr(judging, name) == getattr(training.envs[0], name)
    assert judging.closeness_distance == pytest.approx(0.28)
    training.close()
    judging.close()
