"""Motion of many robots: exact kinematics, or PyBullet's physics."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from mpfa_envs.robots.motion_loops import accelerate, drive_arcs

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from mpfa_envs.robots.model import RobotModel
    from mpfa_envs.robots.simulation import Simulation

SUBSTEP: Final = 1 / 30
"""Duration of a step of the physics engine [s].

The wheels keep their speeds as exactly at 30 Hz as at 240 Hz; at 20 Hz they do not.
"""
Physics = Literal["kinematic", "wheels"]
"""Kinds of motion."""
SERVERS: Final = 32
"""Physics servers at most; up to as many robots on wheels drive the same bits as alone."""


class Drives:
    """Motion of many robots, whose wheels do what :class:`WheelLimits` say and no more."""

    def __init__(self, robot: RobotModel, robots: int, *, time_step: float) -> None:
        self._limits = robot.wheel_limits
        self._time_step = time_step
        self.commands = np.zeros((robots, 2))
        """Speeds ordered of the wheels so far, as fast as they may change [m/s]."""

    def place(self, index: int, x: float, y: float, heading: float) -> None:
        """Put a robot at rest at a pose [m, m, rad]."""
        self.commands[index] = 0.0

    def move(
        self,
        motions: NDArray[np.float64],
        running: NDArray[np.bool_],
        speeds: NDArray[np.float64],
        disturb: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
    ) -> None:
        """Drive for a time step towards wheel speeds ``[N, 2]`` [m/s]; update the motions."""
        accelerate(self.commands, speeds, running, self._limits, self._time_step)
        driven = self.commands if disturb is None else disturb(self.commands)
        self._turn(motions, running, driven)

    def _turn(
        self, motions: NDArray[np.float64], running: NDArray[np.bool_], speeds: NDArray[np.float64]
    ) -> None:
        """Hold the wheel speeds ``[N, 2]`` [m/s] for one time step and update the motions."""
        raise NotImplementedError

    def close(self) -> None:
        """Release what is held; a second call does nothing."""


class KinematicDrives(Drives):
    """Moves robots on exact arcs: the wheels have their speed at once and never slip."""

    def __init__(self, robot: RobotModel, robots: int, *, time_step: float) -> None:
        super().__init__(robot, robots, time_step=time_step)
        self._wheel_base = robot.wheel_base

    def _turn(
        self, motions: NDArray[np.float64], running: NDArray[np.bool_], speeds: NDArray[np.float64]
    ) -> None:
        """Hold the wheel speeds ``[N, 2]`` [m/s] for one time step and update the motions."""
        drive_arcs(motions, running, speeds, self._wheel_base, self._time_step)


class WheelDrives(Drives):
    """Moves robots by PyBullet: motors turn the wheels, friction moves the robot."""

    # Up to 32 robots have a physics server each and drive the same bits as alone. A server takes 35
    # MB, so more robots share 32 of them and pass through each other. There PyBullet's solver
    # stops at other last digits, and trajectories diverge slowly.

    def __init__(self, robot: RobotModel, robots: int, *, time_step: float) -> None:
        # Imported here so that kinematic environments run without PyBullet.
        from mpfa_envs.robots.simulation import Simulation

        super().__init__(robot, robots, time_step=time_step)
        self._wheel_radius = robot.wheel_radius
        self._simulations = [
            Simulation(time_step=time_step, substeps=max(1, round(time_step / SUBSTEP)))
            for _ in range(min(robots, SERVERS))
        ]
        self._names = [f"robot_{index}" for index in range(robots)]
        for index, name in enumerate(self._names):
            self._simulation_of(index).add_robot(robot, name=name)
        for index in range(robots):
            self.place(index, 0.0, 0.0, 0.0)

    def _simulation_of(self, index: int) -> Simulation:
        """The server of a robot."""
        return self._simulations[index % len(self._simulations)]

    def place(self, index: int, x: float, y: float, heading: float) -> None:
        """Put a robot at rest at a pose [m, m, rad]."""
        super().place(index, x, y, heading)
        self._simulation_of(index).place_robot(x, y, heading, name=self._names[index])

    def _turn(
        self, motions: NDArray[np.float64], running: NDArray[np.bool_], speeds: NDArray[np.float64]
    ) -> None:
        """Hold the wheel speeds ``[N, 2]`` [m/s] for one time step and update the motions."""
        turning = np.where(running[:, None], speeds / self._wheel_radius, 0.0).tolist()
        moving = np.flatnonzero(running).tolist()
        # In a server of its own, a robot that does not run is not simulated; in a shared one it
        # stops.
        shared = len(self._names) > len(self._simulations)
        for index in range(len(self._names)) if shared else moving:
            left, right = turning[index]
            simulation = self._simulation_of(index)
            simulation.set_wheel_speeds(left, right, name=self._names[index])
        for number in {index % len(self._simulations) for index in moving}:
            self._simulations[number].step()
        for index in moving:
            x, y, heading, speed_x, speed_y, turn = self._simulation_of(index).robot_motion(
                self._names[index]
            )
            forward = speed_x * math.cos(heading) + speed_y * math.sin(heading)
            motions[index] = x, y, heading, forward, turn

    def close(self) -> None:
        """Shut the physics servers down; a second call does nothing."""
        for simulation in self._simulations:
            simulation.close()


def make_drives(physics: Physics, robot: RobotModel, robots: int, *, time_step: float) -> Drives:
    """Make the drives of a kind of physics."""
    if physics == "kinematic":
        return KinematicDrives(robot, robots, time_step=time_step)
    return WheelDrives(robot, robots, time_step=time_step)
