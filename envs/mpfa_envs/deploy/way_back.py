"""What a robot does that stands still: it drives back to where it came from."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from mpfa_envs.robots.standing import STANDING_TIME, stands_still

if TYPE_CHECKING:
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

    @property
    def stands_still(self) -> bool:
        """True if the robot has come nowhere of late."""
        return stands_still(self._places, self._period)

    def speeds(
        self, pose: tuple[float, float, float], time: float, *, reverses: bool
    ) -> tuple[float, float] | None:
        """Speeds of the wheels on the way back [m/s]; None: the policy decides."""
        robot, (x, y, heading) = self._robot, pose
        self._places.append((x, y))
        waits = time - self._since >= STANDING_TIME
        # Wheels that only turn forward cannot turn it on the spot, either.
        if self._target is None and waits and robot.min_wheel_speed < 0.0 and self.stands_still:
            # What it has driven it has seen. Near its start there is no place far enough away.
            away = (place for place in reversed(self._places) if math.dist(place, (x, y)) >= _BACK)
            farthest = max(self._places, key=lambda place: math.dist(place, (x, y)))
            self._target, self._since, self._stood = next(away, farthest), time, (x, y)
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
