"""What the policy's node does: when it decides, and when it stops."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from mpfa_envs.checks import check_number, check_positive
from mpfa_envs.deploy.sectors import Scan, ScanError

if TYPE_CHECKING:
    from mpfa_envs.deploy.pilot import Command, Pilot

_EARLY: Final = 0.2
"""By how much of its period a decision may come early: scans do not come like clockwork."""
_AHEAD: Final = 0.15
"""By how much a stamp may be ahead of the clock [s]: simulated clocks tick some tenths late."""
_MEMORY: Final = 1.0
"""How long odometry is remembered [s]; a longer timeout of scans keeps it as long as that."""
_SLACK: Final = 0.2
"""How far a pose may move besides what the robot drives [m], as where wheels slip."""


class Order(NamedTuple):
    """What to publish."""

    linear: float
    """Forward speed [m/s]."""
    angular: float
    """Turning speed, to the left [rad/s]."""
    reason: str
    """``driving``, ``arrived``, or why the robot stands still; figures follow a colon."""


class _Felt(NamedTuple):
    """The last odometry."""

    pose: tuple[float, float, float]
    speeds: tuple[float, float]
    time: float


class _Seen(NamedTuple):
    """The last scan."""

    scan: Scan
    nearest: float
    """Least distance of a point in front from the robot's center [m]."""
    fault: str
    """Why it cannot be used; empty if it can."""
    time: float


class Controller:
    """Drives to a goal by an exported policy, and stops where it should not.

    It stands still, and says so, while there is no goal, scan or odometry, while one of the two is
    older than it may be (or from the future), while something in front is nearer to the robot's rim
    than the stop distance, or will be before the next check, and whenever a number is not finite or
    a scan does not tell enough. The goal stays, and it drives on once the reason is gone. Odometry
    that jumps gives up the goal, whose place is then unknown. Without a goal it publishes one stop
    and then nothing, so that others may drive.

    Args:
        pilot: The policy.
        stop_distance: Clearance of the robot's rim at or below which it stops [m].
        scan_timeout: Oldest scan that it drives by [s].
        odometry_timeout: Oldest odometry [s].
        check_period: Longest time from one :meth:`tick` to the next [s].

    Raises:
        ValueError: If an argument is out of its range.
    """

    def __init__(
        self,
        pilot: Pilot,
        *,
        stop_distance: float = 0.05,
        scan_timeout: float = 0.5,
        odometry_timeout: float = 0.5,
        check_period: float = 0.05,
    ) -> None:
        if check_number("stop_distance", stop_distance) < 0.0:
            raise ValueError(f"stop_distance must not be negative, got {stop_distance}")
        self.pilot = pilot
        self.stop_distance = stop_distance
        self.scan_timeout = check_positive("scan_timeout", scan_timeout)
        self.odometry_timeout = check_positive("odometry_timeout", odometry_timeout)
        self.check_period = check_positive("check_period", check_period)
        self._seen: _Seen | None = None
        self._felt: _Felt | None = None
        self._track: deque[_Felt] = deque()
        self._ordered = 0.0
        self._held = ""
        self._command: Command | None = None
        self._decided = -math.inf
        self._idle = "no goal"
        self._told = True

    def see(self, scan: Scan, time: float) -> None:
        """Take a scan.

        Args:
            scan: What the lidar has measured.
            time: When [s].
        """
        nearest, fault = math.inf, ""
        try:
            _, points = self.pilot.sectors.read(scan)
            ahead = np.abs(points.angles) <= 0.5 * math.pi
            nearest = float(points.ranges[ahead].min(initial=math.inf))
        except ScanError as error:
            fault = str(error)
        self._seen = _Seen(scan, nearest, fault, time)

    def feel(
        self, pose: tuple[float, float, float], speeds: tuple[float, float], time: float
    ) -> None:
        """Take odometry.

        Args:
            pose: Of the robot (x, y, heading) [m, m, rad].
            speeds: Forward and turning speed [m/s, rad/s].
            time: When [s].

        A pose farther from the last than the robot drives gives up the goal: ``odometry jumped``.
        """
        self._felt = felt = _Felt(pose, speeds, time)
        if not all(map(math.isfinite, (*pose, *speeds, time))):
            return
        if self._track:
            last = self._track[-1]
            moved, passed = math.dist(pose[:2], last.pose[:2]), max(time - last.time, 0.0)
            if moved > 2.0 * self.pilot.robot.max_wheel_speed * passed + _SLACK:
                if self.pilot.goal is not None:
                    self.aim(None, f"odometry jumped: {moved:.1f} m in {passed:.2f} s")
                self._track.clear()
            elif time < last.time:
                self._track.clear()
        self._track.append(felt)
        while self._track[0].time < time - max(_MEMORY, self.scan_timeout):
            self._track.popleft()

    def aim(self, goal: tuple[float, float] | None, reason: str = "no goal") -> None:
        """Set out for a goal, or give up the one there is.

        Args:
            goal: Position (x, y) in the frame of the odometry [m]; None: stand still. One that is
                not finite gives up the goal, too.
            reason: Why there is none.
        """
        self._command, self._told = None, False
        self._idle, self._held = reason, ""
        # Where the goal is, is meant by the odometry from now on.
        self._track.clear()
        self.pilot.stop()
        if goal is not None:
            try:
                self.pilot.begin(goal)
            except ValueError as error:
                self._idle = str(error)

    def correct_goal(self, goal: tuple[float, float]) -> None:
        """The goal in the frame of the odometry, which has drifted; NaN gives up the goal.

        Args:
            goal: Position (x, y) [m].
        """
        if self.pilot.goal is not None:
            try:
                self.pilot.move_goal(goal)
            except ValueError as error:
                self.aim(None, str(error))

    def hold(self, reason: str) -> None:
        """Stand still for a reason that is known elsewhere, until told that it is gone.

        Args:
            reason: Why; empty: no longer. A new goal is not held.
        """
        self._held = reason

    def tick(self, now: float) -> Order | None:
        """Say what to publish now; to be asked at each scan, and some times a second besides.

        Args:
            now: The time, of the clock that scans and odometry are stamped by [s].

        Returns:
            What to publish; None: nothing.
        """
        order = self._choose(now)
        self._ordered = 0.0 if order is None else order.linear
        return order

    def _choose(self, now: float) -> Order | None:
        """What to publish; None: nothing."""
        if self.pilot.goal is None:
            if self._told:
                return None
            self._told = True
            return Order(0.0, 0.0, self._idle)
        seen, felt = self._seen, self._felt
        reason = self._missing(seen, felt, now)
        if reason is None and seen is not None and felt is not None:
            if self.pilot.arrived(felt.pose):
                self.aim(None, "arrived")
                return self._choose(now)
            try:
                return self._drive(seen, felt, now)
            except ValueError as error:
                reason = str(error)
        self._command = None
        return Order(0.0, 0.0, reason or "")

    def _missing(self, seen: _Seen | None, felt: _Felt | None, now: float) -> str | None:
        """What keeps the robot from driving; None: nothing."""
        if self._held:
            return self._held
        if seen is None:
            return "no scan"
        if felt is None:
            return "no odometry"
        if not -_AHEAD <= now - seen.time <= self.scan_timeout:
            return f"stale scan: {now - seen.time:.1f} s old"
        if not -_AHEAD <= now - felt.time <= self.odometry_timeout:
            return f"stale odometry: {now - felt.time:.1f} s old"
        if not all(map(math.isfinite, (*felt.pose, *felt.speeds))):
            return "odometry is not finite"
        if seen.fault:
            return seen.fault
        clearance = seen.nearest - self.pilot.robot.radius
        if clearance - self._covered(seen, felt, now) <= self.stop_distance:
            return f"obstacle: {max(clearance, 0.0):.2f} m from the rim"
        return None

    def _covered(self, seen: _Seen, felt: _Felt, now: float) -> float:
        """How far the robot may come from where it saw to where the next check is [m]."""
        since = [each.speeds[0] for each in self._track if each.time >= seen.time]
        fastest = max(0.0, self._ordered, felt.speeds[0], *since)
        return fastest * (max(now - seen.time, 0.0) + self.check_period)

    def _drive(self, seen: _Seen, felt: _Felt, now: float) -> Order:
        """The command that holds, or a new one where it is due."""
        due = self._decided + (1.0 - _EARLY) * self.pilot.period
        if self._command is None or not self._decided <= now < due:
            taken = self._pose_at(seen.time, felt)
            self._command = self.pilot.decide(seen.scan, felt.pose, felt.speeds, scan_pose=taken)
            self._decided = now
        return Order(self._command.linear, self._command.angular, "driving")

    def _pose_at(self, time: float, felt: _Felt) -> tuple[float, float, float]:
        """Pose at a time, between the two odometries around it; outside of all the last one."""
        later = felt
        for each in reversed(self._track):
            if each.time <= time < later.time:
                share = (time - each.time) / (later.time - each.time)
                x, y, turn = (b - a for a, b in zip(each.pose, later.pose, strict=True))
                turn = math.remainder(turn, math.tau)
                start = each.pose
                return start[0] + share * x, start[1] + share * y, start[2] + share * turn
            later = each
        return felt.pose
