"""A vector environment goes on where another one was, in the middle of episodes."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from mpfa_envs import (
    ROBOTS,
    Box,
    RewardTerms,
    RobotNoise,
    Task,
    VectorNavigationEnv,
    World,
    navigation_reward,
)
from tests.envs.busy import BUSY, POLITE, STANDING, needs

ALL = RobotNoise(range_noise=0.03, dropout=0.05, slip=0.1, drift=0.05)
TASKS = [None, Task((-4.0, 0.0, 1.0), (4.0, 0.0)), None]
CASES: dict[str, dict[str, Any]] = {
    "worlds": {"world": ["B", "D", "test"], "action_repeat": 3},
    "path": {"world": "bars", "progress": "shortest_path", "lidar": {"noise": 0.02}},
    "kept": {"world": "mixed", "episodes_per_world": 3, "autoreset_mode": AutoresetMode.SAME_STEP},
    "physics": {"world": ["A", "D"], "physics": "wheels"},
    "history": {"world": ["B", "D"], "history": 3, "action_repeat": 1, "lidar": {"noise": 0.02}},
    "noise": {"world": "rooms", "noise": ALL, "memory": "map"},
    "noisy physics": {"world": "rooms", "noise": ALL, "memory": "map", "physics": "wheels"},
    "crowd": {"world": "crowd"},
    "walkers": {"world": [BUSY, STANDING], "lidar": {"noise": 0.02}},
    "orca": {"world": [POLITE]},
}


def drive(env: VectorNavigationEnv, first: int, last: int) -> list[np.ndarray]:
    """All that steps show."""
    seen = shown(env)
    for step in range(first, last):
        rng = np.random.default_rng(step)
        *found, _ = env.step(rng.uniform(-0.3, 1.0, (env.num_envs, 2)).astype(np.float32))
        seen += [*found, *shown(env)]
    return seen


def shown(env: VectorNavigationEnv) -> list[np.ndarray]:
    walkers = [env.walkers(index) for index in range(env.num_envs)]
    return [env.observations, env.motions, env.measurements, *env.info_tables, *walkers]


def same(first: list[np.ndarray], second: list[np.ndarray]) -> bool:
    return all(np.array_equal(one, two) for one, two in zip(first, second, strict=True))


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_a_loaded_environment_continues_to_the_bit(case: dict[str, Any]) -> None:
    needs(case)
    case = {"physics": "kinematic"} | case
    env, other = (VectorNavigationEnv(3, **case) for _ in range(2))
    env.reset(seed=1)
    drive(env, 0, 60)
    env.step(np.ones((3, 2), np.float32), only=np.array([True, False, True]))
    env.set_seed([3, None, None])  # For its next episode.
    state = json.loads(json.dumps(env.state_dict(), default=np.ndarray.tolist))
    other.reset(seed=2, options={"worlds": env.worlds[::-1]})
    drive(other, 0, 7)
    other.load_state_dict({**state, "rejected": env.worlds_rejected + 7})
    assert other.worlds_rejected == env.worlds_rejected + 7
    assert other.tasks == env.tasks and other.worlds == env.worlds
    assert [other.trail(i) for i in range(3)] == [env.trail(i) for i in range(3)]
    assert same(drive(other, 60, 90), drive(env, 60, 90))
    assert same(other.reset()[:1], env.reset()[:1])
    env.close()
    other.close()


def test_a_state_from_before_the_first_reset_needs_a_reset() -> None:
    env, other = (VectorNavigationEnv(2, world="clutter", physics="kinematic") for _ in range(2))
    env.set_seed(4)
    other.reset(seed=2)
    other.load_state_dict(env.state_dict())
    with pytest.raises(ResetNeeded):
        other.step(np.zeros((2, 2), np.float32))
    assert same(other.reset()[:1], env.reset()[:1])


def test_a_seed_counts_from_the_next_episode() -> None:
    env, other = (VectorNavigationEnv(2, world="B", noise=ALL, physics="kinematic") for _ in "ab")
    for each in (env, other):
        each.reset(seed=1)
    env.set_seed(5)
    assert same(drive(env, 0, 5), drive(other, 0, 5))
    assert same(env.reset()[:1], other.reset(seed=5)[:1])
    assert env.state_dict()["seeded"] == [None, None]


def value(value: object, *keys: str | int) -> Callable[[Any], None]:
    """Put a value, or what a function makes of the present one, into a state."""

    def spoil(state: Any) -> None:
        *outer, last = keys
        for key in outer:
            state = state[key]
        state[last] = value(state[last]) if callable(value) else value

    return spoil


def later(generator: dict[str, Any]) -> dict[str, Any]:
    rng = np.random.default_rng()
    rng.bit_generator.state = generator
    rng.random()
    return dict(rng.bit_generator.state)


SPOILED: list[tuple[Callable[[Any], None], str]] = [
    (lambda state: state.pop("robots"), r"no state_dict\(\) gave it, KeyError\('robots'\)"),
    (value(None, "arguments"), r"no state_dict\(\) gave it, AttributeError"),
    (lambda state: state["arguments"].pop("split"), "split = 'train', got one with None"),
    (value(5, "arguments", "num_envs"), "num_envs = 2, got one with 5"),
    (value(-1, "rejected"), "rejected must be an integer of at least 0, got -1"),
    (value([{}, None], "seeded"), "state must be for a PCG64|KeyError"),
    (value({}, "robots", 0), "no state_dict"),
    (value(later, "robots", 0, "generator"), "end elsewhere"),
    (value(-1, "robots", 0, "left"), "left must be an integer of at least 0, got -1"),
    (value(1, "robots", 0, "left"), "kept must name a generator's world, got None"),
    (
        value(lambda robot: {**robot, "left": 1, "kept": "B"}, "robots", 0),
        "kept must name a generator's world, got 'B'",
    ),
    (
        value(lambda robot: {**robot, "left": 1, "kept": "halls-7"}, "robots", 0),
        "world 'halls-7' must be at most",
    ),
    (value([[9.0, 0.0]], "robots", 0, "speeds"), "speeds .* at most 1050 pairs from .* to 0.5"),
    (value(np.zeros((1999, 2)), "robots", 0, "speeds"), "speeds .* at most 1050 pairs"),
    (value(np.full((250, 2), 0.5), "robots", 0, "speeds"), r"continue after .* robots \[0\]"),
    (value(lambda speeds: speeds[:-1], "robots", 1, "speeds"), "end elsewhere"),
    (value(np.zeros((3, 2)), "positions"), r"positions must have shape \(2, 2\)"),
]


@pytest.mark.parametrize(
    ("physics", "spoil", "message"),
    [
        *(("kinematic", *row) for row in SPOILED),
        *(("wheels", *row) for row in SPOILED if row[1] == "end elsewhere"),
    ],
)
def test_a_state_that_is_rejected_changes_nothing(
    physics: str, spoil: Callable[[Any], None], message: str
) -> None:
    env, twin = (VectorNavigationEnv(2, world="B", physics=physics) for _ in range(2))
    for each in (env, twin):
        each.reset(seed=0)
        drive(each, 0, 5)
    state = copy.deepcopy(env.state_dict())
    spoil(state)
    with pytest.raises(ValueError, match=f"(state|speeds) .*{message}"):
        env.load_state_dict(state)
    assert same(drive(env, 5, 15), drive(twin, 5, 15))
    env.close()
    twin.close()


OTHERS: list[tuple[dict[str, Any], str]] = [
    ({"world": "mixed"}, r"world = 'A \(.{8}\)', got one with 'mixed'"),
    ({"world": World(name="A", boxes=(Box(1.0, 1.0, 2.0, 2.0),))}, "world = .*, got .*'A "),
    ({"robot": replace(ROBOTS["burger"], mass=2.0)}, "robot.mass = 1.0, got one with 2.0"),
    ({"progress_scale": 99.0}, "progress_scale = 5.0, got one with 99.0"),
    ({"reward": partial(navigation_reward, goal_reward=3.0)}, "goal_reward = 10.0, got .* 3.0"),
    ({"reward": lambda outcome: RewardTerms()}, "reward = 'navigation_reward', got .* of your own"),
    ({"lidar": {"reduction": "median"}}, "lidar.reduction = 'min', got one with 'median'"),
    ({"noise": ALL}, "noise = None, got one with "),
    ({"autoreset_mode": AutoresetMode.SAME_STEP}, "autoreset_mode = 'NextStep', got .*'SameStep'"),
]


@pytest.mark.parametrize(("arguments", "message"), OTHERS, ids=[message for _, message in OTHERS])
def test_a_state_of_another_argument_is_rejected(arguments: dict[str, Any], message: str) -> None:
    standard = {"world": "A", "robot": "burger", "physics": "kinematic"}
    env, other = (VectorNavigationEnv(2, **standard | more) for more in ({}, arguments))
    with pytest.raises(ValueError, match=f"it must be of an environment with {message}"):
        env.load_state_dict(other.state_dict())


@pytest.mark.parametrize("options", [{"worlds": ["A", "B", None]}, {"tasks": TASKS}])
def test_an_episode_of_options_is_saved_only_after_the_next_reset(options: dict[str, Any]) -> None:
    env, other = (VectorNavigationEnv(3, world="D", physics="kinematic") for _ in range(2))
    env.reset(seed=1, options=options)
    with pytest.raises(ValueError, match="whose world or task the options of a reset gave: save"):
        env.state_dict()
    assert same(env.reset()[:1], [env.observations])
    other.load_state_dict(env.state_dict())
    assert same(drive(other, 0, 5), drive(env, 0, 5))


def test_loading_releases_the_physics_of_before(monkeypatch: pytest.MonkeyPatch) -> None:
    env, released = VectorNavigationEnv(2, world="A", physics="kinematic"), []
    env.reset(seed=0)
    before = env._batch.drives
    monkeypatch.setattr(before, "close", lambda: released.append(before), raising=True)
    env.load_state_dict(env.state_dict())
    assert released == [before] and env._batch.drives is not before
