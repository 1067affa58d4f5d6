"""Many robots in the worlds of a generator."""

from __future__ import annotations

import pytest

from mpfa_envs import (
    Box,
    Task,
    VectorNavigationEnv,
    World,
)
from mpfa_envs.env import episodes
from mpfa_envs.generators.generate import generate_world


def make(num_envs: int, world: str, **kwargs: object) -> VectorNavigationEnv:
    return VectorNavigationEnv(num_envs, **{"world": world, "physics": "kinematic"} | kwargs)


def names(env: VectorNavigationEnv, resets: int) -> list[list[str]]:
    return [[world.name for world in env.worlds] for _ in range(resets) if env.reset()]


def test_each_episode_is_in_a_new_world() -> None:
    env = make(2, "bars")
    env.reset(seed=3)
    seen = [world for row in names(env, 5) for world in row]
    assert len(set(seen)) == 10
    assert all(name.startswith("bars-") for name in seen)


def test_a_world_can_be_kept_for_some_episodes() -> None:
    env = make(1, "clutter", episodes_per_world=3)
    env.reset(seed=3)
    rows = [env.worlds[0].name] + [row[0] for row in names(env, 6)]
    assert rows[0] == rows[1] == rows[2] != rows[3] == rows[4] == rows[5] != rows[6]
    tasks = []
    env.reset(seed=3)
    assert env.worlds[0].name == rows[0]  # A seed starts again.
    tasks.append(env.tasks[0])
    env.reset()
    assert env.tasks[0] not in tasks


def test_validation_worlds_are_others_than_those_of_training() -> None:
    env = make(4, "mazes", split="validation", difficulty=0.3)
    env.reset(seed=0)
    for world in env.worlds:
        assert world.name.startswith("mazes-validation-") and world.name.endswith("@0.3")


def test_a_world_without_a_task_is_replaced_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    full = World(name="full", size=(4.0, 4.0), boxes=(Box(-1.9, -1.9, 1.9, 1.9),))
    asked = []

    def sometimes(name: str, seed: int, *, difficulty: float | None = None) -> World:
        asked.append(seed)
        if len(asked) % 3:
            return full
        return generate_world(name, seed, difficulty=difficulty)

    monkeypatch.setattr(episodes, "generate_world", sometimes)
    env = make(2, "bars")
    assert env.worlds_rejected == 0
    env.reset(seed=0)
    env.reset()
    assert env.worlds_rejected == 2 * 4
    assert len(asked) == 3 * 5
    assert all(world.name != "full" for world in env.worlds)


def test_a_task_needs_its_world_where_worlds_come_and_go() -> None:
    env = make(2, "bars")
    task = Task((0.0, 0.0, 0.0), (3.0, 0.0))
    with pytest.raises(ValueError, match="robot 0: world must be given"):
        env.reset(options={"tasks": [task, None]})
    env.reset(seed=0, options={"worlds": ["A", None], "tasks": [task, None]})
    assert env.worlds[0].name == "A" and env.worlds[1].name.startswith("bars-")
    env.reset()
    assert env.worlds[0].name.startswith("bars-")
