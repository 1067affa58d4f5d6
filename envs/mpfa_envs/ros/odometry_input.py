"""The odometry that a controller drives by, and what is wrong with it."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from mpfa_envs.robots.model import RobotModel

Pose = tuple[float, float, float]
AHEAD: Final = 0.15
"""A stamp may be ahead of the clock by this [s]: simulated clocks tick some tenths late."""
_MEMORY: Final = 1.0
"""Time for which odometry is kept [s], unless the timeout of scans is longer."""
_SLACK: Final = 0.2, 0.5
"""Slack of a pose's motion and turn over what the robot drives [m, rad], as where wheels slip."""
_MOVED: Final = 0.05, 0.1
"""A robot that has come this far, or has turned by this, sees something else [m, rad]."""
_PUSHED: Final = 0.5
"""A robot with orders to drive this far must have moved [m]."""
_GAP: Final = 0.5
"""Longest time between two odometries that counts [s]."""


class Odometry(NamedTuple):
    """Odometry."""

    pose: Pose
    speeds: tuple[float, float]
    time: float


class OdometryInput:
    """The odometry of the last second, or of ``memory`` if that is longer [s]."""

    def __init__(self, robot: RobotModel, memory: float) -> None:
        # Twice what the wheels can, turning on the spot.
        self._limits = 2.0 * robot.max_wheel_speed, 4.0 * robot.max_wheel_speed / robot.wheel_base
        self.set_memory(memory)
        self._past: deque[Odometry] = deque()
        self._pushed = 0.0
        self._from: Pose | None = None
        self._finite = True
        self.last: Odometry | None = None
        """Of numbers that are finite."""

    def set_memory(self, memory: float) -> None:
        """Keep the odometry of a time [s], or longer."""
        self._memory = max(_MEMORY, memory)

    def take(self, odometry: Odometry, ordered: float) -> str:
        """Take odometry and the last order [m/s]; return why its poses cannot be trusted."""
        self._finite = all(map(math.isfinite, (*odometry.pose, *odometry.speeds, odometry.time)))
        if not self._finite:
            return ""
        self.last = odometry
        if not self._past:
            self._past.append(odometry)
            return ""
        before = self._past[-1]
        # Headings continue beyond half a turn, so that turns can be compared.
        x, y, heading = odometry.pose
        heading += math.tau * round((before.pose[2] - heading) / math.tau)
        odometry = odometry._replace(pose=(x, y, heading))
        back = odometry.time < before.time
        # The oldest, too: a slide of a little in each message is a jump as well.
        past = (before,) if back else (before, self._past[0])
        lost = self._jump(odometry, past) or self._stall(odometry, ordered)
        if lost or back:
            self._past.clear()
        self._past.append(odometry)
        while self._past[0].time < odometry.time - self._memory:
            self._past.popleft()
        return lost

    def forget(self) -> None:
        """Stop comparing with earlier poses."""
        self._past.clear()
        self._pushed, self._from = 0.0, None

    def missing(self, now: float, timeout: float) -> str:
        """Why the robot must not drive by it; empty if it may."""
        if not self._finite:
            return "odometry is not finite"
        if self.last is None:
            return "no odometry"
        age = now - self.last.time
        if not -AHEAD <= age <= timeout:
            return f"stale odometry: {age:.1f} s old"
        linear, angular = self.last.speeds
        if self._too_far(linear, 1.0) or self._too_much(angular, 1.0):
            return f"odometry too fast: {linear:.3g} m/s, {angular:.3g} rad/s"
        return ""

    def fastest(self, since: float, sign: float) -> float:
        """Greatest speed forward, or with a sign of -1 backward, since some time [m/s]."""
        speeds = [each.speeds[0] for each in self._past if each.time >= since]
        if self.last is not None:
            speeds.append(self.last.speeds[0])
        return max((sign * speed for speed in speeds), default=0.0)

    def pose_at(self, time: float) -> Pose | None:
        """Pose at a time, between the two odometries around it; outside of all the last one."""
        if self.last is None:
            return None
        later: Odometry | None = None
        for each in reversed(self._past):
            if later is not None and each.time <= time < later.time:
                share = (time - each.time) / (later.time - each.time)
                x, y, turn = (b - a for a, b in zip(each.pose, later.pose, strict=True))
                start = each.pose
                return start[0] + share * x, start[1] + share * y, start[2] + share * turn
            later = each
        return self.last.pose

    def _too_far(self, moved: float, passed: float) -> bool:
        """Return True if the wheels do not come that far in a time [s]."""
        return abs(moved) > self._limits[0] * passed + _SLACK[0]

    def _too_much(self, turned: float, passed: float) -> bool:
        """Return True if they do not turn the robot by that in a time [s]."""
        return abs(turned) > self._limits[1] * passed + _SLACK[1]

    def _jump(self, odometry: Odometry, past: tuple[Odometry, ...]) -> str:
        """The jump of a pose that the wheels cannot make since earlier ones; empty without."""
        for each in past:
            moved, turned = (
                math.dist(odometry.pose[:2], each.pose[:2]),
                odometry.pose[2] - each.pose[2],
            )
            passed = max(odometry.time - each.time, 0.0)
            if self._too_far(moved, passed):
                return f"odometry jumped: {moved:.1f} m in {passed:.2f} s"
            if self._too_much(turned, passed):
                return f"odometry jumped: {math.degrees(turned):.0f} degrees in {passed:.2f} s"
        return ""

    def _stall(self, odometry: Odometry, ordered: float) -> str:
        """Return the distance ordered while the robot stood; empty if it moves as ordered."""
        self._pushed += abs(ordered) * min(max(odometry.time - self._past[-1].time, 0.0), _GAP)
        if not ordered or self._from is None or has_moved(self._from, odometry.pose):
            self._pushed, self._from = 0.0, odometry.pose
        if self._pushed <= _PUSHED:
            return ""
        return f"odometry stands still: ordered to drive {self._pushed:.1f} m"


def has_moved(start: Pose | None, end: Pose) -> bool:
    """Return True if what a robot sees from two poses differs."""
    if start is None:
        return False
    turned = abs(math.remainder(end[2] - start[2], math.tau))
    return math.dist(start[:2], end[:2]) > _MOVED[0] or turned > _MOVED[1]
