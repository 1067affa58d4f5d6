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
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from mpfa_envs.checks import check_not_negative, check_positive
from mpfa_envs.deploy.map_path import GoalError
from mpfa_envs.ros.disturbances import Disturbances
from mpfa_envs.ros.laser_input import LaserInput
from mpfa_envs.ros.odometry_input import Odometry, OdometryInput
from mpfa_envs.sensing.scan import ScanError

if TYPE_CHECKING:
    from mpfa_envs.deploy.command import Command
    from mpfa_envs.deploy.pilot import Pilot
    from mpfa_envs.ros.laser_input import LaserReading
    from mpfa_envs.sensing.scan import Scan
    from mpfa_envs.worlds.world import World

_EARLY: Final = 0.2
"""Share of its period by which a decision may come early, as scans are irregular."""
_PLACE: Final = 0.5
"""Side of the squares that count as one place [m]."""
_NOWHERE: Final = 40.0
"""A robot that could have driven this far must have come to a new place [m]."""
_LOOK: Final = 1.0
"""Time from one look for a path to the next [s]."""
_CLOSED: Final = 10.0
"""Time for which walls must close the goal in before it is given up: people step aside [s]."""

State = Literal[
    "idle", "accepted", "driving", "waiting", "arrived", "canceled", "given up", "rejected"
]
"""What has become of the goal: it is under way in the states ``accepted``, not yet decided on,
``driving`` and ``waiting``, where the robot stands for a reason that may pass; the others are its
ends, and ``idle`` is before the first one."""
ACTIVE: Final[tuple[State, ...]] = ("accepted", "driving", "waiting")


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
        self.state: State = "idle"
        self._disturbances = Disturbances()
        self._looked, self._open = -math.inf, -math.inf
        self._command: Command | None = None
        self._decided = -math.inf
        self._idle = "no goal"
        self._told = True
        self._plan: tuple[World, tuple[float, float, float]] | None = None

    def set_scan_timeout(self, timeout: float) -> None:
        """Change the oldest scan that it drives by [s]."""
        self.scan_timeout = check_positive("scan_timeout", timeout)
        self._odometry.set_memory(timeout)

    def see(self, scan: Scan, time: float) -> None:
        """Take a scan and its time [s]."""
        self._laser.take(scan, time, self._odometry)

    def feel(
        self, pose: tuple[float, float, float], speeds: tuple[float, float], time: float
    ) -> None:
        """Take odometry: pose (x, y, heading), forward and turning speed, time [m, rad, s]."""
        odometry = Odometry(pose, speeds, time)
        lost = self._odometry.take(odometry, self._ordered[0])
        if self._odometry.last is odometry:
            self._disturbances.take(odometry, self._ordered)
        if lost and self.pilot.goal is not None:
            self._give_up(lost)

    def note(self, now: float) -> str:
        """What is worth saying at a time [s], though the robot drives on; empty if nothing is."""
        if self.state not in ACTIVE:
            return ""
        reading = self._laser.last
        closed = "unreachable so far: walls that were seen close the goal in"
        return (
            (closed if self._looked > self._open else "")
            or ("" if reading is None else reading.inside)
            or self._disturbances.note(now)
        )

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
        state: State = "canceled",
    ) -> None:
        """Set out for a goal (x, y) in the odometry's frame [m], or stop for a reason.

        There the robot turns to a heading, if there is one [rad]. Without a goal, the state is what
        has become of the last one.
        """
        self._command, self._told = None, False
        self._idle, self._held = reason, ""
        self.state = state if goal is None else "accepted"
        self._looked = self._open = -math.inf
        self._disturbances.forget()
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
                self._idle, self.state = str(error), "rejected"

    def _give_up(self, reason: str) -> None:
        """Stop for a reason that does not pass."""
        self.aim(None, reason, state="given up")

    def correct_goal(self, goal: tuple[float, float], heading: float | None = None) -> None:
        """The goal in the frame of the odometry, which has drifted; NaN gives up the goal."""
        if self.pilot.goal is not None:
            try:
                self.pilot.move_goal(goal, heading=heading)
            except ValueError as error:
                self._give_up(str(error))

    def hold(self, reason: str) -> None:
        """Stand still for a reason from outside, until it is empty or the goal is new."""
        self._held = reason

    def stand(self, reason: str) -> Order:
        """The order to stand for a reason from outside that has passed at the next tick."""
        self._ordered = 0.0, 0.0
        self.pilot.give(self._ticked, 0.0, 0.0)
        return self._wait(reason)

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
            return self._wait(reason)
        if self.pilot.arrived(odometry.pose):
            self.aim(None, "arrived", state="arrived")
        elif stuck := self._stuck(reading):
            self._give_up(stuck)
        else:
            try:
                order = self._drive(reading, odometry, now)
            except ScanError as error:
                # The next scan may look there, as where a turning robot has lost one.
                self._count(odometry)
                return self._wait(str(error))
            except GoalError as error:
                self.aim(None, str(error), state="rejected")
            # Whatever the policy raises: a policy that has failed is not asked again.
            except Exception as error:
                known = isinstance(error, ValueError)
                self._give_up(str(error) if known else f"failed: {error!r}")
            else:
                self._count(odometry)
                return self._unless_blocked(order, reading, now)
        return self._choose(now)

    def _wait(self, reason: str) -> Order:
        """Stand still for a reason that may pass."""
        self._command, self.state = None, "waiting"
        return Order(0.0, 0.0, reason)

    def _stuck(self, reading: LaserReading) -> str:
        """Why the goal is given up; empty if the robot may still reach it."""
        if self._looked - self._open > _CLOSED:
            return f"unreachable: for {_CLOSED:g} s walls that were seen have closed the goal in"
        if self._lost <= _NOWHERE:
            return ""
        reason = "stands still" if self.pilot.stands_still else "no progress"
        cause = f"; {reading.inside}" if reading.inside else ""
        return f"{reason}: time for {_NOWHERE:g} m, and no new place{cause}"

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
        self.state = "waiting"
        reason = f"obstacle: {max(clearance, 0.0):.2f} m from the rim"
        return Order(0.0, order.angular, reason)

    def _drive(self, reading: LaserReading, odometry: Odometry, now: float) -> Order:
        """The command that holds, or a new one where it is due."""
        due = self._decided + (1.0 - _EARLY) * self.pilot.period
        if self._command is None or not self._decided <= now < due:
            taken = self._odometry.pose_at(reading.time)
            age = max(now - odometry.time, 0.0)
            self._command = self.pilot.decide(
                reading.scan,
                odometry.pose,
                odometry.speeds,
                scan_pose=taken,
                time=now,
                age=age,
                scan_age=max(now - reading.time, 0.0),
            )
            self._decided = now
            self._look_for_path(odometry, now)
        self.state = "driving"
        return Order(*self.pilot.ramp(self._ordered, self._command[2:], self._passed), "driving")

    def _look_for_path(self, odometry: Odometry, now: float) -> None:
        """Find out whether walls close the goal in, once in a while."""
        if not self._looked <= now < self._looked + _LOOK:
            first, self._looked = self._open == -math.inf, now
            if not self.pilot.closed_in(odometry.pose[:2]) or first:
                self._open = now

    def _count(self, odometry: Odometry) -> None:
        """Count how far the robot could have driven since it came to its last new place."""
        place = round(odometry.pose[0] / _PLACE), round(odometry.pose[1] / _PLACE)
        self._lost += self._passed * self.pilot.pace * self.pilot.card.robot.max_wheel_speed
        if place not in self._places:
            self._places.add(place)
            self._lost = 0.0
