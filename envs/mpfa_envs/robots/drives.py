"""Motion of many robots: exact kinematics, or PyBullet's physics."""

from __future__ import annotations

import math
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from mpfa_envs.robots.motion_loops import accelerate, drive_arcs
from mpfa_envs.saved import read_array
from mpfa_envs.tables import grown

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

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
        """Speeds that the wheels have by now been told, as fast as they may change [m/s]."""

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

    def state_dict(self) -> dict[str, Any]:
        """State that brings the robots back to where they are in their episodes."""
        return {}

    def read(self, state: Mapping[str, Any], starts: NDArray[np.float64]) -> Callable[[], None]:
        """Check what :meth:`state_dict` gave; the result loads it, from starts ``[N, 3]``."""
        return lambda: None

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
        # Speeds of each robot in its episode so far, and their number.
        self._driven = np.zeros((robots, 64, 2))
        self._counts = np.zeros(robots, dtype=np.int64)
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
        self._counts[index] = 0

    def _turn(
        self, motions: NDArray[np.float64], running: NDArray[np.bool_], speeds: NDArray[np.float64]
    ) -> None:
        """Hold the wheel speeds ``[N, 2]`` [m/s] for one time step and update the motions."""
        self._remember(running, speeds)
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

    def _remember(self, running: NDArray[np.bool_], speeds: NDArray[np.float64]) -> None:
        """Record the wheel speeds since the start of the episodes."""
        if self._counts.max() == self._driven.shape[1]:
            self._driven = grown(self._driven, 2 * self._driven.shape[1])
        self._driven[running, self._counts[running]] = speeds[running]
        self._counts[running] += 1

    def state_dict(self) -> dict[str, Any]:
        """The wheel speeds of the episodes so far: the engine cannot save its whole state."""
        counts = self._counts.copy()
        return {"counts": counts, "speeds": self._driven[:, : counts.max()].copy()}

    def read(self, state: Mapping[str, Any], starts: NDArray[np.float64]) -> Callable[[], None]:
        """Check what :meth:`state_dict` gave; the result drives the episodes again."""
        counts = read_array(state, "counts", self._counts)
        if counts.min() < 0:
            raise ValueError(f"counts of the state must not be negative, got {counts.tolist()}")
        speeds = read_array(state, "speeds", np.zeros((len(counts), counts.max(), 2)))
        return partial(self._drive_again, counts, speeds, starts)

    def _drive_again(
        self,
        counts: NDArray[np.int64],  # time steps so far, [N]
        speeds: NDArray[np.float64],  # of the wheels in them [m/s], [N, steps, 2]
        starts: NDArray[np.float64],  # (x, y, heading) [m, m, rad], [N, 3]
    ) -> None:
        last, motions = int(counts.max()), np.zeros((len(counts), 5))
        commands = self.commands.copy()
        # All end at once; one that has driven for a shorter time is placed later.
        for step in range(last + 1):
            for index in np.flatnonzero(counts == last - step).tolist():
                self.place(index, *starts[index].tolist())
            if step < last:
                running = step >= last - counts
                now = speeds[np.arange(len(counts)), np.maximum(step - last + counts, 0)]
                self._turn(motions, running, now)
        self.commands[...] = commands

    def close(self) -> None:
        """Shut the physics servers down; a second call does nothing."""
        for simulation in self._simulations:
            simulation.close()


def make_drives(physics: Physics, robot: RobotModel, robots: int, *, time_step: float) -> Drives:
    """Make the drives of a kind of physics."""
    if physics == "kinematic":
        return KinematicDrives(robot, robots, time_step=time_step)
    return WheelDrives(robot, robots, time_step=time_step)
