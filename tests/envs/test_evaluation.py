"""Evaluation: known answers for the estimates, and controllers whose success is known."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mpfa_envs import (
    POLICIES,
    ROBOTS,
    Policy,
    TaskConfig,
    VectorNavigationEnv,
    evaluate,
    load_policy,
    make_planner,
    run_tasks,
    summarize,
    world_tasks,
)
from mpfa_envs.driver import Filtered
from mpfa_envs.evaluation.results import EpisodeResult, bootstrap, sct, spl, wilson
from mpfa_envs.policies.layers import Linear, Tanh
from mpfa_envs.policies.policy import policy_file
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot


def steer(observation: NDArray[np.float32]) -> NDArray[np.float32]:
    """Turn towards the goal, as a policy in an empty world has to; for one or many robots."""
    turn = np.arctan2(observation[..., 19], observation[..., 18])
    return np.clip(np.stack((1.0 - 2.0 * turn, 1.0 + 2.0 * turn), axis=-1), -1, 1)


def circle(observation: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.broadcast_to(np.array([-1.0, 1.0]), (*observation.shape[:-1], 2))


def stand(observation: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.zeros(2)


def steering_policy(**env_arguments: object) -> Policy:
    """Turns to the goal by its sine."""
    weight = np.zeros((2, 24), np.float32)
    weight[0, 19], weight[1, 19] = -3.0, 3.0
    layers = [Linear(weight, np.full(2, 0.8, np.float32)), Tanh()]
    return Policy(layers, env_arguments={"physics": "kinematic", **env_arguments})


def result(**changes: float) -> EpisodeResult:
    fields = {
        "episode": 0, "success": True, "collision": False, "timeout": False, "time_s": 10.0,
        "path_length": 4.0, "shortest_path": 3.0, "min_clearance": 0.5, "spl": 0.75,
        "sct": 0.6,
    }  # fmt: skip
    return EpisodeResult(**{**fields, **changes})  # type: ignore[arg-type]


def test_a_rate_has_the_interval_of_wilson() -> None:
    rate, total, z = 0.905, 200, 1.959964
    center = (rate + z * z / (2 * total)) / (1 + z * z / total)
    half = z * math.sqrt(rate * (1 - rate) / total + z * z / (4 * total**2)) / (1 + z * z / total)
    interval = wilson([True] * 181 + [False] * 19)
    expected = (rate, center - half, center + half)
    assert (interval.value, interval.low, interval.high) == pytest.approx(expected, abs=1e-6)


def test_the_bootstrap_interval_covers_the_mean_at_its_level() -> None:
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(200):
        interval = bootstrap(list(rng.normal(3.0, 1.0, 40)), rng)
        covered += interval.low <= 3.0 <= interval.high
    assert 175 <= covered <= 199


@pytest.mark.parametrize("values", [[], [2.0]])
def test_without_two_values_there_is_no_interval(values: list[float]) -> None:
    interval = bootstrap(values, np.random.default_rng(0))
    assert math.isnan(interval.low) and math.isnan(interval.high)
    assert interval.value == pytest.approx(values[0] if values else math.nan, nan_ok=True)


def test_outcomes_sum_to_one_and_times_count_successes_alone() -> None:
    failed = {"success": False, "spl": 0.0, "sct": 0.0, "time_s": 50.0}
    summary = summarize(
        [result(), result(**failed, collision=True), result(**failed, timeout=True), result()]
    )
    assert summary["success"].value == 0.5
    assert sum(summary[k].value for k in ("success", "collision", "timeout")) == 1.0
    assert summary["time_s"].value == 10.0
    assert summary["spl"].value == pytest.approx(0.375)
    assert summary["sct"].value == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("success", "driven", "expected"), [(True, 4.0, 0.75), (True, 2.9, 1.0), (False, 3.0, 0.0)]
)
def test_spl_is_the_shortest_path_over_the_driven_one(
    success: bool, driven: float, expected: float
) -> None:
    assert spl(success, path_length=driven, shortest_path=3.0) == expected


@pytest.mark.parametrize(
    ("success", "time_s", "expected"), [(True, 8.0, 0.75), (True, 5.9, 1.0), (False, 9.0, 0.0)]
)
def test_sct_is_the_time_of_the_shortest_path_at_full_speed_over_the_time_taken(
    success: bool, time_s: float, expected: float
) -> None:
    assert sct(success, time_s=time_s, shortest_path=3.0, speed=0.5) == expected


@pytest.mark.parametrize("physics", ["kinematic", "wheels"])
def test_results_do_not_depend_on_how_many_run_at_once(physics: str) -> None:
    policy = steering_policy(max_steps=60, lidar={"noise": 0.01})
    alone, three, eight = (
        evaluate(policy, "B", episodes=9, physics=physics, envs_at_once=count)
        for count in (1, 3, 8)
    )
    assert alone == three == eight
    assert {(r.success, r.collision, r.timeout) for r in alone} >= {(0, 1, 0), (0, 0, 1)}


def test_several_worlds_give_rows_that_name_theirs() -> None:
    policy = steering_policy(max_steps=20)
    both = evaluate(policy, ["C", "rooms-100"], episodes=3)
    assert [(r.world, r.episode) for r in both] == [
        (world, episode) for world in ("C", "rooms-100") for episode in range(3)
    ]
    assert both[3:] == evaluate(policy, "rooms-100", episodes=3)
    assert both[0].barn_score is None


def test_a_policys_env_arguments_hold_unless_others_are_given(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[VectorNavigationEnv] = []
    original = VectorNavigationEnv.__init__

    def remember(self: VectorNavigationEnv, *sizes: int, **arguments: object) -> None:
        original(self, *sizes, **arguments)  # type: ignore[arg-type]
        made.append(self)

    monkeypatch.setattr(VectorNavigationEnv, "__init__", remember)
    learned = {"robot": "burger", "max_steps": 7, "action_repeat": 2, "closeness_distance": 0.2}
    learned |= {"progress": "shortest_path", "lidar": {"sectors": 18}}
    policy = steering_policy(**learned)
    evaluate(policy, "A", episodes=1)
    evaluate(policy, "A", episodes=1, action_repeat=3, contact=False, clearance=0.195)
    first, second = made
    expected = {**learned, "contact": True, "physics": "kinematic"}
    assert first.config == TaskConfig(**{**expected, "max_steps": first.config.max_steps})
    assert (first.config.max_steps, first.config.action_repeat) == (7, 2)
    assert second.config.action_repeat == 3
    assert [each.config.collision_distance for each in (first, second)] == [0.105, 0.3]


def test_a_trajectory_leads_from_start_to_goal() -> None:
    tasks = world_tasks("A", episodes=5, seed=2)
    trails: dict[int, list[tuple[float, float]]] = {}

    def keep(env: VectorNavigationEnv, robot: int, number: int) -> None:
        trails[number] = env.trail(robot)

    arguments = {"physics": "kinematic", "max_steps": 300}
    results = run_tasks(steer, tasks, envs_at_once=2, on_end=keep, **arguments)
    for number, (episode, each) in enumerate(zip(results, tasks, strict=True)):
        trail = trails[number]
        assert trail[0] == pytest.approx(each.task.start[:2])
        assert math.dist(trail[-1], each.task.goal) <= 0.5
        driven = np.linalg.norm(np.diff(trail, axis=0), axis=1).sum()
        assert episode.path_length == pytest.approx(driven)
        assert episode.time_s == pytest.approx(0.1 * (len(trail) - 1))


def test_the_test_worlds_of_a_generator_have_four_tasks_each() -> None:
    tasks = world_tasks("bars:test", episodes=10)
    names = [each.world.name for each in tasks]
    assert names == ["bars-test-0"] * 4 + ["bars-test-1"] * 4 + ["bars-test-2"] * 2
    assert world_tasks("bars:test", episodes=4) == tasks[:4]
    results = evaluate(steering_policy(max_steps=20), "bars:test", episodes=6)
    assert [(found.world, found.episode) for found in results[3:]] == [
        ("bars-test-0", 3), ("bars-test-1", 0), ("bars-test-1", 1),
    ]  # fmt: skip


def test_barn_has_100_seconds_and_other_tasks_what_is_asked_for() -> None:
    limits = {"bars:test": 2.0, "mazes:validation": 2.0, "barn": 100.0, "A": 2.0}
    for name, limit in limits.items():
        (found,) = evaluate(circle, name, episodes=1, physics="kinematic", max_steps=20)
        assert found.timeout and found.time_s == pytest.approx(limit)


@pytest.mark.parametrize("world", ["rooms:test", "A"])
@pytest.mark.parametrize(("robot", "limit"), [("kobuki", 150.0), ("burger", 477.3)])
def test_every_robot_has_the_time_for_105_m_at_full_speed(
    world: str, robot: str, limit: float
) -> None:
    found = evaluate(stand, world, episodes=1, physics="kinematic", robot=robot)
    assert [(each.outcome, round(each.time_s, 1)) for each in found] == [("standstill", limit)]


def test_a_robot_stands_still_that_turns_on_the_spot_but_not_one_that_drives() -> None:
    arguments: dict[str, Any] = {"physics": "kinematic", "robot": "kobuki", "max_steps": 150}
    around = {"turns": circle, "stands": stand, "drives": lambda _: np.array([0.2, 0.8])}
    ends = [evaluate(driver, "A", episodes=1, **arguments)[0] for driver in around.values()]
    assert [end.outcome for end in ends] == ["standstill", "standstill", "timeout"]
    assert all(end.timeout for end in ends)
    summary = summarize(ends)
    assert (summary["timeout"].value, summary["standstill"].value) == (1.0, 2 / 3)
    short = evaluate(stand, "A", episodes=1, **{**arguments, "max_steps": 50})
    assert short[0].outcome == "timeout"  # Ten seconds are needed to tell.


def test_a_time_limit_is_in_seconds_whatever_the_time_step() -> None:
    for time_step in (0.05, 0.2):
        given = {"physics": "kinematic", "time_step": time_step, "action_repeat": 1}
        (found,) = evaluate(circle, "barn", episodes=1, **given)
        assert found.timeout and found.time_s == pytest.approx(100.0)


def test_walkers_and_noise_of_a_task_ignore_the_other_tasks() -> None:
    given: dict[str, Any] = {"physics": "kinematic", "lidar": {"noise": 0.05}, "max_steps": 100}
    crowd = world_tasks("crowd:test", episodes=6)
    alone = run_tasks(steer, crowd, **given)
    after = run_tasks(steer, [*world_tasks("A", episodes=2), *crowd], **given)
    assert after[2:] == alone
    some = run_tasks(steer, crowd[3:], **given)
    assert [found.path_length for found in some] == [found.path_length for found in alone[3:]]


def test_an_undrivable_task_is_named_before_any_is_driven() -> None:
    wide = replace(resolve_robot("turtlebot2"), name="wide", radius=0.45)
    tasks, driven = world_tasks("bars:test", episodes=40), 0

    def count(observation: NDArray[np.float32]) -> NDArray[np.float64]:
        nonlocal driven
        driven += 1
        return np.ones(2)

    with pytest.raises(ValueError, match=r"task \d+, in world 'bars-test-\d+': (goal|start) must"):
        run_tasks(count, tasks, robot=wide, physics="kinematic")
    assert driven == 0


BIG = replace(ROBOTS["kobuki"], name="big", radius=0.35)


@pytest.mark.parametrize(
    ("policy", "robot", "message"),
    [
        (make_planner("astar", robot="kobuki"), BIG, "with robot='big': name .* radius 0.18 and"),
        (make_planner("dijkstra"), "kobuki", "robot='kobuki': .*, min_wheel_speed 0.05 and -0.7"),
        (load_policy("td3-turtlebot2"), replace(ROBOTS["turtlebot2"], wheel_acceleration=0.2),
         "'turtlebot2' with robot='turtlebot2': wheel_acceleration .* and 0.2 differ"),
        (Filtered(load_policy("td3-rooms"), TaskConfig(robot="waffle", memory="map").make_filter()),
         "kobuki", "filter must be .*, got one for 'waffle' with robot='kobuki'"),
    ],
)  # fmt: skip
def test_a_policy_for_another_robot_is_warned_of(
    policy: Any, robot: RobotChoice, message: str
) -> None:
    with pytest.warns(UserWarning, match=message):
        evaluate(policy, "A", episodes=1, physics="kinematic", robot=robot, max_steps=2)


def test_a_policy_that_learned_behind_the_filter_and_has_none_is_warned_of() -> None:
    policy = load_policy("td3-rooms")
    assert policy.card["filter"]
    with pytest.warns(UserWarning, match="learned behind the filter and drives without it"):
        evaluate(policy, "A", episodes=1, max_steps=2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        behind = Filtered(policy, TaskConfig(**policy.env_arguments).make_filter())
        evaluate(behind, "A", episodes=1, max_steps=2, **policy.env_arguments)
        evaluate(load_policy("td3-paper"), "A", episodes=1, max_steps=2)


@pytest.mark.parametrize("name", POLICIES)
def test_a_policy_of_the_package_drives_around_obstacles(name: str) -> None:
    assert policy_file(name).stat().st_size < 100_000
    policy = load_policy(name)
    assert policy.card["method"] == "mpfa_per"
    memory = {} if name == "td3-paper" else {"memory": "map"}
    assert set(policy.env_arguments) - {"history"} == {
        "robot", "physics", "action_repeat", "closeness_distance", *memory,
    }  # fmt: skip
    assert policy.env_arguments.items() >= memory.items()
    driver = policy
    if policy.card.get("filter"):
        driver = Filtered(policy, TaskConfig(**policy.env_arguments).make_filter())
    arguments = policy.env_arguments | {"physics": "kinematic"}
    results = evaluate(driver, "D", episodes=10, seed=4711, **arguments)
    assert sum(found.success for found in results) >= 9
