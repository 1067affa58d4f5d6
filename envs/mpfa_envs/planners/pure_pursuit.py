"""Following a path: driving at a point ahead on it, on the arc that leads there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import check_positive
from mpfa_envs.paths.distance import FreeGrid
from mpfa_envs.robots.model import RobotModel
from mpfa_envs.worlds.shapes import Point

_SPACING: Final = 0.05
"""Distance between the points of a path [m]."""
_WINDOW: Final = 2.0
"""Length of the path ahead that is searched for the robot's place [m]."""
_BESIDE: Final = math.radians(60.0)
"""To a point farther to the side the robot turns on its tightest circle [rad]."""
_BEHIND: Final = math.radians(120.0)
"""A point farther to the side than this is behind the robot [rad]."""
_FACING: Final = math.radians(10.0)
"""A point less to the side than this is faced [rad]."""
_RIM: Final = 0.03
"""Clearance that the robot's rim keeps if it can [m]."""
_ARC: Final = 0.5
"""Length of the arcs that are tested [m]."""
_SLOWER: Final = 0.8
"""Share of its speed that a robot that can stop loses towards a point at that angle."""
_TURN_TIME: Final = 0.4
"""Time in which a turn on the spot would be made at its first speed [s]."""
_CURVATURES: Final = 41
"""Number of arcs that are tested."""


class PurePursuit:
    r"""Pure pursuit of one path (Coulter 1992, CMU-RI-TR-92-01).

    The robot drives at the farthest point of the path within the look-ahead distance :math:`L` to
    which the straight line is as free as the path. At an angle :math:`\alpha` and a distance
    :math:`l` that point is on the arc of curvature :math:`\kappa = 2 \sin(\alpha) / l`. One wheel
    is at its fastest; the other is slower by what the arc asks for, as far as it can be. To a point
    beside or behind it the robot turns on its tightest circle. Of the arcs that are free for the
    next half meter it takes the one nearest to the wanted arc.

    A robot that can stop turns on the spot to a point beside or behind it, and where no arc is free
    for as long as it takes to brake. It drives no faster than it can brake in the free part of its
    arc, and more slowly the farther to the side the point is.

    Args:
        path: Positions from the start to the goal [m].
        robot: Whose wheels are driven.
        grid: The free places of the world.
        look_ahead: L [m].

    Raises:
        ValueError: If the path has no two positions, or the look-ahead distance is not positive.

    Examples:
        >>> from mpfa_envs import ROBOTS, WORLDS
        >>> from mpfa_envs.paths.distance import FreeGrid
        >>> from mpfa_envs.planners import PurePursuit
        >>> grid = FreeGrid(WORLDS["A"], distance=0.25)
        >>> pursuit = PurePursuit([(0.0, 0.0), (3.0, 0.0)], ROBOTS["turtlebot2"], grid)
        >>> pursuit.act(0.0, 0.0, 0.0)
        (1.0, 1.0)
        >>> left, right = pursuit.act(0.5, 0.2, 0.0)  # To the left of the path: turn right.
        >>> left > right
        True
    """

    def __init__(
        self, path: Sequence[Point], robot: RobotModel, grid: FreeGrid, *, look_ahead: float = 0.6
    ) -> None:
        self.look_ahead = check_positive("look_ahead", look_ahead)
        if len(path) < 2:
            raise ValueError(f"path must have two positions at least, got {list(path)}")
        self.robot, self.grid = robot, grid
        self.points = _resampled(np.asarray(path, dtype=np.float64))
        """The path [m], ``[points, 2]``."""
        self._place = 0
        self._side = 0.0
        # Neither wheel goes backwards on an arc: that is for turns on the spot.
        slow, fast = max(robot.min_wheel_speed, 0.0), robot.max_wheel_speed
        self._slow = slow
        self._tightest = 2.0 * (fast - slow) / (robot.wheel_base * (fast + slow))
        self._curvatures = np.linspace(-self._tightest, self._tightest, _CURVATURES)
        along = np.arange(_SPACING, _ARC + 1e-9, _SPACING)
        half = 0.5 * self._curvatures[:, None] * along
        # Along the chord of the arc; np.sinc(x) is sin(pi x) / (pi x).
        directions = np.stack((np.cos(half), np.sin(half)), axis=-1)
        self._arcs = (along * np.sinc(half / math.pi))[..., None] * directions

    def act(self, x: float, y: float, heading: float) -> tuple[float, float]:
        """Speeds of left and right wheel at a pose [m, m, rad], from -1, the slowest, to 1."""
        ahead_x, ahead_y = self._point_ahead(x, y)
        angle = math.remainder(math.atan2(ahead_y - y, ahead_x - x) - heading, math.tau)
        if self.robot.can_stop and abs(angle) > _BESIDE:
            return self._turn_on_the_spot(angle)
        if abs(angle) > _BESIDE:
            wanted = self._turn_to(angle)
        else:
            self._side = 0.0
            # Near the end of the path the arc would become as tight as the point is near.
            distance = max(math.hypot(ahead_x - x, ahead_y - y), 2 * _SPACING)
            wanted = 2.0 * math.sin(angle) / distance
        curvature, free = self._nearest_free(x, y, heading, wanted)
        if not self.robot.can_stop:
            return self._wheels(curvature, self.robot.max_wheel_speed)
        if free < _SPACING:
            # The point is in the open: once the robot faces it, it may creep there.
            if abs(angle) > _FACING:
                return self._turn_on_the_spot(angle)
            curvature, free = 0.0, 0.5 * _SPACING
        return self._wheels(curvature, self._safe_speed(angle, free))

    def _point_ahead(self, x: float, y: float) -> Point:
        """The point to drive at."""
        window = self.points[self._place : self._place + round(_WINDOW / _SPACING)]
        gaps = np.hypot(*(window - (x, y)).T)
        nearest = int(gaps.argmin())
        self._place += nearest
        window, gaps = window[nearest:], gaps[nearest:]
        within = np.flatnonzero(gaps <= self.look_ahead)
        if not len(within):
            return tuple(window[0].tolist())
        # From the farthest to the nearest of them.
        candidates = window[: within[-1] + 1][::-1]
        rooms = self._line_clearances(x, y, candidates)
        # Beside the path it may be as narrow for the robot as it may be at all.
        for least in (self.grid.distance, self.robot.radius + _RIM):
            if (rooms >= least).any():
                break
        return tuple(candidates[int((rooms >= least).argmax())].tolist())

    def _line_clearances(self, x: float, y: float, to: NDArray[np.float64]) -> NDArray[np.float32]:
        """Least clearance on the straight line to each point [m], ``[points]``."""
        shares = np.linspace(0.0, 1.0, 1 + math.ceil(self.look_ahead / _SPACING))[1:, None]
        places = (x + shares * (to[:, 0] - x), y + shares * (to[:, 1] - y))
        return np.asarray(self._clearances(*places).min(axis=0))

    def _turn_to(self, angle: float) -> float:
        """Curvature of the tightest circle to a point [1/m]; behind, it keeps its side."""
        if not (self._side and abs(angle) > _BEHIND):
            self._side = math.copysign(1.0, angle)
        return self._side * self._tightest

    def _nearest_free(self, x: float, y: float, heading: float, wanted: float) -> Point:
        """Curvature nearest to the wanted one of an arc that is free for longest [1/m, m]."""
        cosine, sine = math.cos(heading), math.sin(heading)
        across, up = self._arcs[..., 0], self._arcs[..., 1]
        rooms = self._clearances(x + across * cosine - up * sine, y + across * sine + up * cosine)
        blocked = rooms < self.robot.radius + _RIM
        # An arc that is blocked nowhere is free for all of its steps.
        steps = np.where(blocked.any(axis=1), blocked.argmax(axis=1), blocked.shape[1])
        off = np.abs(self._curvatures - wanted)
        best = np.lexsort((off, -steps))[0]
        return float(self._curvatures[best]), float(steps[best]) * _SPACING

    def _clearances(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float32]:
        """Clearances of the cells at some places [m], of any shape."""
        grid = self.grid
        columns, rows = (
            np.clip(np.rint((at - first) / grid.resolution).astype(np.int64), 0, count - 1)
            for at, first, count in zip((x, y), grid.origin, grid.free.shape, strict=True)
        )
        return np.asarray(grid.clearance[columns, rows])

    def _turn_on_the_spot(self, angle: float) -> tuple[float, float]:
        """Actions that turn to a point; behind, the robot keeps its side."""
        side = math.copysign(1.0, self._turn_to(angle))
        speed = 0.5 * self.robot.wheel_base * abs(angle) / _TURN_TIME
        speed = min(speed, self.robot.wheel_limits.across, self.robot.max_wheel_speed)
        return self._action(-side * speed), self._action(side * speed)

    def _safe_speed(self, angle: float, free: float) -> float:
        """Speed of the faster wheel [m/s], for a point at an angle and the free part of an arc."""
        limits = self.robot.wheel_limits
        speed = limits.fast * (1.0 - _SLOWER * abs(angle) / _BESIDE)
        # Half the speed from which it can brake: speeds follow the decisions late.
        return min(speed, 0.5 * math.sqrt(2.0 * limits.acceleration * free))

    def _wheels(self, curvature: float, fast: float) -> tuple[float, float]:
        """The wheel speeds on an arc [1/m], the faster one at a speed [m/s], left is positive."""
        half = 0.5 * self.robot.wheel_base * abs(curvature)
        inner = self._action(max(fast * (1.0 - half) / (1.0 + half), self._slow))
        outer = self._action(fast)
        return (inner, outer) if curvature > 0.0 else (outer, inner)

    def _action(self, speed: float) -> float:
        """Action of a wheel's speed [m/s]."""
        slow, fast = self.robot.min_wheel_speed, self.robot.max_wheel_speed
        return min(max(2.0 * (speed - slow) / (fast - slow) - 1.0, -1.0), 1.0)


def _resampled(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points along a path, evenly spaced, with its ends."""
    along = np.append(0.0, np.hypot(*np.diff(path, axis=0).T).cumsum())
    count = max(2, 1 + math.ceil(along[-1] / _SPACING))
    at = np.linspace(0.0, along[-1], count)
    return np.stack([np.interp(at, along, values) for values in path.T], axis=1)
