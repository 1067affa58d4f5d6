"""Many robots in the worlds of a generator."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from mpfa_envs import (
    ENV_IDS,
    GENERATORS,
    WORLDS,
    Box,
    Task,
    VectorNavigationEnv,
    World,
)
from mpfa_envs.env import episodes
from mpfa_envs.generators.generate import generate_world, resolve_world
from mpfa_envs.paths.distance import DistanceField, FreeGrid

GENERATOR_IDS = [each for each in ENV_IDS if each.split("-")[1] not in WORLDS]


def make(num_envs: int, world: str, **kwargs: object) -> VectorNavigationEnv:
    return VectorNavigationEnv(num_envs, **{"world": world, "physics": "kinematic"} | kwargs)


def names(env: VectorNavigationEnv, resets: int) -> list[list[str]]:
    return [[world.name for world in env.worlds] for _ in range(resets) if env.reset()]


@pytest.mark.parametrize("env_id", GENERATOR_IDS)
def test_every_generator_has_an_id_for_one_robot_or_many(env_id: str) -> None:
    assert len(GENERATOR_IDS) == len(GENERATORS)
    env = gymnasium.make_vec(env_id, num_envs=3, physics="kinematic")
    observations, _ = env.reset(seed=0)
    kind = env_id.split("-")[1].lower()
    assert kind in GENERATORS
    single = gymnasium.make(env_id, physics="kinematic")
    assert len({single.reset(seed=seed) and single.unwrapped.world.name for seed in (0, None)}) == 2
    assert len({world.name for world in env.worlds}) == 3
    for world in env.worlds:
        assert world == resolve_world(world.name)
    for _ in range(20):
        assert env.observation_space.contains(observations)
        observations, *_ = env.step(np.full((3, 2), 0.4, dtype=np.float32))
    env.close()


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


@pytest.mark.parametrize("kind", GENERATORS)
def test_every_task_can_be_solved_at_the_collision_distance(kind: str) -> None:
    env = make(6, kind, max_goal_distance=6.0)
    env.reset(seed=1)
    for world, task in zip(env.worlds, env.tasks, strict=True):
        field = DistanceField(FreeGrid(world, distance=env.config.collision_distance), task.goal)
        assert 1.9 <= field.at(*task.start[:2]) <= 6.1
        assert world.clearance(*task.start[:2]) > env.config.collision_distance


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


def test_a_replacement_world_is_kept_for_as_many_episodes() -> None:
    env = VectorNavigationEnv(1, world="clutter", physics="kinematic", episodes_per_world=3)
    env.reset(seed=0)
    full = World(name="full", boxes=(Box(-5.0, -5.0, 5.0, 5.0),))
    env._source._worlds[0], env._source._left[0] = full, 1
    names = []
    for _ in range(4):
        env.reset()
        names.append(env.worlds[0].name)
    assert len(set(names[:3])) == 1 and names[3] != names[0]
