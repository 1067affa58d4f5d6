"""From messages to orders: goals and plans of any frame, and what has become of a goal."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple

from mpfa_envs.ros.controller import ACTIVE
from mpfa_envs.ros.messages import Pose, odometry_of, plan_of, scan_of, seconds

if TYPE_CHECKING:
    from mpfa_envs.ros.controller import Controller, Order, State
    from mpfa_envs.ros.frames import Frames
    from mpfa_envs.worlds.world import World


class Progress(NamedTuple):
    """How far a drive has come."""

    distance: float
    """Distance to the goal in a straight line [m]; NaN where its place is not known."""
    time: float
    """Time since the goal came [s]."""
    recoveries: int
    """How often the robot has driven back from where it stood."""


class Navigator:
    """Takes messages and gives orders; any objects with the attributes of the messages will do."""

    def __init__(
        self,
        controller: Controller,
        frames: Frames,
        *,
        trust_stamps: bool = True,  # False: what a message says is of the time when it came
        turns: bool = True,  # to the heading of a goal, where the robot can
        transform_timeout: float = 1.0,  # oldest transform by which it drives [s]
        base: str = "",  # frame of the robot's body; empty: the one whose pose is the odometry's
    ) -> None:
        self.controller, self.frames = controller, frames
        self._trust_stamps, self._transform_timeout = trust_stamps, transform_timeout
        self._turns = turns and controller.pilot.turns_on_the_spot
        self._goal: tuple[Pose, str] | None = None
        self._plan: tuple[World, Pose, str] | None = None
        self.base_frame, self._sensor = base, ""
        """The frame of the robot's body; empty before the first odometry."""
        self._waits = ""
        self._felt, self._known_since, self._since = -math.inf, -math.inf, 0.0
        self.pose: Pose | None = None
        """The last one of the odometry."""

    @property
    def state(self) -> State:
        """What has become of the goal."""
        return "waiting" if self._waits else self.controller.state

    @property
    def is_active(self) -> bool:
        """True while there is a goal that the robot has neither reached nor given up."""
        return self.state in ACTIVE

    @property
    def waits(self) -> str:
        """Why the place of the goal is not known yet; empty if it is."""
        return self._waits

    @property
    def lidar(self) -> str:
        """Where the lidar is mounted, and who says so."""
        x, y, direction = self.controller.pilot.sectors.mount
        source = "the parameter mount or the robot's file"
        if self._sensor:
            source = f"tf2: {self._sensor!r} in {self.base_frame!r}"
        degrees = math.degrees(direction)
        return f"lidar at ({x:.3f}, {y:.3f}) m, looks to {degrees:.0f} degrees, by {source}"

    def see(self, message: Any, now: float) -> None:
        """Take a ``sensor_msgs/LaserScan``."""
        self._find_lidar(message.header.frame_id)
        self.controller.see(scan_of(message), self._time_of(message.header, now))

    def feel(self, message: Any, now: float) -> None:
        """Take a ``nav_msgs/Odometry``."""
        last, frame = self.frames.odometry, message.header.frame_id
        self.frames.odometry = frame
        if last not in (None, frame) and self._goal is not None:
            self._forget_goal()
            reason = f"odometry jumped: from frame {last!r} to {frame!r}"
            self.controller.aim(None, reason, state="given up")
        self.base_frame = self.base_frame or getattr(message, "child_frame_id", "")
        pose, speeds = odometry_of(message)
        self.pose, self._felt = pose, self._time_of(message.header, now)
        self.controller.feel(pose, speeds, self._felt)

    def know(self, message: Any) -> None:
        """Take a ``nav_msgs/OccupancyGrid``; one that comes while it drives is for later goals."""
        self._plan = (*plan_of(message), message.header.frame_id)

    def aim(self, pose: Pose, frame: str, stamp: float, now: float) -> None:
        """Take a goal of a frame, and the time at which it was said [s]; 0: now."""
        heading = pose[2] if self._turns else math.nan
        self._goal, self._since = ((*pose[:2], heading), frame), now
        self.frames.forget()
        self._waits = ""
        self.controller.aim(None)
        # Who gave the goal knew this odometry; an older one may be of before it began again.
        self._known_since = (stamp if self._trust_stamps else 0.0) or now
        self._set_out(now)

    def cancel(self, reason: str = "canceled") -> None:
        """Give up the goal, as someone wants."""
        if self.is_active:
            self._forget_goal()
            self.controller.aim(None, reason)

    def fail(self) -> None:
        """Give up the goal after an error."""
        self._forget_goal()
        self.controller.aim(None, "failed", state="given up")

    def check(self, now: float) -> Order | None:
        """The order to publish at a time [s], if any."""
        if self._waits:
            self._set_out(now)
        elif self.controller.pilot.goal is None:
            self._goal = None
        else:
            self._correct(now)
        return self.controller.tick(now)

    def progress(self, now: float) -> Progress:
        """How far the drive has come at a time [s]."""
        pilot, distance = self.controller.pilot, math.nan
        if pilot.goal is not None and self.pose is not None:
            distance = math.dist(self.pose[:2], pilot.goal)
        return Progress(distance, max(now - self._since, 0.0), pilot.recoveries)

    def _find_lidar(self, sensor: str) -> None:
        """Mount the lidar where tf2 has it, once; a place outside of the robot is an error."""
        if self.base_frame and sensor != self._sensor:
            mount = self.frames.mount(sensor, self.base_frame)
            if mount is not None:
                self.controller.pilot.sectors.mount_at(mount)
                self._sensor = sensor

    def _time_of(self, header: Any, now: float) -> float:
        return seconds(header.stamp) if self._trust_stamps else now

    def _forget_goal(self) -> None:
        self._goal, self._waits = None, ""

    def _place_plan(self, now: float) -> None:
        """Give the controller the plan, where localization has it."""
        if self._plan is not None:
            plan, pose, frame = self._plan
            self.controller.know(plan, self.frames.in_odometry(pose, frame, now))

    def _set_out(self, now: float) -> None:
        """Set out for the goal if its place is known; else it is tried again at each check."""
        if self._goal is None:
            return
        try:
            if self._felt < self._known_since:
                raise LookupError("there was no odometry as new as the goal yet")
            x, y, heading = self.frames.in_odometry(*self._goal, now)
            self._place_plan(now)
        # What tf2 raises has no public base class.
        except Exception as error:
            self._waits = f"goal in frame {self._goal[1]!r}: {error}"
        else:
            self._waits = ""
            self.controller.aim((x, y), heading=None if math.isnan(heading) else heading)

    def _correct(self, now: float) -> None:
        """Update goal and plan by the newest transform; an old one keeps the robot standing."""
        used = {placed[-1] for placed in (self._goal, self._plan) if placed}
        if self._goal is None or not any(map(self.frames.is_other, used)):
            return
        # As above; a correction that fails once is made later, and the last transform grows old.
        with suppress(Exception):
            x, y, heading = self.frames.in_odometry(*self._goal, now)
            self._place_plan(now)
            self.controller.correct_goal((x, y), None if math.isnan(heading) else heading)
        age = self.frames.age(now)
        old = not age <= self._transform_timeout
        self.controller.hold(f"stale transform: {age:.1f} s old" if old else "")
