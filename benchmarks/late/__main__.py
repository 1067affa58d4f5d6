"""Drive policies on a robot whose orders are late, and print or keep rows of docs/results/late.csv.

    python -m benchmarks.late td3-rooms                                in time
    python -m benchmarks.late td3-rooms --latency 0.1 0.2 --seeds 0 1 2 3 4
    python -m benchmarks.late td3-rooms --latency 0.1 --node           the ROS node's controller
    python -m benchmarks.late td3-rooms --latency 0.1 --off -0.05      a pilot that is told 0.05 s
    python -m benchmarks.late td3-rooms --latency 0.1 --strength 0.8   weaker wheels than its file's
    python -m benchmarks.late td3-rooms --latency 0.3 --alone          no planner leads it out
    python -m benchmarks.late mpc --robot kobuki --latency 0.1         the planner alone

The robot is a circle on a raster plan, with exact rays and wheels that accelerate; its orders act
``--latency`` seconds after their scan. Each seed has a building and tasks of its own, half of which
lead through a door as wide as the robot and 5 cm on each side. Needs the extra ``onnx``.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import pandas as pd

from benchmarks.late.building import Grid, Point, Task, building, clearance, ranges, sample_tasks
from mpfa_envs import export_policy, load_policy, make_pilot
from mpfa_envs.deploy import Pilot, Scan, ScanError
from mpfa_envs.robots.model import RobotModel
from mpfa_envs.ros.controller import Controller
from training.files import run_script
from training.records import read_table, write_table

TICK = 0.01
"""Time step of the robot [s]."""
_TICKS = 5
"""Time steps between two looks of a driver."""
_SPARE = 0.05
"""Room on each side of the robot in a narrow door [m]."""
_REACH = 1.2
"""Farthest obstacle that the rim's clearance is measured to [m]."""
_ENDS = {"arrived": "arrived", "collision": "touched", "timeout": "timeout", "gave up": "gave_up"}


class Robot:
    """Two wheels, orders that come late, and speeds that change as fast as they can."""

    def __init__(self, grid: Grid, model: RobotModel, task: Task, *, latency: float) -> None:
        self.grid, self.model, self.latency = grid, model, latency
        (self.x, self.y), self.heading = task.start, task.heading
        self.wheels, self.wanted = [0.0, 0.0], [0.0, 0.0]
        self.orders: list[tuple[float, list[float]]] = []
        self.time = self.length = 0.0
        self.least = math.inf

    @property
    def pose(self) -> tuple[float, float, float]:
        """Place and heading, within a turn."""
        return self.x, self.y, math.atan2(math.sin(self.heading), math.cos(self.heading))

    @property
    def speeds(self) -> tuple[float, float]:
        """Forward and turning speed."""
        left, right = self.wheels
        return (left + right) / 2, (right - left) / self.model.wheel_base

    def scan(self) -> Scan:
        """Return exact ranges, two for each degree of the field of view."""
        view = self.model.field_of_view
        count = 2 * round(view)
        step = math.radians(view) / (count if view >= 360 else count - 1)
        ahead, left, turned = self.model.lidar_mount
        first, far = -math.radians(view) / 2, self.model.lidar_range
        x = self.x + ahead * math.cos(self.heading) - left * math.sin(self.heading)
        y = self.y + ahead * math.sin(self.heading) + left * math.cos(self.heading)
        seen = ranges(self.grid, x, y, self.heading + turned + first, step, count, far)
        return Scan(first, step, seen, 0.0, far)

    def order(self, linear: float, angular: float) -> None:
        """Order speeds, which act after the latency."""
        model = self.model
        most = (model.max_wheel_speed - model.min_wheel_speed) / model.wheel_base
        turn = min(model.turn_limit or math.inf, most)
        linear = min(max(linear, model.min_wheel_speed), model.max_wheel_speed)
        apart = min(max(angular, -turn), turn) * model.wheel_base / 2
        self.orders.append((self.time + self.latency, [linear - apart, linear + apart]))

    def step(self, acceleration: float) -> bool:
        """Drive for a tick; return False if the robot touches."""
        while self.orders and self.orders[0][0] <= self.time + 1e-9:
            self.wanted = self.orders.pop(0)[1]
        change = acceleration * TICK
        for wheel in range(2):
            more = self.wanted[wheel] - self.wheels[wheel]
            self.wheels[wheel] += min(max(more, -change), change)
        forward, turning = self.speeds
        self.heading += turning * TICK / 2
        self.x += forward * math.cos(self.heading) * TICK
        self.y += forward * math.sin(self.heading) * TICK
        self.heading += turning * TICK / 2
        self.time += TICK
        self.length += abs(forward) * TICK
        rim = clearance(self.grid, self.x, self.y, _REACH) - self.model.radius
        self.least = min(self.least, rim)
        return bool(rim > 0.0)


class Driver(Protocol):
    """What decides for a robot."""

    spent: list[float]

    def begin(self, goal: Point) -> None:
        """Begin a drive."""

    def look(self, robot: Robot) -> str | tuple[float, float]:
        """Return the speeds to order, or how the drive ended."""


class Piloted:
    """A pilot, which decides once in each of its periods."""

    def __init__(self, pilot: Pilot) -> None:
        self._pilot = pilot
        self.spent: list[float] = []
        """CPU time of each decision [s]."""

    def begin(self, goal: Point) -> None:
        """Begin a drive."""
        self._next, self._speeds = 0.0, (0.0, 0.0)
        self._pilot.begin(goal=goal, map_center=(9.0, 6.0))

    def look(self, robot: Robot) -> str | tuple[float, float]:
        """Return the speeds to order, or how the drive ended."""
        if self._pilot.arrived(robot.pose):
            return "arrived"
        if robot.time + 1e-9 >= self._next:
            self._next = robot.time + self._pilot.period
            scan, began = robot.scan(), time.process_time()
            try:
                command = self._pilot.decide(scan, robot.pose, robot.speeds)
                self._speeds = command.linear, command.angular
            except ScanError:
                self._speeds = 0.0, 0.0
            self.spent.append(time.process_time() - began)
        return self._speeds


class Noded:
    """The controller of the ROS node around a pilot, which sees every second look."""

    def __init__(self, pilot: Pilot) -> None:
        self._pilot = pilot
        self.spent: list[float] = []

    def begin(self, goal: Point) -> None:
        """Begin a drive."""
        self._controller, self._goal = Controller(self._pilot, stop_distance=0.05), goal
        self._looks = 0

    def look(self, robot: Robot) -> str | tuple[float, float]:
        """Return the speeds to order, or how the drive ended."""
        self._controller.feel(robot.pose, robot.speeds, robot.time)
        if self._looks == 0:
            self._controller.aim(self._goal)
        if self._looks % 2 == 0:
            self._controller.see(robot.scan(), robot.time)
        self._looks += 1
        order = self._controller.tick(robot.time)
        if order is None:
            return "gave up"
        if order.reason.startswith("arrived"):
            return "arrived"
        return order.linear, order.angular


def drive(robot: Robot, driver: Driver, goal: Point, *, acceleration: float) -> str:
    """Drive to a goal; return how the drive ended."""
    driver.begin(goal)
    # A robot drives 105 m at full speed in that time.
    while robot.time < max(120.0, 105.0 / robot.model.max_wheel_speed):
        speeds = driver.look(robot)
        if isinstance(speeds, str):
            return speeds
        robot.order(*speeds)
        if not all([robot.step(acceleration) for _ in range(_TICKS)]):
            return "collision"
    return "timeout"


def pilot_of(options: argparse.Namespace, file: Path, latency: float) -> Pilot:
    """The pilot of a policy or of the planner."""
    if options.policy == "mpc":
        return make_pilot("mpc", robot=options.robot, clearance=options.clearance, latency=latency)
    rescue = not options.alone
    return Pilot.load(file, clearance=options.clearance, latency=latency, rescue=rescue)


def row_of(options: argparse.Namespace, file: Path, latency: float, seed: int) -> dict[str, object]:
    """Drive the tasks of a building; return their row."""
    told = round(latency + options.off, 9)
    pilot = pilot_of(options, file, told)
    model = pilot.robot
    narrow = 2 * (model.radius + _SPARE)
    grid = building(seed, narrow)
    tasks = sample_tasks(grid, model.radius, options.tasks, seed=seed, narrow=narrow)
    driver: Driver = Noded(pilot) if options.node else Piloted(pilot)
    acceleration = options.strength * (model.wheel_acceleration or 1e9)
    ends, times, shares = Counter[str](), [], []
    least, through = math.inf, 0
    for task in tasks:
        robot = Robot(grid, model, task, latency=latency)
        end = drive(robot, driver, task.goal, acceleration=acceleration)
        ends[end] += 1
        least = min(least, robot.least)
        arrived = end == "arrived"
        shares.append(arrived * task.length / max(task.length, robot.length))
        through += arrived and task.narrow
        times += [robot.time] * arrived
    return {
        "policy": options.policy,
        "driver": ("node" if options.node else "pilot") + " alone" * options.alone,
        "latency": latency,
        "told": told,
        "strength": options.strength,
        "seed": seed,
        "tasks": len(tasks),
        **{column: ends[end] for end, column in _ENDS.items()},
        "narrow": through,
        "narrow_of": sum(task.narrow for task in tasks),
        "least": round(least, 4),
        "spl": round(float(np.mean(shares)), 3),
        "time": round(float(np.mean(times)), 1) if times else math.nan,
        "decision_ms": round(1e3 * float(np.mean(driver.spent)), 2) if driver.spent else math.nan,
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Drive, and print the rows."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.late",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("policy", help="a policy of the package, a run, an ONNX file, or mpc")
    parser.add_argument("--robot", default="kobuki", help="of mpc")
    parser.add_argument("--alone", action="store_true", help="no mpc leads out where it stands")
    parser.add_argument("--latency", type=float, nargs="+", default=[0.0], help="of orders [s]")
    parser.add_argument("--off", type=float, default=0.0, help="told latency less the true one [s]")
    parser.add_argument(
        "--strength", type=float, default=1.0, help="of the wheels, over the file's"
    )
    parser.add_argument("--clearance", type=float, default=0.03, help="of the filter [m]")
    parser.add_argument("--node", action="store_true", help="through the node's controller")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="of the buildings")
    parser.add_argument("--tasks", type=int, default=40, help="in each building")
    parser.add_argument("--keep", type=Path, metavar="FILE", help="add the rows to a CSV file")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(options.policy)
        if file.suffix != ".onnx" and options.policy != "mpc":
            file = export_policy(load_policy(options.policy), Path(folder) / "policy.onnx")
        rows = [
            row_of(options, file, latency, seed)
            for latency in options.latency
            for seed in options.seeds
        ]
    found = pd.DataFrame(rows)
    print(found.to_string(index=False))
    if options.keep is not None:
        before = read_table(options.keep)
        write_table(pd.concat([before, found]) if len(before) else found, options.keep)


if __name__ == "__main__":
    run_script(main)
