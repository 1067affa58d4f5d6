from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from mpfa_envs import (
    WORLDS,
    Box,
    Mirror,
    NavigationEnv,
    RandomMirror,
    TaskConfig,
    World,
    make_navigation_env,
)
from tests.envs.paper import paper_env


def mirrored(world: World) -> World:
    boxes = tuple(Box(box.x_min, -box.y_max, box.x_max, -box.y_min) for box in world.boxes)
    return World(name="mirrored", boxes=boxes)


ALL_AROUND: dict[str, Any] = {"sectors": 36, "memory": "map", "history": 2}
"""Observations of a robot that sees all around."""


@pytest.mark.parametrize("robot", ["kobuki", "turtlebot4", "burger", "waffle"])
def test_front_and_rear_are_those_of_a_robot_put_down_the_other_way_round(robot: str) -> None:
    sides = [Mirror(front_rear=each, **ALL_AROUND) for each in (False, True)]

    def turned(values: np.ndarray, what: str) -> np.ndarray:
        image = torch.from_numpy(values)
        for side in sides:
            image = getattr(side, what)(image)
        return image.numpy()

    task = {"robot": robot, "physics": "kinematic", "memory": "map", "history": 2}
    env, other = (NavigationEnv(world="D", **task) for _ in range(2))
    rng = np.random.default_rng(0)
    moved = 0.0
    for _ in range(3):
        seen, info = env.reset(seed=int(rng.integers(100)))
        (x, y, heading), goal = env.task
        image, _ = other.reset(options={"start": (x, y, heading + math.pi), "goal": goal})
        done = False
        for _ in range(25):
            np.testing.assert_allclose(image, turned(seen, "observation"), atol=2e-5)
            if done:
                break
            action = rng.uniform(-1.0, 1.0, 2).astype(np.float32)
            seen, reward, done, _, info = env.step(action)
            image, other_reward, other_done, _, _ = other.step(turned(action, "action"))
            assert other_done == done
            assert other_reward == pytest.approx(reward, abs=1e-5)
        moved += info["path_length"]
    assert moved > 1.0
    env.close()
    other.close()


@pytest.mark.parametrize(
    ("task", "mirrors"),
    [
        ({}, 1),
        ({"lidar": {"sectors": 36, "field_of_view": 360.0}}, 1),
        ({"robot": "kobuki"}, 2),
        ({"robot": "kobuki", "lidar": {"sectors": 27, "field_of_view": 270.0}}, 1),
        ({"robot": "kobuki", "lidar": {"sectors": 35, "field_of_view": 360.0}}, 1),
    ],
)
def test_a_task_has_the_mirrors_of_its_robot_and_lidar(task: dict[str, Any], mirrors: int) -> None:
    config = TaskConfig(memory="map", **task)
    transform = config.make_mirror()
    assert len(transform.mirrors) == mirrors
    low, _ = config.make_spaces(10.0)
    for mirror in transform.mirrors:
        assert mirror.observation(torch.rand(low.shape)).shape == low.shape


def test_a_quarter_of_the_transitions_is_seen_in_each_mirror_and_in_both() -> None:
    torch.manual_seed(0)
    rows = TensorDict(
        {
            "observation": torch.rand(800, 42),
            "action": torch.rand(800, 2),
            "next": {"observation": torch.rand(800, 42)},
        },
        [800],
    )
    shown = RandomMirror(sectors=36, front_rear=True)(rows.clone())
    left, right = rows["action"].unbind(1)
    for image in ((left, right), (right, left), (-left, -right), (-right, -left)):
        chosen = (shown["action"] == torch.stack(image, 1)).all(1)
        # 800 samples of a quarter: five standard deviations are 61.
        assert 139 < chosen.sum() < 261


def test_the_mirror_shows_the_view_in_the_mirrored_world(physics: str) -> None:
    world, mirror = WORLDS["D"], Mirror()
    env = paper_env(world=world, physics=physics)
    other = paper_env(world=mirrored(world), physics=physics)
    # A physics engine solves its contacts one after the other, and so not quite alike.
    tolerance = 1e-5 if physics == "kinematic" else 0.02
    rng = np.random.default_rng(0)
    for _ in range(3):
        seen, info = env.reset(seed=int(rng.integers(100)))
        (x, y, heading), (goal_x, goal_y) = env.task
        task = {"start": (x, -y, -heading), "goal": (goal_x, -goal_y)}
        image, other_info = other.reset(options=task)
        done = False
        for _ in range(15):
            expected = mirror.observation(torch.from_numpy(seen)).numpy()
            # With physics a ray may just pass a corner in one world that it hits in the other.
            differences = np.sort(np.abs(image - expected))
            assert differences[-1 if physics == "kinematic" else -2] < tolerance
            assert other_info["distance"] == pytest.approx(info["distance"], abs=tolerance)
            if done:
                break
            action = rng.uniform(-1.0, 1.0, 2).astype(np.float32)
            seen, reward, done, _, info = env.step(action)
            action = mirror.action(torch.from_numpy(action)).numpy()
            image, other_reward, other_done, _, other_info = other.step(action)
            assert other_done == done
            assert other_reward == pytest.approx(reward, abs=tolerance)
    env.close()
    other.close()


def sample(chance: float, *, seed: int = 0) -> tuple[TensorDict, TensorDict]:
    """Rollout, and a batch sampled from a buffer with the transform."""
    env = make_navigation_env("C", physics="kinematic", seed=0)
    torch.manual_seed(0)
    rollout = env.rollout(30)
    env.close()
    transform = RandomMirror(chance=chance, generator=torch.Generator().manual_seed(seed))
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(100), batch_size=400, transform=transform
    )
    buffer.extend(rollout)
    return rollout, buffer.sample()


def test_half_of_the_transitions_are_mirrored_each_as_a_whole() -> None:
    rollout, batch = sample(0.5)
    mirror, stored = Mirror(), rollout[batch["index"]]
    images = stored.clone()
    for key in ("observation", ("next", "observation")):
        images[key] = mirror.observation(stored[key])
    images["action"] = mirror.action(stored["action"])
    keys = ("observation", "action", ("next", "observation"))
    same = {key: (batch[key] == stored[key]).all(-1) for key in keys}
    swapped = {key: (batch[key] == images[key]).all(-1) for key in keys}
    as_it_was = torch.stack(list(same.values())).all(0)
    in_the_mirror = torch.stack(list(swapped.values())).all(0)
    assert (as_it_was ^ in_the_mirror).all()
    # 400 samples of one half: five standard deviations are 50.
    assert 150 < in_the_mirror.sum() < 250
    assert batch["next", "reward"].equal(stored["next", "reward"])


def test_the_action_without_noise_is_mirrored_with_the_action() -> None:
    rows = TensorDict(
        {
            "observation": torch.rand(6, 24),
            "action": torch.rand(6, 2),
            "behavior_mean": torch.rand(6, 2),
            "behavior_sigma": torch.rand(6, 1),
            "next": {"observation": torch.rand(6, 24)},
        },
        [6],
    )
    found = RandomMirror(chance=1.0)(rows.clone())
    for key in ("action", "behavior_mean"):
        assert found[key].equal(rows[key].flip(-1))
    assert found["behavior_sigma"].equal(rows["behavior_sigma"])
