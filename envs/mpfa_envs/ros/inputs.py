"""The last scan and the odometry of the last second, checked for what cannot be true."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.deploy.pilot import Pilot
    from mpfa_envs.robots.model import RobotModel
    from mpfa_envs.sensing.sectors import Points, Scan

Pose = tuple[float, float, float]
_AHEAD: Final = 0.15
"""A stamp may be ahead of the clock by this [s]: simulated clocks tick some tenths late."""
_MEMORY: Final = 1.0
"""Time for which odometry is kept [s], unless the timeout of scans is longer."""
_SLACK: Final = 0.2, 0.5
"""Slack of a pose's motion and turn over what the robot drives [m, rad], as where wheels slip."""
_MOVED: Final = 0.05, 0.1
"""A robot that has come this far, or has turned by this, sees something else [m, rad]."""
_LAG: Final = 0.25
"""Odometry may lag behind the scans by this, and show a standing robot as driving [s]."""
_PUSHED: Final = 0.5
"""A robot with orders to drive this far must have moved [m]."""
_GAP: Final = 0.5
"""Longest time between two odometries that counts [s]."""


class Seen(NamedTuple):
    """The last scan."""

    scan: Scan
    time: float
    """When it was taken [s]; of one that repeats itself, when it came first."""
    ahead: float = math.inf
    """Least distance of what is in front from the robot's center [m],"""
    behind: float = math.inf
    """and of what is behind."""
    fault: str = ""
    """Why it cannot be used; empty if it can."""
    repeated: bool = False
    """True if the robot has moved, and this scan has not changed."""


class Felt(NamedTuple):
    """Odometry."""

    pose: Pose
    speeds: tuple[float, float]
    time: float


class Sight:
    """The last scan, and whether it repeats the one before."""

    def __init__(self, pilot: Pilot, stop_distance: float) -> None:
        self._sectors = pilot.sectors
        self._free = pilot.robot.radius + stop_distance
        self.last: Seen | None = None
        self._ranges: NDArray[np.float64] = np.empty(0)
        self._since = -math.inf
        self._from: Pose | None = None

    def take(self, scan: Scan, time: float, track: Track) -> None:
        """Take a scan and its time [s]."""
        try:
            self._sectors.read(scan)
            points = self._sectors.around(scan)
        # ScanError, and what NumPy says of what is no array of numbers.
        except ValueError as error:
            self.last = Seen(scan, time, fault=str(error))
            return
        repeated = self._repeats(scan, time, points, track)
        front = np.abs(points.angles) <= 0.5 * math.pi
        ahead, behind = (
            float(np.fmin.reduce(points.ranges[half], initial=math.inf)) for half in (front, ~front)
        )
        silent = np.isnan(points.ranges)
        fault = self._hidden(scan, 1.0) if silent[front].any() else ""
        if silent[~front].any() and self._hidden(scan, -1.0):
            behind = 0.0
        when = self._since if repeated else time
        self.last = Seen(scan, when, ahead, behind, fault, repeated)

    def forget(self) -> None:
        """Stop comparing with earlier odometry."""
        self._from = None

    def missing(self, now: float, timeout: float) -> str:
        """Why the robot must not drive by it; empty if it may."""
        if self.last is None:
            return "no scan"
        age = now - self.last.time
        if not -_AHEAD <= age <= timeout:
            return f"{'repeated' if self.last.repeated else 'stale'} scan: {age:.1f} s old"
        return self.last.fault

    def _repeats(self, scan: Scan, time: float, points: Points, track: Track) -> bool:
        """Return True if the robot has moved since the first scan with these numbers."""
        # Where nothing is in reach, scans are alike.
        # A copy, as the caller may reuse the array.
        ranges = np.array(scan.ranges, dtype=np.float64)
        met = bool((points.ranges < self._sectors.card.max_range).any())
        if not met or not np.array_equal(ranges, self._ranges, equal_nan=True):
            self._ranges, self._since, self._from = ranges, time, None
            return False
        if self._from is None and time >= self._since + _LAG:
            self._from = track.pose_at(time)
        return track.last is not None and _moved(self._from, track.last.pose)

    def _hidden(self, scan: Scan, sign: float) -> str:
        """Why a ray in front, or behind with a sign of -1, that is not valid may hide something."""
        # It may be too near to measure, which matters where the robot does not stop before that.
        x, y, _ = self._sectors.mount
        blind = scan.range_min + math.hypot(max(sign * x, 0.0), y)
        if blind <= self._free:
            return ""
        return (
            f"a ray in front is not valid, and may hide what is nearer than range_min, "
            f"{scan.range_min:.2f} m: raise stop_distance by {blind - self._free:.2f} m"
        )


class Track:
    """The odometry of the last second, or of ``memory`` if that is longer [s]."""

    def __init__(self, robot: RobotModel, memory: float) -> None:
        # Twice what the wheels can, turning on the spot.
        self._limits = 2.0 * robot.max_wheel_speed, 4.0 * robot.max_wheel_speed / robot.wheel_base
        self._memory = max(_MEMORY, memory)
        self._past: deque[Felt] = deque()
        self._pushed = 0.0
        self._from: Pose | None = None
        self._finite = True
        self.last: Felt | None = None
        """Of numbers that are finite."""

    def take(self, felt: Felt, ordered: float) -> str:
        """Take odometry and the last order [m/s]; return why its poses cannot be trusted."""
        self._finite = all(map(math.isfinite, (*felt.pose, *felt.speeds, felt.time)))
        if not self._finite:
            return ""
        self.last = felt
        if not self._past:
            self._past.append(felt)
            return ""
        before = self._past[-1]
        # Headings continue beyond half a turn, so that turns can be compared.
        x, y, heading = felt.pose
        heading += math.tau * round((before.pose[2] - heading) / math.tau)
        felt = felt._replace(pose=(x, y, heading))
        back = felt.time < before.time
        # The oldest, too: a slide of a little in each message is a jump as well.
        past = (before,) if back else (before, self._past[0])
        lost = self._jump(felt, past) or self._stall(felt, ordered)
        if lost or back:
            self._past.clear()
        self._past.append(felt)
        while self._past[0].time < felt.time - self._memory:
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
        if not -_AHEAD <= age <= timeout:
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
        later: Felt | None = None
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

    def _jump(self, felt: Felt, past: tuple[Felt, ...]) -> str:
        """The jump of a pose that the wheels cannot make since earlier ones; empty without."""
        for each in past:
            moved, turned = math.dist(felt.pose[:2], each.pose[:2]), felt.pose[2] - each.pose[2]
            passed = max(felt.time - each.time, 0.0)
            if self._too_far(moved, passed):
                return f"odometry jumped: {moved:.1f} m in {passed:.2f} s"
            if self._too_much(turned, passed):
                return f"odometry jumped: {math.degrees(turned):.0f} degrees in {passed:.2f} s"
        return ""

    def _stall(self, felt: Felt, ordered: float) -> str:
        """Return the distance ordered while the robot stood; empty if it moves as ordered."""
        self._pushed += abs(ordered) * min(max(felt.time - self._past[-1].time, 0.0), _GAP)
        if not ordered or self._from is None or _moved(self._from, felt.pose):
            self._pushed, self._from = 0.0, felt.pose
        if self._pushed <= _PUSHED:
            return ""
        return f"odometry stands still: ordered to drive {self._pushed:.1f} m"


def _moved(start: Pose | None, end: Pose) -> bool:
    """Return True if what a robot sees from two poses differs."""
    if start is None:
        return False
    turned = abs(math.remainder(end[2] - start[2], math.tau))
    return math.dist(start[:2], end[:2]) > _MOVED[0] or turned > _MOVED[1]
