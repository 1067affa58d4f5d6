"""A vector environment goes on where another one was, in the middle of episodes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from mpfa_envs import (
    ROBOTS,
    WORLDS,
    Box,
    RewardTerms,
    RobotModel,
    RobotNoise,
    VectorNavigationEnv,
    World,
    navigation_reward,
)
from mpfa_envs.worlds.plain import fingerprint, world_from_plain, world_to_plain
from tests.envs.busy import BUSY, POLITE, STANDING, needs
from tests.envs.shapes import SCATTERED, random_shapes


def actions_of(step: int, robots: int) -> np.ndarray:
    return np.random.default_rng(step).uniform(-0.3, 1.0, (robots, 2)).astype(np.float32)


def drive(env: VectorNavigationEnv, first: int, last: int) -> bytes:
    """All that steps show, as bytes."""
    seen = []
    for step in range(first, last):
        observations, rewards, terminated, truncated, infos = env.step(
            actions_of(step, env.num_envs)
        )
        seen += [observations, rewards, terminated, truncated]
        seen += [infos[name] for name in ("path_length", "x", "walker_distance", "intrusion_time")]
        seen += [env.walkers(index) for index in range(env.num_envs)]
    return b"".join(array.tobytes() for array in seen)


ALL = RobotNoise(range_noise=0.03, dropout=0.05, slip=0.1, latency=2, drift=0.05)
FEW = replace(BUSY, name="few", walkers=BUSY.walkers[3:5])
CASES: list[dict[str, Any]] = [
    {"world": ["B", "D", "test"]},
    {"world": "bars", "progress": "shortest_path", "lidar": {"noise": 0.02}},
    {"world": "mixed", "episodes_per_world": 3, "autoreset_mode": AutoresetMode.SAME_STEP},
    {"world": ["A", "D"], "physics": "wheels"},
    {"world": "bars", "memory": "map"},
    {"world": ["B", "D"], "history": 3, "lidar": {"noise": 0.02}},
    {"world": "rooms", "noise": ALL, "memory": "map"},
    {"world": "rooms", "noise": ALL, "memory": "map", "physics": "wheels"},
    {"world": [BUSY, FEW, STANDING], "lidar": {"noise": 0.02}},
    {"world": [POLITE]},
    {"world": [SCATTERED], "progress": "shortest_path"},
]


@pytest.mark.parametrize("case", CASES, ids=str)
def test_what_follows_is_the_same_to_the_bit(case: dict[str, Any]) -> None:
    needs(case)
    case = {"physics": "kinematic"} | case

    def make() -> VectorNavigationEnv:
        return VectorNavigationEnv(4, **case)

    env, other = make(), make()
    env.reset(seed=1)
    drive(env, 0, 45)
    state = env.state_dict()
    expected = drive(env, 45, 100)
    other.reset(seed=2, options={"worlds": env.worlds[::-1]})
    drive(other, 0, 7)
    other.load_state_dict(state)
    np.testing.assert_array_equal(other.observations, state["batch"]["observations"])
    assert drive(other, 45, 100) == expected
    assert other.tasks == env.tasks and other.worlds == env.worlds
    assert [other.trail(i) for i in range(4)] == [env.trail(i) for i in range(4)]
    assert other.worlds_rejected == env.worlds_rejected
    env.close()
    other.close()


def test_wheels_are_restored_at_the_start_of_an_episode_too() -> None:
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
        *outer, last = keys
        for key in outer:
            state = state[key]
        del state[last]

    return spoil


def with_value(value: object, *keys: str | int) -> Callable[[dict[str, Any]], None]:
    def spoil(state: Any) -> None:
        *outer, last = keys
        for key in outer:
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
        (with_value(3, "batch", "tasks"), "tasks of the state must have 2 entries, got 3"),
        (with_value([], "rngs"), "rngs of the state must have 2 entries"),
        (with_value(np.array([0, 10**9]), "batch", "steps"), r"steps .* in \[0, 500\], got"),
        (without("begun"), "state must be what state_dict.* gave"),
        (without("source", "refused"), "refused must be an integer of at least 0, got None"),
        (without("source", "left"), "left of the state must have 2 entries, got None"),
        (with_value([1], "source", "left"), "left of the state must have 2 entries, got 1"),
        (with_value([-1, 0], "source", "left"), "left must be an integer of at least 0, got -1"),
        (with_value([None], "source", "worlds"), "worlds of the state must have 2 entries"),
        (with_value([2**70, 0], "source", "left"), "left must be at most 100000, got"),
        (with_value(np.full((2, 5), np.nan), "batch", "motions"), "motions .* must be finite"),
        (with_value(np.full((2, 2), np.inf), "batch", "goals"), "goals .* must be finite"),
        (with_value(np.full((2, 2), 9.0), "batch", "goals"), "must lie in Box.*got .*9"),
        (
            with_value(np.full((2, 5), 1e300), "batch", "motions"),
            r"must lie in Box.*got .*1\.e\+300",
        ),
        (with_value([((0, 0, 0), (0, 9))] * 2, "batch", "tasks"), "must lie in Box.*got .*9"),
        (with_value([((0, math.nan, 0), (0, 0))] * 2, "batch", "tasks"), "must lie in Box.*nan"),
        (with_value(-1, "rngs", 0, "state", "inc"), "rngs of the state must be of PCG64"),
        (with_value([2, 0], "source", "left"), "worlds .* hold a world wherever left is not 0"),
    ],
)
def test_another_environments_state_is_rejected(
    spoil: Callable[[dict[str, Any]], None], message: str
) -> None:
    env = VectorNavigationEnv(2, world="B", physics="kinematic")
    env.reset(seed=0)
    drive(env, 0, 5)
    twin = VectorNavigationEnv(2, world="B", physics="kinematic")
    twin.load_state_dict(env.state_dict())
    state = env.state_dict()
    spoil(state)
    assert drive(env, 5, 8) == drive(twin, 5, 8)
    with pytest.raises(ValueError, match=message):
        env.load_state_dict(state)
    assert drive(env, 8, 40) == drive(twin, 8, 40)


@pytest.mark.parametrize("name", ["commands", "kept", "scales", "poses", "odometry"])
def test_noise_that_is_no_number_is_rejected(name: str) -> None:
    env = VectorNavigationEnv(
        2, world="B", physics="kinematic", noise={"slip": 0.1, "latency": 1, "drift": 0.1}
    )
    env.reset(seed=0)
    state = env.state_dict()
    state["batch"][f"noise_{name}"][1] = np.nan
    with pytest.raises(ValueError, match=f"noise_{name} of the state must be finite numbers"):
        env.load_state_dict(state)


def test_a_state_without_measurable_paths_is_rejected_before_any_change() -> None:
    env, other = (
        VectorNavigationEnv(2, world="rooms", physics="kinematic", progress="shortest_path")
        for _ in range(2)
    )
    env.reset(seed=1)
    other.reset(seed=2)
    state = env.state_dict()
    full = World(name="full", boxes=(Box(-5.0, -5.0, 5.0, 5.0),))
    state["batch"]["worlds"][1] = world_to_plain(full)
    poses, worlds, tasks = other.poses, other.worlds, other.tasks
    with pytest.raises(ValueError, match="'full' has none"):
        other.load_state_dict(state)
    np.testing.assert_array_equal(other.poses, poses)
    assert (other.worlds, other.tasks) == (worlds, tasks)


def test_wheels_stay_where_they_are_without_what_they_have_driven() -> None:
    env = VectorNavigationEnv(2, world="B", physics="wheels")
    env.reset(seed=0)
    drive(env, 0, 3)
    for spoil in (without("batch", "drives"), with_value(np.zeros(2), "batch", "drives", "speeds")):
        state = env.state_dict()
        spoil(state)
        drive(env, 3, 4)
        poses = env.poses
        with pytest.raises(ValueError, match=r"(counts|speeds) of the state must have shape"):
            env.load_state_dict(state)
        np.testing.assert_array_equal(env.poses, poses)
    env.close()


BURGER = ROBOTS["burger"]
OTHERS: list[tuple[dict[str, Any], str]] = [
    ({"world": "mixed"}, r"world = 'A \(.{8}\)', got one with 'mixed'"),
    ({"world": ["A", "B"]}, r"world = 'A \(.{8}\)', got one with \['A .*', 'B .*'\]"),
    ({"world": World(name="A", boxes=(Box(1.0, 1.0, 2.0, 2.0),))}, "world = .*, got .*'A "),
    ({"robot": replace(BURGER, mass=2.0)}, "robot.mass = 1.0, got one with 2.0"),
    ({"progress_scale": 99.0}, "progress_scale = 5.0, got one with 99.0"),
    ({"reward": partial(navigation_reward, goal_reward=3.0)}, "goal_reward = 10.0, got .* 3.0"),
    ({"reward": lambda outcome: RewardTerms()}, "reward = 'navigation_reward', got .* of your own"),
    ({"lidar": {"max_range": 2.0}}, "lidar.max_range = 10.0, got one with 2.0"),
    ({"lidar": {"reduction": "median"}}, "lidar.reduction = 'min', got one with 'median'"),
    (
        {"lidar": {"field_of_view": 90.0, "sectors": 36}},
        "lidar.field_of_view = 360.0, got one with 90.0",
    ),
    ({"lidar": {"noise": 0.1}}, "lidar.noise = 0.0, got one with 0.1"),
    ({"lidar": {"dropout": 0.1}}, "lidar.dropout = 0.0, got one with 0.1"),
    ({"noise": ALL}, "noise = None, got one with "),
    ({"history": 2}, "history = 0, got one with 2"),
    ({"min_goal_distance": 3.0}, "min_goal_distance = 2.0, got one with 3.0"),
    ({"max_goal_distance": 5.0}, "max_goal_distance = inf, got one with 5.0"),
    ({"detour_chance": 0.0}, "detour_chance = 0.8, got one with 0.0"),
    ({"episodes_per_world": 2}, "episodes_per_world = 1, got one with 2"),
    ({"split": "validation"}, "split = 'train', got one with 'validation'"),
    ({"autoreset_mode": AutoresetMode.SAME_STEP}, "autoreset_mode = 'NextStep', got .*'SameStep'"),
]


def burgers(**arguments: object) -> VectorNavigationEnv:
    standard = {"world": "A", "robot": "burger", "physics": "kinematic"}
    return VectorNavigationEnv(2, **standard | arguments)


@pytest.mark.parametrize(("arguments", "message"), OTHERS, ids=[message for _, message in OTHERS])
def test_a_state_of_another_argument_is_rejected(arguments: dict[str, Any], message: str) -> None:
    state = burgers(**arguments).state_dict()
    with pytest.raises(ValueError, match=f"state must be of an environment with {message}"):
        burgers().load_state_dict(state)


def test_a_state_of_another_difficulty_is_rejected() -> None:
    state = burgers(world="bars", difficulty=0.3).state_dict()
    with pytest.raises(ValueError, match=r"difficulty = None, got one with 0\.3"):
        burgers(world="bars").load_state_dict(state)


def test_a_state_that_describes_fewer_arguments_is_loaded() -> None:
    env, other = burgers(), burgers()
    env.reset(seed=0)
    state = env.state_dict()
    names = "world reward progress_scale robot.mass lidar.noise noise split"
    for name in names.split():
        del state["arguments"][name]
    other.load_state_dict(state)
    assert drive(other, 0, 20) == drive(env, 0, 20)


def test_equal_worlds_alone_have_the_same_fingerprint() -> None:
    whole = World(name="hall", size=(8, 6), boxes=(Box(1, 1, 2, 2),))
    same = World(name="hall", size=(8.0, 6.0), boxes=(Box(1.0, 1.0, 2.0, 2.0),))
    assert fingerprint(whole) == fingerprint(same)
    assert fingerprint(replace(whole, boxes=())) != fingerprint(whole)
    assert len({fingerprint(world) for world in WORLDS.values()}) == len(WORLDS)


def test_wheels_that_change_slowly_go_on_from_a_state_and_begin_at_rest() -> None:
    ahead = np.ones((2, 2), np.float32)
    env, other = burgers(robot="kobuki"), burgers(robot="kobuki")
    begun, _ = env.reset(seed=0)
    env.step(ahead)
    other.load_state_dict(env.state_dict())
    assert np.array_equal(env.step(-ahead)[0], other.step(-ahead)[0])
    env.step(ahead)
    assert np.array_equal(env.reset(seed=0)[0], begun)
    env.step(ahead)
    assert env.motions[:, 3] == pytest.approx(0.8 * 0.2)


def test_saved_states_keep_the_names_of_their_arguments() -> None:
    env = VectorNavigationEnv(1, physics="kinematic")
    names = set(env.state_dict()["arguments"])
    env.close()
    assert {name for name in names if "." not in name} == {
        *("num_envs", "robot", "physics", "max_steps", "time_step", "action_repeat"),
        *("goal_radius", "collision_distance", "closeness_distance", "progress", "memory"),
        *("reward", "goal_reward", "collision_reward", "progress_scale", "step_cost"),
        *("history", "noise"),
        *("rays", "sectors", "min_goal_distance", "detour_chance", "world", "difficulty"),
        *("max_goal_distance", "episodes_per_world", "split", "autoreset_mode"),
    }
    lidar = {"reduction", "max_range", "noise", "field_of_view", "dropout"}
    robot = {field.name for field in fields(RobotModel)} - {"name"}
    prefixed = {f"lidar.{name}" for name in lidar} | {f"robot.{name}" for name in robot}
    assert {name for name in names if "." in name} == prefixed
