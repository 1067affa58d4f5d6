"""What a robot does without its policy: it arrives at its goal, or drives back where it stands."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from mpfa_envs.checks import check_number, check_positive
from mpfa_envs.control.standing import STANDING_TIME, stands_still

if TYPE_CHECKING:
    from mpfa_envs.deploy.card import Card
    from mpfa_envs.robots.model import RobotModel

_BACK: Final = 0.5
"""Distance by which a robot that stands still drives back [m]."""
_BACK_TIME: Final = 5.0
"""Longest time for which it does so [s]."""
_BACK_SPEED: Final = 0.3
"""Share of its greatest speed with which it does so."""


class WayBack:
    """The places of a robot's decisions, and the way back of a robot that stands still."""

    def __init__(
        self,
        robot: RobotModel,  # in whose speeds orders are given
        period: float,  # from decision to decision [s]
    ) -> None:
        self._robot, self._period = robot, period
        self._places: list[tuple[float, float]] = []
        self._target: tuple[float, float] | None = None
        self._since, self._stood = -math.inf, (0.0, 0.0)
        self.count = 0
        """How often it has driven back."""

    @property
    def stands_still(self) -> bool:
        """True if the robot has come nowhere of late."""
        return stands_still(self._places, self._period)

    def speeds(
        self, pose: tuple[float, float, float], time: float, *, reverses: bool, led: bool
    ) -> tuple[float, float] | None:
        """Speeds of the wheels on the way back [m/s]; None: the policy decides, or who leads it."""
        robot, (x, y, heading) = self._robot, pose
        self._places.append((x, y))
        if led:
            # It begins to count when it is led no more.
            self._target, self._since = None, time
            return None
        waits = time - self._since >= STANDING_TIME
        # Wheels that only turn forward cannot turn it on the spot, either.
        if self._target is None and waits and robot.min_wheel_speed < 0.0 and self.stands_still:
            # What it has driven it has seen. Near its start there is no place far enough away.
            away = (place for place in reversed(self._places) if math.dist(place, (x, y)) >= _BACK)
            farthest = max(self._places, key=lambda place: math.dist(place, (x, y)))
            self._target, self._since, self._stood = next(away, farthest), time, (x, y)
            self.count += 1
        driven = math.dist(self._stood, (x, y)) >= 0.8 * _BACK
        if self._target is None or driven or time - self._since >= _BACK_TIME:
            self._target = None
            return None
        bearing = math.atan2(self._target[1] - y, self._target[0] - x) - heading
        ahead = math.cos(bearing) if reverses else 1.0
        off = math.remainder(bearing, math.pi if reverses else math.tau)
        # It turns first.
        speed = _BACK_SPEED * robot.max_wheel_speed * max(math.cos(off), 0.0) ** 4
        speed, turn = math.copysign(speed, ahead), 0.5 * math.sin(off) * robot.wheel_base
        return speed - turn, speed + turn


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
        self._learned_radius = card.goal_radius
        self.set_radius(card.goal_radius if radius is None else radius)
        self.heading: float | None = None
        self._there = False

    def set_radius(self, radius: float) -> None:
        """Change the distance from the goal at which it has arrived [m]."""
        self.radius = check_positive("goal_radius", radius)

    def check(self, heading: float | None) -> None:
        """Reject a heading for a robot that cannot turn on the spot."""
        if heading is not None and not self.spot_speed > 0.0:
            raise ValueError(
                f"heading must be None for {self._robot.name}, which cannot turn on the spot "
                f"(min_wheel_speed = {self._robot.min_wheel_speed}), got {heading}"
            )

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
        as_learned = self.heading is None and self.radius >= self._learned_radius
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
