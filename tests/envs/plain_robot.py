"""One robot in a static world in plain Python: the oracle of the compiled loops."""

from __future__ import annotations

import math

import numpy as np

from mpfa_envs import Lidar, Polygon, Task, World
from mpfa_envs.env.config import TaskConfig
from tests.envs.shapes import distance


class PlainRobot:
    """Motion on exact arcs, lidar, observation, Eq. (25) and the ends of an episode."""

    def __init__(
        self, world: World, task: Task, config: TaskConfig, *, step_cost: float = 0.0
    ) -> None:
        self.step_cost = step_cost
        self.world, self.goal, self.config = world, task.goal, config
        self.lidar = config.make_lidar(world)
        x, y, heading = task.start
        self.motion = x, y, math.remainder(heading, math.tau), 0.0, 0.0
        self.wheels = 0.0, 0.0
        self.steps, self.path_length, self.over = 0, 0.0, False
        self.min_clearance = distance(x, y, world) - config.robot.radius

    @property
    def distance(self) -> float:
        """Distance to the goal [m]."""
        return math.dist(self.goal, self.motion[:2])

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        """Observation, reward, terminated and truncated."""
        left, right = self.config.robot.wheel_speeds(action)
        reward = 0.0
        for _ in range(self.config.action_repeat):
            if not self.over:
                reward += self._advance(left, right)
        return self.observe(), reward, self.success or self.collision, self.timeout

    def _advance(self, left: float, right: float) -> float:
        before, far = self.motion, self.distance
        change = self.config.time_step * (self.config.robot.wheel_acceleration or math.inf)
        self.wheels = tuple(
            min(max(wanted, now - change), now + change)
            for now, wanted in zip(self.wheels, (left, right), strict=True)
        )
        self.motion = drive_arc(before, *self.wheels, self.config)
        self.steps += 1
        self.path_length += math.dist(before[:2], self.motion[:2])
        clearance = distance(*self.motion[:2], self.world)
        self.min_clearance = min(self.min_clearance, clearance - self.config.robot.radius)
        self.success = self.distance <= self.config.goal_radius
        self.collision = not self.success and clearance <= self.config.collision_distance
        ended = self.success or self.collision
        self.timeout = not ended and self.steps >= self.config.max_steps
        self.over = ended or self.timeout
        approach = self.config.progress_scale * (far - self.distance)  # Eq. (25)
        return 10.0 if self.success else -5.0 if self.collision else approach - self.step_cost

    def observe(self) -> np.ndarray:
        """The observation, ``[O]``."""
        x, y, heading, speed, turn = self.motion
        robot, near = self.config.robot, self.config.closeness_distance
        ranges = np.array([cast(self.world, x, y, heading + a) for a in self.lidar.angles])
        sectors = np.minimum(ranges, self.lidar.max_range).reshape(self.lidar.sectors, -1).min(1)
        bearing = math.atan2(self.goal[1] - y, self.goal[0] - x) - heading
        numbers = (
            math.cos(bearing),
            math.sin(bearing),
            min(0.3 / self.distance, 1.0),
            self.distance / 10.0,
            speed / robot.max_wheel_speed,
            turn / robot.max_angular_speed,
        )
        return np.concatenate((near / np.maximum(sectors, near), numbers))


def drive_arc(motion: tuple, left: float, right: float, config: TaskConfig) -> tuple:
    """Pose and speeds after a time step: along the chord of an exact arc."""
    x, y, heading = motion[:3]
    speed, turn = 0.5 * (left + right), (right - left) / config.robot.wheel_base
    half = 0.5 * turn * config.time_step
    chord = speed * config.time_step * (math.sin(half) / half if half else 1.0)
    x, y = x + chord * math.cos(heading + half), y + chord * math.sin(heading + half)
    return x, y, math.remainder(heading + 2 * half, math.tau), speed, turn


def cast(world: World, x: float, y: float, angle: float) -> float:
    """Range of a ray to what it meets first [m]; zero in an obstacle."""
    dx, dy = math.cos(angle), math.sin(angle)
    room = world.room
    met = [_at_box(room.x_min, room.y_min, room.x_max, room.y_max, x, y, dx, dy)[1]]
    for box in world.boxes:
        enter, leave = _at_box(box.x_min, box.y_min, box.x_max, box.y_max, x, y, dx, dy)
        if leave >= max(enter, 0.0):
            met.append(max(enter, 0.0))
    for circle in world.cylinders:
        along = (circle.x - x) * dx + (circle.y - y) * dy
        aside = (circle.x - x) * dy - (circle.y - y) * dx
        if abs(aside) <= circle.radius:
            half = math.sqrt(circle.radius**2 - aside**2)
            if along + half >= 0.0:
                met.append(max(along - half, 0.0))
    for polygon in world.polygons:
        met.extend(_at_polygon(polygon, x, y, dx, dy))
    return min(met)


def _at_box(
    x0: float, y0: float, x1: float, y1: float, x: float, y: float, dx: float, dy: float
) -> tuple[float, float]:
    """Where a ray enters and leaves a box [m]."""
    dx, dy = dx + 1e-300, dy + 1e-300
    across, up = sorted(((x0 - x) / dx, (x1 - x) / dx)), sorted(((y0 - y) / dy, (y1 - y) / dy))
    return max(across[0], up[0]), min(across[1], up[1])


def _at_polygon(polygon: Polygon, x: float, y: float, dx: float, dy: float) -> list[float]:
    """Ranges to the edges of a polygon [m], and zero inside."""
    corners = polygon.vertices
    met, crossings = [], 0
    for (x0, y0), (x1, y1) in zip(corners, (*corners[1:], corners[0]), strict=True):
        turn = dx * (y1 - y0) - dy * (x1 - x0)
        if turn:
            along = ((x0 - x) * (y1 - y0) - (y0 - y) * (x1 - x0)) / turn
            share = ((x0 - x) * dy - (y0 - y) * dx) / turn
            if 0.0 <= share <= 1.0 and along >= 0.0:
                met.append(along)
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
            crossings += 1
    return [*met, *([0.0] if crossings % 2 else [])]


def scan(lidar: Lidar, world: World, x: float, y: float, heading: float) -> np.ndarray:
    """Range of every ray [m], ``[rays]``."""
    ranges = [cast(world, x, y, heading + angle) for angle in lidar.angles]
    return np.clip(ranges, 0.0, lidar.max_range)
