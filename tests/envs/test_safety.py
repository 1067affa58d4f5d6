from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mpfa_envs import (
    GENERATORS,
    ROBOTS,
    Box,
    RobotModel,
    SafetyFilter,
    TaskConfig,
    VectorNavigationEnv,
    World,
    evaluate,
)
from mpfa_envs.driver import Filtered
from mpfa_envs.robots.resolve import resolve_robot
from mpfa_envs.sensing.lidar import ray_angles

AROUND = {"field_of_view": 360.0, "sectors": 36}
STANDING = [name for name in GENERATORS if name not in ("crowd", "mixed")]
WALL = World(name="wall", size=(10.0, 10.0), boxes=(Box(1.0, -4.0, 1.5, 4.0),))


def task(robot: str | RobotModel = "kobuki", **arguments: Any) -> dict[str, Any]:
    near = resolve_robot(robot).radius
    return {"robot": robot, "physics": "kinematic", "closeness_distance": near, **arguments}


def observed(config: TaskConfig, ranges: float | np.ndarray, left: float = 0.0, right: float = 0.0):
    """The observation of a robot with wheel speeds [m/s] amid ranges [m]."""
    robot, parts = config.robot, config.observation_slices
    seen = np.zeros(max(part.stop for part in parts.values()), np.float32)
    seen[parts["lidar"]] = config.closeness_distance / np.maximum(ranges, config.closeness_distance)
    seen[parts["linear_speed"]] = 0.5 * (left + right) / robot.max_wheel_speed
    turning = (right - left) / robot.wheel_base
    seen[parts["angular_speed"]] = turning / robot.max_angular_speed
    return seen


def ahead_is(config: TaskConfig, distance: float) -> np.ndarray:
    """Ranges of the sectors where a wall crosses the robot's way at a distance [m]."""
    angles = config.make_lidar().angles.reshape(-1, 3)
    cosines = np.cos(angles)
    ranges = np.where(cosines > 1e-9, distance / np.maximum(cosines, 1e-9), np.inf)
    return np.minimum(ranges.min(axis=1), 10.0)


def drive_at_random(
    robot: str | RobotModel,
    world: str,
    decisions: int,
    *,
    physics: str,
    robots: int,
    view: float = 360.0,
    latency: Any = None,
    told: RobotModel | None = None,
) -> float:
    """Least clearance of robots that hold a random action for a while [m]."""
    near = resolve_robot(robot).lidar_to_rim
    arguments = {"robot": robot, "physics": physics, "closeness_distance": near, "max_steps": 400}
    arguments |= {"contact": True, "latency": latency}
    arguments["lidar"] = {"field_of_view": view, "sectors": round(view / 10.0)}
    keep = TaskConfig(**arguments).make_filter()
    if told is not None:
        keep = SafetyFilter(
            told,
            angles=ray_angles(view, 108),
            sectors=36,
            max_range=10.0,
            closeness_distance=near,
            braking=0.8,
        )
    rng = np.random.default_rng(0)
    env = VectorNavigationEnv(robots, world=world, **arguments)
    observations, infos = env.reset(seed=0)
    least = math.inf
    for step in range(decisions // robots):
        if step % 10 == 0:
            actions = rng.uniform(-1.0, 1.0, (robots, 2)).astype(np.float32)
        observations, _, _, _, infos = env.step(keep(observations, actions))
        least = min(least, infos["min_clearance"].min())
    env.close()
    return least


KOBUKI = ROBOTS["kobuki"]
FAST = {"min_wheel_speed": -1.5, "max_wheel_speed": 1.5, "wheel_acceleration": 0.5}
SLOW_BRAKES = {"min_wheel_speed": -0.7, "wheel_acceleration": 0.2}
UNLIMITED = {"min_wheel_speed": -1.0, "max_wheel_speed": 1.0, "wheel_acceleration": None}
FORWARD = {"deceleration": 0.5, "turn_acceleration": 2.0, "reverse": False}
DRIVES: dict[str, tuple[dict[str, Any], str, dict[str, Any]]] = {
    "itself": ({}, "mazes", {}),
    "half a view": ({"lidar_mount": (0.0, 0.0, 0.0)}, "mazes", {"view": 180.0}),
    "lidar ahead": ({"lidar_mount": (0.12, 0.0, 0.0)}, "rooms", {"view": 240.0}),
    "lidar behind": ({"lidar_mount": (-0.1, 0.0, 0.0)}, "mazes", {"view": 180.0}),
    "lidar aside": ({"lidar_mount": (0.06, 0.1, 0.0)}, "rooms", {"view": 360.0}),
    "turns slowly": ({"deceleration": 0.5, "turn_acceleration": 0.5}, "rooms", {}),
    "forward alone": (FORWARD, "rooms", {}),
    "brakes slowly": (SLOW_BRAKES, "rooms", {}),
    "fast": (FAST, "rooms", {}),
    "stops at once": (UNLIMITED, "rooms", {}),
    "turns more quickly than it says": (
        {"wheel_acceleration": 2.0},
        "mazes",
        {"told": replace(KOBUKI, wheel_acceleration=2.0, turn_acceleration=1)},
    ),
    "late orders": ({}, "mazes", {"latency": 0.3}),
    "orders of any delay": ({}, "rooms", {"latency": (0.0, 0.25)}),
}
"""What differs from a Kobuki, the world, and arguments of the drive."""


@pytest.mark.parametrize("case", DRIVES)
def test_a_random_policy_touches_nothing(case: str) -> None:
    changes, world, arguments = DRIVES[case]
    robot = replace(KOBUKI, **{"field_of_view": arguments.get("view", 360.0)} | changes)
    least = drive_at_random(robot, world, 2_500, physics="kinematic", robots=20, **arguments)
    assert least > 0.0


@pytest.mark.parametrize(("view", "place"), [(60.0, (0.12, 0.0, 0.0)), (170.0, (0.0, 0.0, 0.0))])
def test_a_view_beside_which_it_would_never_drive_is_rejected(
    view: float, place: tuple[float, ...]
) -> None:
    robot = replace(ROBOTS["kobuki"], field_of_view=view, lidar_mount=place)
    with pytest.raises(ValueError, match=f"at least 180 degrees for a filter.* got {view:.0f}"):
        TaskConfig(robot=robot).make_filter()
    TaskConfig(robot=replace(ROBOTS["turtlebot2"], field_of_view=view)).make_filter()


@pytest.mark.parametrize(("x", "view"), [(0.12, 180.0), (-0.1, 240.0)])
def test_a_robot_drives_in_a_hall_wherever_its_lidar_is(x: float, view: float) -> None:
    robot = replace(ROBOTS["kobuki"], field_of_view=view, lidar_mount=(x, 0.0, 0.0))
    keep = TaskConfig(robot=robot).make_filter()
    ahead = np.ones(2, np.float32)
    assert keep(observed(TaskConfig(robot=robot), 10.0), ahead).tolist() == [1.0, 1.0]


@pytest.mark.parametrize("view", [180.0, 240.0, 300.0])
def test_a_robot_that_turns_with_a_rounded_speed_may_stop(view: float) -> None:
    changes = {"lidar_mount": (0.12, 0.0, 0.0), "wheel_acceleration": 0.3}
    robot = replace(ROBOTS["kobuki"], field_of_view=view, **changes)
    config = TaskConfig(robot=robot)
    seen, stand = observed(config, 8.0), np.zeros(2, np.float32)
    seen[..., config.observation_slices["linear_speed"]] = 1e-8
    seen[..., config.observation_slices["angular_speed"]] = -0.95
    assert config.make_filter()(seen, stand).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("view", [180.0, 270.0, 360.0])
def test_what_is_out_of_view_is_not_free(view: float) -> None:
    config = TaskConfig(**task(lidar={"field_of_view": view, "sectors": round(view / 10.0)}))
    keep, back = config.make_filter(), np.full(2, -0.3, np.float32)
    free = observed(config, 5.0)
    assert np.array_equal(keep(free, back), back) == (view == 360.0)
    for action in ((0.5, 0.5), (0.6, 0.4), (-0.3, 0.3)):
        wanted = np.array(action, np.float32)
        assert np.array_equal(keep(free, wanted), wanted)


@pytest.mark.slow
@pytest.mark.parametrize("world", STANDING)
def test_a_random_policy_touches_nothing_in_a_million_decisions(world: str) -> None:
    each = 1_000_000 // len(STANDING) + 64
    assert drive_at_random("kobuki", world, each, physics="kinematic", robots=64) > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("world", STANDING)
@pytest.mark.parametrize("robot", ["kobuki", "burger", "turtlebot4", "waffle"])
def test_a_random_policy_touches_nothing_on_wheels(robot: str, world: str) -> None:
    assert drive_at_random(robot, world, 4_000, physics="wheels", robots=32) > 0.0


def test_without_the_filter_a_random_policy_does_touch() -> None:
    arguments = task(contact=True)
    env = VectorNavigationEnv(20, world="mazes", **arguments)
    env.reset(seed=0)
    ahead = np.ones((20, 2), np.float32)
    touched = sum(env.step(ahead)[4]["collision"].sum() for _ in range(100))
    env.close()
    assert touched > 10


@pytest.mark.parametrize("robot", ["kobuki", "turtlebot2"])
def test_an_action_in_the_open_is_left_as_it_is(robot: str) -> None:
    config = TaskConfig(**task(robot))
    actions = np.random.default_rng(0).uniform(-1.5, 1.5, (50, 2)).astype(np.float32)
    seen = np.tile(observed(config, 3.0), (50, 1))
    assert np.array_equal(config.make_filter()(seen, actions), actions)


def test_a_robot_brakes_in_time_before_a_wall() -> None:
    config = TaskConfig(**task())
    keep, robot = config.make_filter(), config.robot
    start = -3.0
    env = VectorNavigationEnv(1, world=WALL, **task(contact=True))
    seen, infos = env.reset(options={"tasks": [((start, 0.0, 0.0), (3.0, 4.5))]})
    fastest = 0.0
    for _ in range(60):
        # Straight on alone: other candidates would steer clear.
        action = np.ones((1, 2), np.float32)
        if not np.array_equal(keep(seen, action), action):
            action[:] = 0.0
        seen, _, _, _, infos = env.step(action)
        fastest = max(fastest, env.motions[0, 3])
    gap = 1.0 - robot.radius - env.poses[0, 0]
    env.close()
    assert fastest == pytest.approx(robot.max_wheel_speed)
    assert 0.03 <= gap < 0.3 and not infos["collision"][0]


@pytest.mark.parametrize("gap", [0.029, 0.02, 0.014])
def test_what_is_too_near_may_be_passed_but_not_approached(gap: float) -> None:
    config = TaskConfig(**task())
    keep, beside = config.make_filter(), np.full(36, 5.0)
    beside[8:10] = config.robot.radius + gap  # To the left, from 80 to 100 degrees.
    slowly = np.full(2, 0.1, np.float32)
    assert np.array_equal(keep(observed(config, beside), slowly), slowly)
    before = np.full(36, 5.0)
    before[17:19] = config.robot.radius + gap
    assert keep(observed(config, before), slowly).sum() <= 0.0
    assert np.array_equal(keep(observed(config, before), -slowly), -slowly)


@pytest.mark.parametrize("action", [(0.1, 0.1), (0.0, 0.0), (-0.3, 0.3)])
def test_a_robot_that_has_crept_too_near_is_ordered_away(action: tuple[float, float]) -> None:
    config = TaskConfig(**task())
    keep, before = config.make_filter(), np.full(36, 5.0)
    for gap, leaves in ((0.002, True), (0.012, False)):
        before[17:19] = config.robot.radius + gap
        ordered = keep(observed(config, before), np.array(action, np.float32))
        assert (ordered.sum() < -0.01) == leaves


@pytest.mark.parametrize("gap", [0.009, 0.006])
def test_a_robot_too_near_that_drives_a_millimeter_a_second_may_turn_away(gap: float) -> None:
    robot = replace(ROBOTS["kobuki"], reverse=False, wheel_acceleration=0.7)
    config = TaskConfig(**task(robot=robot, time_step=0.02, action_repeat=10))
    keep, beside = config.make_filter(), np.full(36, 5.0)
    beside[9] = config.robot.radius + gap  # 80 to 90 degrees to the left of ahead.
    turns = np.array((0.3, -0.3), np.float32)  # To the right.
    ordered = keep(observed(config, beside, 0.116, -0.1136), turns)
    assert ordered[0] > ordered[1]


def test_what_is_nearer_than_the_observation_tells_may_be_at_the_rim() -> None:
    config = TaskConfig(**task(closeness_distance=0.4))
    assert config.make_filter()(observed(config, 0.3), np.full(2, 0.1, np.float32)).sum() <= 0.0


def test_turning_on_the_spot_is_always_possible() -> None:
    config = TaskConfig(**task())
    turn = np.array([-0.3, 0.3], np.float32)
    assert np.array_equal(config.make_filter()(observed(config, 0.185), turn), turn)


def test_a_robot_that_cannot_stop_keeps_room_for_a_circle() -> None:
    config = TaskConfig(**task("turtlebot2", lidar=AROUND))
    keep, ahead = config.make_filter(), np.ones(2, np.float32)
    near, far = (
        keep(observed(config, ahead_is(config, distance), 0.5, 0.5), ahead)
        for distance in (0.4, 0.9)
    )
    assert np.array_equal(far, ahead) and not np.array_equal(near, ahead)


@pytest.mark.parametrize(
    ("blocked", "drives"), [((8, 9), True), ((26, 27), True), ((8, 9, 26, 27), False)]
)
def test_one_free_circle_is_enough_for_a_robot_that_cannot_stop(
    blocked: tuple[int, ...], drives: bool
) -> None:
    config = TaskConfig(**task("turtlebot2", lidar=AROUND))
    ranges, ahead = np.full(36, 10.0), np.ones(2, np.float32)
    ranges[[*blocked]] = 0.35  # To the left, to the right, or on both sides.
    kept = config.make_filter()(observed(config, ranges, 0.5, 0.5), ahead)
    assert np.array_equal(kept, ahead) == drives


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_where_no_circle_is_free_it_turns_to_the_freer_side(side: float) -> None:
    config = TaskConfig(**task("turtlebot2", lidar=AROUND))
    ranges = np.full(36, 0.4)
    ranges[:18] += 0.03 * side
    left, right = config.make_filter()(observed(config, ranges, 0.3, 0.3), np.ones(2, np.float32))
    assert (left, right) == (-side, side)


def test_a_robot_that_cannot_stop_circles_among_walls_for_ever() -> None:
    arguments = task("turtlebot2", lidar=AROUND, contact=True, max_steps=3000)
    keep = TaskConfig(**arguments).make_filter()
    box = World(name="box", size=(2.0, 2.0))
    env = VectorNavigationEnv(1, world=box, goal_radius=0.05, min_goal_distance=0.2, **arguments)
    seen, infos = env.reset(options={"tasks": [((0.0, 0.0, 0.0), (0.78, 0.78))]})
    for _ in range(1000):
        seen, _, _, _, infos = env.step(keep(seen, np.ones((1, 2), np.float32)))
    env.close()
    assert infos["min_clearance"][0] > 0.0 and not infos["collision"][0]


def test_rows_do_not_depend_on_each_other() -> None:
    config = TaskConfig(**task())
    keep, rng = config.make_filter(), np.random.default_rng(0)
    rows = [
        observed(config, rng.uniform(0.19, 1.0, 36), *rng.uniform(-0.4, 0.7, 2)) for _ in range(30)
    ]
    actions = rng.uniform(-1.0, 1.0, (30, 2)).astype(np.float32)
    together = keep(np.array(rows), actions)
    alone = [keep(row, action) for row, action in zip(rows, actions, strict=True)]
    assert (together != actions).any() and np.array_equal(together, alone)


def test_what_a_larger_clearance_keeps_is_farther_away() -> None:
    arguments = task(contact=True)
    least = {}
    for clearance in (0.03, 0.15):
        config = TaskConfig(**arguments)
        drive = Filtered(
            lambda seen: np.ones((len(seen), 2)), config.make_filter(clearance=clearance)
        )
        results = evaluate(drive, "C", episodes=20, **arguments)
        least[clearance] = np.mean([each.min_clearance for each in results])
        assert not any(each.collision for each in results)
    assert least[0.15] > 0.045 and least[0.03] < 0.02


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot": "kobukki"}, "robot must be .*did you mean 'kobuki'"),
        ({"clearance": -0.1}, "clearance must not be negative, got -0.1"),
        ({"angles": np.zeros(5)}, "angles must be a multiple of sectors = 36, got 5"),
        ({"max_range": 0.0}, "max_range must be positive, got 0.0"),
        ({"max_range": 0.6}, "max_range must be at least 0.656 m, within which kobuki .* got 0.6"),
        ({"closeness_distance": 0.0}, "closeness_distance must be positive, got 0.0"),
        ({"samples": 1}, "samples must be an integer of at least 2, got 1"),
    ],
)
def test_an_argument_out_of_range_is_rejected(change: dict[str, Any], message: str) -> None:
    angles = ray_angles(360.0, 36)
    arguments = {"robot": "kobuki", "angles": angles, "sectors": 36, "max_range": 10.0}
    with pytest.raises(ValueError, match=message):
        SafetyFilter(**{**arguments, "closeness_distance": 0.2, **change})


@pytest.mark.parametrize(
    ("seen", "action", "message"),
    [
        (np.zeros(24), np.zeros(2), r"observation must have shape \[..., 42\], got \(24,\)"),
        (np.zeros((3, 42)), np.zeros((2, 2)), r"action must have shape \(3, 2\), got \(2, 2\)"),
        (np.full(42, math.nan), np.zeros(2), "must not hold NaN"),
        (np.zeros(42), np.full(2, math.nan), "must not hold NaN"),
    ],
)
def test_what_is_no_observation_or_action_is_rejected(
    seen: np.ndarray, action: np.ndarray, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        TaskConfig(**task()).make_filter()(seen, action)


def test_wheels_that_brake_slowly_begin_earlier() -> None:
    def first_change(acceleration: float) -> float:
        robot = replace(ROBOTS["kobuki"], wheel_acceleration=acceleration)
        config = TaskConfig(robot=robot, physics="kinematic", closeness_distance=0.18)
        keep, ahead = config.make_filter(), np.ones(2, np.float32)
        for distance in np.arange(2.0, 0.2, -0.01):
            seen = observed(config, ahead_is(config, distance), 0.7, 0.7)
            if not np.array_equal(keep(seen, ahead), ahead):
                return float(distance)
        return 0.0

    assert first_change(0.4) > first_change(0.8) + 0.1 > first_change(8.0) + 0.2


def test_what_is_not_seen_beside_a_lidar_ahead_of_the_axle_lies_at_the_rim() -> None:
    lidar = {"field_of_view": 270.0, "sectors": 27}
    robot = replace(ROBOTS["kobuki"], name="own", lidar_mount=(0.1, 0.0, 0.0))
    config = TaskConfig(**task(robot, lidar=lidar, closeness_distance=robot.lidar_to_rim))
    keep = config.make_filter()
    seen = observed(config, np.array([5.0] * 26 + [0.0]))
    points = keep.seen(seen[None])
    ends = points[2] + points[0][0] * points[1]
    distances = np.hypot(ends[0], ends[1])
    assert distances.min() == pytest.approx(robot.radius)
    ahead = np.ones(2, np.float32)
    np.testing.assert_array_equal(keep(seen, ahead), ahead)
    assert keep(seen, -ahead).tolist() != [-1.0, -1.0]
