"""Many robots at once against as many environments of one robot, and gymnasium's conventions."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from mpfa_envs import (
    PAPER_TASK,
    WORLDS,
    Box,
    NavigationEnv,
    RewardTerms,
    RobotNoise,
    Task,
    VectorNavigationEnv,
    World,
    navigation_reward,
)
from mpfa_envs.sensing.observation import INFO_TYPES
from tests.envs.busy import BUSY, POLITE, needs
from tests.envs.plain_robot import PlainRobot
from tests.envs.shapes import SCATTERED, random_shapes

NAMES = ["A", "B", "D", "test"]
ALL = RobotNoise(range_noise=0.03, dropout=0.05, slip=0.1, drift=0.05)
MODES = [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP]


def make(num_envs: int = 4, **kwargs: object) -> VectorNavigationEnv:
    return VectorNavigationEnv(num_envs, **{"world": NAMES, "physics": "kinematic"} | kwargs)


def drive(rng: np.random.Generator, robots: int) -> np.ndarray:
    """Actions that lead somewhere: mostly forward."""
    return rng.uniform(-0.3, 1.0, (robots, 2)).astype(np.float32)


def assert_alike(ours: tuple, theirs: tuple, atol: float) -> None:
    """Compare what a step or a reset of two vector environments has given."""
    *arrays, infos = ours
    *expected, expected_infos = theirs
    for array, other in zip(arrays, expected, strict=True):
        np.testing.assert_allclose(array, other, atol=atol)
        assert array.dtype == other.dtype
    assert_infos_alike(infos, expected_infos, atol)


def assert_infos_alike(infos: dict, expected: dict, atol: float) -> None:
    assert set(infos) == set(expected)
    for key, value in expected.items():
        if isinstance(value, dict):
            assert_infos_alike(infos[key], value, atol)
        elif value.dtype == object:
            for row, other in zip(infos[key], value, strict=True):
                assert (row is None) == (other is None)
                if other is not None:
                    np.testing.assert_allclose(row, other, atol=atol)
        elif f"_{key}" in expected:
            mask = expected[f"_{key}"]
            np.testing.assert_allclose(infos[key][mask], value[mask], atol=atol)
            assert infos[key].dtype == value.dtype, key
        else:
            np.testing.assert_array_equal(infos[key], value, key)


ALONE: list[dict[str, Any]] = [
    {"reward": lambda outcome: RewardTerms(other=outcome.clearance), "time_step": 0.2},
    {"lidar": {"reduction": "median", "sectors": 6, "rays_per_sector": 4}, "latency": 0.25},
    {"noise": ALL, "memory": "map", "history": 1},
    {"world": [BUSY] * 4, "progress": "shortest_path", "contact": True},
    {"world": [POLITE] * 4},
    {"world": [SCATTERED, "B", SCATTERED, "A"], "progress": "shortest_path", "physics": "wheels"},
]


@pytest.mark.parametrize(
    ("mode", "arguments"),
    [(MODES[number % 2], arguments) for number, arguments in enumerate(ALONE)],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else value.name,
)
def test_robots_drive_the_same_episodes_as_alone(mode: AutoresetMode, arguments: dict) -> None:
    arguments = {"physics": "kinematic", "world": NAMES, "max_steps": 60} | arguments
    needs(arguments)
    ours = VectorNavigationEnv(4, autoreset_mode=mode, **arguments)
    singles = [partial(NavigationEnv, **arguments | {"world": each}) for each in arguments["world"]]
    theirs = SyncVectorEnv(singles, autoreset_mode=mode, observation_mode="different")
    seeds, rng, episodes = [3, 4, 5, 6], np.random.default_rng(0), 0
    assert_alike(ours.reset(seed=seeds), theirs.reset(seed=seeds), 1e-9)
    for _ in range(45):
        actions = drive(rng, 4)
        seen = ours.step(actions)
        assert_alike(seen, theirs.step(actions), 1e-9)
        for index, single in enumerate(theirs.envs):
            np.testing.assert_array_equal(ours.walkers(index), single.unwrapped.walkers)
        episodes += int((seen[2] | seen[3]).sum())
    assert episodes > 1
    ours.close()
    ours.close()
    theirs.close()


def test_robots_that_share_a_server_part_slowly() -> None:
    ours, theirs = make(40, physics="wheels"), make(8, physics="wheels")
    tasks = [Task((0.0, -3.0, 0.3 * i), (0.0, 3.0)) for i in range(8)]
    ours.reset(seed=0, options={"worlds": ["A"] * 40, "tasks": tasks * 5})
    theirs.reset(seed=0, options={"worlds": ["A"] * 8, "tasks": tasks})
    actions = np.tile(np.linspace(0.2, 0.9, 8, dtype=np.float32)[:, None], (1, 2))
    actions[:, 1] -= 0.2
    for _ in range(15):  # Three seconds.
        ours.step(np.tile(actions, (5, 1)))
        theirs.step(actions)
    # All 40 are in one place, and none hindered another.
    gaps = ours.poses.reshape(5, 8, 3)[..., :2] - theirs.poses[:, :2]
    assert np.hypot(*gaps.T).max() < 0.05
    ours.close()
    theirs.close()


@pytest.mark.parametrize(
    ("arguments", "cost"),
    [
        ({}, 0.0),
        ({"action_repeat": 3, "robot": "burger", "closeness_distance": 0.5}, 0.0),
        ({"reward": partial(navigation_reward, step_cost=0.05)}, 0.05),
        (PAPER_TASK, 0.0),
    ],
)
def test_a_robot_drives_among_any_shapes_as_in_plain_python(arguments: dict, cost: float) -> None:
    rng, worlds = np.random.default_rng(7), []
    while len(worlds) < 6:
        world = random_shapes(rng, boxes=3, cylinders=4, polygons=3)
        if world.clearance(0.0, 0.0) > 0.5 and world.clearance(3.0, 2.0) > 0.5:
            worlds.append(world)
    env = make(6, world=worlds, **{**arguments, "detour_chance": 0.0, "max_steps": 89})
    seen, _ = env.reset(seed=0)
    plain = [
        PlainRobot(world, task, env.config, step_cost=cost)
        for world, task in zip(worlds, env.tasks, strict=True)
    ]
    np.testing.assert_allclose(seen, [each.observe() for each in plain], atol=1e-6)
    running, ends = np.ones(6, dtype=np.bool_), set()
    for _ in range(60):
        actions = drive(rng, 6)
        observations, rewards, terminated, truncated, infos = env.step(actions, only=running)
        for index in np.flatnonzero(running):
            expected = plain[index].step(actions[index])
            np.testing.assert_allclose(observations[index], expected[0], atol=1e-6)
            assert rewards[index] == pytest.approx(expected[1], abs=1e-9)
            assert (terminated[index], truncated[index]) == expected[2:]
            for name in ("success", "collision", "path_length", "min_clearance", "distance"):
                assert infos[name][index] == pytest.approx(getattr(plain[index], name), abs=1e-9)
            ends |= {name for name in ("collision", "timeout") if infos[name][index]}
        running &= ~(terminated | truncated)
    assert ends


@pytest.mark.parametrize("world", ["A", BUSY, "mixed"], ids=["A", "busy", "mixed"])
def test_a_robot_has_the_same_episodes_whatever_their_number(world: object) -> None:
    seen = []
    for robots in (1, 3, 16):
        env, rng = make(robots, world=world, max_steps=60), np.random.default_rng(0)
        rows = [env.reset(seed=5)[0][0]]
        for _ in range(80):
            actions = np.tile(drive(rng, 1), (robots, 1))
            actions[1:] *= 0.5
            rows.append(env.step(actions)[0][0])
        seen.append(np.array(rows))
    np.testing.assert_array_equal(seen[0], seen[1])
    np.testing.assert_array_equal(seen[0], seen[2])


def test_an_ended_robot_waits_for_a_reset_that_names_it() -> None:
    env = make(2, world="A", autoreset_mode=AutoresetMode.DISABLED, max_steps=4)
    with pytest.raises(ResetNeeded, match="call reset"):
        env.step(np.ones((2, 2)))
    env.reset(seed=0)
    truncated = [env.step(np.ones((2, 2)))[3].tolist() for _ in range(2)]
    assert truncated == [[False, False], [True, True]]
    with pytest.raises(ResetNeeded, match=r"robots \[0, 1\] have ended.*reset_mask"):
        env.step(np.ones((2, 2)))
    before = env.poses
    _, infos = env.reset(options={"reset_mask": np.array([False, True])})
    assert infos["_x"].tolist() == [False, True]
    assert (env.poses[0] == before[0]).all() and (env.poses[1] != before[1]).all()
    with pytest.raises(ResetNeeded, match=r"robots \[0\] have ended"):
        env.step(np.ones((2, 2)))
    env.step(np.ones((2, 2)), only=np.array([False, True]))


def test_options_fix_the_next_episode_and_no_later_one() -> None:
    post = World(name="post", boxes=(Box(1.0, -0.5, 2.0, 0.5),))
    task = Task((0.0, 0.0, 7.0), (3.0, 0.0))
    env = make(3, world="D")
    env.reset(seed=1, options={"worlds": [None, post, post], "tasks": [None, task, None]})
    assert [world.name for world in env.worlds] == ["D", "post", "post"]
    assert env.tasks[1] == task and env.tasks[2] != task
    assert env.poses[1].tolist() == pytest.approx([0.0, 0.0, 7.0 - math.tau])
    env.reset()
    assert [world.name for world in env.worlds] == ["D"] * 3


def test_what_was_given_does_not_change_with_the_next_step() -> None:
    env = make(2)
    observations, infos = env.reset(seed=0)
    kept = observations.copy(), {key: value.copy() for key, value in infos.items()}
    env.step(np.ones((2, 2)))
    np.testing.assert_array_equal(observations, kept[0])
    for key, value in infos.items():
        np.testing.assert_array_equal(value, kept[1][key])
    assert set(INFO_TYPES) <= set(infos)


@pytest.mark.parametrize(
    ("words", "actions"),
    [
        ({"max_episode_steps": 7}, 7),
        ({"max_episode_steps": 7, "action_repeat": 3}, 7),
        ({"max_episode_steps": 7, "max_steps": 8}, 4),
        ({"max_episode_steps": -1, "max_steps": 8}, 4),
    ],
)
def test_the_time_limit_of_gymnasium_is_that_of_one_environment(words, actions) -> None:
    words = {**words, "physics": "kinematic"}
    one, many = (
        make("mpfa/Navigation-A-v1", **words, **more)
        for make, more in ((gymnasium.make, {}), (gymnasium.make_vec, {"num_envs": 2}))
    )
    one.reset(seed=0)
    many.reset(seed=0)
    for step in range(1, actions + 1):
        ended = one.step(np.zeros(2, np.float32))[3]
        assert many.step(np.zeros((2, 2), np.float32))[3].tolist() == [ended] * 2
        assert ended == (step == actions)
    one.close()
    many.close()


@pytest.mark.parametrize("limit", [0, "7"])
def test_a_time_limit_that_is_no_count_is_rejected_by_name(limit) -> None:
    with pytest.raises(ValueError, match="max_episode_steps"):
        gymnasium.make_vec("mpfa/Navigation-A-v1", num_envs=2, max_episode_steps=limit)


@pytest.mark.parametrize("env_id", [f"mpfa/Navigation-{name}-v1" for name in ("A", "test")])
def test_every_world_has_an_id_of_a_vector_environment(env_id: str) -> None:
    env = gymnasium.make_vec(env_id, num_envs=2, physics="kinematic")
    assert isinstance(env.unwrapped, VectorNavigationEnv)
    assert env.worlds[0] in WORLDS.values()
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    observations, _ = env.reset(seed=0)
    assert env.observation_space.contains(observations)
    assert env.single_observation_space.shape == (24,)
    assert env.action_space.contains(env.action_space.sample())
    env.close()


def test_long_episodes_keep_their_trail() -> None:
    env = make(1, world="A", max_steps=3000)
    env.reset(options={"tasks": [Task((0.0, 0.0, 0.0), (4.0, 4.0))]})
    for _ in range(700):
        env.step(np.array([[0.2, 0.6]]))
    trail = env.trail(0)
    assert len(trail) == 1401 and trail[0] == (0.0, 0.0)
    assert (0.0, 0.0) not in trail[1:]
    assert trail[-1] == tuple(env.poses[0, :2])


def test_pictures_show_each_world() -> None:
    env = make(2, render_mode="rgb_array")
    with pytest.raises(ResetNeeded, match="render"):
        env.render()
    env.reset(seed=0)
    assert [picture.shape for picture in env.render()] == [(480, 480, 3)] * 2
    assert make(2).render() is None


def test_what_was_never_built_can_be_closed() -> None:
    # gymnasium 1.2 closes an environment whose arguments were rejected, when it is collected.
    VectorNavigationEnv.__new__(VectorNavigationEnv).close_extras()


def test_each_mask_of_the_infos_is_its_own() -> None:
    env = VectorNavigationEnv(3, world="A", physics="kinematic")
    _, infos = env.reset(seed=0)
    infos["_x"][:] = False
    assert infos["_success"].all() and not infos["_x"].any()
    env.close()


def test_a_seed_of_a_reset_seeds_the_robots_that_it_starts() -> None:
    env, twin = (VectorNavigationEnv(2, world="B", physics="kinematic") for _ in range(2))
    first, second = np.array([True, False]), np.array([False, True])
    env.reset(seed=0)
    twin.reset(seed=0)
    env.reset(seed=9, options={"reset_mask": first})
    for each in (env, twin):
        each.reset(options={"reset_mask": second})
    assert env.tasks[1] == twin.tasks[1]
    assert env.tasks[0] != twin.tasks[0]
