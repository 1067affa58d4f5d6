"""A vector environment goes on where another one was, in the middle of episodes."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from mpfa_envs import VectorNavigationEnv
from mpfa_envs.plain_worlds import world_from_plain, world_to_plain
from tests.envs.shapes import random_shapes


def actions_of(step: int, robots: int) -> np.ndarray:
    return np.random.default_rng(step).uniform(-0.3, 1.0, (robots, 2)).astype(np.float32)


def drive(env: VectorNavigationEnv, first: int, last: int) -> bytes:
    """All that steps show, as bytes."""
    seen = []
    for step in range(first, last):
        observations, rewards, terminated, truncated, infos = env.step(
            actions_of(step, env.num_envs)
        )
        seen += [observations, rewards, terminated, truncated, infos["path_length"], infos["x"]]
    return b"".join(array.tobytes() for array in seen)


CASES: list[dict[str, Any]] = [
    {"world": ["B", "D", "test"]},
    {"world": "bars", "progress": "shortest_path", "lidar": {"noise": 0.02}},
    {"world": "mixed", "episodes_per_world": 3, "autoreset_mode": AutoresetMode.SAME_STEP},
    {"world": ["A", "D"], "physics": "wheels"},
    {"world": "bars", "memory": "map"},
]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_what_follows_is_the_same_to_the_bit(case: dict[str, Any]) -> None:
    if case.get("physics") == "wheels":
        pytest.importorskip("pybullet", reason="PyBullet has wheels for Python 3.11 and earlier")
    case = {"physics": "kinematic"} | case

    def make() -> VectorNavigationEnv:
        return VectorNavigationEnv(4, **case)

    env, other = make(), make()
    env.reset(seed=1)
    drive(env, 0, 45)
    state = env.state_dict()
    expected = drive(env, 45, 100)
    other.reset(seed=2)
    drive(other, 0, 7)
    other.load_state_dict(state)
    np.testing.assert_array_equal(other.observations, state["batch"]["observations"])
    assert drive(other, 45, 100) == expected
    assert other.tasks == env.tasks and other.worlds == env.worlds
    assert [other.trail(i) for i in range(4)] == [env.trail(i) for i in range(4)]
    assert other.worlds_refused == env.worlds_refused
    env.close()
    other.close()


def test_wheels_are_restored_at_the_start_of_an_episode_too() -> None:
    pytest.importorskip("pybullet", reason="PyBullet has wheels for Python 3.11 and earlier")
    env, other = (VectorNavigationEnv(2, world="A", physics="wheels") for _ in range(2))
    env.reset(seed=1)
    drive(env, 0, 10)
    env.reset(options={"reset_mask": np.array([False, True])})
    state = env.state_dict()
    other.reset(seed=2)
    drive(other, 0, 7)
    other.load_state_dict(state)
    assert drive(other, 10, 30) == drive(env, 10, 30)
    env.close()
    other.close()


def test_a_state_is_plain_values_and_arrays() -> None:
    env = VectorNavigationEnv(2, world="clutter", physics="kinematic")
    env.load_state_dict(env.state_dict())  # Before the first reset there is little in it.
    env.reset(seed=0)
    drive(env, 0, 3)

    def plain(value: object) -> object:
        assert isinstance(value, (np.ndarray, np.generic)), type(value)
        return value.tolist()

    json.dumps(env.state_dict(), default=plain)
    state = env.state_dict()
    before = state["batch"]["motions"].copy()
    drive(env, 3, 6)
    np.testing.assert_array_equal(state["batch"]["motions"], before)


def test_any_world_is_the_same_after_it_was_plain() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        world = random_shapes(rng, boxes=3, cylinders=3, polygons=3)
        assert world_from_plain(world_to_plain(world)) == world


def without(*keys: str) -> Callable[[dict[str, Any]], None]:
    def spoil(state: dict[str, Any]) -> None:
        *way, last = keys
        for key in way:
            state = state[key]
        del state[last]

    return spoil


def with_value(value: object, *keys: str) -> Callable[[dict[str, Any]], None]:
    def spoil(state: dict[str, Any]) -> None:
        *way, last = keys
        for key in way:
            state = state[key]
        state[last] = value

    return spoil


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (without("arguments"), "state must be what state_dict.* gave"),
        (with_value("wheels", "arguments", "physics"), "physics = 'kinematic', got .*'wheels'"),
        (with_value(5, "arguments", "num_envs"), "num_envs = 2, got one with 5"),
        (with_value([{}, {}], "rngs"), "rngs of the state must be of PCG64, got {}"),
        (with_value([{}], "rngs"), "rngs of the state must have 2 entries"),
        (without("batch", "motions"), r"motions of the state must have shape \(2, 5\), got \(\)"),
        (with_value(np.zeros((3, 5)), "batch", "motions"), r"motions .* \(2, 5\), got \(3, 5\)"),
        (with_value([None], "batch", "tasks"), "tasks of the state must have 2 entries"),
        (with_value([{}, {}], "batch", "worlds"), "worlds must hold the fields of a World"),
        (with_value("map", "arguments", "memory"), "memory = 'none', got one with 'map'"),
        (with_value([3, 4], "batch", "tasks"), "task must be a start and a goal, got 3"),
    ],
)
def test_what_is_no_state_of_this_environment_is_refused(
    spoil: Callable[[dict[str, Any]], None], message: str
) -> None:
    env = VectorNavigationEnv(2, world="B", physics="kinematic")
    env.reset(seed=0)
    drive(env, 0, 5)
    twin = VectorNavigationEnv(2, world="B", physics="kinematic")
    twin.load_state_dict(env.state_dict())
    state = env.state_dict()
    spoil(state)
    with pytest.raises(ValueError, match=message):
        env.load_state_dict(state)
    assert drive(env, 5, 40) == drive(twin, 5, 40)
