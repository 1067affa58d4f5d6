from __future__ import annotations

import hashlib
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from mpfa_envs import (
    ROBOTS,
    WORLDS,
    NavigationEnv,
    RewardTerms,
    TaskConfig,
)
from mpfa_envs.sensing.observation import INFO_TYPES
from tests.envs.paper import drive_to_end, full_speed, paper_env
from tests.envs.process import run

STRAIGHT = {"start": (0.0, 0.0, 0.0), "goal": (2.98, 0.0)}


def rolled(physics: str, *, world: str = "D", episodes_before: int = 0) -> str:
    """Hash of a seeded drive, after other episodes in the same environment."""
    env = paper_env(world=world, physics=physics)
    rng = np.random.default_rng(99)
    for _ in range(episodes_before):
        env.reset(seed=int(rng.integers(1000)))
        for _ in range(7):
            if any(env.step(rng.uniform(-1, 1, 2).astype(np.float32))[2:4]):
                break
    digest = hashlib.sha256()
    observation, _ = env.reset(seed=5)
    actions = np.random.default_rng(7).uniform(-1, 1, (40, 2)).astype(np.float32)
    for action in actions:
        digest.update(observation.tobytes())
        observation, reward, terminated, truncated, info = env.step(action)
        digest.update(np.array([reward, info["x"], info["y"], info["heading"]]).tobytes())
        if terminated or truncated:
            observation, _ = env.reset()
    env.close()
    return digest.hexdigest()


@pytest.mark.parametrize("env_id", ["mpfa/Rooms-v1", "mpfa/Navigation-D-v1"])
def test_an_id_passes_the_checker_without_a_warning(env_id: str, physics: str) -> None:
    env = gymnasium.make(env_id, physics=physics)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)
    env.close()


def test_without_pybullet_kinematics_drives_and_wheels_say_what_they_need() -> None:
    code = """
from mpfa_envs import NavigationEnv, evaluate
ahead = lambda seen: [1.0, 1.0]
assert len(evaluate(ahead, "B", episodes=2, physics="kinematic")) == 2
for make in (NavigationEnv, lambda: evaluate(ahead, "B", episodes=2)):
    try:
        make()
    except ImportError as error:
        print(error)
"""
    lines = run(code, without=["pybullet"]).splitlines()
    assert len(lines) == 2
    assert all("Python 3.11 and earlier" in line for line in lines)
    assert all("physics='kinematic'" in line for line in lines)


def test_the_same_seed_gives_the_same_bits_after_other_episodes(physics: str) -> None:
    assert rolled(physics) == rolled(physics, episodes_before=5)


def test_close_twice_is_fine_and_the_server_is_gone() -> None:
    import pybullet

    env = paper_env(physics="wheels")
    client = env.robots._batch.drives._simulations[0].client
    assert pybullet.isConnected(physicsClientId=client)
    env.close()
    env.close()
    assert not pybullet.isConnected(physicsClientId=client)


def test_the_goal_ends_an_episode_with_success() -> None:
    env = paper_env(physics="kinematic")
    env.reset(options=STRAIGHT)
    for _ in range(49):
        _, reward, terminated, _, info = env.step([1.0, 1.0])
        assert not terminated and not info["success"]
        assert reward == info["reward_progress"] == pytest.approx(15 * 0.05)
    _, reward, terminated, truncated, info = env.step([1.0, 1.0])
    assert (reward, terminated, truncated) == (10.0, True, False)
    assert (info["success"], info["collision"], info["timeout"]) == (True, False, False)
    assert info["path_length"] == pytest.approx(2.5)
    assert info["shortest_path"] == pytest.approx(2.48)
    assert info["sim_time"] == pytest.approx(5.0)


def test_the_info_has_the_same_keys_and_types_always(physics: str) -> None:
    env = paper_env(world="C", physics=physics, max_steps=30)
    for seed in range(3):
        _, info = env.reset(seed=seed)
        done = False
        while not done:
            assert {key: type(value) for key, value in info.items()} == INFO_TYPES
            _, reward, terminated, truncated, info = env.step(env.action_space.sample())
            terms = [value for key, value in info.items() if key.startswith("reward_")]
            assert reward == sum(terms)
            done = terminated or truncated
    env.close()


def test_a_reward_of_your_own_replaces_the_equation() -> None:
    env = paper_env(
        physics="kinematic", reward=lambda outcome: RewardTerms(other=outcome.clearance)
    )
    env.reset(options=STRAIGHT)
    _, reward, _, _, info = env.step([1.0, 1.0])
    assert reward == info["reward_other"] == pytest.approx(5 - 0.05 - 0.18)
    assert info["reward_progress"] == 0.0


def test_actions_beyond_the_box_are_clipped() -> None:
    env = paper_env(physics="kinematic")
    env.reset(options=STRAIGHT)
    assert env.step([9.0, 9.0])[4]["x"] == pytest.approx(0.05)


def test_a_step_outside_an_episode_asks_for_a_reset() -> None:
    env = paper_env(physics="kinematic", max_steps=1, render_mode="rgb_array")
    with pytest.raises(ResetNeeded, match=r"call reset\(\) before step\(\)"):
        env.step([0.0, 0.0])
    with pytest.raises(ResetNeeded, match=r"call reset\(\) before render\(\)"):
        env.render()
    env.reset(options=STRAIGHT)
    env.step([0.0, 0.0])
    with pytest.raises(ResetNeeded, match=r"call reset\(\) before step\(\)"):
        env.step([0.0, 0.0])


@pytest.mark.parametrize("robot", ROBOTS)
def test_wheels_and_kinematics_agree_at_constant_speed(robot: str) -> None:
    ends = []
    for physics in ("kinematic", "wheels"):
        env = paper_env(robot=robot, physics=physics)
        env.reset(options={"start": (-2, -2, 0), "goal": (4, 4)})
        for step in range(40):
            info = env.step([0.2, 0.3] if step % 20 < 10 else [0.8, 0.6])[4]
        ends.append((info["x"], info["y"], info["heading"]))
        env.close()
    # The motors take up to 0.3 s to reach a speed, so after four changes they are 10 cm behind.
    np.testing.assert_allclose(ends[0][:2], ends[1][:2], atol=0.12)
    assert ends[0][2] == pytest.approx(ends[1][2], abs=0.08)


def test_the_ids_are_the_class_with_its_defaults() -> None:
    for name in WORLDS:
        env = gymnasium.make(f"mpfa/Navigation-{name}-v1", physics="kinematic").unwrapped
        assert env.config == TaskConfig(physics="kinematic")
        assert env.config.collision_distance == env.config.closeness_distance == 0.25
        assert (env.config.action_repeat, env.config.detour_chance) == (2, 0.8)
    repeated = gymnasium.make("mpfa/Navigation-A-v1", physics="kinematic", action_repeat=3)
    assert repeated.unwrapped.config.action_repeat == 3


def test_a_goal_reached_in_the_last_step_is_no_timeout() -> None:
    ends = []
    for max_steps in (500, 31, 30):  # The goal is 1.52 m away, and a step is 0.05 m.
        env = NavigationEnv(physics="kinematic", max_steps=max_steps)
        *_, ended, truncated, info = drive_to_end(env, full_speed, goal=(2.02, 0.0))
        ends.append((ended, truncated, info["success"], info["timeout"]))
    assert ends == [(True, False, True, False)] * 2 + [(False, True, False, True)]


@pytest.mark.parametrize(("goal", "success"), [((-4.0, 0.0), False), ((4.75, 0.5), True)])
def test_a_robot_at_the_very_collision_distance_has_collided_unless_at_its_goal(
    goal: tuple[float, float], success: bool
) -> None:
    env = NavigationEnv(physics="kinematic", time_step=0.125, action_repeat=1, clearance=0.07)
    # A step is 1/16 m: 12 of them are exact.
    env.reset(options={"start": (4.0, 0.0, 0.0), "goal": goal})
    *before, last = [env.step([1.0, 1.0]) for _ in range(12)]
    assert env.trail[-1] == (4.75, 0.0)
    assert [step[2] for step in before] == [False] * 11 and last[2]
    assert (last[4]["success"], last[4]["collision"]) == (success, not success)
