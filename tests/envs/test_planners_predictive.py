"""Predictive control: its parts beside plain computations, and its drives."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from mpfa_envs import (
    Box,
    Task,
    TaskConfig,
    VectorNavigationEnv,
    World,
    evaluate,
    make_planner,
    run_tasks,
    world_tasks,
)
from mpfa_envs.control.predictive_loops import (
    CELL,
    ROOMY,
    Effort,
    PlanningState,
    best_plan,
    rollout,
    room_around,
)
from mpfa_envs.driver import Driver
from mpfa_envs.paths.grid_loops import MOVES, path_lengths
from mpfa_envs.planners import PredictiveControl
from mpfa_envs.robots.model import ROBOTS, RobotModel
from mpfa_envs.tasks.sampling import WorldTask

KOBUKI = TaskConfig(robot="kobuki", memory="map").make_filter()
BODY = KOBUKI.body
EFFORT = Effort(turn=0.35, stand=0.5, either=True, circle=0, blind=False)
STEPS = 16
# A doorway of 0.5 m for a robot of 0.36 m, and a pocket before the goal.
DOOR = World(name="door", boxes=(Box(-0.1, 0.25, 0.1, 5.0), Box(-0.1, -5.0, 0.1, -0.25)))
POCKET = World(
    name="pocket",
    boxes=(Box(1.0, -1.5, 1.2, 1.5), Box(-0.5, 1.3, 1.0, 1.5), Box(-0.5, -1.5, 1.0, -1.3)),
)


def scene(wall: float = math.inf, *, speed: float = 0.0, goal: float = 9.0) -> PlanningState:
    """A robot that drives east with its goal ahead [m], and a wall before it at a distance [m]."""
    rooms = np.full((121, 121), ROOMY)
    kept, points = BODY.radius + BODY.clearance, np.empty((1, 0, 4))
    if wall < math.inf:
        beside = wall * np.tan(np.linspace(-0.9, 0.9, 61))
        points = np.stack((np.full(61, wall), beside, np.full(61, kept**2)), axis=1)[None]
    room_around(points[0], 0.0, BODY.radius, rooms)
    lengths = np.abs(np.arange(200)[:, None] * 0.1 - 9.0 - goal) + np.zeros((1, 200))
    speeds, counts = np.array([[speed, speed]]), np.zeros(1, np.int64)
    levels, pose = np.zeros((200, 200), np.uint8), (9.0, 10.0, 0.0)
    return PlanningState(
        pose,
        speeds,
        points,
        counts,
        BODY,
        -1.0,
        rooms[None],
        levels,
        lengths,
        (9.0 + goal, 10.0, 0.47),
        0.0,
    )


def straight(speed: float) -> np.ndarray:
    return np.full((STEPS, 2), speed)


def test_paths_over_costly_cells_are_those_of_plain_relaxation() -> None:
    rng = np.random.default_rng(0)
    factors = rng.choice([0, 5, 8, 150], p=[0.1, 0.5, 0.3, 0.1], size=(12, 15))
    factors[3, 4] = 5
    found = path_lengths(
        factors, np.array([[3, 4]]), np.zeros(1), MOVES, 0.02, math.inf, buckets=400
    )
    expected = np.full(factors.shape, math.inf)
    expected[3, 4] = 0.0
    for _ in range(factors.size):
        before = expected.copy()
        for (i, j), factor in np.ndenumerate(factors):
            for across, up, a, b, c, d in MOVES.tolist():
                to = i + across, j + up
                if not (0 <= to[0] < 12 and 0 <= to[1] < 15) or not factor:
                    continue
                crossed = [factors[cell] for cell in (to, (i + a, j + b), (i + c, j + d))]
                if min(crossed) > 0:
                    step = max(factor, *crossed) * 0.02 * math.hypot(across, up)
                    expected[to] = min(expected[to], expected[i, j] + step)
        if np.array_equal(before, expected):
            break
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_the_room_around_is_that_over_what_the_filter_keeps() -> None:
    rooms = np.empty((61, 61))
    # It looks up the map. What is at the rim is not seen, and nothing stands on a border.
    points = np.array([(0.5, 0.1, 0.04), (0.0, 0.17, 0.03), (-0.6, 0.0, 0.0)])
    room_around(points, math.pi / 2, 0.18, rooms)
    for (column, row), room in np.ndenumerate(rooms):
        away = math.hypot(CELL * (column - 30) + 0.1, CELL * (row - 30) - 0.5) - 0.2
        assert room == pytest.approx(min(away, ROOMY))


def test_a_plan_costs_its_time_and_that_from_its_end() -> None:
    cruising = rollout(straight(0.7), scene(speed=0.7), BODY, EFFORT, math.inf)
    # At full speed from here to the goal's center, as the field says.
    assert cruising == pytest.approx(9.0 / 0.7, abs=0.02)
    standing = rollout(straight(0.0), scene(), BODY, EFFORT, math.inf)
    assert standing == pytest.approx(1.6 + 9.0 / 0.7 + 0.7 / (2 * 0.8), abs=0.02)
    near = rollout(straight(0.7), scene(speed=0.7, goal=0.8), BODY, EFFORT, math.inf)
    assert near == pytest.approx(0.5)  # Within 0.47 m of it.
    assert rollout(straight(0.7), scene(speed=0.7), BODY, EFFORT, 12.0) == math.inf


@pytest.mark.parametrize(("room", "more"), [(0.5 * ROOMY, 0.25), (-0.01, 1.0)])
def test_time_near_obstacles_costs_more_also_where_the_robot_begins_too_near(
    room: float, more: float
) -> None:
    free = rollout(straight(0.7), scene(speed=0.7), BODY, EFFORT, math.inf)
    near = scene(speed=0.7)._replace(rooms=np.full((1, 121, 121), room))
    assert rollout(straight(0.7), near, BODY, EFFORT, math.inf) == pytest.approx(free + 1.6 * more)


def test_a_robot_that_squeezes_through_may_plan_into_what_it_sees_at_a_cost() -> None:
    near = scene(speed=0.7)._replace(rooms=np.full((1, 121, 121), ROOMY))
    near.rooms[0, 64:, :] = -0.04
    assert rollout(straight(0.7), near, BODY, EFFORT, math.inf) == math.inf
    squeezed = near._replace(into=0.05)
    free = rollout(straight(0.7), scene(speed=0.7), BODY, EFFORT, math.inf)
    assert rollout(straight(0.7), squeezed, BODY, EFFORT, math.inf) > free + 1.0
    assert rollout(straight(0.7), near._replace(into=0.03), BODY, EFFORT, math.inf) == math.inf


def test_to_drive_backwards_costs_a_robot_that_does_not_see_there() -> None:
    back = scene(speed=-0.7)
    blind = EFFORT._replace(blind=True)
    seen, unseen = (rollout(straight(-0.7), back, BODY, e, math.inf) for e in (EFFORT, blind))
    assert unseen > seen + 10.0
    ahead = [rollout(straight(0.7), scene(), BODY, e, math.inf) for e in (EFFORT, blind)]
    assert ahead[0] == ahead[1]


def test_a_plan_must_be_able_to_stop_after_its_end() -> None:
    # 1.12 m, 0.27 m to brake in time steps, and 0.21 m of rim and clearance.
    assert rollout(straight(0.7), scene(1.59, speed=0.7), BODY, EFFORT, math.inf) == math.inf
    assert rollout(straight(0.7), scene(1.61, speed=0.7), BODY, EFFORT, math.inf) < 99.0


def test_a_plan_through_a_wall_of_the_map_costs_more_than_any_path() -> None:
    levels = np.zeros((200, 200), np.uint8)
    levels[95:98] = 3  # From 0.45 to 0.75 m ahead, where no ray ends.
    behind = scene(speed=0.7)._replace(levels=levels)
    assert rollout(straight(0.7), behind, BODY, EFFORT, math.inf) > 9.0 / 0.7 + 60.0


def test_the_cost_to_go_is_not_that_behind_a_thin_wall() -> None:
    # From the corner of a cell, a wall of a small robot's map runs askew 0.14 m ahead.
    steps_behind = np.add.outer(np.arange(200), np.arange(200)) - 192
    lengths = np.where(steps_behind < -1, 15.0, np.where(steps_behind <= 1, 25.0, 4.0))
    before = scene()._replace(lengths=lengths)
    assert rollout(straight(0.0), before, BODY, EFFORT, math.inf) > 15.0 / 0.7


def test_a_robot_that_cannot_stop_needs_a_circle_after_its_plan() -> None:
    body = TaskConfig(robot="turtlebot2", memory="map").make_filter().body
    circle = Effort(turn=0.3, stand=0.5, either=False, circle=33, blind=False)
    ahead = straight(0.5)
    assert rollout(ahead, scene(0.8 + 0.14 + 0.2, speed=0.5), body, circle, 99.0) == math.inf
    assert rollout(ahead, scene(0.8 + 0.14 + 0.3, speed=0.5), body, circle, 99.0) < 99.0


def test_the_search_speeds_up_and_rejects_what_the_filter_rejects() -> None:
    pairs = np.array([(0.7, 0.7), (0.0, 0.0)])
    noise = np.random.default_rng(0).standard_normal((3, 20, 4, 2))
    plan = straight(0.0)
    time = best_plan(plan, pairs, noise, scene(), BODY, EFFORT)
    assert plan[0].min() > 0.65 and time < 14.0
    # No action leaves so much room.
    shut = scene()._replace(least=math.inf)
    assert best_plan(plan, pairs, noise, shut, BODY, EFFORT) == math.inf


CASES: list[tuple[str, dict[str, Any]]] = [
    ("turtlebot2", {}),
    ("kobuki", {"plan": "known"}),
    ("kobuki", {"latency": 0.3, "goal_radius": 0.2}),
    ("burger", {}),
    ("turtlebot4", {"physics": "wheels"}),
]


@pytest.mark.parametrize(("robot", "task"), CASES, ids=str)
def test_robots_reach_the_goals_of_map_d(robot: str, task: dict[str, Any]) -> None:
    if task.get("physics") == "wheels":
        pytest.importorskip("pybullet", reason="PyBullet has wheels for Python 3.11 and earlier")
    results = evaluate(make_planner("mpc", robot=robot), "D", episodes=4, seed=3, **task)
    assert all(result.success for result in results)
    assert np.mean([result.spl for result in results]) > 0.85


def test_a_robot_of_its_own_limits_drives_ahead_alone() -> None:
    cart = RobotModel(
        name="cart",
        radius=0.3,
        height=0.4,
        mass=30.0,
        wheel_base=0.4,
        wheel_radius=0.08,
        min_wheel_speed=-0.3,
        max_wheel_speed=0.8,
        wheel_acceleration=0.5,
        turn_limit=1.2,
        turn_acceleration=1.5,
        reverse=False,
        field_of_view=270.0,
        lidar_mount=(0.15, 0.0, 0.0),
    )
    planner = make_planner("mpc", robot=cart)
    assert isinstance(planner, Driver)
    back = []

    def keep(env: VectorNavigationEnv, robot: int, number: int) -> None:
        back.append(env.motions[robot, 3] < -1e-9)

    results = run_tasks(
        planner, world_tasks("rooms:validation", episodes=3), on_end=keep, **planner.env_arguments
    )
    assert all(result.success for result in results) and not any(back)


def test_a_narrow_door_and_a_pocket_are_left_behind() -> None:
    tasks = [
        WorldTask(DOOR, Task((-2.0, 0.4, 1.0), (2.0, 0.0))),
        WorldTask(POCKET, Task((-2.0, 0.1, 0.0), (3.0, 0.0))),
    ]
    for robot in ("kobuki", "waffle"):
        planner = make_planner("mpc", robot=robot)
        assert planner.env_arguments["closeness_distance"] == planner.robot.lidar_to_rim
        wide = tasks[1:] if robot == "waffle" else tasks
        assert all(each.success for each in run_tasks(planner, wide, **planner.env_arguments))


@pytest.mark.parametrize("thick", [0.1, 0.3])
def test_a_door_five_centimeters_wider_on_each_side_is_passed(thick: float) -> None:
    posts = Box(-thick, 0.23, thick, 5.0), Box(-thick, -5.0, thick, -0.23)
    door = World(name="door", boxes=posts)
    tasks = [WorldTask(door, Task(start, (2.0, 0.0))) for start in ((-2.0, 0.4, 1.0), (-2, -1, 2))]
    planner = make_planner("mpc", robot="kobuki")
    results = run_tasks(planner, tasks, **planner.env_arguments)
    assert all(each.success and each.time_s < 30.0 for each in results)


def test_a_robot_that_does_not_come_away_squeezes_and_then_pays_for_the_path_ahead() -> None:
    planner = PredictiveControl(robot="kobuki")
    with_map = {"robot": "kobuki", "physics": "kinematic", "memory": "map", "contact": True}
    env = VectorNavigationEnv(1, world=DOOR, **with_map)
    options = {"tasks": [Task((-2.0, 0.0, 0.0), (2.0, 0.0))]}
    env.reset(seed=0, options=options)
    robots = np.zeros(1, np.int64)
    planner.begin(0, env.errand(0))
    first = planner.drive(env.senses(robots))
    lengths = planner._episodes[0].lengths[30:36, 54]
    assert (np.diff(lengths) < 0.0).all()
    for _ in range(15):  # It is held: nothing is driven.
        planner.drive(env.senses(robots))
    assert not planner._episodes[0].raised.any()
    for _ in range(15):
        planner.drive(env.senses(robots))
    raised = planner._episodes[0].raised
    assert raised.max() == 25 and 6 <= np.count_nonzero(raised) <= 9
    env.reset(seed=0, options=options)
    planner.begin(0, env.errand(0))
    np.testing.assert_array_equal(planner.drive(env.senses(robots)), first)


def test_predictive_control_needs_the_map_of_its_robot() -> None:
    planner = make_planner("mpc", robot="kobuki")
    with pytest.raises(ValueError, match="memory must be 'map' for mpc, got 'none'"):
        evaluate(planner, "D", episodes=1, memory="none")
    assert {name: planner.env_arguments[name] for name in ("memory", "robot")} == {
        "memory": "map",
        "robot": ROBOTS["kobuki"],
    }


def test_the_seed_decides_the_samples_and_nothing_else_does() -> None:
    first, again, other = (PredictiveControl(robot="kobuki", seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first._noise, again._noise)
    assert not np.array_equal(first._noise, other._noise)


def test_a_robot_plans_from_where_its_odometry_places_it_and_behind_the_filter() -> None:
    planner = PredictiveControl(robot="kobuki")
    task: dict[str, Any] = {"robot": "kobuki", "physics": "kinematic", "memory": "map"}
    env = VectorNavigationEnv(1, world="D", noise={"drift": 0.3}, goal_radius=0.3, **task)
    env.reset(seed=0)
    planner.begin(0, env.errand(0))
    robots = np.zeros(1, np.int64)
    for _ in range(12):
        env.step(planner.drive(env.senses(robots)))
    kept = planner._keep
    senses = env.senses(robots)
    assert kept is not None and senses.maps is not None
    scene = planner._scene(kept, senses.maps, senses, 0)
    place = np.array(scene.pose[:2]) + senses.maps.origins[0]
    assert math.dist(place, env.measurements[0, 4:6]) < 1e-9 < math.dist(place, env.poses[0, :2])
    assert scene.goal[2] == pytest.approx(0.94 * 0.3)
    calls: list[int] = []
    among = kept.among

    def count(*arguments: Any) -> Any:
        calls.append(1)
        return among(*arguments)

    kept.among = count  # type: ignore[method-assign]
    planner.drive(env.senses(robots))
    assert calls
    env.close()


def test_a_last_plan_is_tried_again_from_the_moment_of_now() -> None:
    plan = np.linspace(0.0, 0.7, STEPS)[:, None].repeat(2, axis=1)
    expected = np.concatenate((plan[2:], plan[-1:], plan[-1:]))
    expected[:2] = expected[0]
    nothing = np.empty((0, 2)), np.empty((0, 0, 4, 2))
    best_plan(plan, *nothing, scene(), BODY._replace(repeat=2), EFFORT)
    np.testing.assert_array_equal(plan, expected)
