"""Controller and simulated robot coupled as by topics: it drives as in the environment."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx", reason="exported policies are of the extra onnx")

from mpfa_envs import (
    ROBOTS,
    RobotModel,
    VectorNavigationEnv,
    World,
    evaluate,
    export_policy,
    load_policy,
    world_tasks,
)
from mpfa_envs.deploy import Pilot
from mpfa_envs.generators.generate import resolve_world
from mpfa_envs.ros.controller import Controller
from mpfa_envs.ros.simulated_robot import SimulatedRobot
from tests.envs.exported import SHIPPED


def drive(controller: Controller, robot: SimulatedRobot, *, limit: float = 50.0) -> str:
    """Drive to the controller's goal: ``arrived``, ``touched``, or why it stood still at last."""
    end, reason = robot.time + limit, ""
    while robot.time < end - 1e-6:
        controller.feel(robot.motion[:3], robot.motion[3:], robot.time)
        controller.see(robot.scan(), robot.time)
        order = controller.tick(robot.time)
        assert order is not None
        if order.reason == "arrived":
            return "arrived"
        reason = order.reason
        robot.obey(order.linear, order.angular)
        robot.step()
        if robot.touched:
            return "touched"
    return reason


def ends(folder: Path, physics: str, count: int, *, rays: int, world: str) -> list[str]:
    """How drives between the pairs of a world end."""
    file = export_policy(load_policy(SHIPPED), folder / "policy.onnx")
    controller = Controller(Pilot.load(file), stop_distance=0.0)
    half = 0.5 * math.pi * (1.0 - 1.0 / rays)
    robot = SimulatedRobot(world, physics=physics, rays=rays, field=(-half, half))
    found = []
    for each in world_tasks(world, episodes=count, seed=0):
        robot.place(each.task.start)
        controller.aim(each.task.goal)
        found.append(drive(controller, robot))
    robot.close()
    return found


def in_the_environment(physics: str, count: int, world: str) -> list[bool]:
    results = evaluate(load_policy(SHIPPED), world, episodes=count, physics=physics)
    return [result.success for result in results]


def test_on_exact_arcs_it_succeeds_as_in_the_environment(tmp_path: Path) -> None:
    found = ends(tmp_path, "kinematic", 5, rays=54, world="test")
    assert [end == "arrived" for end in found] == in_the_environment("kinematic", 5, "test")


@pytest.mark.parametrize("count", [5, pytest.param(20, marks=pytest.mark.slow)])
def test_on_wheels_it_succeeds_as_in_the_environment(tmp_path: Path, count: int) -> None:
    found = ends(tmp_path, "wheels", count, rays=54, world="test")
    assert [end == "arrived" for end in found] == in_the_environment("wheels", count, "test")


def test_the_simulated_robot_obeys_until_the_timeout() -> None:
    robot = SimulatedRobot("A", physics="kinematic", command_timeout=0.3)
    robot.obey(0.4, 0.5)
    for _ in range(10):
        robot.step()
    assert robot.time == pytest.approx(1.0)
    x, y, heading, *speeds = robot.motion
    # Told at 0 s: the steps that begin at 0, 0.1, 0.2 and 0.3 s.
    assert heading == pytest.approx(0.2) and speeds == [0.0, 0.0]
    assert (x, y) == pytest.approx((0.8 * math.sin(0.2), 0.8 * (1 - math.cos(0.2))))
    robot.obey(math.nan, 0.0)
    robot.step()
    assert robot.motion.linear_speed == 0.0


@pytest.mark.parametrize(("robot", "physics"), [("kobuki", "kinematic"), ("burger", "wheels")])
def test_it_drives_with_the_wheels_of_the_environment(robot: str, physics: str) -> None:
    model, room = ROBOTS[robot], World(name="room", size=(10.0, 10.0))
    start = (-2.0, 0.0, 0.5)
    env = VectorNavigationEnv(1, world=room, robot=robot, physics=physics, action_repeat=1)
    env.reset(options={"tasks": [(start, (3.0, 3.0))]})
    simulated = SimulatedRobot(room, robot=robot, physics=physics)
    simulated.place(start)
    for action in [(1, 1)] * 6 + [(-1, 1)] * 6 + [(-1, -1)] * 6:
        env.step(np.array([action], dtype=np.float32))
        left, right = model.wheel_speeds(np.array(action, dtype=np.float32))
        simulated.obey(0.5 * (left + right), (right - left) / model.wheel_base)
        simulated.step()
        assert simulated.motion == pytest.approx(env.motions[0], abs=1e-9)
    env.close()
    simulated.close()


@pytest.mark.parametrize(
    ("robot", "told", "wheels"),
    [
        ("turtlebot2", (0.0, -1.0), (0.115, 0.05)),  # It can neither stand nor reverse,
        ("turtlebot2", (9.0, 0.0), (0.5, 0.5)),
        ("turtlebot2", (0.0, 0.0), (0.0, 0.0)),  # but its motors can be switched off.
        ("kobuki", (0.7, 0.0), (0.08, 0.08)),
        ("kobuki", (0.0, -9.0), (0.08, -0.08)),
    ],
)
def test_its_wheels_do_what_those_of_the_model_can(
    robot: str, told: tuple[float, float], wheels: tuple[float, float]
) -> None:
    simulated = SimulatedRobot("A", robot=robot, physics="kinematic")
    simulated.obey(*told)
    simulated.step()
    left, right = wheels
    turn = (right - left) / ROBOTS[robot].wheel_base
    assert simulated.motion[3:] == pytest.approx((0.5 * (left + right), turn))


def test_its_scan_is_what_is_around_it() -> None:
    robot = SimulatedRobot(World(name="room", size=(6.0, 4.0)), physics="kinematic", max_range=2.5)
    scan = robot.scan()
    around = dict(zip(range(-180, 180), np.asarray(scan.ranges).tolist(), strict=True))
    assert scan.angle_min == -math.pi and scan.angle_increment == pytest.approx(math.pi / 180)
    assert (around[0], around[-180]) == (math.inf, math.inf)
    assert (around[90], around[-90]) == pytest.approx((2.0, 2.0))


def test_it_touches_what_it_meets_until_it_is_placed_elsewhere() -> None:
    robot = SimulatedRobot(World(name="room", size=(2.0, 2.0)), physics="kinematic")
    for _ in range(20):
        robot.obey(0.5, 0.0)
        robot.step()
    assert robot.touched
    robot.place((0.0, 0.0, 1.0))
    assert not robot.touched and robot.motion == (0.0, 0.0, 1.0, 0.0, 0.0)


KOBUKI = ROBOTS["kobuki"]
OWN = [
    KOBUKI,
    ROBOTS["turtlebot4"],
    ROBOTS["burger"],
    replace(KOBUKI, name="wide", radius=0.19, wheel_base=0.3),
]
LIDARS = [(108, 360.0), (1440, 360.0), (720, 270.0)]
"""Rays and field of view [degrees]."""
WORLDS = ("mazes-1", "mazes-2", "mazes-3", "test", "bars-4", "fields-2", "clutter-3")


def least_clearance(
    folder: Path, robot: RobotModel, lidar: tuple[int, float], drives: int, time_step: float = 0.1
) -> float:
    """Least clearance of the rim in drives behind the filter, of 3 cm [m]."""
    rays, view = lidar
    half = 0.5 * math.radians(view) * (1.0 - 1.0 / rays)
    file = export_policy(load_policy("td3-rooms"), folder / "policy.onnx")
    pilot = Pilot.load(file, robot=robot, clearance=0.03, unseen=0.3)
    least = math.inf
    for number in range(drives):
        world = resolve_world(WORLDS[number % len(WORLDS)])
        task = world_tasks(world, episodes=number + 1, robot=robot)[number].task
        simulated = SimulatedRobot(
            world, robot=robot, physics="kinematic", rays=rays, field=(-half, half),
            time_step=time_step,
        )  # fmt: skip
        simulated.place(task.start)
        controller = Controller(pilot, stop_distance=0.0)
        controller.aim(task.goal)
        while simulated.time < 60.0 / pilot.pace:
            controller.feel(simulated.motion[:3], simulated.motion[3:], simulated.time)
            controller.see(simulated.scan(), simulated.time)
            order = controller.tick(simulated.time)
            if order is None:
                break
            simulated.obey(order.linear, order.angular)
            simulated.step()
            least = min(least, world.clearance(*simulated.motion[:2]) - robot.radius)
    return least


@pytest.mark.parametrize(("acceleration", "time_step", "drives"), [(0.2, 0.1, 2), (4.0, 0.1, 1)])
def test_behind_the_filter_nothing_is_touched(
    tmp_path: Path, acceleration: float, time_step: float, drives: int
) -> None:
    robot = replace(KOBUKI, name="own", wheel_acceleration=acceleration)
    assert least_clearance(tmp_path, robot, LIDARS[0], drives, time_step) > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("lidar", LIDARS)
@pytest.mark.parametrize("acceleration", [0.2, "own", 4.0])
@pytest.mark.parametrize("robot", OWN, ids=lambda robot: robot.name)
def test_a_thousand_drives_behind_the_filter_touch_nothing(
    tmp_path: Path, robot: RobotModel, acceleration: float | str, lidar: tuple[int, float]
) -> None:
    if acceleration != "own":
        robot = replace(robot, wheel_acceleration=acceleration)
    assert least_clearance(tmp_path, robot, lidar, 28) > 0.0
