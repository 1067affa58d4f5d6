"""An action that is held for several time steps."""

from __future__ import annotations

import numpy as np
import pytest

from mpfa_envs import NavigationEnv
from tests.envs.paper import drive_to_end, full_speed

STRAIGHT = {"start": (0.0, 0.0, 0.0), "goal": (2.98, 0.0)}


def make_env(repeat: int, **arguments: object) -> NavigationEnv:
    env = NavigationEnv(action_repeat=repeat, **{"physics": "kinematic", **arguments})
    env.reset(seed=0, options=STRAIGHT)
    return env


@pytest.mark.parametrize("physics", ["kinematic", "wheels"])
def test_a_held_action_equals_the_same_action_given_again(physics: str) -> None:
    held, single = make_env(3, physics=physics), make_env(1, physics=physics)
    for action in np.random.default_rng(0).uniform(-1.0, 1.0, (5, 2)).astype(np.float32):
        observation, reward, *_, info = held.step(action)
        steps = [single.step(action) for _ in range(3)]
        assert np.array_equal(observation, steps[-1][0])
        assert reward == pytest.approx(sum(step[1] for step in steps))
        for name in ("x", "y", "heading", "sim_time", "path_length", "min_clearance"):
            assert info[name] == steps[-1][4][name], name
    assert held.trail == single.trail
    held.close(), single.close()


def test_the_episode_ends_at_the_time_step_at_the_goal() -> None:
    ends = []
    for repeat in (1, 4):
        env = NavigationEnv(action_repeat=repeat, physics="kinematic")
        total, _, truncated, info = drive_to_end(env, full_speed, goal=(2.98, 0.0))
        assert info["success"] and not truncated
        ends.append((info["sim_time"], info["x"], pytest.approx(total)))
    assert ends[0] == ends[1]
    # 2.48 m at 0.05 m a time step: 50 of them, which four do not divide.
    assert ends[0][0] == pytest.approx(5.0)


def test_a_held_action_cannot_pass_through_an_obstacle() -> None:
    env = NavigationEnv(world="B", physics="kinematic", contact=True, action_repeat=100)
    env.reset(seed=0, options={"start": (0.0, 0.0, 0.0), "goal": (4.0, 0.0)})
    *_, terminated, _, info = env.step([1.0, 1.0])
    assert terminated and info["collision"]
    assert info["min_clearance"] > -0.05
