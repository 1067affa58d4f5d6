"""The dynamic window: what it sees, what it may choose, and how far that gets."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from mpfa_envs import Box, NavigationEnv, RobotModel, World, evaluate
from mpfa_envs.planners import DynamicWindow, WindowScore
from mpfa_envs.robots.model import ROBOTS
from mpfa_envs.sensing.observation import observation_slices
from tests.envs.paper import drive_to_end

TURTLEBOT = ROBOTS["turtlebot2"]
PARTS = observation_slices()


def observation(
    *, goal: tuple[float, float] = (3.0, 0.0), left: float = 0.3, right: float = 0.3
) -> np.ndarray:
    """The observation of a robot in the open that drives with some wheel speeds [m/s]."""
    seen = np.zeros(24, np.float32)
    seen[PARTS["lidar"]] = 0.25 / 10.0
    distance = math.hypot(*goal)
    seen[PARTS["goal_direction"]] = goal[0] / distance, goal[1] / distance
    seen[PARTS["goal_distance"]] = distance / 10.0
    seen[PARTS["linear_speed"]] = 0.5 * (left + right) / TURTLEBOT.max_wheel_speed
    turn = (right - left) / TURTLEBOT.wheel_base
    seen[PARTS["angular_speed"]] = turn / TURTLEBOT.max_angular_speed
    return seen


def with_wall_ahead(seen: np.ndarray, distance: float) -> np.ndarray:
    """The same with a wall across the path, at a distance from the robot's center [m]."""
    angles = np.pi * (0.5 - (np.arange(18) + 0.5) / 18)
    ranges = np.minimum(distance / np.maximum(np.cos(angles), 1e-9), 10.0)
    seen = seen.copy()
    seen[PARTS["lidar"]] = 0.25 / np.maximum(ranges, 0.25)
    return seen


def speeds(action: np.ndarray) -> tuple[float, float]:
    return TURTLEBOT.wheel_speeds(action)


def cart(speed: float, braking: float, view: float) -> RobotModel:
    """A robot that can stop and reverse [m/s, m/s², degrees]."""
    return RobotModel(
        name="cart", radius=0.25, height=0.3, mass=10.0, wheel_base=0.4, wheel_radius=0.06,
        min_wheel_speed=-speed, max_wheel_speed=speed, wheel_acceleration=braking,
        field_of_view=view,
    )  # fmt: skip


CARTS = [(1.0, 0.5, 360.0), (1.5, 1.0, 360.0), (1.0, 0.3, 360.0), (0.7, 0.8, 180.0),
         (0.7, 0.8, 270.0), (1.0, 0.5, 180.0)]  # fmt: skip


@pytest.mark.parametrize(("speed", "braking", "view"), CARTS)
def test_it_collides_with_nothing_however_long_the_robot_takes_to_stop(
    speed: float, braking: float, view: float
) -> None:
    robot = cart(speed, braking, view)
    window = DynamicWindow(robot=robot, memory="map")
    results = evaluate(window, "test", episodes=5, physics="kinematic", robot=robot)
    assert not any(each.collision for each in results)
    assert np.mean([each.success for each in results]) > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("world", ["test", "mazes-2", "mazes-5"])
@pytest.mark.parametrize(("speed", "braking", "view"), CARTS)
def test_it_collides_with_nothing_in_forty_drives(
    speed: float, braking: float, view: float, world: str
) -> None:
    robot = cart(speed, braking, view)
    window = DynamicWindow(robot=robot, memory="map")
    results = evaluate(window, world, episodes=40, physics="kinematic", robot=robot)
    assert not any(each.collision for each in results)


@pytest.mark.parametrize("view", [180.0, 270.0, 360.0])
def test_it_reverses_only_where_it_sees(view: float) -> None:
    slowest = DynamicWindow(robot=cart(0.7, 0.8, view)).pairs.sum(axis=1).min()
    assert slowest == (pytest.approx(-1.4) if view == 360.0 else 0.0)


def test_arcs_let_a_robot_that_cannot_stop_turn_round() -> None:
    wide = replace(cart(1.0, 0.5, 180.0), min_wheel_speed=0.4)
    assert DynamicWindow(robot=wide).length == pytest.approx(math.pi * 0.5 * 0.4 * 1.4 / 0.6)
    assert DynamicWindow().length == 0.6


def test_arcs_are_those_that_the_robot_drives() -> None:
    window = DynamicWindow(samples=4)
    with NavigationEnv(world="A", physics="kinematic", time_step=0.1, action_repeat=1) as env:
        for pair, arc in zip(window.pairs, window.arcs, strict=True):
            env.reset(options={"start": (0.0, 0.0, 0.0), "goal": (4.0, 4.0)})
            action = (2.0 * (pair - 0.05) / 0.45 - 1.0).astype(np.float32)
            driven = []
            steps = round(float(window.length / pair.mean() / 0.1)) + 2
            for _ in range(min(steps, 60)):
                *_, info = env.step(action)
                driven.append((info["x"], info["y"]))
            gaps = np.linalg.norm(np.array(driven)[None] - arc[:, None], axis=2).min(axis=1)
            # No farther from the path driven than half of what is driven in a step.
            assert gaps[: len(arc) // 2].max() < 0.03


def test_wheel_speeds_stay_in_the_window_and_their_range() -> None:
    window = DynamicWindow(acceleration=0.5, decision=0.2)
    rng = np.random.default_rng(0)
    for _ in range(50):
        left, right = rng.uniform(0.05, 0.5, 2)
        goal = tuple(rng.uniform(-3.0, 3.0, 2))
        chosen = speeds(window(observation(goal=goal, left=left, right=right)))
        assert np.abs(np.array(chosen) - (left, right)).max() <= 0.1 + 1e-5
        assert min(chosen) >= 0.05 - 1e-6 and max(chosen) <= 0.5 + 1e-6


def test_a_robot_whose_controller_limits_its_turn_turns_no_faster() -> None:
    robot = replace(ROBOTS["kobuki"], turn_acceleration=1.0)
    seen = np.zeros(DynamicWindow(robot=robot).observation_size, np.float32)
    parts = observation_slices(36)
    seen[parts["lidar"]], seen[parts["goal_direction"]] = 0.02, (0.0, 1.0)
    left, right = robot.wheel_speeds(DynamicWindow(robot=robot)(seen))
    assert abs(right - left) / robot.wheel_base <= 0.2 + 1e-6


def test_in_the_open_it_turns_and_drives_to_the_goal() -> None:
    window = DynamicWindow()
    left, right = speeds(window(observation(goal=(3.0, 0.0), left=0.5, right=0.5)))
    assert left == right == pytest.approx(0.5)
    left, right = speeds(window(observation(goal=(1.0, 2.0))))
    assert right > left
    left, right = speeds(window(observation(goal=(1.0, -2.0))))
    assert left > right


def test_it_turns_from_a_wall_that_hides_the_goal() -> None:
    window = DynamicWindow()
    ahead = observation(goal=(3.0, 0.3))
    left, right = speeds(window(with_wall_ahead(ahead, 0.6)))
    assert abs(right - left) > 0.1


def test_without_a_free_arc_it_takes_the_longest() -> None:
    window = DynamicWindow()
    seen = observation()
    # Posts all around at 0.35 m: only how far an arc gets tells them apart.
    seen[PARTS["lidar"]] = 0.25 / 0.35
    left, right = speeds(window(seen))
    arcs = {tuple(pair): arc for pair, arc in zip(window.pairs.round(6), window.arcs, strict=True)}
    angles = np.pi * (0.5 - (np.arange(18) + 0.5) / 18)
    posts = 0.35 * np.stack((np.cos(angles), np.sin(angles)), axis=1)

    def steps_free(arc: np.ndarray) -> int:
        for step, place in enumerate(arc):
            if np.linalg.norm(posts - place, axis=1).min() - 0.18 < WindowScore().least:
                return step
        return len(arc)

    reachable = [pair for pair in arcs if np.abs(np.array(pair) - 0.3).max() <= 0.2 + 1e-9]
    most = max(steps_free(arcs[pair]) for pair in reachable)
    chosen = min(reachable, key=lambda pair: math.dist(pair, (left, right)))
    assert most < len(window.arcs[0])
    assert steps_free(arcs[chosen]) == most


def test_each_choice_depends_on_its_own_observation_alone() -> None:
    window = DynamicWindow()
    rng = np.random.default_rng(1)
    seen = [
        with_wall_ahead(observation(goal=tuple(rng.uniform(-3, 3, 2))), rng.uniform(0.4, 3.0))
        for _ in range(8)
    ]
    together = window(np.array(seen))
    assert together.shape == (8, 2) and together.dtype == np.float32
    for row, action in zip(seen, together, strict=True):
        assert np.array_equal(window(row), action)
    assert np.array_equal(window(np.array(seen)[::-1]), together[::-1])


def test_with_a_map_it_follows_the_path_to_the_goal() -> None:
    window = DynamicWindow(memory="map")
    seen = np.append(observation(goal=(2.0, 2.0)), [0.6, -0.8, 0.5]).astype(np.float32)
    left, right = speeds(window(seen))
    assert left > right


@pytest.mark.parametrize(
    ("world", "least"), [("A", 15), ("validation", 10)], ids=["A", "validation"]
)
def test_it_reaches_most_goals(world: str, least: int) -> None:
    results = evaluate(DynamicWindow(), world, episodes=15, seed=5)
    assert sum(result.success for result in results) >= least


def test_a_map_leads_it_out_of_a_pocket() -> None:
    walls = (Box(1.0, -1.2, 1.2, 1.2), Box(-0.8, 1.0, 1.2, 1.2), Box(-0.8, -1.2, 1.2, -1.0))
    pocket = World(name="pocket", boxes=walls)
    success = {}
    for memory in ("none", "map"):
        task = {"memory": memory, "contact": True}
        with NavigationEnv(world=pocket, physics="kinematic", **task) as env:
            *_, info = drive_to_end(env, DynamicWindow(memory=memory), goal=(3.0, 0.0))
        success[memory] = info["success"]
    assert success == {"none": False, "map": True}


def test_few_speeds_of_slow_wheels_include_the_nearest() -> None:
    # The speeds of a wheel are 0.05, 0.2, 0.35 and 0.5 m/s, and none is within 0.02 m/s of it.
    window = DynamicWindow(samples=4, acceleration=0.1)
    chosen = speeds(window(observation(goal=(0.0, 3.0), left=0.3, right=0.25)))
    assert chosen == pytest.approx((0.35, 0.2))


def test_it_keeps_off_a_wall_beside_it_if_clearance_counts() -> None:
    seen = observation(goal=(3.0, 0.0), left=0.5, right=0.5)
    seen[PARTS["lidar"]][:5] = 0.25 / 0.4  # On the left.
    left, right = speeds(DynamicWindow(score=WindowScore(clearance=0.0))(seen))
    assert left == right
    left, right = speeds(DynamicWindow(score=WindowScore(clearance=1.0))(seen))
    assert left > right
