"""Frames of ROS: poses of other frames in that of the odometry, as tf2 has them."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from mpfa_envs.ros.messages import Pose, mount_of, seconds, transformed

if TYPE_CHECKING:
    from collections.abc import Callable


class Frames:
    """Poses in the frame of the odometry, and the age of what places them there."""

    def __init__(
        self,
        lookup: Callable[[str, str], Any] | None,  # None: tf2 is not installed
        *,
        trust_stamps: bool,  # False: transforms age from when they came
    ) -> None:
        self._lookup = lookup
        self._trust_stamps = trust_stamps
        self.odometry: str | None = None
        """The frame of the odometry; None before the first one."""
        self.forget()

    def forget(self) -> None:
        """Begin again with a new goal."""
        self._stamp, self._came = -math.inf, -math.inf

    def is_other(self, frame: str) -> bool:
        """Return True if a frame is not that of the odometry."""
        return frame not in ("", self.odometry)

    def in_odometry(self, place: Pose, frame: str, now: float) -> Pose:
        """Transform a pose of another frame into that of the odometry."""
        if not self.is_other(frame):
            return place
        if not self.odometry:
            raise LookupError("the odometry names no frame")
        if self._lookup is None:
            raise LookupError("tf2_ros is not installed")
        found = self._lookup(self.odometry, frame)
        stamp = seconds(found.header.stamp)
        if stamp != self._stamp:
            self._stamp, self._came = stamp, now
        return transformed(place, found.transform)

    def mount(self, sensor: str, base: str) -> tuple[float, ...] | None:
        """Pose of a sensor's frame in that of the robot; None where tf2 does not know it."""
        if self._lookup is None or not sensor:
            return None
        # What tf2 raises has no public base class.
        with suppress(Exception):
            return mount_of(self._lookup(base, sensor).transform)
        return None

    def age(self, now: float) -> float:
        """Age of the last transform [s]; transforms that never change have none."""
        if self._stamp == 0.0:
            return 0.0
        return now - (self._stamp if self._trust_stamps else self._came)
