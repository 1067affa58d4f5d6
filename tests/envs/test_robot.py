from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.speed.bullet_world import BulletWorld
from mpfa_envs import ROBOTS, WORLDS, Box, Cylinder, Polygon, RobotModel, World
from mpfa_envs.robots.drives import KinematicDrives, WheelDrives


class Wheels:
    """One robot on simulated wheels."""

    def __init__(self, robot: RobotModel) -> None:
        self.drives = WheelDrives(robot, 1, time_step=0.1)
        self.motion = np.zeros((1, 5))

    def place(self, *pose: float) -> None:
        self.drives.place(0, *pose)
        self.motion[0] = *pose, 0.0, 0.0

    def move(self, left: float, right: float) -> np.ndarray:
        self.drives.move(self.motion, np.ones(1, dtype=np.bool_), np.array([[left, right]]))
        return self.motion[0].copy()


@pytest.mark.parametrize(
    ("name", "wheels"),
    [("turtlebot2", "left"), ("burger", "slow"), ("kobuki", "fast"), ("waffle", "right")],
)
def test_the_simulated_robot_drives_and_turns_as_commanded(name: str, wheels: str) -> None:
    robot = ROBOTS[name]
    actions = {"fast": (1, 1), "slow": (-1, -1), "left": (-1, 1), "right": (1, -1)}
    left, right = robot.wheel_speeds(np.array(actions[wheels], dtype=np.float32))
    drive = Wheels(robot)
    drive.place(0.0, 0.0, 0.5)
    for _ in range(8):
        before = drive.move(left, right)
    driven = turned = 0.0
    for _ in range(20):
        after = drive.move(left, right)
        middle = before[2] + 0.5 * math.remainder(after[2] - before[2], math.tau)
        driven += math.cos(middle) * (after[0] - before[0])
        driven += math.sin(middle) * (after[1] - before[1])
        turned += math.remainder(after[2] - before[2], math.tau)
        before = after
    drive.drives.close()
    assert driven / 2.0 == pytest.approx((left + right) / 2, rel=0.03, abs=0.005)
    assert turned / 2.0 == pytest.approx((right - left) / robot.wheel_base, rel=0.03, abs=0.01)


@pytest.mark.parametrize("name", [name for name in ROBOTS if ROBOTS[name].wheel_acceleration])
def test_a_simulated_robot_that_brakes_stays_on_its_wheels(name: str) -> None:
    robot = ROBOTS[name]
    change = robot.wheel_limits.acceleration * 0.1
    drive = Wheels(robot)
    drive.place(0.0, 0.0, 0.0)
    speed, motions = 0.0, []
    for wanted in [robot.max_wheel_speed] * 15 + [robot.min_wheel_speed] * 30:
        speed = min(max(wanted, speed - change), speed + change)
        motions.append((speed, drive.move(speed, speed)[3]))
    drive.drives.close()
    commanded, driven = np.array(motions).T
    assert np.abs(driven - commanded).max() < 0.1 * robot.max_wheel_speed + change


@pytest.mark.parametrize(("name", "fastest"), [("turtlebot4", 1.9), ("kobuki", math.pi)])
def test_a_robot_turns_no_faster_than_its_limit(name: str, fastest: float) -> None:
    robot = ROBOTS[name]
    for action in ((-1.0, 1.0), (1.0, -1.0)):
        left, right = robot.wheel_speeds(np.array(action, dtype=np.float32))
        assert (right - left) / robot.wheel_base == pytest.approx(action[1] * fastest)
        assert left + right == pytest.approx(0.0)
    assert robot.max_angular_speed == pytest.approx(fastest)


def driven_from(
    robot: RobotModel, start: tuple[float, float], wanted: tuple[float, float]
) -> NDArray[np.float64]:
    """Forward and turning speeds of the first second on the way to other wheel speeds."""
    drives = KinematicDrives(robot, 1, time_step=0.02)
    drives.commands[0] = start
    motions, speeds = np.zeros((1, 5)), []
    for _ in range(50):
        drives.move(motions, np.ones(1, dtype=np.bool_), np.array([wanted]))
        speeds.append(motions[0, 3:].copy())
    return np.array(speeds)


@pytest.mark.parametrize(
    ("start", "wanted"), [((0.0, 0.0), (-0.7, 0.7)), ((0.5, 0.5), (0.0, 0.0)), ((0.7, 0.1), (0, 0))]
)
def test_a_robot_turns_and_brakes_no_faster_than_its_controller_allows(
    start: tuple[float, float], wanted: tuple[float, float]
) -> None:
    limits = {"deceleration": 0.5, "turn_acceleration": 2.0}
    robot = replace(ROBOTS["kobuki"], wheel_acceleration=1.0, **limits)
    speeds = driven_from(robot, start, wanted)
    assert np.abs(np.diff(speeds[:, 0])).max() <= 0.5 * 0.02 + 1e-9
    assert np.abs(np.diff(speeds[:, 1])).max() <= 2.0 * 0.02 + 1e-9
    aim = speeds[-1] - np.array([sum(wanted) / 2, (wanted[1] - wanted[0]) / robot.wheel_base])
    before = speeds[0] - np.array([sum(wanted) / 2, (wanted[1] - wanted[0]) / robot.wheel_base])
    assert np.abs(aim).sum() < np.abs(before).sum()


def test_a_controller_that_limits_the_turn_limits_the_forward_speed_apart_from_it() -> None:
    robot = replace(ROBOTS["kobuki"], wheel_acceleration=1.0, turn_acceleration=4.0)
    # Slower by 0.3 m/s, and a turn by 1 rad/s: for the left wheel far more than for the right one.
    turn = 0.5 * robot.wheel_base
    speeds = driven_from(robot, (0.5, 0.5), (0.2 - turn, 0.2 + turn))
    steps = np.arange(1, 51)
    assert speeds[:, 0] == pytest.approx(np.maximum(0.5 - 0.02 * steps, 0.2))
    assert speeds[:, 1] == pytest.approx(np.minimum(0.08 * steps, 1.0))


@pytest.mark.parametrize(
    ("action", "forward", "turn"),
    [((-1, -1), 0.0, 0.0), ((-1, 0), 0.0, 1.75), ((-1, 1), 0.2, 3.5), ((0, 1), 0.55, 1.75)],
)
def test_a_body_that_does_not_reverse_turns_on_the_spot(
    action: tuple[float, float], forward: float, turn: float
) -> None:
    cart = replace(ROBOTS["waffle"], wheel_base=0.4, min_wheel_speed=-0.5, max_wheel_speed=0.9)
    cart = replace(cart, turn_limit=None, reverse=False)
    left, right = cart.wheel_speeds(np.array(action, dtype=np.float32))
    assert (left + right) / 2 == pytest.approx(forward)
    assert (right - left) / 0.4 == pytest.approx(turn)
    assert -0.5 <= min(left, right) <= max(left, right) <= 0.9


def test_a_wall_stops_the_simulated_robot() -> None:
    simulation = BulletWorld(WORLDS["A"], time_step=0.1, substeps=3)
    simulation.add_robot(robot := ROBOTS["turtlebot2"])
    simulation.place_robot(4.5, 0.0, 0.0)
    simulation.set_wheel_speeds(0.5 / robot.wheel_radius, 0.5 / robot.wheel_radius)
    simulation.step(30)
    assert simulation.robot_motion()[0] == pytest.approx(5.0 - 0.18, abs=0.02)
    simulation.close()


def test_a_drive_does_not_depend_on_earlier_ones_however_short() -> None:
    def driven(drive: Wheels) -> list[list[float]]:
        rng = np.random.default_rng(0)
        drive.place(0.3, 0.2, 0.7)
        return [drive.move(*rng.uniform(0.05, 0.5, 2)).tolist() for _ in range(30)]

    drives = [Wheels(ROBOTS["turtlebot2"]) for _ in range(2)]
    expected = driven(drives[0])
    for steps, pose in ((20, (4.6, 0.0, 0.1)), (1, (0.3, 0.2, 0.7)), (0, (0.3, 0.2, 0.7))):
        drives[1].place(*pose)
        for _ in range(steps):
            drives[1].move(0.5, 0.4)
        assert driven(drives[1]) == expected
    for drive in drives:
        drive.drives.close()


def test_the_turtlebot2_has_the_measures_of_the_paper() -> None:
    robot = ROBOTS["turtlebot2"]
    assert (robot.radius, robot.wheel_base, robot.wheel_radius) == (0.18, 0.23, 0.035)
    assert robot.max_angular_speed == pytest.approx(1.9565, abs=1e-4)


def test_the_engine_feels_obstacles_where_the_world_has_them() -> None:
    world = World(
        name="shapes",
        boxes=(Box(-3.0, 1.0, -1.0, 2.0),),
        cylinders=(Cylinder(2.5, 2.5, 0.6),),
        polygons=(
            Polygon(((1.0, -3.0), (3.0, -2.0), (2.0, -0.5))),
            Polygon(((-3.0, -3.0), (-0.5, -3.2), (-1.6, -2.4), (-0.8, -0.6), (-2.2, -1.6))),
        ),
    )
    simulation = BulletWorld(world)
    simulation.add_robot(ROBOTS["turtlebot2"])
    rng = np.random.default_rng(0)
    compared = 0
    while compared < 60:
        x, y = rng.uniform(-4.7, 4.7, 2).tolist()
        clearance = world.clearance(x, y) - 0.178
        if not 0.01 < clearance < 0.4:
            continue
        compared += 1
        simulation.place_robot(x, y, 0.0)
        # The engine rounds edges by millimeters.
        assert simulation.gap(simulation.bodies["robot"]) == pytest.approx(clearance, abs=0.006)
    simulation.close()
