"""Counts that would take all time or memory are rejected, wherever they are given."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mpfa_envs import (
    WORLDS,
    Lidar,
    Mirror,
    NavigationEnv,
    Policy,
    RobotNoise,
    VectorNavigationEnv,
    evaluate,
    make_navigation_env,
    world_tasks,
)
from mpfa_envs.generators import generator_tasks, split_worlds
from mpfa_envs.planners import DynamicWindow
from mpfa_envs.policies.layers import Linear
from mpfa_envs.tasks.sampling import evaluation_pairs

MANY = 2**31


def of_a_policy(**env_arguments: object) -> Callable[[], object]:
    """The evaluation of a policy whose file asks for these arguments."""
    layers = [Linear(np.ones((2, 24), np.float32), np.zeros(2, np.float32))]
    policy = Policy(layers, env_arguments=env_arguments)
    return lambda: evaluate(policy, "A", episodes=1, physics="kinematic")


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("num_envs", lambda: VectorNavigationEnv(MANY)),
        ("num_envs", lambda: make_navigation_env("A", num_envs=MANY)),
        ("num_envs", lambda: make_navigation_env("A", num_envs=MANY, parallel=True)),
        ("episodes", lambda: evaluate(DynamicWindow(), "A", episodes=MANY)),
        ("envs_at_once", lambda: evaluate(DynamicWindow(), "A", episodes=1, envs_at_once=MANY)),
        ("episodes", lambda: world_tasks("bars:test", episodes=MANY)),
        ("n", lambda: evaluation_pairs("A", MANY, seed=0)),
        ("count", lambda: split_worlds("bars", "test", MANY)),
        ("count", lambda: generator_tasks("bars", "test", worlds=MANY)),
        ("tasks", lambda: generator_tasks("bars", "test", tasks=MANY)),
        ("max_steps", lambda: NavigationEnv(physics="kinematic", max_steps=MANY)),
        ("action_repeat", lambda: NavigationEnv(physics="kinematic", action_repeat=MANY)),
        ("sectors", lambda: Mirror(sectors=MANY)),
        ("latency", lambda: RobotNoise(latency=MANY)),
        ("rays_per_sector", lambda: Lidar(WORLDS["A"], rays_per_sector=MANY)),
        (r"sectors \* rays_per_sector", lambda: Lidar(WORLDS["A"], sectors=99_999)),
        ("sectors", of_a_policy(lidar={"sectors": MANY})),
        ("history", of_a_policy(history=MANY)),
        (r"sectors \* history", of_a_policy(history=99_999)),
        ("latency", of_a_policy(noise={"latency": MANY})),
        ("max_steps", of_a_policy(max_steps=MANY)),
    ],
)
def test_a_count_beyond_bounds_is_rejected_at_once(name: str, call: Callable[[], object]) -> None:
    with pytest.raises(ValueError, match=rf"^{name} must be at most 1000*, got [0-9]+$"):
        call()


def test_a_seed_may_be_as_large_as_any() -> None:
    env = NavigationEnv(world="A", physics="kinematic")
    assert env.reset(seed=2**60)[1] == env.reset(seed=2**60)[1]
    assert VectorNavigationEnv(1, physics="kinematic").reset(seed=2**200)
    assert evaluation_pairs("A", 1, seed=2**200)
