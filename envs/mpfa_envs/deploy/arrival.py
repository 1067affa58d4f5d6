"""The end of a drive: when a robot is at its goal, how it slows down for it and turns there."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from mpfa_envs.checks import check_number, check_positive

if TYPE_CHECKING:
    from mpfa_envs.deploy.card import Card
    from mpfa_envs.robots.model import RobotModel

_FACING: Final = math.radians(5.0)
"""Error of the heading at a goal [rad]."""
_STANDS: Final = 0.03
"""Speed below which a robot stands, and may turn at the goal [m/s]."""
_LAST: Final = 0.02
"""Distance from the goal below which the robot drives no more slowly [m]."""


class Arrival:
    """Brings a robot to rest within a radius of its goal, and to a heading if it has one."""

    def __init__(
        self,
        robot: RobotModel,  # that drives
        card: Card,  # of the policy
        radius: float | None,  # [m]; None: as the policy learned
        *,
        pace: float,
        period: float,  # from decision to decision [s]
        latency: float,  # [s]
    ) -> None:
        self._robot, self._late = robot, latency * pace
        self._wait = period + latency
        self._braking = robot.wheel_limits.acceleration / pace**2
        self.radius = card.goal_radius if radius is None else check_positive("goal_radius", radius)
        self._learned = self.radius >= card.goal_radius
        self.heading: float | None = None
        self._there = False

    def begin(self, heading: float | None) -> None:
        """Set out for a goal at which the robot has a heading [rad], or any."""
        self.heading = None if heading is None else check_number("heading", heading)
        self._there = False

    def is_at(self, pose: tuple[float, float, float], away: float) -> bool:
        """Return True if a pose at a distance from the goal [m] is the end of the drive."""
        # The robot takes a little way to stop.
        there = away <= (2.0 if self._there else 1.0) * self.radius
        if self.heading is None:
            return there
        self._there = there
        return there and abs(math.remainder(self.heading - pose[2], math.tau)) <= _FACING

    @property
    def turns(self) -> bool:
        """True if the robot is at the goal and has to turn there."""
        return self.heading is not None and self._there

    def fastest(self, pose: tuple[float, float, float], goal: tuple[float, float]) -> float:
        """Greatest speed of the policy's robot with which it stops at the goal [m/s]."""
        as_learned = self.heading is None and self._learned
        if as_learned or not self._robot.can_stop or math.isinf(self._braking):
            return math.inf
        # Half the braking, as decisions are late; what remains at the goal is stopped within it.
        away = max(math.dist(pose[:2], goal), _LAST)
        # v * late + v² / braking is the way until it stands.
        root = math.sqrt(self._late**2 + 4.0 * away / self._braking)
        return 0.5 * self._braking * (root - self._late)

    @property
    def spot_speed(self) -> float:
        """Fastest turn on the spot [rad/s]."""
        robot = self._robot
        wheels = min(robot.max_wheel_speed, -robot.min_wheel_speed)
        return min(robot.max_angular_speed, 2.0 * wheels / robot.wheel_base)

    def turn(self, heading: float, speed: float) -> float:
        """The turn [rad/s] of a robot with a heading [rad] and a speed [m/s] at the goal."""
        if self.heading is None or abs(speed) > _STANDS:
            return 0.0
        off, limits = math.remainder(self.heading - heading, math.tau), self._robot.wheel_limits
        change = 2.0 * min(limits.acceleration, limits.turning) / self._robot.wheel_base
        fastest = min(self.spot_speed, 0.5 * abs(off) / self._wait)
        if math.isfinite(change):
            fastest = min(fastest, math.sqrt(change * abs(off)))
        return math.copysign(fastest, off)
