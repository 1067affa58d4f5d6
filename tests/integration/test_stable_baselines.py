"""Stable-Baselines3 on many robots: what it is told, and a policy that is one of this project."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")

import stable_baselines
from mpfa_envs import VectorNavigationEnv, evaluate, load_policy

pytestmark = pytest.mark.filterwarnings("ignore")


def make_robots(count: int = 2, **arguments: object) -> stable_baselines.Robots:
    options = {"physics": "kinematic", "world": "B", "max_steps": 6, **arguments}
    mode = AutoresetMode.SAME_STEP
    return stable_baselines.Robots(VectorNavigationEnv(count, autoreset_mode=mode, **options))


def test_the_last_observation_of_an_episode_is_told_and_a_timeout_is_one() -> None:
    robots = make_robots()
    robots.seed(3)
    first = robots.reset()
    twin = VectorNavigationEnv(
        2, world="B", physics="kinematic", max_steps=6, autoreset_mode=AutoresetMode.DISABLED
    )
    seen, _ = twin.reset(seed=[3, 4])
    np.testing.assert_array_equal(first, seen)
    actions = np.array([[0.2, 0.5], [0.5, 0.2]], np.float32)
    for number in range(3):
        now, rewards, ended, infos = robots.step(actions)
        seen, want, *_ = twin.step(actions)
        assert ended.tolist() == [number == 2] * 2
        np.testing.assert_allclose(rewards, want, rtol=1e-6)
    for robot in range(2):
        np.testing.assert_array_equal(infos[robot]["terminal_observation"], seen[robot])
        assert infos[robot]["TimeLimit.truncated"] and not infos[robot]["is_success"]
    assert np.abs(now - seen).max() > 0.1  # Another episode has begun.
    robots.close()


def test_another_mode_raises() -> None:
    with pytest.raises(ValueError, match=r"env must have AutoresetMode\.SAME_STEP, got"):
        stable_baselines.Robots(VectorNavigationEnv(1, physics="kinematic"))


@pytest.mark.parametrize("algorithm", ["sac", "td3"])
def test_a_trained_policy_is_one_of_this_project(tmp_path: Path, algorithm: str) -> None:
    words = f"{algorithm} --world A --robots 4 --actions 1100 --output {tmp_path}".split()
    policy = load_policy(stable_baselines.main(words))
    assert policy.card["learner"] == f"stable-baselines3 {algorithm}"
    assert policy.card["steps"] == 1100
    assert len(evaluate(policy, "A", episodes=2)) == 2


@pytest.mark.parametrize("algorithm", ["sac", "td3"])
def test_the_policy_acts_as_the_model_does(algorithm: str) -> None:
    robots = make_robots(3, memory="map")
    model = stable_baselines.make_model(algorithm, robots, learning_starts=0, seed=0)
    model.learn(30)
    seen = robots.reset()
    want, _ = model.predict(seen, deterministic=True)
    found = stable_baselines.policy_of(model, card={})(seen)
    np.testing.assert_allclose(found, want, atol=1e-5)
    robots.close()
