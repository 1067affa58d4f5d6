"""Motion of many robots: orders on their way to the wheels, exact kinematics, or PyBullet."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from mpfa_envs.robots.motion_loops import accelerate, drive_arcs, drive_orders

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from mpfa_envs.robots.model import RobotModel
    from mpfa_envs.robots.motion_loops import WheelLimits
    from mpfa_envs.robots.simulation import Simulation

STRENGTH: Final = 0.8
"""Share of their acceleration that a real robot's wheels have at least."""
OFF: Final = 0.05
"""Error that the latency of a real robot may have [s]."""
_TIME_STEP: Final = 0.02
"""Time for which a real wheel's speed is taken as constant [s]."""
_KEPT: Final = 5.0
"""Time for which orders are remembered [s]."""


class Orders:
    """Orders of a robot and the times at which they were given; at first it was told to stand."""

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._given: deque[tuple[float, float, float]] = deque()

    def give(self, time: float, linear: float, angular: float) -> None:
        """Remember an order [m/s, rad/s] in place of all that are not earlier [s]."""
        given = self._given
        while given and given[-1][0] >= time:
            given.pop()
        across = 0.5 * self._robot.wheel_base * angular
        given.append((time, linear - across, linear + across))
        while len(given) > 1 and given[1][0] < time - _KEPT:
            given.popleft()

    def states(
        self,
        motion: NDArray[np.float64],  # (x, y, heading, forward, turning), [5]
        age: float,  # of the motion [s]
        now: float,  # [s]
        latency: float,  # [s]
        *,
        certain: bool,
    ) -> NDArray[np.float64]:
        """Motions that the robot may have when an order of now acts, ``[S, 5]``."""
        limits = self._robot.wheel_limits
        assumed = [(latency, limits)]
        if not certain:
            slow = limits._replace(
                acceleration=STRENGTH * limits.acceleration, turning=STRENGTH * limits.turning
            )
            early, quick = max(latency - OFF, 0.0), limits._replace(turning=math.inf)
            assumed += [(latency + OFF, slow), (early, quick)]
        rows = [
            self.ahead(motion, since=now - age, until=now + late, latency=late, limits=limits)
            for late, limits in assumed
        ]
        return np.array(rows)

    def ahead(
        self,
        motion: NDArray[np.float64],  # (x, y, heading, forward, turning), [5]
        *,
        since: float,  # time of the motion [s]
        until: float,  # [s]
        latency: float,  # from an order to the wheels [s]
        limits: WheelLimits | None = None,  # None: those of the robot
    ) -> NDArray[np.float64]:
        """The motion, ``[5]``, at a later time."""
        times, orders = [], []
        begin, order = since, (0.0, 0.0)
        for given, left, right in self._given:
            act = given + latency
            if act >= until:
                break
            if act > begin:
                times.append(act - begin)
                orders.append(order)
                begin = act
            order = left, right
        times.append(until - begin)
        orders.append(order)
        limits, base = limits or self._robot.wheel_limits, self._robot.wheel_base
        return drive_orders(motion, np.array(times), np.array(orders), limits, base, _TIME_STEP)


class LateOrders:
    """Orders of many robots, which reach the wheels some time steps late."""

    def __init__(
        self,
        robot: RobotModel,
        robots: int,
        *,
        latency: tuple[float, float],  # least and greatest [s]
        time_step: float,  # [s]
    ) -> None:
        self._limits, self._wheel_base = robot.wheel_limits, robot.wheel_base
        self._latency, self._time_step = latency, time_step
        self._steps = np.zeros(robots, dtype=np.int64)
        self._past = np.zeros((robots, round(latency[1] / time_step) + 1, 2))
        """Wheel speeds that were ordered in the last time steps [m/s], the newest first."""

    def begin(self, index: int, rng: np.random.Generator) -> None:
        """Start an episode of a robot, which stands until its first order arrives."""
        low, high = self._latency
        latency = rng.uniform(low, high) if low < high else low
        self._steps[index] = round(latency / self._time_step)
        self._past[index] = 0.0

    def arriving(
        self, speeds: NDArray[np.float64], running: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Give orders ``[N, 2]`` [m/s]; those that the wheels have in this time step."""
        self._past[running, 1:] = self._past[running, :-1]
        self._past[running, 0] = speeds[running]
        return self._past[np.arange(len(speeds)), self._steps]

    def ahead(self, motions: NDArray[np.float64]) -> NDArray[np.float64]:
        """The motions ``[N, 5]`` of the robots when the next order acts."""
        ahead, step = motions.copy(), self._time_step
        for robot in np.flatnonzero(self._steps).tolist():
            orders = self._past[robot, self._steps[robot] - 1 :: -1]
            times = np.full(len(orders), step)
            ahead[robot] = drive_orders(
                motions[robot], times, orders, self._limits, self._wheel_base, step
            )
        return ahead


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
