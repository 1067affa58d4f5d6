"""The scan that a controller drives by, and what is wrong with it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from mpfa_envs.ros.odometry_input import AHEAD, has_moved
from mpfa_envs.sensing.scan import ScanError, check_real, in_numbers

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.deploy.pilot import Pilot
    from mpfa_envs.ros.odometry_input import OdometryInput, Pose
    from mpfa_envs.sensing.scan import Scan
    from mpfa_envs.sensing.sectors import Points

_LAG: Final = 0.25
"""Odometry may lag behind the scans by this, and show a standing robot as driving [s]."""


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
    inside: str = ""
    """What is to be said of a ray that ends inside the robot; empty without."""


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
        since = self._since if repeated else moment
        ahead, behind, fault = self._obstacles(scan, points)
        inside = self._inside(scan)
        self.last = LaserReading(scan, since, ahead, behind, fault, repeated, inside)

    def _inside(self, scan: Scan) -> str:
        """What is to be said of a ray that ends inside the robot."""
        ray = self._sectors.inside(scan)
        if ray is None:
            return ""
        degrees, depth = math.degrees(ray[0]), ray[1]
        return (
            f"the ray at {degrees:.0f} degrees of the scan ends {depth:.2f} m inside the robot: "
            "filter the robot's own parts out of the scan, or clean the lidar"
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
        if not -AHEAD <= age <= timeout:
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
        return odometry.last is not None and has_moved(self._from, odometry.last.pose)

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
