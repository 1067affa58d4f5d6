"""Model predictive control: the wheel speeds that take the least time on the robot's own map."""

from __future__ import annotations

import cmath
import math
from collections import deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mpfa_envs.checks import check_count, check_positive, check_seed
from mpfa_envs.paths.field_loops import path_lengths
from mpfa_envs.paths.grid_loops import MOVES, STEP_SCALE
from mpfa_envs.planners.predictive_loops import (
    CELL,
    Effort,
    Scene,
    best_plan,
    room_around,
)
from mpfa_envs.robots.resolve import RobotChoice, resolve_robot
from mpfa_envs.safety.loops import least_room, see
from mpfa_envs.sensing.map_loops import BLOCKED, cell_of
from mpfa_envs.sensing.map_memory import RESOLUTION

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mpfa_envs.env.config import TaskConfig
    from mpfa_envs.env.vector import VectorNavigationEnv
    from mpfa_envs.robots.motion_loops import WheelLimits
    from mpfa_envs.sensing.map_loops import MapArrays
    from mpfa_envs.worlds.shapes import Point

_FACTORS: Final = np.array((5, 8, 150, 1000))
"""Cost of a step in a free cell, one near an obstacle, a tight and a blocked one."""
_STEP: Final = RESOLUTION * STEP_SCALE / 5
"""Length of a straight step over its cost [m]."""
_BUCKETS: Final = 2500
"""More than the costliest step costs."""
_AROUND: Final = 3.0
"""By how much a path may be longer to be found in addition to the robot's own [m]."""
_LENGTH: Final = 1.12
"""Length of a plan at full speed [m]."""
_TIME_STEP: Final = 0.1
"""Time step of the environments, unless another is given [s]."""
_HELD: Final = 0.14
"""Length that the robot drives at full speed from decision to decision [m]."""
_TURN: Final = 1.1
"""Angle for whose turn at full speed a radian beside the path counts [rad]."""
_ROUNDS: Final = 3
"""Rounds of samples, the later ones nearer to the best plan."""
_SPEEDS: Final = 9
"""Speeds of a wheel that are tried alone."""
_FEW: Final = 5
"""Speeds of a wheel that are tried after one another."""
_REACHED: Final = 0.94
"""Share of the goal's radius within which a plan ends: the wheels are not exact."""
_WAIT: Final = 0.3
"""Share of a plan's time that it must save to begin without moving."""
_STUCK: Final = 2.5
"""Time after which a robot that has not left a small place is stuck [s]."""
_PLACE: Final = 0.1
"""Radius of such a place [m]."""
_LEAVE: Final = 3.0
"""By how much more it must save until the robot has left a place where it was stuck."""
_LEFT: Final = 0.3
"""Distance from such a place at which it has [m]."""
_RAISED: Final = 25
"""By how much cells cost more before which a robot was stuck: half a meter each."""
_AHEAD: Final = 12
"""Cells of the path ahead of a stuck robot among which the sectors show what closes it."""


@dataclass
class _Field:
    """The plan and the time field of one robot's episode."""

    plan: NDArray[np.float64]
    """Wheel speeds of the time steps ahead [m/s], ``[T, 2]``."""
    goal: Point
    levels: NDArray[np.uint8]
    """The robot's map when the field was found, ``[columns, rows]``."""
    raised: NDArray[np.int64]
    """By how much cells cost more than the map says, as the robot was stuck before them."""
    lengths: NDArray[np.float64]
    """Length of the cheapest path from each cell to the goal [m], ``[columns, rows]``."""
    farthest: float = -math.inf
    """Length above which none was found [m]."""
    left: Point | None = None
    """Place that the robot must leave, as it was stuck there (x, y) [m]."""
    places: deque[Point] = field(default_factory=deque)
    """Where the robot was of late (x, y) [m]."""


class PredictiveControl:
    r"""Sampling model predictive control, a :class:`~mpfa_envs.evaluation.runs.Driver`.

    It has what a policy with a map has: the sectors of the lidar, the speeds, the map of what the
    lidar hit and the pose by odometry. With late orders all of these are of the moment when the
    next order acts. Robot, lidar, filter and time steps are those of the environment.

    - *Cost-to-go.* Dijkstra's algorithm finds the lengths of the cheapest paths to the goal on the
      robot's map. Cells that nothing has hit are free.
    - *Sampling.* Candidates are the last plan, to stand, constant speeds, pairs of speeds after one
      another, and normal samples around the best plan in three rounds of falling spread.
    - *Rollout.* Each plan drives the kinematic model of a differential drive, with its limits of
      speed, turn and acceleration. Its cost is its time, more of it near obstacles, and the time
      from its end to the goal: along the path, to turn to it and to reach full speed.
    - *Terminal constraint.* After its end the plan must stop, or drive a full circle if the robot
      cannot, without coming nearer to what the sectors show than the filter keeps.
    - *Filter.* A plan begins with an action that the :class:`~mpfa_envs.SafetyFilter` lets pass, by
      the test of the filter itself.
    - *Recovery.* If the robot does not leave a place for 2.5 s, cells of the path before it cost
      half a meter more for the rest of the episode, as in guided local search: those where the
      sectors show no room. So another path becomes the cheapest, in the end the one back.

    Args:
        robot: Whose wheels are driven.
        length: Length of a plan at full speed [m].
        samples: Plans that are sampled in each round.
        seed: Seed of the samples, which are the same in each decision.

    Raises:
        ValueError: If a number is out of its range.

    Examples:
        >>> from mpfa_envs import evaluate
        >>> from mpfa_envs.planners import PredictiveControl
        >>> planner = PredictiveControl(robot="kobuki")
        >>> [each.success for each in evaluate(planner, "D", episodes=3)]
        [True, True, True]
    """

    def __init__(
        self,
        *,
        robot: RobotChoice = "turtlebot2",
        length: float = _LENGTH,
        samples: int = 80,
        seed: int = 0,
    ) -> None:
        self.robot = resolve_robot(robot)
        self.length = check_positive("length", length)
        shape = (_ROUNDS, check_count("samples", samples), 4, 2)
        self._noise = np.random.default_rng(check_seed(seed)).standard_normal(shape)
        repeat = max(2, round(_HELD / self.robot.max_wheel_speed / _TIME_STEP))
        self.env_arguments: dict[str, Any] = {
            "robot": self.robot,
            "physics": "kinematic",
            "memory": "map",
            "action_repeat": repeat,
        }
        """Arguments of the environments that it drives in, unless others are given. A slow robot
        holds its actions for longer, as its policies do."""
        self._config: TaskConfig | None = None
        self._fields: dict[int, _Field] = {}

    def begin(self, env: VectorNavigationEnv, robot: int) -> None:
        """Forget the last episode of a robot.

        Raises:
            ValueError: If robots have no map, or the filter cannot keep this robot off obstacles.
        """
        maps, task = env.maps, env.tasks[robot]
        if maps is None:
            raise ValueError(f"memory must be 'map' for mpc, got {env.config.memory!r}")
        if task is None:
            raise ValueError(f"robot {robot} must have begun an episode to plan for")
        if env.config is not self._config:
            self._prepare(env.config)
        limits, repeat = self._body.limits, self._body.repeat
        steps = max(round(self.length / limits.fast / self._body.time_step), 2 * repeat)
        plan = np.full((steps, 2), max(limits.slow, 0.0))
        levels = np.zeros(maps.shapes[robot], np.uint8)
        self._fields[robot] = _Field(
            plan,
            task.goal,
            levels,
            np.zeros_like(_FACTORS, shape=levels.shape),
            np.full(levels.shape, math.inf),
        )

    def _prepare(self, config: TaskConfig) -> None:
        """Take robot, lidar, filter and time steps from a task."""
        self._keep = config.make_filter()
        self._body = body = self._keep.body
        limits = body.limits
        self._tried = _pairs(limits, _SPEEDS), _pairs(limits, _FEW)
        circle = 0
        if limits.slow > 0.0:
            whole = math.tau * body.wheel_base / (limits.fast - limits.slow)
            circle = math.ceil(whole / body.time_step)
        either = limits.reverse and limits.slow < -0.9 * limits.fast
        wait = _WAIT * self.length / limits.fast
        self._effort = Effort(_TURN / config.robot.max_angular_speed, wait, either, circle)
        reach = self.length + limits.fast * (0.5 * limits.fast / limits.acceleration + 0.1)
        half = math.ceil(reach / CELL)
        self._rooms = np.empty((2 * half + 1, 2 * half + 1))
        self._radius = _REACHED * config.goal_radius
        # Set last: what was rejected is rejected again.
        self._config = config

    def drive(
        self,
        env: VectorNavigationEnv,
        robots: NDArray[np.int64],
        observations: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Actions of the N robots, ``[N, 2]``, by their observations, maps and odometry."""
        poses, maps, actions = env.moments[:, 4:7], env.maps, []
        assert maps is not None  # Checked when the episode began.
        slow, fast = self._body.limits.slow, self._body.limits.fast
        for robot, row in zip(robots.tolist(), observations, strict=True):
            known = self._fields[robot]
            pose = tuple(poses[robot].tolist())
            scene = self._scene(known, row, pose, maps, robot)
            effort = self._effort
            if known.left is not None:
                effort = effort._replace(stand=_LEAVE * effort.stand)
            time = best_plan(known.plan, *self._tried, self._noise, scene, self._body, effort)
            if time == math.inf:
                known.plan[:] = max(slow, 0.0)
            actions.append(2.0 * (known.plan[0] - slow) / (fast - slow) - 1.0)
        return self._keep(observations, np.array(actions, dtype=np.float32))

    def _place(
        self, known: _Field, maps: MapArrays, robot: int, pose: tuple[float, ...]
    ) -> tuple[float, float]:
        """Column and row of a robot on its map, whose time field is found if it has changed."""
        columns, rows = maps.shapes[robot]
        levels, origin = maps.levels[robot, :columns, :rows], maps.origins[robot]
        u, v = ((pose[:2] - origin) / RESOLUTION).tolist()
        cell = cell_of(u, columns), cell_of(v, rows)
        stuck = self._is_stuck(known, (pose[0], pose[1]))
        if stuck:
            self._penalize(known, (u, v, pose[2]))
        near = known.lengths[cell] + 0.5 * _AROUND <= known.farthest
        if stuck or not near or not np.array_equal(levels, known.levels):
            known.levels = levels.copy()
            goal_u, goal_v = ((known.goal - origin) / RESOLUTION).tolist()
            away = np.hypot(np.arange(columns)[:, None] - goal_u, np.arange(rows) - goal_v)
            seeds = np.argwhere(away <= self._radius / RESOLUTION - 0.5)
            seeds = np.concatenate((seeds, [[cell_of(goal_u, columns), cell_of(goal_v, rows)]]))
            known.lengths = path_lengths(
                np.minimum(_FACTORS[levels] + known.raised, _FACTORS[BLOCKED]),
                seeds,
                np.zeros(len(seeds)),
                MOVES,
                _STEP,
                math.inf,
                cell,
                _AROUND / _STEP,
                _BUCKETS,
            )
            known.farthest = float(known.lengths[cell]) + _AROUND
        return u, v

    def _is_stuck(self, known: _Field, place: Point) -> bool:
        """Return True if a robot has not left a small place for a while."""
        known.places.append(place)
        if known.left is not None and math.dist(place, known.left) > _LEFT:
            known.left = None
        held = self._body.repeat * self._body.time_step
        if len(known.places) <= _STUCK / held:
            return False
        known.places.popleft()
        stuck = all(math.dist(place, last) <= _PLACE for last in known.places)
        if stuck:
            known.places.clear()
            known.left = place
        return stuck

    def _penalize(self, known: _Field, place: tuple[float, float, float]) -> None:
        """Make the path costlier where the sectors show no room, for the rest of the episode."""
        u, v, heading = place
        columns, rows = known.lengths.shape
        i, j = cell_of(u, columns), cell_of(v, rows)
        middle = len(self._rooms) // 2
        for _ in range(_AHEAD):
            first, low = max(i - 1, 0), max(j - 1, 0)
            around = known.lengths[first : i + 2, low : j + 2]
            across, up = np.unravel_index(around.argmin(), around.shape)
            i, j = first + int(across), low + int(up)
            away = RESOLUTION / CELL * complex(i - u, j - v) * cmath.exp(-1j * heading)
            at = middle + round(away.real), middle + round(away.imag)
            if min(at) >= 0 and max(at) < len(self._rooms) and self._rooms[at] < 0.0:
                break
        known.raised[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2] += _RAISED

    def _scene(
        self,
        known: _Field,
        observation: NDArray[np.float32],
        pose: tuple[float, ...],
        maps: MapArrays,
        robot: int,
    ) -> Scene:
        """What a robot knows when it decides."""
        seen, body = self._keep.seen(observation[None]), self._body
        ranges, directions, origins, speeds = seen
        points, counts = np.empty((1, ranges.shape[1], 3)), np.empty(1, np.int64)
        see(seen, body, 0.0, points, counts)
        least = least_room(points[0, : counts[0]], body)
        room_around(ranges[0], directions, origins, body, self._rooms)
        place = self._place(known, maps, robot, pose)
        cosine, sine = math.cos(pose[2]), math.sin(pose[2])
        across, up = known.goal[0] - pose[0], known.goal[1] - pose[1]
        goal = across * cosine + up * sine, up * cosine - across * sine, self._radius
        field = known.levels, known.lengths, known.farthest, RESOLUTION
        return Scene(self._rooms, points, counts, least, speeds, *field, (*place, pose[2]), goal)


def _pairs(limits: WheelLimits, count: int) -> NDArray[np.float64]:
    """Speeds of the left and the right wheel that are tried [m/s], ``[K, 2]``."""
    speeds = np.linspace(limits.slow, limits.fast, count)
    pairs = np.stack(np.meshgrid(speeds, speeds), axis=-1).reshape(-1, 2)
    can = 0.5 * np.abs(pairs[:, 1] - pairs[:, 0]) <= limits.across + 1e-9
    return np.asarray(pairs[can & (limits.reverse | (pairs.sum(axis=1) >= 0.0))])
