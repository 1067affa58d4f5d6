"""What happens to a driving robot that is worth saying, and no reason to stop."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from mpfa_envs.ros.odometry_input import Odometry

_WINDOW: Final = 4.0
"""Time over which orders and motion are compared [s]."""
_LATE: Final = 0.5
"""Time for which wheels may take to follow an order [s]."""
_LEAST: Final = 0.4
"""Distance that must have been ordered before wheels are judged [m]."""
_SLOW: Final = 0.6
"""Share of the ordered distance below which wheels are slow."""
_SHOVE: Final = 0.1, math.radians(15.0)
"""Motion and turn between two odometries beyond what was measured or ordered [m, rad]."""
_SAID: Final = 2.0
"""Time for which a shove is reported [s]."""


class _Step(NamedTuple):
    """A time between two odometries."""

    time: float
    """Its end [s]."""
    passed: float
    """Its length [s]."""
    ordered: float
    """Distance that was ordered, without a sign [m]."""
    moved: float
    """Distance that the robot moved [m]."""


class Disturbances:
    """Compares a robot's motion with its orders."""

    def __init__(self) -> None:
        self._steps: deque[_Step] = deque()
        self._last: Odometry | None = None
        self._shove, self._shoved = "", -math.inf

    def forget(self) -> None:
        """Begin again, as with a new goal."""
        self._steps.clear()
        self._last = None
        self._shove, self._shoved = "", -math.inf

    def take(self, odometry: Odometry, ordered: tuple[float, float]) -> None:
        """Take odometry, and the speeds ordered since the last one [m/s, rad/s]."""
        last, self._last = self._last, odometry
        if last is None or not 0.0 < (passed := odometry.time - last.time) < _WINDOW:
            self._steps.clear()
            return
        moved = math.dist(odometry.pose[:2], last.pose[:2])
        self._steps.append(_Step(odometry.time, passed, abs(ordered[0]) * passed, moved))
        while self._steps[0].time < odometry.time - _WINDOW:
            self._steps.popleft()
        self._take_shove(last, odometry, passed)

    def note(self, now: float) -> str:
        """What is to be said at a time [s]; empty if nothing is."""
        if self._shove and now - self._shoved <= _SAID:
            return self._shove
        ordered = sum(step.ordered for step in self._steps)
        moved = sum(step.moved for step in self._steps)
        length = sum(step.passed for step in self._steps)
        # Of a short time most would be that in which the wheels begin to turn.
        if length < _WINDOW - 2.0 * _LATE or ordered < _LEAST or moved >= _SLOW * ordered:
            return ""
        return f"wheels are slow: the robot moves {moved / ordered:.0%} of the ordered distance"

    def _take_shove(self, last: Odometry, odometry: Odometry, passed: float) -> None:
        """Note a motion that the measured speeds do not explain."""
        linear, angular = (
            max(abs(a), abs(b)) for a, b in zip(last.speeds, odometry.speeds, strict=True)
        )
        moved = math.dist(odometry.pose[:2], last.pose[:2]) - linear * passed
        turned = abs(math.remainder(odometry.pose[2] - last.pose[2], math.tau)) - angular * passed
        what = ""
        if moved > _SHOVE[0]:
            what = f"moved by {moved:.2f} m"
        elif turned > _SHOVE[1]:
            what = f"turned by {math.degrees(turned):.0f} degrees"
        if what:
            self._shove, self._shoved = (
                f"pushed, or its pose corrected: {what} more than its wheels say",
                odometry.time,
            )
