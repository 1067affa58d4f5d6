from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest

from mpfa_envs import (
    WORLDS,
    NavigationEnv,
    RewardTerms,
    StepOutcome,
    Task,
    VectorNavigationEnv,
    World,
    navigation_reward,
)
from mpfa_envs.paths.distance import DistanceField, FreeGrid


def outcome(before: float, after: float, *, success: bool = False, collision: bool = False):
    return StepOutcome(before, after, success, collision, 1.0, 0.3, 0.0)


def test_approaching_is_rewarded_and_leaving_costs() -> None:
    assert navigation_reward(outcome(2.0, 1.9)).total == pytest.approx(0.5)
    assert navigation_reward(outcome(1.9, 2.0)).total == pytest.approx(-0.5)


SCALES = {"goal_reward": 3, "collision_reward": -7.0, "progress_scale": 2.0, "step_cost": 0.25}


@pytest.mark.parametrize(
    ("step", "terms"),
    [
        (outcome(2.0, 1.5), (0.0, 0.0, 1.0, -0.25)),
        (outcome(1.5, 2.0), (0.0, 0.0, -1.0, -0.25)),
        (outcome(2.0, 1.5, success=True), (3.0, 0.0, 0.0, 0.0)),
        (outcome(2.0, 1.5, collision=True), (0.0, -7.0, 0.0, 0.0)),
    ],
)
def test_each_term_has_the_sign_and_the_size_of_the_equation(step, terms) -> None:
    assert navigation_reward(step, **SCALES) == terms


@pytest.mark.parametrize(
    ("start", "goal", "terms"),
    [
        # Two time steps of 0.05 m, ahead to the goal, away from it, to its rim, and to the wall.
        ((0.0, 0.0, 0.0), (3.0, 0.0), (0.0, 0.0, 0.2, -0.5)),
        ((0.0, 0.0, math.pi), (3.0, 0.0), (0.0, 0.0, -0.2, -0.5)),
        ((0.0, 0.0, 0.0), (0.59, 0.0), (3.0, 0.0, 0.1, -0.25)),
        ((4.66, 0.0, 0.0), (-3.0, 0.0), (0.0, -7.0, -0.1, -0.25)),
    ],
)
def test_a_driven_step_is_paid_by_the_equation(start, goal, terms) -> None:
    env = VectorNavigationEnv(
        2,
        world=World(name="empty"),
        physics="kinematic",
        action_repeat=2,
        reward=partial(navigation_reward, **SCALES),
    )
    env.reset(seed=0, options={"tasks": [Task(start, goal), Task((0.0, 0.0, 0.0), (4.0, 4.0))]})
    *_, infos = env.step(np.ones((2, 2), np.float32))
    names = ("goal", "collision", "progress", "other")
    paid = [infos[f"reward_{name}"][0] for name in names]
    np.testing.assert_allclose(paid, terms, atol=1e-9)


def one_robot(**arguments: object) -> float:
    """The reward of one step."""
    with NavigationEnv(physics="kinematic", action_repeat=1, **arguments) as env:
        env.reset(seed=0)
        return env.step(np.ones(2))[1]


def two_robots(**arguments: object) -> float:
    """The first one's reward of one step."""
    env = VectorNavigationEnv(2, physics="kinematic", action_repeat=1, **arguments)
    env.reset(seed=0)
    return float(env.step(np.ones((2, 2)))[1][0])


@pytest.mark.parametrize(
    ("terms", "shown"),
    [
        (1.0, "got 1.0"),
        (None, "got None"),
        ((1.0, 2.0), r"got \(1.0, 2.0\)"),
        (np.ones(1), r"got array\(\[1.\]\)"),
        ("1234", "got '1234'"),
        (RewardTerms(progress=math.nan), "got RewardTerms.*nan"),
    ],
)
def test_a_reward_without_four_finite_numbers_is_rejected(terms, shown) -> None:
    with pytest.raises(ValueError, match=f"reward must give RewardTerms of four .*{shown}"):
        two_robots(reward=lambda outcome: terms)


@pytest.mark.parametrize("step", [one_robot, two_robots])
def test_any_four_numbers_are_the_terms_of_a_reward(step) -> None:
    assert step(reward=lambda outcome: np.array([1, 2, 3, 4])) == 10.0


@pytest.mark.parametrize("make", [NavigationEnv, partial(VectorNavigationEnv, 2)])
def test_a_bad_payment_is_rejected_before_anything_is_built(make) -> None:
    reward = partial(navigation_reward, goal_reward=math.inf)
    with pytest.raises(ValueError, match="goal_reward must be a finite number, got inf"):
        make(reward=reward)
    with pytest.raises(ValueError, match=r"reward must have keywords of .*'goal'"):
        make(reward=partial(navigation_reward, goal=20.0))


@pytest.mark.parametrize("step", [one_robot, two_robots])
def test_without_progress_an_approach_is_not_rewarded(step) -> None:
    reward = partial(navigation_reward, goal_reward=20.0, progress_scale=3.0)
    assert step(reward=reward) != 0.0
    assert step(reward=reward, progress="none") == 0.0


def test_progress_along_the_shortest_path_is_the_difference_of_its_lengths() -> None:
    options = {"physics": "kinematic", "progress_scale": 2.0, "detour_chance": 1.0}
    env = VectorNavigationEnv(3, world="D", progress="shortest_path", **options)
    env.reset(seed=0)
    grid = FreeGrid(WORLDS["D"], distance=env.config.collision_distance)
    fields = [DistanceField(grid, task.goal) for task in env.tasks if task is not None]
    before = [field.at(*pose[:2]) for field, pose in zip(fields, env.poses, strict=True)]
    for _ in range(3):
        _, rewards, *ended, _ = env.step(np.full((3, 2), 0.5))
        assert not np.any(ended)
        after = [field.at(*pose[:2]) for field, pose in zip(fields, env.poses, strict=True)]
        np.testing.assert_allclose(rewards, 2.0 * np.subtract(before, after), atol=1e-9)
        before = after
    env.close()
