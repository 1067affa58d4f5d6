"""Arguments and calls that environments, robots, senses and policies reject: a row each."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from mpfa_envs import (
    ROBOTS,
    ROOMS_TASK,
    WORLDS,
    DiscreteWheels,
    Lidar,
    Mirror,
    NavigationEnv,
    RandomMirror,
    RobotNoise,
    Task,
    TaskConfig,
    VectorNavigationEnv,
    Walker,
    World,
    evaluate,
    make_navigation_env,
    world_tasks,
)
from mpfa_envs.deploy import Pilot
from mpfa_envs.generators.generate import generator_tasks, split_worlds
from mpfa_envs.robots.discrete import WHEEL_PAIRS
from mpfa_envs.ros.controller import Controller
from mpfa_envs.ros.simulated_robot import SimulatedRobot
from mpfa_envs.sensing.observation import Binning
from mpfa_envs.tasks.sampling import evaluation_pairs
from tests.envs.exported import card, make_policy

Rows = list[tuple[Mapping[str, Any], str]]


def ahead(seen: np.ndarray) -> np.ndarray:
    return np.ones((1, 2), np.float32)


def one(**arguments: Any) -> NavigationEnv:
    return NavigationEnv(**{"physics": "kinematic"} | arguments)


def many(**arguments: Any) -> VectorNavigationEnv:
    return VectorNavigationEnv(**{"num_envs": 2, "physics": "kinematic"} | arguments)


def torchrl(**arguments: Any) -> object:
    return make_navigation_env(**{"physics": "kinematic"} | arguments)


def pilot(**arguments: Any) -> Pilot:
    return Pilot(card(), ahead, **arguments)


def controller(**arguments: Any) -> Controller:
    return Controller(pilot(), **arguments)


TASK: Rows = [
    ({"progress_scale": 1e300}, r"progress_scale must be at most 1e\+09 in size, got 1e\+300"),
    ({"robot": "burgr"}, "robot must be .*got 'burgr' .did you mean 'burger'"),
    ({"physics": "magic"}, "physics must be one of .*got 'magic'"),
    ({"progress": "path"}, "progress must be one of .*got 'path'"),
    ({"max_steps": 0}, "max_steps must be a positive integer, got 0"),
    ({"action_repeat": 0}, "action_repeat must be a positive integer, got 0"),
    ({"time_step": 0.0}, "time_step must be positive, got 0.0"),
    ({"time_step": 0.6}, "time_step must be at most 0.5 s, .*collision_distance = 0.25 .*got 0.6"),
    (
        {"robot": replace(ROBOTS["burger"], min_wheel_speed=-2.0), "time_step": 0.2},
        "time_step must be at most 0.[0-9]+ s, .*at its fastest, got 0.2",
    ),
    ({"goal_radius": math.nan}, "goal_radius must be a finite number, got nan"),
    ({"min_goal_distance": 0.3}, "min_goal_distance must be above goal_radius = 0.5, got 0.3"),
    ({"closeness_distance": 0.0}, "closeness_distance must be positive, got 0.0"),
    ({"detour_chance": 1.1}, r"detour_chance must be in \[0, 1\], got 1.1"),
    ({"progress_scale": math.inf}, "progress_scale must be a finite number, got inf"),
    ({"clearance": -0.1}, "clearance must not be negative, got -0.1"),
    ({"contact": "touch"}, "contact must be .*got 'touch'"),
    ({"reward": 3}, "reward must be callable or None, got 3"),
    ({"memory": "lstm"}, r"memory must be one of \('none', 'map'\), got 'lstm'"),
    ({"history": -1}, "history must be an integer of at least 0, got -1"),
    ({"lidar": {"sectors": 0}}, "sectors must be a positive integer, got 0"),
    ({"lidar": {"reduction": "mean"}}, "reduction must be one of .*got 'mean'"),
    ({"lidar": {"max_range": -1.0}}, r"max_range must be positive, got -1\.0"),
    ({"lidar": {"noise": -1.0}}, r"noise must not be negative, got -1\.0"),
    ({"lidar": {"sector": 3}}, "lidar must hold arguments of Lidar, got {.*'sector': 3"),
    ({"lidar": 18}, "lidar must hold arguments of Lidar, got 18"),
    (
        {"lidar": {"noise": 0.1}, "noise": {"range_noise": 0.1}},
        "lidar must not hold 'noise' together with noise=",
    ),
    ({"noise": {"latecy": 1}}, "noise must be a RobotNoise or hold arguments of it"),
    ({"noise": {"slip": 0.6}}, r"slip must be in \[0, 0.45\], got 0.6"),
    ({"noise": 3}, "noise must be a RobotNoise or hold arguments of it, got 3"),
]
ONE: Rows = [
    ({"world": "tets"}, "world must be .*got 'tets' .did you mean 'test'"),
    ({"render_mode": "ansi"}, "render_mode must be None or 'human' or 'rgb_array', got 'ansi'"),
    ({"noise": {"slip": 0.6}}, r"slip must be in \[0, 0.45\], got 0.6"),
]
MANY: Rows = [
    ({"num_envs": 0}, "num_envs must be a positive integer, got 0"),
    ({"world": []}, "world must hold at least one world, got an empty sequence"),
    ({"world": ["A", "tets"]}, "world must be .*got 'tets' .did you mean 'test'"),
    ({"world": "barz"}, "world must be .*got 'barz' .did you mean 'bars'"),
    ({"difficulty": 0.5}, "difficulty must be None unless world is the name of a generator"),
    ({"world": "rooms", "difficulty": 1.5}, r"difficulty must be in \[0, 1\], got 1.5"),
    ({"episodes_per_world": 0}, "episodes_per_world must be a positive integer, got 0"),
    ({"split": "test"}, "split must be 'train' or 'validation', got 'test'"),
    ({"max_goal_distance": 2.0}, "max_goal_distance must be above min_goal_distance = 2.0"),
    (
        {"min_goal_distance": 0.7, "max_goal_distance": True},
        "max_goal_distance must be above min_goal_distance = 0.7, got True",
    ),
    ({"autoreset_mode": "Never"}, "autoreset_mode must be .*got 'Never'"),
    ({"min_goal_distance": 40.0}, "world 'A' has no start and goal at least"),
    ({"world": World(name="box", size=(0.9, 0.9))}, "world 'box' has no free goal"),
    ({"world": "bars", "min_goal_distance": 90.0}, "world = 'bars' cannot be driven: 50 of"),
    ({"progress": "path"}, "progress must be one of .*got 'path'"),
]
TORCHRL: Rows = [
    ({"num_envs": 0}, "num_envs must be a positive integer, got 0"),
    ({"num_envs": 0, "parallel": True}, "num_envs must be a positive integer, got 0"),
    ({"parallel": True}, "num_envs must be a positive integer with parallel=True, got None"),
    ({"parallel": True, "num_envs": 2, "world": ["A", "B"]}, "world must be one, .*, got"),
    ({"info_keys": ("succes",)}, "info_keys must be among .*got 'succes'"),
]
ROBOT: Rows = [
    ({"radius": 0.0}, "radius must be positive, got 0.0"),
    ({"mass": math.inf}, "mass must be a finite number, got inf"),
    ({"name": ""}, "name must be a non-empty string, got ''"),
    ({"wheel_base": 1.0}, "wheel_base must be at most the diameter 0.36, got 1.0"),
    (
        {"lidar_mount": (0.3, 0.0, 0.0)},
        r"lidar_mount must be .* the radius 0.18 m .*got \(0.3, 0\)",
    ),
    ({"wheel_radius": 0.3}, "wheel_radius must be at most half the height"),
    ({"min_wheel_speed": 0.5}, "min_wheel_speed must be below max_wheel_speed = 0.5, got 0.5"),
]
NOISE: Rows = [
    ({"range_noise": -0.1}, "range_noise must not be negative, got -0.1"),
    ({"drift": math.nan}, "drift must be a finite number, got nan"),
    ({"dropout": 1.5}, r"dropout must be in \[0, 1\], got 1.5"),
]
LIDAR: Rows = [
    ({"field_of_view": 0.0}, "field_of_view must be positive, got 0.0"),
    ({"field_of_view": 361.0}, "field_of_view must be at most 360 deg in size, got 361"),
]
PAIRS: Rows = [
    ({"pairs": [(1.0, 1.0)]}, r"pairs must be two or more pairs of numbers, got \[\(1.0, 1.0\)\]"),
    ({"pairs": [(1.0, 1.0), (2.0, 1.0)]}, r"pairs must be in \[-1, 1\]"),
    ({"pairs": [(1.0, math.nan), (0.0, 1.0)]}, r"pairs must be in \[-1, 1\]"),
    ({"pairs": [(1.0, 1.0), (1.0, 1.0)]}, "pairs must be different"),
    ({"pairs": [1.0, 0.5]}, "pairs must be two or more pairs"),
]
MIRROR: Rows = [
    ({"sectors": -1}, "sectors must be a positive integer, got -1"),
    ({"history": -1}, "history must be an integer of at least 0, got -1"),
    ({"pairs": [(1.0, 1.0), (0.0, 1.0)]}, "pairs must hold the mirror image of each, got none of"),
    ({"sectors": 35, "front_rear": True}, "sectors must be even with front_rear, got 35"),
    ({"pairs": WHEEL_PAIRS, "front_rear": True}, "pairs must be None with front_rear, got"),
]
CHANCE: Rows = [
    ({"chance": -0.1}, r"chance must be in \[0, 1\], got -0.1"),
]
BINS: Rows = [
    ({"groups": 0}, "groups must be a positive integer, got 0"),
    ({"groups": 19}, "groups must be at most 18 sectors, got 19"),
    ({"closeness": (0.5, 0.5)}, r"closeness must be finite and rise, got \(0.5, 0.5\)"),
    ({"distances": (math.nan,)}, r"distances must be finite and rise, got \(nan,\)"),
    ({"directions": 2.5}, "directions must be a positive integer, got 2.5"),
    ({"observation_size": 23}, "observation_size must be 24 or more: 23"),
]
PILOT: Rows = [
    ({"robot": "waffle"}, "learned with a robot of radius 0.18 m, waffle has 0.22 m"),
    ({"robot": "burger", "pace": 0.5}, "pace must be above 0 and at most 0.44, as burger"),
    ({"pace": 0.0}, "pace must be above 0"),
    ({"silent": "near"}, "silent must be one of"),
    ({"mount": (0.0, 1.0)}, "mount must be 3 numbers, .*got 2"),
    ({"mount": (0.0, 0.2, 0.0)}, r"mount must be at most the radius 0.18 m .*got \(0, 0.2\)"),
    ({"unseen": -1.0}, "unseen must be positive, got -1.0"),
    ({"map_size": math.inf}, "map_size must be a finite number, got inf"),
]
CONTROLLER: Rows = [
    ({"stop_distance": -0.1}, "stop_distance must not be negative, got -0.1"),
    ({"scan_timeout": 0.0}, "scan_timeout must be positive, got 0.0"),
    ({"odometry_timeout": math.inf}, "odometry_timeout must be a finite number, got inf"),
    ({"check_period": 0.0}, "check_period must be positive, got 0.0"),
]
SIMULATED: Rows = [
    ({"physics": "none"}, "physics must be one of .*got 'none'"),
    ({"rays": 1}, "rays must be an integer of at least 2, got 1"),
    ({"field": (1.0, 1.0)}, r"field must rise, got \(1.0, 1.0\)"),
    ({"time_step": 0.0}, "time_step must be positive, got 0.0"),
    ({"seed": -1}, "seed must be an integer of at least 0, got -1"),
]
PARTS: list[tuple[Callable[..., object], Rows]] = [
    (TaskConfig, TASK),
    (one, ONE),
    (many, MANY),
    (torchrl, TORCHRL),
    (partial(replace, ROBOTS["turtlebot2"]), ROBOT),
    (RobotNoise, NOISE),
    (partial(Lidar, WORLDS["A"]), LIDAR),
    (DiscreteWheels, PAIRS),
    (Mirror, MIRROR),
    (RandomMirror, CHANCE),
    (Binning, BINS),
    (pilot, PILOT),
    (controller, CONTROLLER),
    (partial(SimulatedRobot, "A", **{"physics": "kinematic"}), SIMULATED),
]


@pytest.mark.parametrize(
    ("make", "arguments", "message"),
    [(make, *row) for make, rows in PARTS for row in rows],
)
def test_a_bad_argument_is_named_with_its_value(
    make: Callable[..., object], arguments: Mapping[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        make(**arguments)


@pytest.mark.parametrize("make", [one, many, torchrl])
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("num_env", "^got an unexpected keyword argument 'num_env': did you mean 'num_envs'"),
        ("max_episode_steps", "^got an unexpected keyword argument .*: did you mean 'max_steps'"),
        ("collision_distance", "^got an unexpected .*: give clearance, .*, or contact=True$"),
        ("wrong", "^got an unexpected keyword argument 'wrong'$"),
    ],
)
def test_an_unknown_argument_is_rejected_with_the_nearest(make, name, message) -> None:
    with pytest.raises(TypeError, match=message):
        make(**{name: 2})


def of_a_policy(**env_arguments: Any) -> object:
    """The evaluation of a policy whose file asks for these arguments."""
    return evaluate(make_policy(**env_arguments), "A", episodes=1, physics="kinematic")


def evaluated(**arguments: Any) -> object:
    return evaluate(ahead, "A", **{"episodes": 1, **arguments})


@pytest.mark.parametrize(
    ("make", "count"),
    [
        (many, "num_envs"),
        (torchrl, "num_envs"),
        (partial(torchrl, parallel=True), "num_envs"),
        (evaluated, "episodes"),
        (evaluated, "envs_at_once"),
        (partial(world_tasks, "bars:test"), "episodes"),
        (partial(evaluation_pairs, "A", seed=0), "n"),
        (partial(split_worlds, "bars", "test"), "count"),
        (partial(generator_tasks, "bars", "test"), "tasks"),
        (one, "max_steps"),
        (one, "action_repeat"),
        (Mirror, "sectors"),
        (partial(Lidar, WORLDS["A"]), "rays_per_sector"),
        (of_a_policy, "history"),
        (of_a_policy, "max_steps"),
    ],
)
def test_a_count_beyond_bounds_is_rejected_at_once(make: Callable[..., object], count: str) -> None:
    with pytest.raises(ValueError, match=rf"^{count} must be at most 1000*, got [0-9]+$"):
        make(**{count: 2**31})


@pytest.mark.parametrize(
    ("name", "make", "arguments"),
    [
        ("count", partial(generator_tasks, "bars", "test"), {"worlds": 2**31}),
        (r"sectors \* rays_per_sector", partial(Lidar, WORLDS["A"]), {"sectors": 99_999}),
        (r"sectors \* history", of_a_policy, {"history": 99_999}),
        ("sectors", of_a_policy, {"lidar": {"sectors": 2**31}}),
    ],
)
def test_counts_that_multiply_or_lie_within_are_bounded_too(
    name: str, make: Callable[..., object], arguments: Mapping[str, Any]
) -> None:
    with pytest.raises(ValueError, match=rf"^{name} must be at most 1000*, got [0-9]+$"):
        make(**arguments)


def test_a_seed_may_be_as_large_as_any() -> None:
    env = one()
    assert env.reset(seed=2**60)[1] == env.reset(seed=2**60)[1]
    assert many().reset(seed=2**200)
    assert evaluation_pairs("A", 1, seed=2**200)


TINY = World(name="tiny", size=(0.8, 0.8))
FULL = replace(WORLDS["D"], name="full", walkers=(Walker(radius=2.4),))
FAR = {"start": (99.0, 0.0, 0.0), "goal": (4.0, 4.0)}
ONE_RESET: Rows = [
    *(
        ({"seed": seed}, f"seed must be an integer of at least 0, got {seed!r}")
        for seed in (-1, 1.5, "1", True)
    ),
    ({"options": {"reset_mask": True}}, "got 'reset_mask'"),
    ({"options": {"start": (0, 0, 0)}}, "options must have start and goal, or neither"),
    ({"options": {"start": (0, 0), "goal": (3, 0)}}, r"start must be 3 finite .*got \(0, 0\)"),
    ({"options": {"start": (0, 0, 0), "goal": (math.inf, 0)}}, "goal must be 2 finite numbers"),
    ({"options": {"start": (0, 0, 0), "goal": "ab"}}, "goal must be 2 finite numbers, got 'ab'"),
    ({"options": {"start": (4.8, 0, 0), "goal": (3, 0)}}, r"start must be farther .*\(4.8, 0.0\)"),
    ({"options": {"start": (0, 0, 0), "goal": (0.4, 0)}}, r"goal must be farther .*\(0.4, 0.0\)"),
    ({"options": {"start": (0, 0, 0), "goal": (7, 0)}}, r"goal must be within reach .*\(7.0, 0.0"),
    *(
        ({"seed": seed, "options": {"world": FULL}}, "'full' has no place for")
        for seed in (None, 1)
    ),
]
ROOMS_RESET: Rows = [
    ({"seed": 1, "options": {"world": "A", "goal": (4.0, 4.0)}}, "start and goal, or neither"),
    ({"seed": 1, "options": FAR}, "world must be given"),
    ({"seed": 1, "options": {"world": "A", **FAR}}, "99"),
    ({"seed": 1, "options": {"world": TINY}}, "world 'tiny' has no"),
]
MANY_RESET: Rows = [
    ({"seed": -1}, "seed must be an integer of at least 0, got -1"),
    ({"seed": [1]}, "seed must have 2 entries, got 1"),
    ({"seed": np.array([1, 2])}, r"seed must be an integer of at least 0, got array\(\[1, 2\]\)"),
    *(
        ({"seed": 1, "options": options}, message)
        for options, message in (
            (["reset_mask"], r"options must be a dictionary or None, got \['reset_mask'\]"),
            ({"task": []}, "options must have keys among .*got 'task'"),
            ({"tasks": [None]}, "tasks must have 2 entries, got 1"),
            ({"tasks": "ab"}, "tasks must be a sequence .*got 'ab'"),
            ({"worlds": ["tets", None]}, "robot 0: world must be .*did you mean 'test'"),
            ({"tasks": [None, Task((4.9, 0, 0), (0, 0))]}, "robot 1: start must be farther"),
            ({"tasks": [None, ((0, 0, 0), (9, 0))]}, "robot 1: goal must be within reach"),
            ({"reset_mask": np.zeros(2, dtype=np.bool_)}, "reset_mask must name at least one"),
            ({"reset_mask": [True, False]}, "reset_mask must be a NumPy array of 2 bool"),
            (
                {"worlds": [World(name="hall", size=(90.0, 9.0)), None]},
                "robot 0: world 'hall' .* 14",
            ),
            ({"worlds": [None, TINY]}, "world 'tiny' has no free start"),
        )
    ),
]
NEW_WORLD_RESET: Rows = [
    ({"seed": seed, "options": {"worlds": [None, TINY]}}, "world 'tiny' has no")
    for seed in (None, 5)
]
ONE_STEP: Rows = [
    ({"action": [math.nan, 0.0]}, "actions must not hold NaN"),
    ({"action": [0.0]}, r"action must have shape \(2,\), got \(1,\)"),
]
MANY_STEP: Rows = [
    ({"actions": np.array([[0.0, math.nan], [0, 0]])}, r"not hold NaN, got some for robots \[0\]"),
    ({"actions": np.zeros(2)}, r"actions must have shape \(2, 2\), got \(2,\)"),
    *(
        ({"actions": np.ones((2, 2)), "only": only}, "only must be a NumPy array of 2 bool")
        for only in ([True, False], np.ones(3, dtype=np.bool_), np.ones(2))
    ),
]
NEW_WORLDS = {"world": "rooms", "episodes_per_world": 2, "max_goal_distance": 20.0}
CALLS: list[tuple[Callable[..., Any], str, Rows]] = [
    (one, "reset", ONE_RESET),
    (partial(one, **ROOMS_TASK), "reset", ROOMS_RESET),
    (many, "reset", MANY_RESET),
    (partial(many, **NEW_WORLDS), "reset", NEW_WORLD_RESET),
    (one, "step", ONE_STEP),
    (many, "step", MANY_STEP),
]


@pytest.mark.parametrize(
    ("make", "method", "arguments", "message"),
    [(make, method, *row) for make, method, rows in CALLS for row in rows],
)
def test_after_a_rejected_call_an_environment_goes_on_as_before(
    make: Callable[..., Any], method: str, arguments: Mapping[str, Any], message: str
) -> None:
    env, twin = make(), make()
    action = np.ones(env.action_space.shape)
    for each in (env, twin):
        each.reset(seed=0)
        each.step(action)
    with pytest.raises(ValueError, match=message):
        getattr(env, method)(**arguments)
    if isinstance(env, NavigationEnv):
        assert env.np_random_seed == 0
    for _ in range(2):
        np.testing.assert_array_equal(env.step(action)[0], twin.step(action)[0])
    for _ in range(3):
        np.testing.assert_array_equal(env.reset()[0], twin.reset()[0])
