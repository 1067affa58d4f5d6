"""The dynamic window approach: choose the best of the arcs that the robot can drive next."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import check_count, check_positive
from mpfa_envs.env.config import TaskConfig
from mpfa_envs.robots.model import RobotModel
from mpfa_envs.robots.motion_loops import pairs_within
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from mpfa_envs.safety.filter import SafetyFilter
from mpfa_envs.sensing.observation import DISTANCE_SCALE, Memory, observation_slices

_STEP: Final = 0.1
"""Distance between the places on an arc that are tested [m]."""
_RESOLUTION: Final = 0.05
"""Difference between the speeds of a wheel that are tried [m/s]."""
_ACCELERATION: Final = 1.0
"""Acceleration of wheels that change their speed at once [m/s²]."""
_LENGTH: Final = 0.6
"""Least length of the arcs [m]."""
_OPEN: Final = 0.3
"""Length of the straight line that is open in an open direction [m]."""
_LINES: Final = 72
"""Number of directions that are looked at."""
_ALONG: Final = 1.0
"""Longest part of a path that is followed [m]: its direction holds for little more."""


@dataclass(frozen=True, kw_only=True)
class WindowScore:
    """Weights of the terms of an arc's score, each in [0, 1], and their ends.

    Chosen on validation worlds.
    """

    heading: float = 1.0
    """Weight of driving towards the goal, or along the path on the robot's map."""
    facing: float = 0.0
    """Weight of the angle to it at the end of an arc."""
    clearance: float = 0.15
    """Weight of the distance from lidar hits."""
    speed: float = 0.1
    """Weight of the forward speed."""
    roomy: float = 0.4
    """Clearances of the rim above this score alike [m]."""
    least: float = 0.03
    """An arc with less clearance of the rim collides [m]."""


_STOPPING: Final = WindowScore(facing=0.2, clearance=0.3, roomy=0.2, least=0.05)
"""Of a robot that can stop, chosen on validation worlds likewise."""


class DynamicWindow:
    r"""Dynamic window approach (Fox, Burgard and Thrun 1997, https://doi.org/10.1109/100.580977).

    A function of the observation and nothing else, as a trained policy is. From the lidar it takes
    a point in the middle of each sector, from the speeds those of the wheels. The pairs of wheel
    speeds that can be reached before the next decision are the window. Each pair moves the robot on
    an arc. One that collides within its length is not admissible, the others have the score

    .. math:: w_h\,\text{heading} + w_c\,\text{clearance} + w_s\,\text{speed}

    where the heading is how much nearer to the goal the end of the arc is, over its length; the
    clearance is the least distance of the robot's rim from a point on the arc; the speed is that of
    the robot's center; each is scaled to [0, 1]. If no pair is admissible, the one is taken that
    gets farthest.

    In the original a pair is admissible if the robot can stop before it collides. So it is for a
    robot that can stop: all arcs last as long as the fastest takes for its length, and where it
    takes farther to brake the pair passes a :class:`~mpfa_envs.SafetyFilter`. A robot that stands
    may turn on the spot, and it reverses only if its lidar sees all round. The facing of the end of
    an arc, its angle to the target, is a term of its own then, and the target is moved to the
    nearest direction that is open: without it the robot would stand before a wall, facing the
    target.
    The paper's robot neither stops nor reverses: its arcs have the same length for all speeds, long
    enough to turn round.

    The lidar looks ahead and nothing is remembered: it does not leave a pocket. With
    ``memory="map"`` the heading is that of the path on the robot's map, which leads out.

    Args:
        robot: Whose wheels are driven.
        memory: ``"map"`` if observations are those of ``NavigationEnv(memory="map")``.
        sectors: Number of sectors of the lidar; None: as the robot has.
        max_range: Range of the lidar [m].
        closeness_distance: That of the environment [m]; None: the environment's default.
        decision: Time between two decisions [s].
        acceleration: By how much a wheel's speed can change [m/s²]; None: that of the robot, or 1
            where its wheels change their speed at once.
        samples: Number of speeds of each wheel; None: one every 0.05 m/s.
        length: Length of the arcs, or of the fastest one of a robot that can stop [m]; None: 0.6 m,
            or what a robot that cannot stop takes to turn round, if that is more.
        score: What arcs are judged by; None: as chosen for the robot.

    Raises:
        ValueError: If a number is out of its range.

    Examples:
        >>> from mpfa_envs.planners import DynamicWindow
        >>> from mpfa_envs import evaluate
        >>> results = evaluate(DynamicWindow(), "B", episodes=3, physics="kinematic")
        >>> [each.success for each in results]
        [True, True, True]
    """

    def __init__(
        self,
        *,
        robot: RobotChoice = "turtlebot2",
        memory: Memory = "none",
        sectors: int | None = None,
        max_range: float = 10.0,
        closeness_distance: float | None = None,
        decision: float = 0.2,
        acceleration: float | None = None,
        samples: int | None = None,
        length: float | None = None,
        score: WindowScore | None = None,
    ) -> None:
        self.robot = resolve_robot(robot)
        self.score = score or (_STOPPING if self.robot.can_stop else WindowScore())
        lidar: dict[str, Any] = {"max_range": max_range}
        if sectors is not None:
            lidar["sectors"] = sectors
        settings: dict[str, Any] = {"lidar": lidar, "closeness_distance": closeness_distance}
        task = TaskConfig(robot=self.robot, **settings)
        self._lidar = task.make_lidar()
        self.closeness_distance = task.closeness_distance
        limits = self.robot.wheel_limits
        if acceleration is None:
            unlimited = math.isinf(limits.acceleration)
            acceleration = _ACCELERATION if unlimited else limits.acceleration
        self.change = check_positive("acceleration", acceleration) * check_positive(
            "decision", decision
        )
        """By how much a wheel's speed can change until the next decision [m/s]."""
        self._turning = min(limits.turning * decision, self.change)
        slow, fast = self.robot.min_wheel_speed, self.robot.max_wheel_speed
        if length is None:
            half_turn = 0.5 * math.pi * self.robot.wheel_base * (fast + slow) / (fast - slow)
            length = _LENGTH if self.robot.can_stop else max(_LENGTH, half_turn)
        self.length = check_positive("length", length)
        self._keep: SafetyFilter | None = None
        if self.robot.can_stop and fast * (decision + 0.5 * fast / acceleration) > self.length:
            braking = replace(self.robot, wheel_acceleration=acceleration)
            settings.update(robot=braking, memory=memory, time_step=0.5 * decision)
            self._keep = TaskConfig(**settings).make_filter(clearance=self.score.least)
        count = self._lidar.sectors
        self._parts = observation_slices(count, memory=memory)
        self.observation_size = max(part.stop for part in self._parts.values())
        view = math.radians(self._lidar.field_of_view)
        angles = view * (0.5 - (np.arange(count) + 0.5) / count)
        self._directions = np.stack((np.cos(angles), np.sin(angles)), axis=1)
        reverses = self._lidar.field_of_view >= 360.0 and self.robot.reverse
        self.pairs = _pairs(self.robot, samples, min(_RESOLUTION, self.change), reverses=reverses)
        """Speeds of the left and the right wheel [m/s], ``[K, 2]``."""
        left, right = self.pairs.T
        self._speeds = 0.5 * (left + right) / fast
        along = np.linspace(0.0, self.length, 1 + max(1, round(self.length / _STEP)))[1:]
        # All arcs take the time of the fastest one, or all have its length.
        pace = 2.0 * fast if self.robot.can_stop else right + left
        half = ((right - left) / pace / self.robot.wheel_base)[:, None] * along
        along = ((right + left) / pace)[:, None] * along
        self._turned = 2.0 * half[:, -1]
        directions = np.stack((np.cos(half), np.sin(half)), axis=-1)
        # Along the chord of the arc; np.sinc(x) is sin(pi x) / (pi x).
        self.arcs = (along * np.sinc(half / math.pi))[..., None] * directions
        """Places on each arc in the robot's frame [m], ``[K, T, 2]``."""
        self._bearings = np.linspace(-math.pi, math.pi, _LINES, endpoint=False)
        directions = np.stack((np.cos(self._bearings), np.sin(self._bearings)), axis=1)
        self._steps = np.arange(_STEP, _OPEN + 1e-9, _STEP)
        self._lines = self._steps[:, None] * directions[:, None]
        self.memory = memory
        self.env_arguments: dict[str, Any] = {
            "robot": self.robot,
            "physics": "kinematic",
            "memory": memory,
            "closeness_distance": self.closeness_distance,
        }
        """Arguments of the environments that it drives in, unless others are given."""

    def __call__(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Actions ``[..., 2]`` for observations ``[..., O]``, which must be finite."""
        observation = np.asarray(observation, dtype=np.float32)
        if observation.ndim == 0 or observation.shape[-1] != self.observation_size:
            raise ValueError(
                f"observation must have shape [..., {self.observation_size}], "
                f"got {observation.shape}"
            )
        if not np.isfinite(observation).all():
            raise ValueError("observation must be finite, got NaN or infinity in it")
        rows = observation.astype(np.float64).reshape(-1, self.observation_size)
        chosen = np.array([self._best(row) for row in rows], dtype=np.int64)
        slow, fast = self.robot.min_wheel_speed, self.robot.max_wheel_speed
        actions = (2.0 * (self.pairs[chosen] - slow) / (fast - slow) - 1.0).astype(np.float32)
        if self._keep is not None:
            actions = self._keep(observation.reshape(len(rows), -1), actions)
        return actions.reshape(*observation.shape[:-1], 2)

    def _best(self, row: NDArray[np.float64]) -> int:
        """Number of the best pair for one observation, ``[O]``."""
        score, window = self.score, self._window(row)
        direction, distance = self._target(row)
        arcs = self.arcs[window]
        rims = self._rim_clearances(row, arcs)
        collides = rims < score.least
        admissible = ~collides.any(axis=1)
        if not admissible.any():
            return int(window[np.lexsort((rims.min(axis=1), collides.argmax(axis=1)))[-1]])
        room = np.clip(rims.min(axis=1) / score.roomy, 0.0, 1.0)
        total = (
            score.heading * self._heading(distance * direction, distance, arcs)
            + score.facing * self._facing(distance * direction, window)
            + score.clearance * room
            + score.speed * self._speeds[window]
        )
        total[~admissible] = -math.inf
        return int(window[total.argmax()])

    def _window(self, row: NDArray[np.float64]) -> NDArray[np.int64]:
        """Numbers of the pairs that the wheels can have at the next decision."""
        robot, parts = self.robot, self._parts
        speed = row[parts["linear_speed"]] * robot.max_wheel_speed
        across = 0.5 * robot.wheel_base * row[parts["angular_speed"]] * robot.max_angular_speed
        now = np.concatenate((speed - across, speed + across))
        # A wheel that slips, or stands as in the beginning, is outside the range of speeds.
        now = np.clip(now, robot.min_wheel_speed, robot.max_wheel_speed)
        changes = np.abs(self.pairs - now).max(axis=1)
        turns = 0.5 * np.abs(self.pairs[:, 1] - self.pairs[:, 0] - now[1] + now[0])
        changes = np.maximum(changes, turns * (self.change / self._turning))
        # The nearest where none of few samples is near enough.
        return np.flatnonzero(changes <= max(self.change, changes.min()) + 1e-9)

    def _rim_clearances(
        self, row: NDArray[np.float64], arcs: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Distance of the rim from the nearest point that the lidar hit [m], ``[K, T]``."""
        closeness = row[self._parts["lidar"]]
        ranges = self.closeness_distance / np.maximum(closeness, 1e-9)
        met = ranges < 0.999 * self._lidar.max_range
        points = self._directions[met] * ranges[met, None] + self._lidar.mount
        if not len(points):
            return np.full(arcs.shape[:2], math.inf)
        gaps = arcs[:, :, None, :] - points
        squares = np.einsum("ktpc,ktpc->ktp", gaps, gaps)
        # What is nearer already counts as if it were as far as it may be, and may not get nearer.
        away = np.hypot(*points.T) if any(self._lidar.mount) else ranges[met]
        spare = np.maximum(self.robot.radius + self.score.least + 1e-9 - away, 0.0)
        return np.asarray((np.sqrt(squares) + spare).min(axis=2) - self.robot.radius)

    def _heading(
        self, target: NDArray[np.float64], distance: float, arcs: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Approach of each arc to its target, from 0 to 1, ``[K]``."""
        left = np.hypot(*(arcs[:, -1] - target).T)
        return np.asarray(0.5 + 0.5 * (distance - left) / self.length)

    def _facing(
        self, target: NDArray[np.float64], window: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Score how well each arc ends facing its target, from 0 to 1, ``[K]``."""
        x, y = (target - self.arcs[window, -1]).T
        return 1.0 - _angles_between(np.arctan2(y, x), self._turned[window]) / math.pi

    def _target(self, row: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        """Direction ``[2]`` and distance [m] of the place to drive to, in the robot's frame."""
        parts = self._parts
        if self.memory == "map":
            direction = row[parts["way_direction"]]
            distance = min(float(row[parts["way_length"]][0]) * DISTANCE_SCALE, _ALONG)
        else:
            direction = row[parts["goal_direction"]]
            distance = float(row[parts["goal_distance"]][0]) * DISTANCE_SCALE
        if self.robot.can_stop:
            direction = self._open_direction(row, direction, distance)
        return direction, distance

    def _open_direction(
        self, row: NDArray[np.float64], wanted: NDArray[np.float64], distance: float
    ) -> NDArray[np.float64]:
        """The direction nearest to the wanted one in which the robot can drive, ``[2]``."""
        # Otherwise it would stand before a wall that the target is behind, and face it.
        rims = self._rim_clearances(row, self._lines)
        blocked = ((rims < self.score.least) & (self._steps <= distance)).any(axis=1)
        off = _angles_between(self._bearings, math.atan2(wanted[1], wanted[0]))
        off[blocked] = math.inf
        nearest = int(off.argmin())
        if blocked.all() or off[nearest] <= math.pi / _LINES:
            return wanted
        return np.asarray(self._lines[nearest, 0] / self._steps[0])


def _angles_between(
    one: NDArray[np.float64], other: NDArray[np.float64] | float
) -> NDArray[np.float64]:
    """Angles between directions, from 0 to π [rad]."""
    return np.abs(np.mod(one - other + math.pi, math.tau) - math.pi)


def _pairs(
    robot: RobotModel, samples: int | None, resolution: float, *, reverses: bool
) -> NDArray[np.float64]:
    """Speeds of the left and the right wheel that a robot may have [m/s], ``[K, 2]``."""
    slow, fast = robot.min_wheel_speed, robot.max_wheel_speed
    if samples is None:
        samples = 1 + max(1, round((fast - slow) / resolution))
    speeds = np.linspace(slow, fast, check_count("samples", samples, least=2))
    if robot.can_stop:
        speeds = np.union1d(speeds.round(9), 0.0)
    return pairs_within(robot.wheel_limits._replace(reverse=reverses), speeds)
