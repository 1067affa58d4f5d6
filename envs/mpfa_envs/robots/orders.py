"""The orders that a robot's driver gave, some of which are still under way to the wheels."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final

import numpy as np

from mpfa_envs.robots.motion_loops import drive_orders

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.robots.model import RobotModel
    from mpfa_envs.robots.motion_loops import WheelLimits

STRENGTH: Final = 0.8
"""Share of their acceleration that a real robot's wheels have at least."""
_OFF: Final = 0.05
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
            early, quick = max(latency - _OFF, 0.0), limits._replace(turning=math.inf)
            assumed += [(latency + _OFF, slow), (early, quick)]
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
