"""A simulated robot with the interface of a real one: speeds in, measurements out."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mpfa_envs.checks import check_choice, check_count, check_positive, check_seed
from mpfa_envs.deploy.card import check_finite
from mpfa_envs.generators.generate import resolve_world
from mpfa_envs.robots.drives import Physics, make_drives
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from mpfa_envs.sensing.lidar import Lidar
from mpfa_envs.sensing.scan import Scan

if TYPE_CHECKING:
    import os

    from mpfa_envs.worlds.world import World


class Motion(NamedTuple):
    """Pose and speeds of a robot."""

    x: float
    """Position [m]."""
    y: float
    """Position [m]."""
    heading: float
    """Direction of the front, from the x axis to the left, in [-π, π] [rad]."""
    linear_speed: float
    """Forward speed [m/s]."""
    angular_speed: float
    """Turning speed, to the left [rad/s]."""


class SimulatedRobot:
    """The robot of the environments on their drives, driven as real ones: speeds in, scans out."""

    def __init__(
        self,
        world: str | os.PathLike[str] | World = "test",
        *,
        robot: RobotChoice = "turtlebot2",
        physics: Physics = "wheels",
        time_step: float = 0.1,
        rays: int = 360,
        field: tuple[float, float] = (-math.pi, math.pi - math.tau / 360),  # of the rays [rad]
        max_range: float = 10.0,  # beyond, a ray reports infinity [m]
        noise: float = 0.0,  # of the ranges [m]
        command_timeout: float = 0.5,  # stands still without orders for so long [s]
        seed: int = 0,
    ) -> None:
        self.world = resolve_world(world)
        self.robot = resolve_robot(robot)
        self.time_step = check_positive("time_step", time_step)
        first, last = check_finite("field", field, 2)
        if check_count("rays", rays, least=2) and not first < last:
            raise ValueError(f"field must rise, got {field}")
        check_choice("physics", physics, Physics)
        self._field = first, last
        # Its rays go from left to right around its middle, those of a scan from right to left.
        view = math.degrees(last - first) * rays / (rays - 1)
        self._make_lidar = partial(
            Lidar,
            sectors=rays,
            reduction="single",
            max_range=max_range,
            noise=noise,
            field_of_view=min(view, 360.0),
        )
        self._lidar = self._make_lidar(self.world)
        self._timeout = check_positive("command_timeout", command_timeout)
        self._rng = np.random.default_rng(check_seed(seed))
        self._drives = make_drives(physics, self.robot, 1, time_step=self.time_step)
        self.time = 0.0
        """Since the robot was made [s]."""
        self.place((0.0, 0.0, 0.0))

    def place(self, start: tuple[float, float, float]) -> None:
        """Put it at rest at a pose (x, y, heading) [m, m, rad]."""
        x, y, heading = check_finite("start", start, 3)
        heading = math.remainder(heading, math.tau)
        self._drives.place(0, x, y, heading)
        self._motions = np.array([[x, y, heading, 0.0, 0.0]])
        self.touched = False
        """True if its rim has met an obstacle since it was placed."""
        self._told = (0.0, 0.0)
        self._told_at = -math.inf

    def become(self, world: World) -> None:
        """Change the world around it, as where someone has walked on."""
        self.world, self._lidar = world, self._make_lidar(world)

    @property
    def motion(self) -> Motion:
        """Its pose and speeds."""
        return Motion(*self._motions[0].tolist())

    def obey(self, linear: float, angular: float) -> None:
        """Take speeds of the body, forward and to the left [m/s, rad/s], to hold for a while."""
        told = linear, angular
        self._told = told if all(map(math.isfinite, told)) else (0.0, 0.0)
        self._told_at = self.time

    def step(self) -> None:
        """Drive for a time step."""
        # Sums of time steps are rounded.
        fresh = self.time - self._told_at <= self._timeout + 1e-9
        linear, angular = self._told if fresh else (0.0, 0.0)
        turn = 0.5 * angular * self.robot.wheel_base
        speeds = np.array([[linear - turn, linear + turn]])
        self._drives.move(self._motions, np.ones(1, dtype=np.bool_), speeds)
        self.time += self.time_step
        clearance = self.world.clearance(*self.motion[:2])
        self.touched = self.touched or clearance <= self.robot.radius

    def scan(self) -> Scan:
        """Measure with the lidar, where the robot has it."""
        x, y, heading, *_ = self.motion
        (first, last), far = self._field, self._lidar.max_range
        across, up, yaw, roll = (*self.robot.lidar_mount, 0.0)[:4]
        x += across * math.cos(heading) - up * math.sin(heading)
        y += across * math.sin(heading) + up * math.cos(heading)
        side = 1.0 if abs(roll) < 1.0 else -1.0
        heading += yaw + side * 0.5 * (first + last)
        ranges = self._lidar.measure(x, y, heading, rng=self._rng)
        ranges = ranges[::-1] if side > 0.0 else ranges
        step = (last - first) / (len(ranges) - 1)
        return Scan(first, step, np.where(ranges >= far, math.inf, ranges), 0.0, far)

    def close(self) -> None:
        """Release the physics server."""
        self._drives.close()
