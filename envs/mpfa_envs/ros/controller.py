"""The decisions and the stops of the policy's node.

The robot stands still, and says so, while there is no goal, scan or odometry, while one of the two
is older than it may be (or from the future), while something where it drives is nearer to its rim
than the stop distance, or will be before the next check, and whenever a number cannot be true or a
scan lacks the range of a sector. A scan that repeats itself while the robot moves grows older. The
goal stays, and the robot drives on once the reason is gone. Odometry that jumps or stands still
gives up the goal, whose place is then unknown, and so do a policy that fails and one that drives
for long without coming to a new place. Without a goal the node publishes one stop and then nothing,
so that others may drive.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from mpfa_envs.checks import check_not_negative, check_positive
from mpfa_envs.sensing.scan import ScanError, check_real, in_numbers

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.deploy.pilot import Command, Pilot
    from mpfa_envs.robots.model import RobotModel
    from mpfa_envs.sensing.scan import Scan
    from mpfa_envs.sensing.sectors import Points
    from mpfa_envs.worlds.world import World

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


class LaserReading(NamedTuple):
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


class Odometry(NamedTuple):
    """Odometry."""

    pose: Pose
    speeds: tuple[float, float]
    time: float


class LaserInput:
    """The last scan, and whether it repeats the one before."""

    def __init__(self, pilot: Pilot, stop_distance: float) -> None:
        self._sectors = pilot.sectors
        self._free = pilot.robot.radius + stop_distance
        self.last: LaserReading | None = None
        self._ranges: NDArray[np.float64] = np.empty(0)
        self._since = -math.inf
        self._from: Pose | None = None

    def take(self, scan: Scan, time: float, odometry: OdometryInput) -> None:
        """Take a scan and its time [s]."""
        moment = math.nan
        try:
            moment = check_real("time", time)
            scan = in_numbers(scan)
            self._sectors.read(scan)
            points = self._sectors.around(scan)
        except ScanError as error:
            self.last = LaserReading(scan, moment, fault=str(error))
            return
        repeated = self._repeats(scan, moment, points, odometry)
        self.last = LaserReading(
            scan, self._since if repeated else moment, *self._obstacles(scan, points), repeated
        )

    def _obstacles(self, scan: Scan, points: Points) -> tuple[float, float, str]:
        """Least distances in front and behind [m], and why the robot cannot drive by them."""
        front = np.abs(points.angles) <= 0.5 * math.pi
        ahead, behind = (
            float(np.fmin.reduce(points.ranges[half], initial=math.inf)) for half in (front, ~front)
        )
        silent = np.isnan(points.ranges)
        fault = self._hidden(scan, 1.0) if silent[front].any() else ""
        # What a silent ray behind may hide could touch the robot.
        hidden_behind = silent[~front].any() and self._hidden(scan, -1.0)
        return ahead, 0.0 if hidden_behind else behind, fault

    def forget(self) -> None:
        """Stop comparing with earlier odometry."""
        self._from = None

    def missing(self, now: float, timeout: float) -> str:
        """Why the robot must not drive by it; empty if it may."""
        if self.last is None:
            return "no scan"
        age = now - self.last.time
        if math.isnan(age) and self.last.fault:
            return self.last.fault
        if not -_AHEAD <= age <= timeout:
            return f"{'repeated' if self.last.repeated else 'stale'} scan: {age:.1f} s old"
        return self.last.fault

    def _repeats(self, scan: Scan, time: float, points: Points, odometry: OdometryInput) -> bool:
        """Return True if the robot has moved since the first scan with these numbers."""
        # Where nothing is in reach, scans are alike.
        # A copy, as the caller may reuse the array.
        ranges = np.array(scan.ranges, dtype=np.float64)
        met = bool((points.ranges < self._sectors.card.max_range).any())
        if not met or not np.array_equal(ranges, self._ranges, equal_nan=True):
            self._ranges, self._since, self._from = ranges, time, None
            return False
        if self._from is None and time >= self._since + _LAG:
            self._from = odometry.pose_at(time)
        return odometry.last is not None and _moved(self._from, odometry.last.pose)

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


class OdometryInput:
    """The odometry of the last second, or of ``memory`` if that is longer [s]."""

    def __init__(self, robot: RobotModel, memory: float) -> None:
        # Twice what the wheels can, turning on the spot.
        self._limits = 2.0 * robot.max_wheel_speed, 4.0 * robot.max_wheel_speed / robot.wheel_base
        self._memory = max(_MEMORY, memory)
        self._past: deque[Odometry] = deque()
        self._pushed = 0.0
        self._from: Pose | None = None
        self._finite = True
        self.last: Odometry | None = None
        """Of numbers that are finite."""

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
        if not ordered or self._from is None or _moved(self._from, odometry.pose):
            self._pushed, self._from = 0.0, odometry.pose
        if self._pushed <= _PUSHED:
            return ""
        return f"odometry stands still: ordered to drive {self._pushed:.1f} m"


def _moved(start: Pose | None, end: Pose) -> bool:
    """Return True if what a robot sees from two poses differs."""
    if start is None:
        return False
    turned = abs(math.remainder(end[2] - start[2], math.tau))
    return math.dist(start[:2], end[:2]) > _MOVED[0] or turned > _MOVED[1]


_EARLY: Final = 0.2
"""Share of its period by which a decision may come early, as scans are irregular."""
_PLACE: Final = 0.5
"""Side of the squares that count as one place [m]."""
_NOWHERE: Final = 40.0
"""A robot that could have driven this far must have come to a new place [m]."""


class Order(NamedTuple):
    """The speeds to publish."""

    linear: float
    """Forward speed [m/s]."""
    angular: float
    """Turning speed, to the left [rad/s]."""
    reason: str
    """``driving``, ``arrived``, or why the robot stands still; figures follow a colon."""


class Controller:
    """Drives to a goal by an exported policy, and stops where it should not."""

    def __init__(
        self,
        pilot: Pilot,
        *,
        stop_distance: float = 0.05,  # clearance of the rim at or below which it stops [m]
        scan_timeout: float = 0.5,  # oldest scan that it drives by [s]
        odometry_timeout: float = 0.5,  # [s]
        check_period: float = 0.05,  # longest time from one tick() to the next [s]
    ) -> None:
        self.pilot = pilot
        self.stop_distance = check_not_negative("stop_distance", stop_distance)
        self.scan_timeout = check_positive("scan_timeout", scan_timeout)
        self.odometry_timeout = check_positive("odometry_timeout", odometry_timeout)
        self.check_period = check_positive("check_period", check_period)
        self._laser = LaserInput(pilot, self.stop_distance)
        self._odometry = OdometryInput(pilot.robot, scan_timeout)
        self._ordered = 0.0, 0.0
        self._ticked, self._passed = -math.inf, 0.0
        self._places: set[tuple[int, int]] = set()
        self._lost = 0.0
        self._held = ""
        self._command: Command | None = None
        self._decided = -math.inf
        self._idle = "no goal"
        self._told = True
        self._plan: tuple[World, tuple[float, float, float]] | None = None

    def see(self, scan: Scan, time: float) -> None:
        """Take a scan and its time [s]."""
        self._laser.take(scan, time, self._odometry)

    def feel(
        self, pose: tuple[float, float, float], speeds: tuple[float, float], time: float
    ) -> None:
        """Take odometry: pose (x, y, heading), forward and turning speed, time [m, rad, s]."""
        lost = self._odometry.take(Odometry(pose, speeds, time), self._ordered[0])
        if lost and self.pilot.goal is not None:
            self.aim(None, lost)

    def know(self, plan: World | None, pose: tuple[float, float, float]) -> None:
        """Take the plan for this and later goals, and its pose in the frame of the odometry."""
        self._plan = None if plan is None else (plan, pose)
        if plan is not None and self.pilot.plan is plan:
            self.pilot.move_plan(pose)

    def aim(
        self,
        goal: tuple[float, float] | None,
        reason: str = "no goal",
        *,
        heading: float | None = None,
    ) -> None:
        """Set out for a goal (x, y) in the odometry's frame [m], or stop for a reason.

        There the robot turns to a heading, if there is one [rad].
        """
        self._command, self._told = None, False
        self._idle, self._held = reason, ""
        self._places, self._lost = set(), 0.0
        # The goal is in the frame of the odometry from now on.
        self._odometry.forget()
        self._laser.forget()
        self.pilot.stop()
        if goal is not None:
            try:
                plan, pose = self._plan or (None, (0.0, 0.0, 0.0))
                self.pilot.begin(goal, plan=plan, plan_pose=pose, heading=heading)
            except ValueError as error:
                self._idle = str(error)

    def correct_goal(self, goal: tuple[float, float], heading: float | None = None) -> None:
        """The goal in the frame of the odometry, which has drifted; NaN gives up the goal."""
        if self.pilot.goal is not None:
            try:
                self.pilot.move_goal(goal, heading=heading)
            except ValueError as error:
                self.aim(None, str(error))

    def hold(self, reason: str) -> None:
        """Stand still for a reason from outside, until it is empty or the goal is new."""
        self._held = reason

    def tick(self, now: float) -> Order | None:
        """The order to publish at a time [s], if any; call it several times a second."""
        self._passed = min(max(now - self._ticked, 0.0), self.pilot.period)
        self._ticked = now
        order = self._choose(now)
        self._ordered = (0.0, 0.0) if order is None else order[:2]
        self.pilot.give(now, *self._ordered)
        return order

    def _choose(self, now: float) -> Order | None:
        """The order of a moment [s]; None: nothing to publish."""
        if self.pilot.goal is None:
            if self._told:
                return None
            self._told = True
            return Order(0.0, 0.0, self._idle)
        reading, odometry = self._laser.last, self._odometry.last
        reason = (
            self._held
            or self._laser.missing(now, self.scan_timeout)
            or self._odometry.missing(now, self.odometry_timeout)
        )
        if reason or reading is None or odometry is None:
            self._command = None
            return Order(0.0, 0.0, reason)
        if self.pilot.arrived(odometry.pose):
            self.aim(None, "arrived")
            return self._choose(now)
        if self._lost > _NOWHERE:
            reason = "stands still" if self.pilot.stands_still else "no progress"
            self.aim(None, f"{reason}: time for {_NOWHERE:g} m, and no new place")
            return self._choose(now)
        try:
            order = self._drive(reading, odometry, now)
        # Whatever the policy raises: a policy that has failed is not asked again.
        except Exception as error:
            self.aim(None, str(error) if isinstance(error, ValueError) else f"failed: {error!r}")
            return self._choose(now)
        self._count(odometry)
        return self._unless_blocked(order, reading, now)

    def _unless_blocked(self, order: Order, reading: LaserReading, now: float) -> Order:
        """The order, or its turn alone if it comes too near to something before the next check."""
        nearest, sign = (reading.behind, -1.0) if order.linear < 0.0 else (reading.ahead, 1.0)
        # A filter keeps off all that is measured.
        if self.pilot.has_filter and nearest > 0.0:
            return order
        clearance = nearest - self.pilot.robot.radius
        fastest = max(sign * self._ordered[0], self._odometry.fastest(reading.time, sign), 0.0)
        covered = fastest * (max(now - reading.time, 0.0) + self.check_period)
        if clearance - covered > self.stop_distance:
            return order
        reason = f"obstacle: {max(clearance, 0.0):.2f} m from the rim"
        return Order(0.0, order.angular, reason)

    def _drive(self, reading: LaserReading, odometry: Odometry, now: float) -> Order:
        """The command that holds, or a new one where it is due."""
        due = self._decided + (1.0 - _EARLY) * self.pilot.period
        if self._command is None or not self._decided <= now < due:
            taken = self._odometry.pose_at(reading.time)
            age = max(now - odometry.time, 0.0)
            self._command = self.pilot.decide(
                reading.scan, odometry.pose, odometry.speeds, scan_pose=taken, time=now, age=age
            )
            self._decided = now
        return Order(*self.pilot.ramp(self._ordered, self._command[2:], self._passed), "driving")

    def _count(self, odometry: Odometry) -> None:
        """Count how far the robot could have driven since it came to its last new place."""
        place = round(odometry.pose[0] / _PLACE), round(odometry.pose[1] / _PLACE)
        self._lost += self._passed * self.pilot.pace * self.pilot.card.robot.max_wheel_speed
        if place not in self._places:
            self._places.add(place)
            self._lost = 0.0
