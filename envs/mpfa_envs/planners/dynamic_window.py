"""The dynamic window approach: choose the best of the arcs that the robot can drive next."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mpfa_envs.checks import check_count, check_positive
from mpfa_envs.robots.model import RobotModel, resolve_robot
from mpfa_envs.sensing.observation import DISTANCE_SCALE, Memory, observation_slices

_STEP: Final = 0.1
"""Distance between the places on an arc that are tested [m]."""
_ALONG: Final = 1.0
"""Longest part of a path that is followed [m]: its direction holds for little more."""


@dataclass(frozen=True, kw_only=True)
class WindowScore:
    """Weights of the terms of an arc's score, each in [0, 1], and their ends.

    Chosen on validation worlds.
    """

    heading: float = 1.0
    """Weight of driving towards the goal, or along the path on the robot's map."""
    clearance: float = 0.15
    """Weight of the distance from lidar hits."""
    speed: float = 0.1
    """Weight of the forward speed."""
    roomy: float = 0.4
    """Clearances of the rim above this score alike [m]."""
    least: float = 0.03
    """An arc with less clearance of the rim collides [m]."""


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

    In the original a pair is admissible if the robot can stop before it collides. This robot
    neither stops nor reverses, so that arcs have the same length for all speeds, long enough to
    turn round.

    The lidar looks ahead and nothing is remembered: it does not leave a pocket. With
    ``memory="map"`` the heading is that of the path on the robot's map, which leads out.

    Args:
        robot: Whose wheels are driven.
        memory: ``"map"`` if observations are those of ``NavigationEnv(memory="map")``.
        sectors: Number of sectors of the lidar.
        max_range: Range of the lidar [m].
        closeness_distance: That of the environment [m]; None: the environment's default.
        decision: Time between two decisions [s].
        acceleration: By how much a wheel's speed can change [m/s²].
        samples: Number of speeds of each wheel.
        length: Length of the arcs [m].
        score: What arcs are judged by.

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
        robot: str | RobotModel = "turtlebot2",
        memory: Memory = "none",
        sectors: int = 18,
        max_range: float = 10.0,
        closeness_distance: float | None = None,
        decision: float = 0.2,
        acceleration: float = 1.0,
        samples: int = 10,
        length: float = 0.6,
        score: WindowScore | None = None,
    ) -> None:
        self.robot = resolve_robot(robot)
        self.score = score or WindowScore()
        self.max_range = check_positive("max_range", max_range)
        self.closeness_distance = (
            self.robot.collision_distance
            if closeness_distance is None
            else check_positive("closeness_distance", closeness_distance)
        )
        self.change = check_positive("acceleration", acceleration) * check_positive(
            "decision", decision
        )
        """By how much a wheel's speed can change until the next decision [m/s]."""
        self.length = check_positive("length", length)
        self._parts = observation_slices(sectors, memory=memory)
        self.sectors = sectors
        self.observation_size = max(part.stop for part in self._parts.values())
        angles = math.pi * (0.5 - (np.arange(self.sectors) + 0.5) / self.sectors)
        self._directions = np.stack((np.cos(angles), np.sin(angles)), axis=1)
        slow, fast = self.robot.min_wheel_speed, self.robot.max_wheel_speed
        speeds = np.linspace(slow, fast, check_count("samples", samples, least=2))
        self.pairs = np.stack(np.meshgrid(speeds, speeds), axis=-1).reshape(-1, 2)
        """Speeds of the left and the right wheel [m/s], ``[K, 2]``."""
        left, right = self.pairs.T
        self._speeds = 0.5 * (left + right) / fast
        along = np.linspace(0.0, self.length, 1 + max(1, round(self.length / _STEP)))[1:]
        # The curvature is the turning speed over the forward speed.
        half = ((right - left) / (right + left) / self.robot.wheel_base)[:, None] * along
        directions = np.stack((np.cos(half), np.sin(half)), axis=-1)
        # Along the chord of the arc; np.sinc(x) is sin(pi x) / (pi x).
        self.arcs = (along * np.sinc(half / math.pi))[..., None] * directions
        """Places on each arc in the robot's frame [m], ``[K, T, 2]``."""
        self.memory = memory
        self.env_arguments: dict[str, Any] = {
            "robot": robot,
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
        return actions.reshape(*observation.shape[:-1], 2)

    def _best(self, row: NDArray[np.float64]) -> int:
        """Number of the best pair for one observation, ``[O]``."""
        score, window = self.score, self._window(row)
        arcs = self.arcs[window]
        rims = self._rim_clearances(row, arcs)
        collides = rims < score.least
        admissible = ~collides.any(axis=1)
        if not admissible.any():
            return int(window[np.lexsort((rims.min(axis=1), collides.argmax(axis=1)))[-1]])
        room = np.clip(rims.min(axis=1) / score.roomy, 0.0, 1.0)
        total = (
            score.heading * self._heading(row, arcs)
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
        # The nearest where none of few samples is near enough.
        return np.flatnonzero(changes <= max(self.change, changes.min()) + 1e-9)

    def _rim_clearances(
        self, row: NDArray[np.float64], arcs: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Distance of the rim from the nearest point that the lidar hit [m], ``[K, T]``."""
        closeness = row[self._parts["lidar"]]
        ranges = self.closeness_distance / np.maximum(closeness, 1e-9)
        met = ranges < 0.999 * self.max_range
        points = self._directions[met] * ranges[met, None]
        if not len(points):
            return np.full(arcs.shape[:2], math.inf)
        gaps = arcs[:, :, None, :] - points
        squares = np.einsum("ktpc,ktpc->ktp", gaps, gaps)
        return np.sqrt(squares.min(axis=2)) - self.robot.radius

    def _heading(self, row: NDArray[np.float64], arcs: NDArray[np.float64]) -> NDArray[np.float64]:
        """Approach of each arc to its target, from 0 to 1, ``[K]``."""
        parts = self._parts
        if self.memory == "map":
            direction = row[parts["way_direction"]]
            distance = min(float(row[parts["way_length"]][0]) * DISTANCE_SCALE, _ALONG)
        else:
            direction = row[parts["goal_direction"]]
            distance = float(row[parts["goal_distance"]][0]) * DISTANCE_SCALE
        left = np.hypot(*(arcs[:, -1] - distance * direction).T)
        return np.asarray(0.5 + 0.5 * (distance - left) / self.length)
