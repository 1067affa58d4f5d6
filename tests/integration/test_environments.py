"""Where a run learns and where it is judged."""

from __future__ import annotations

import pytest

from environments import make_evaluation_env, make_training_env
from settings import Environment


@pytest.mark.parametrize(("robot", "radius"), [("turtlebot2", 0.18), ("burger", 0.105)])
def test_a_robot_learns_with_a_margin_and_is_judged_by_contact(robot: str, radius: float) -> None:
    settings = Environment(robot=robot, physics="kinematic", margin=0.1, progress_scale=3.0)
    training, judging = make_training_env("C", settings), make_evaluation_env("C", settings)
    learning = training.envs[0]
    assert learning.collision_distance == pytest.approx(radius + 0.1)
    assert judging.collision_distance == pytest.approx(radius)
    training.close()
    judging.close()


def test_an_unknown_robot_is_named() -> None:
    with pytest.raises(ValueError, match=r"robot must be .*got 'burgr'"):
        make_training_env("C", Environment(robot="burgr"))


def test_it_senses_alike_where_it_learns_and_where_it_is_judged() -> None:
    settings = Environment(physics="kinematic", margin=0.1, max_steps=40, action_repeat=3)
    training, judging = make_training_env("D", settings), make_evaluation_env("D", settings)
    training.set_seed(1)
    seen = training.reset()["observation"].numpy()
    task = training.envs[0].task
    assert judging.reset(options=task._asdict())[0] == pytest.approx(seen)
    for name in ("max_steps", "action_repeat", "closeness_distance", "physics"):
        assert getattr(judging, name) == getattr(training.envs[0], name)
    assert judging.closeness_distance == pytest.approx(0.28)
    training.close()
    judging.close()
